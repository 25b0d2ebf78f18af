"""Commands about a run: serve its policy, relearn tasks, diagnose, explain, view and check it."""

import asyncio
import contextlib
import socket
from dataclasses import asdict
from importlib import import_module
from pathlib import Path
from typing import Annotated

from libero_env.cli.options import Answer, Device, Field, FilePath, Natural, Positional, Processes, Seed
from libero_eval.requests import (
    DiagnoseRequest,
    RelearnRequest,
    SaliencyRequest,
    ViewRequest,
)
from lifelong.errors import require_run


def serve(
    run: Positional[FilePath],
    *,
    after: Natural | None = None,
    host: str = "127.0.0.1",
    port: Annotated[int, Field(ge=0, le=65535)] = 8000,
    seed: Seed = 0,
    device: Device = "auto",
    allow: tuple[str, ...] = (),
    policy_threads: Processes = 1,
) -> None:
    """Serve a run's policy in openpi's WebSocket protocol until interrupted.

    Args:
        run: A run's directory, or one of its checkpoints.
        after: The policy after this task, from 0 (default: the last).
        host: Address to listen on.
        port: Port to listen on, 0 for a free one.
        seed: Seed of stochastic policies, for clients that send none.
        device: auto, cpu, cuda, cuda:1.
        allow: Packages of others whose classes the run's configuration may name (default: none; their code is
            executed).
        policy_threads: Threads of a policy on the CPU, as of `libero eval`.
    """
    require_run(run)
    import torch

    from libero_eval.servers.serving import PolicyServer, ServedPolicy
    from lifelong.evaluation.restore import restore

    served = ServedPolicy(restore(run, after=after, device=device, allow=allow), seed=seed)
    if served.run.device.type == "cpu":
        torch.set_num_threads(policy_threads)
    server = PolicyServer(served.metadata, served.session, host=host, port=port)

    def ready(port: int) -> None:
        at = f"[{host}]" if ":" in host else host
        print(f"serving {run} after task {served.run.learned} at ws://{at}:{port}", flush=True)

    with contextlib.suppress(asyncio.CancelledError):
        asyncio.run(server.run(ready))


def relearn(request: RelearnRequest) -> Answer:
    """Relearn tasks of a run; print the savings, and the page."""
    require_run(request.run)
    from libero_eval.relearning import relearn as measure
    from lifelong.pretraining import initial_policy
    from lifelong.report.page import write_report
    from lifelong.results.relearning import by_measure, savings, savings_table

    records = measure(request, initial_policy(request.run, weights=request.initial, allow=request.allow))
    rows = [{**asdict(row), "share": row.share} for part in by_measure(records) for row in savings(part)]
    tables = "\n\n".join(str(savings_table(part)) for part in by_measure(records))
    return Answer(tables, rows, write_report([request.run]))


def diagnose(request: DiagnoseRequest) -> Answer:
    """Tell why a run forgets, a line for each finding; print the page."""
    require_run(request.run)
    from libero_eval.diagnosis.measure import diagnose as measure
    from libero_eval.diagnosis.page import findings, write_diagnosis

    found = measure(request)
    return Answer("\n".join(findings(found)), asdict(found), write_diagnosis(found, request.run))


def saliency(request: SaliencyRequest) -> Answer:
    """Draw the saliency of an episode of a run; print the sheet, and the page."""
    require_run(request.run)
    from libero_eval.saliency import draw_saliency
    from lifelong.report.page import write_report

    path = draw_saliency(request)
    return Answer(str(path), {"sheet": path}, write_report([path.parents[1]]))


def check(
    runs: Positional[Annotated[tuple[FilePath, ...], Field(min_length=1)]],
) -> Answer:
    """Read everything in run directories and change nothing.

    The configuration, every line of results.jsonl, every checkpoint with its checksum, results.json against the
    records, and evaluations. The exit status is 1 where something is damaged or lost.

    Args:
        runs: Run directories, or folders of them.
    """
    for run in runs:
        require_run(run)
    from libero_eval.check import examine, find_runs

    examined = [examine(run) for run in dict.fromkeys(run for path in runs for run in find_runs(path))]
    rows = [{"path": e.path, "sound": e.sound, **e.counts, "findings": list(e.findings)} for e in examined]
    lines = []
    for e in examined:
        counts = ", ".join(f"{count} {name}" for name, count in e.counts.items())
        lines.append(f"{e.path}: {'sound' if e.sound else 'FAULTS'} ({counts})")
        lines += [f"  {finding.level}: {finding.text}" for finding in e.findings]
    return Answer("\n".join(lines), rows, status=int(not all(e.sound for e in examined)))


def view(request: ViewRequest) -> None:
    """Show a scene in the browser until interrupted; print its address."""
    if not Path(request.what).exists() and not request.what.endswith(".hdf5"):
        from libero_env.tasks import find_tasks

        find_tasks([request.what])
    stage = import_module("libero_integrations.stage").Stage(request)
    viewer = import_module("libero_integrations.viewer").Viewer(stage, request.host, request.port)
    try:
        viewer.open(viewer.stage.initial)
        port = viewer.port
        print(f"showing {request.what} at http://localhost:{port}", flush=True)
        print(f"from another machine: ssh -L {port}:localhost:{port} {socket.gethostname()}", flush=True)
        viewer.run()
    finally:
        viewer.close()
