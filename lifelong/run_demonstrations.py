"""The demonstrations that a run learns from: found, recorded, and compared with those that it learned from before."""

import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from itertools import chain
from pathlib import Path
from typing import Any

from libero_env.demos.agreement import stated_facts
from libero_env.demos.generate import LaterDemos
from libero_env.demos.read import demo_lengths, demo_origin
from libero_env.tasks import Task
from lifelong.context import RunContext
from lifelong.data.demonstrations import DemoDatasets, check_pairing, demo_copies, find_demos, perturb_demos
from lifelong.errors import DataError
from lifelong.results.provenance import changed_demonstrations
from lifelong.results.records import DemonstrationsRecord, PhaseRecord, RunRecord
from lifelong.results.run_directory import read_saved_config
from lifelong.streams import learning_stages
from lifelong.training.fit import check_warmup


def later_demos(context: RunContext) -> AbstractContextManager[LaterDemos | None]:
    """Return what records demonstrations while the first tasks are learned, where nothing depends on later ones."""
    derived = context.data.copies or any(context.perturbed) or context.data.pairing == "stored"
    if derived or not context.works_beside or not context.fit.steps_per_epoch:
        return nullcontext()
    first = learning_stages(context.algorithm, context.group_sizes)[0]
    return LaterDemos([context.tasks[task] for task in first])


def open_datasets(
    context: RunContext, others: Sequence[Task], learned: bool = False, later: LaterDemos | None = None
) -> DemoDatasets:
    """Find the tasks' demonstrations, record those that are missing, and return their windows.

    Args:
        others: Tasks that the run learns besides, of which `data.files` may have files, too.
        learned: Whether they are learned already, by a pretraining that runs with the same demonstrations share.
        later: Records those of later tasks meanwhile; what all are is noted when they are there.
    """
    paths, copies = context.ranks.broadcast(_find_demos, context, others, learned, later)
    noted = later is None or later.done

    def wait(path: Path) -> None:
        nonlocal noted
        if not noted and later is not None:
            later.wait(path)
            if noted := later.done:
                _record_demonstrations(context, paths, learned)

    fixed = (context.policy.spec, context.languages, context.data, context.device)
    return DemoDatasets(paths, context.demos, *fixed, copies, wait)


def _find_demos(
    context: RunContext, others: Sequence[Task], learned: bool, later: LaterDemos | None
) -> tuple[list[Path], list[tuple[Path, ...]]]:
    """Return the demonstration file of each task, and those of further copies."""
    began = time.perf_counter()
    record = None if later is None else later.ensure
    recorded = find_demos(context.tasks, context.demos, context.data, context.progress, others, record=record)
    own = (context.tasks, context.demos, context.perturbed, context.data, context.progress)
    paths, copies = perturb_demos(recorded, *own), demo_copies(recorded, *own)
    check_pairing([*paths, *chain(*copies)], context.data)
    if (
        not context.fit.steps_per_epoch and len(context.directory.log.read().of(RunRecord)) == 1
    ):  # it is begun
        stages = learning_stages(context.algorithm, context.group_sizes)
        pairing = context.data.pairing
        smallest = min(
            sum(sum(demo_lengths(paths[task], context.demos[task], pairing=pairing)) for task in stage)
            for stage in stages
        )
        check_warmup(context.fit, context.algorithm, smallest * (1 + context.data.copies))
    if later is None or later.done:
        _record_demonstrations(context, recorded, learned)
    context.directory.log.append(PhaseRecord(phase="demos", seconds=time.perf_counter() - began))
    return paths, copies


def _record_demonstrations(context: RunContext, paths: Sequence[Path], learned: bool) -> None:
    """Record what the tasks' demonstrations are; say where a resume learns from others than the run did before."""
    origins = [demo_origin(path, count) for path, count in zip(paths, context.demos, strict=True)]
    facts = [stated_facts(path, context.data.labels) for path in paths]
    record = DemonstrationsRecord(
        counts=tuple(one.count for one in origins),
        generators=tuple(one.generator for one in origins),
        digests=tuple(one.digest for one in origins),
        models=tuple(one["models"] for one in facts),
        labels=tuple(one["labels"] for one in facts),
    )
    log = context.directory.log
    before = log.read().of(DemonstrationsRecord)
    names = [t.name for t in context.tasks]
    changes = changed_demonstrations(before[-1], record, names) if before else ""
    if changes and learned:
        raise DataError(
            f"what {context.directory.path} has learned cannot be shared by a run {changes.partition(':')[0]}; "
            "use another runs_dir (for a run that is finished, run_id=NAME as well), or move that folder away"
        )
    if not before or before[-1] != record:
        log.append(record)
    if changes:
        print(f"resumed {changes}", file=sys.stderr)


def check_learned_from(context: RunContext, pretraining: RunContext | None, plain: Mapping[str, Any]) -> None:
    """Check that another `data.folder` than before has the demonstrations that a finished run learned from.

    Raises:
        DataError: It has others.
    """
    was = read_saved_config(context.directory.path / "config.yaml").get("data", {}).get("folder")
    if was != plain["data"].get("folder") and context.directory.log.read().demonstrations is not None:
        others = pretraining.tasks if pretraining else ()
        found = find_demos(context.tasks, context.demos, context.data, context.progress, others)
        _record_demonstrations(context, found, learned=True)
