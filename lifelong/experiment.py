"""A run: everything built from its configuration, the task sequence walked, the results summed up."""

import hashlib
import json
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf

from libero_env.envs.batch import BatchEnv
from libero_env.tasks import Task
from lifelong.algorithms import Algorithm
from lifelong.build import build
from lifelong.checkpoints import load_weights
from lifelong.data.demonstrations import DemoDatasets, find_demos
from lifelong.data.settings import CAMERAS, DataSettings
from lifelong.evaluation.environments import EnvPool
from lifelong.evaluation.settings import EvalSettings
from lifelong.policies import Policy
from lifelong.pretraining import pretrain, weights_of
from lifelong.report.page import write_report
from lifelong.results.records import PhaseRecord, RunEndRecord, start_record, utc_now
from lifelong.results.run_directory import RunDirectory, decisive
from lifelong.results.summary import write_summary
from lifelong.seeding import seeded
from lifelong.sequence import Parts, TaskSequence
from lifelong.settings import BenchmarkSettings, PretrainSettings, RunSettings
from lifelong.streams import StreamSettings
from lifelong.tracking import Tracker
from lifelong.training.distributed import Ranks
from lifelong.training.fit import BatchAugmentation
from lifelong.training.precision import check_compiler, deterministic, keep_freed_memory
from lifelong.training.settings import FitSettings
from lifelong.types import PolicySpec

GROUPS = (
    *("algo", "benchmark", "stream", "pretrain", "policy", "data"),
    *("augmentation", "train", "eval", "language", "wandb"),
)
PRETRAIN_KEYS = ("pretrain", "policy", "data", "augmentation", "train", "language", "seed", "init_from")
INIT = 0  # first word of the seed of the policy's initial weights, see lifelong.sequence


def run(config: DictConfig, names: Mapping[str, str], ranks: Ranks = Ranks()) -> Path:  # noqa: B008 - frozen
    """Run a configuration to its end, or go on with a run that was interrupted.

    Args:
        config: What configs/config.yaml composes.
        names: The file chosen in each group, such as algo -> ewc; they name the run.
        ranks: This process among those that train together.

    Returns:
        The run's directory, with results.json and report.html in it.

    Raises:
        LiberoError: Something in the configuration, the data or the directory does not work.
    """
    settings = RunSettings(**{str(k): v for k, v in config.items() if k not in GROUPS})
    if settings.threads:
        torch.set_num_threads(settings.threads)
    keep_freed_memory()
    with deterministic(settings.deterministic):
        return _run(config, names, settings, ranks)


def _run(config: DictConfig, names: Mapping[str, str], settings: RunSettings, ranks: Ranks) -> Path:
    # before anything is written: what cannot work leaves no trace
    built = _build_all(config, settings, ranks)
    label = "_".join(
        [names["policy"], f"seed{settings.seed}", *([settings.run_id] if settings.run_id else [])]
    )
    name = f"{names['benchmark']}/{names['algo']}/{label}"
    directory = RunDirectory(Path(settings.runs_dir) / name)
    plain: Any = OmegaConf.to_container(config, resolve=True)
    with directory.opened(plain, settings.resume) if ranks.first else nullcontext():
        finished = ranks.broadcast(lambda: directory.log.read().finished)
        if finished and ranks.first:
            print(f"{directory.path} is finished; its report is drawn anew (resume=false runs it again)")
        if not finished and ranks.first:
            built.tracker.start(name, str(directory.path), plain)
            _record_start(directory, names, settings.seed, built.tasks, plain, built.group_size)
        if not finished:
            _walk(built, settings, directory, ranks, plain)
        if ranks.first:
            built.tracker.finish()
            _sum_up(directory, plain)
        return directory.path


@dataclass(frozen=True)
class Built:
    """What the configuration describes, before any data are made or simulations opened."""

    tasks: tuple[Task, ...]
    data: DataSettings
    languages: torch.Tensor  # (K, L)
    group_size: int
    stream: StreamSettings
    counts: tuple[int, ...]  # demonstrations of each task
    pretrain: PretrainSettings
    first_tasks: tuple[Task, ...]  # learned before the sequence
    first_languages: torch.Tensor
    spec: PolicySpec
    policy: Policy
    algorithm: Algorithm
    fit: FitSettings
    eval: EvalSettings
    augment: BatchAugmentation
    tracker: Tracker
    device: torch.device


def _build_all(config: DictConfig, settings: RunSettings, ranks: Ranks) -> Built:
    benchmark: BenchmarkSettings = build(config.benchmark)
    tasks, device = benchmark.sequence(), ranks.device(settings.device)
    stream: StreamSettings = build(config.stream)
    before: PretrainSettings = build(config.pretrain)
    first = before.sequence()
    data: DataSettings = build(config.data)
    fit: FitSettings = build(config.train)
    if fit.compile != "off":
        check_compiler(device)
    languages = ranks.broadcast(lambda: build(config.language).embed([t.language for t in (*first, *tasks)]))
    spec = data.spec(languages.shape[1])
    with seeded(settings.seed, INIT):
        policy = build(config.policy, spec=spec).to(device)
    if settings.init_from is not None:
        weights, file = weights_of(Path(settings.init_from).expanduser())
        load_weights(policy, weights, file)
    return Built(
        tasks=tasks,
        data=data,
        languages=languages[len(first) :],
        group_size=benchmark.group_size,
        stream=stream,
        counts=stream.demos(data.demos, len(tasks), benchmark.group_size),
        pretrain=before,
        first_tasks=first,
        first_languages=languages[: len(first)],
        spec=spec,
        policy=policy,
        algorithm=build(config.algo),
        fit=fit,
        eval=build(config.eval),
        augment=build(config.augmentation),
        tracker=build(config.wandb),
        device=device,
    )


def _record_start(
    directory: RunDirectory,
    names: Mapping[str, str],
    seed: int,
    tasks: tuple[Task, ...],
    config: Any,
    group_size: int,
) -> None:
    directory.log.append(
        start_record(
            algo=names["algo"],
            benchmark=names["benchmark"],
            policy=names["policy"],
            seed=seed,
            preset=names.get("preset", ""),
            tasks=[t.name for t in tasks],
            instructions=[t.language for t in tasks],
            config=OmegaConf.to_yaml(OmegaConf.create(config)),
            group_size=group_size,
        )
    )


def _walk(
    built: Built, settings: RunSettings, directory: RunDirectory, ranks: Ranks, plain: Mapping[str, Any]
) -> None:
    """Make sure of the demonstrations and learn the sequence."""
    began = time.perf_counter()
    progress = sys.stderr.isatty() if settings.progress is None else settings.progress
    progress = progress and ranks.first
    paths = ranks.broadcast(_demos, built.tasks, built.counts, built.data, directory, progress)
    with EnvPool(lambda key: _env(built, key), built.eval.open_environments) as envs:
        parts = Parts(
            instructions=tuple(t.language for t in built.tasks),
            languages=built.languages,
            datasets=DemoDatasets(paths, built.counts, built.spec, built.languages, built.data, built.device),
            policy=built.policy,
            algorithm=built.algorithm,
            envs=envs,
            fit=built.fit,
            eval=built.eval,
            augment=built.augment,
            directory=directory,
            tracker=built.tracker,
            seed=settings.seed,
            device=built.device,
            progress=progress,
            ranks=ranks,
            stream=built.stream,
            group_size=built.group_size,
        )
        _pretrain(built, parts, directory, plain)
        TaskSequence(parts).run()
    if ranks.first:
        directory.log.append(RunEndRecord(seconds=time.perf_counter() - began, finished=utc_now()))


def _env(built: Built, key: tuple[int, int]) -> BatchEnv:
    task, simulations = key
    return BatchEnv(
        built.tasks[task],
        simulations,
        num_threads=built.eval.sim_threads,
        cameras=tuple(CAMERAS[view] for view in built.spec.views),
        camera_size=built.spec.image_size,
        horizon=built.eval.horizon + built.eval.settle_steps,
    )


def _demos(
    tasks: tuple[Task, ...],
    counts: Sequence[int],
    data: DataSettings,
    directory: RunDirectory,
    progress: bool,
) -> list[Path]:
    """The demonstration file of each task, and a record of how long that took."""
    began = time.perf_counter()
    paths = find_demos(tasks, counts, data, progress)
    directory.log.append(PhaseRecord(phase="demos", seconds=time.perf_counter() - began))
    return paths


def _pretrain(built: Built, parts: Parts, directory: RunDirectory, plain: Mapping[str, Any]) -> None:
    """Let the policy learn what comes before the sequence, unless the sequence has begun or nothing does."""
    tasks, ranks, began = built.first_tasks, parts.ranks, time.perf_counter()
    if not tasks or ranks.broadcast(lambda: directory.started):
        return
    kept = {key: plain[key] for key in PRETRAIN_KEYS}
    digest = hashlib.sha256(json.dumps(decisive(kept), sort_keys=True).encode()).hexdigest()[:12]
    own = RunDirectory(Path(plain["runs_dir"]) / "pretrain" / str(built.pretrain.suite) / digest)
    counts = [built.pretrain.demos or built.data.demos] * len(tasks)
    with own.opened(kept, resume=True) if ranks.first else nullcontext():
        done = ranks.broadcast(lambda: own.log.read().finished)
        if not done and ranks.first:
            print(
                f"Before the sequence: {len(tasks)} tasks of {built.pretrain.suite} in {own.path}", flush=True
            )
            names = {"algo": "multitask", "benchmark": str(built.pretrain.suite), "policy": "pretrained"}
            _record_start(own, names, parts.seed, tasks, kept, 1)
        paths = ranks.broadcast(_demos, tasks, counts, built.data, own, parts.progress)
        pretrain(
            parts,
            instructions=tuple(t.language for t in tasks),
            languages=built.first_languages,
            datasets=DemoDatasets(paths, counts, built.spec, built.first_languages, built.data, built.device),
            directory=own,
            epochs=built.pretrain.epochs or built.fit.epochs,
        )
        if not done and ranks.first:
            own.log.append(RunEndRecord(seconds=time.perf_counter() - began, finished=utc_now()))
    if ranks.first:
        directory.log.append(PhaseRecord(phase="pretrain", seconds=time.perf_counter() - began))


def _sum_up(directory: RunDirectory, config: Mapping[str, Any]) -> None:
    """Write results.json and the report."""
    results = directory.log.read()
    write_summary(directory.path / "results.json", results, config)
    page = write_report([directory.path])
    print(f"{results.learned_tasks()} tasks learned. Report: {page}")
