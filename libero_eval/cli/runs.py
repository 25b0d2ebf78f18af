"""Commands about a run: serve its policy, relearn its tasks, show where it looks, check its directory."""

import asyncio
import contextlib
from typing import Annotated

from libero_env.cli.options import (
    Device,
    Field,
    FilePath,
    Horizon,
    Natural,
    Positional,
    Positive,
    Processes,
    Seed,
)
from libero_env.text import to_json


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
    import torch

    from libero_eval.servers.serving import PolicyServer, ServedPolicy
    from lifelong.evaluation.restore import restore

    served = ServedPolicy(restore(run, after=after, device=device, allow=allow), seed=seed)
    if served.run.device.type == "cpu":
        torch.set_num_threads(policy_threads)
    server = PolicyServer(served.metadata, served.session, host=host, port=port)

    def ready(port: int) -> None:
        print(f"serving {run} after task {served.run.learned} at ws://{host}:{port}", flush=True)

    with contextlib.suppress(asyncio.CancelledError):
        asyncio.run(server.run(ready))


def relearn(
    run: Positional[FilePath],
    *,
    tasks: tuple[Natural, ...] = (),
    steps: Positive = 400,
    every: Positive = 20,
    tolerance: Annotated[float, Field(ge=0, le=10)] = 0.05,
    held_out: Annotated[int, Field(ge=1, le=1000)] = 5,
    episodes: Natural = 0,
    initial: FilePath | None = None,
    device: Device = "auto",
    allow: tuple[str, ...] = (),
) -> None:
    """Measure how many steps a forgotten task of a run takes until it is back, and write the run's report again.

    Args:
        run: The directory of a finished run.
        tasks: Positions in the run's sequence, from 0 (default: all but the last).
        steps: Steps until it is given up.
        every: Steps between measurements.
        tolerance: Share by which the error may exceed that just after learning, or the difference by which success may
            fall short of it.
        held_out: Demonstrations to measure the error on, after those that were learned from.
        episodes: Rollouts to measure success by, instead of the error; 0: the error.
        initial: The pretrained weights that the run began with: a finished run, or one of its checkpoints.
        device: auto, cpu, cuda, cuda:1.
        allow: Packages of others whose classes the run's configuration may name (default: none; their code is
            executed).
    """
    from libero_eval.relearning import RelearnSettings
    from libero_eval.relearning import relearn as measure
    from lifelong.pretraining import initial_policy
    from lifelong.report.page import write_report
    from lifelong.results.relearning import read_relearning, savings_tables

    measure(
        run,
        initial_policy(run, weights=initial, allow=allow),
        tasks=tasks or None,
        settings=RelearnSettings(steps, every, tolerance, held_out, episodes),
        device=device,
        allow=allow,
    )
    print(savings_tables(read_relearning(run)))
    print(write_report([run]))


def saliency(
    run: Positional[FilePath],
    *,
    task: Natural = 0,
    after: Natural | None = None,
    start: Annotated[int, Field(ge=0, le=49)] = 0,
    moments: Annotated[int, Field(ge=1, le=100)] = 6,
    stride: Annotated[float, Field(ge=1, le=128)] = 8.0,
    horizon: Horizon = 200,
    device: Device = "auto",
    allow: tuple[str, ...] = (),
) -> None:
    """Draw where a policy looks during a rollout, and write the run's report again.

    Args:
        run: A run's directory, or one of its checkpoints.
        task: Position in the run's sequence.
        after: The policy after this task, from 0 (default: the last).
        start: Initial state of the rollout.
        moments: Number of images.
        stride: Distance of two places in pixels of a 128-pixel image.
        horizon: Maximum number of control steps.
        device: auto, cpu, cuda, cuda:1.
        allow: Packages of others whose classes the run's configuration may name (default: none; their code is
            executed).
    """
    from libero_eval.saliency import SaliencySettings, draw_saliency
    from lifelong.report.page import write_report

    settings = SaliencySettings(stride=stride)
    path = draw_saliency(
        run,
        task=task,
        after=after,
        start=start,
        moments=moments,
        horizon=horizon,
        settings=settings,
        device=device,
        allow=allow,
    )
    print(path)
    print(write_report([path.parents[1]]))


def check(
    runs: Positional[Annotated[tuple[FilePath, ...], Field(min_length=1)]], *, json: bool = False
) -> int:
    """Read everything in run directories and change nothing.

    The configuration, every line of results.jsonl, every checkpoint with its checksum, results.json against the
    records, and evaluations. The exit status is 1 where something is damaged or lost.

    Args:
        runs: Run directories, or folders of them.
        json: Print the findings as JSON.
    """
    from libero_eval.check import examine, find_runs

    examined = [examine(run) for run in dict.fromkeys(run for path in runs for run in find_runs(path))]
    if json:
        rows = [
            {"path": e.path, "sound": e.sound, **e.counts, "findings": list(e.findings)} for e in examined
        ]
        print(to_json(rows), end="")
    else:
        for e in examined:
            counts = ", ".join(f"{count} {name}" for name, count in e.counts.items())
            print(f"{e.path}: {'sound' if e.sound else 'FAULTS'} ({counts})")
            for finding in e.findings:
                print(f"  {finding.level}: {finding.text}")
    return int(not all(e.sound for e in examined))
