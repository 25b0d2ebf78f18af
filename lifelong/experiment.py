"""A run: everything built from its configuration, the task sequence walked, the results summed up."""

import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from weakref import WeakValueDictionary

import torch
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from libero_env.demos_generate import ensure_demos
from libero_env.tasks import Task
from libero_env.vector import BatchEnv
from lifelong.algorithms import Algorithm
from lifelong.data import SequenceVLDataset
from lifelong.distributed import Ranks
from lifelong.evaluation import EnvPool, EvalSettings
from lifelong.nn.precision import check_compiler, deterministic
from lifelong.policies import Policy
from lifelong.records import PhaseRecord, RunEndRecord, TaskEndRecord, start_record, utc_now
from lifelong.report import write_report
from lifelong.results import write_summary
from lifelong.rundir import RunDirectory
from lifelong.sequence import Parts, TaskSequence
from lifelong.settings import CAMERAS, BenchmarkSettings, DataSettings, RunSettings
from lifelong.tracking import Tracker
from lifelong.training import BatchAugmentation, FitSettings, seeded
from lifelong.types import PolicySpec

GROUPS = ("algo", "benchmark", "policy", "data", "augmentation", "train", "eval", "language", "wandb")
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
    with deterministic(settings.deterministic):
        return _run(config, names, settings, ranks)


def _run(config: DictConfig, names: Mapping[str, str], settings: RunSettings, ranks: Ranks) -> Path:
    # before anything is written: what cannot work leaves no trace
    built = _build_all(config, settings, ranks)
    label = "_".join([names["policy"], f"seed{settings.seed}", *([settings.run_id] if settings.run_id else [])])
    name = f"{names['benchmark']}/{names['algo']}/{label}"
    directory = RunDirectory(Path(settings.runs_dir) / name)
    plain: Any = OmegaConf.to_container(config, resolve=True)
    with directory.opened(plain, settings.resume) if ranks.first else nullcontext():
        finished = ranks.share(lambda: directory.log.read().finished)
        if finished and ranks.first:
            print(f"{directory.path} is finished; its report is drawn anew (resume=false runs it again)")
        if not finished and ranks.first:
            built.tracker.start(name, str(directory.path), plain)
            _record_start(directory, names, settings.seed, built.tasks, plain)
        if not finished:
            _walk(built, settings, directory, ranks)
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
    spec: PolicySpec
    policy: Policy
    algorithm: Algorithm
    fit: FitSettings
    eval: EvalSettings
    augment: BatchAugmentation
    tracker: Tracker
    device: torch.device


def _build_all(config: DictConfig, settings: RunSettings, ranks: Ranks) -> Built:
    benchmark: BenchmarkSettings = _build(config.benchmark)
    tasks, device = benchmark.sequence(), ranks.device(settings.device)
    data: DataSettings = _build(config.data)
    fit: FitSettings = _build(config.train)
    if fit.compile != "off":
        check_compiler(device)
    languages = ranks.share(lambda: _build(config.language).embed([t.language for t in tasks]))
    spec = data.spec(languages.shape[1])
    with seeded(settings.seed, INIT):
        policy = _build(config.policy, spec=spec).to(device)
    return Built(
        tasks=tasks,
        data=data,
        languages=languages,
        spec=spec,
        policy=policy,
        algorithm=_build(config.algo),
        fit=fit,
        eval=_build(config.eval),
        augment=_build(config.augmentation),
        tracker=_build(config.wandb),
        device=device,
    )


def _build(node: DictConfig, **more: Any) -> Any:
    """The object a node of the configuration describes, with plain lists and dictionaries inside."""
    return instantiate(node, _convert_="all", _partial_=True)(**more)


def _record_start(
    directory: RunDirectory, names: Mapping[str, str], seed: int, tasks: tuple[Task, ...], config: Any
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
        )
    )


def _walk(built: Built, settings: RunSettings, directory: RunDirectory, ranks: Ranks) -> None:
    """Make sure of the demonstrations and learn the sequence."""
    began = time.perf_counter()
    progress = sys.stderr.isatty() if settings.progress is None else settings.progress
    progress = progress and ranks.first
    paths = ranks.share(_demos, built.tasks, built.data, directory, progress)
    with EnvPool(lambda key: _env(built, key), built.eval.open_environments) as envs:
        parts = Parts(
            instructions=tuple(t.language for t in built.tasks),
            languages=built.languages,
            datasets=DemoDatasets(paths, built.spec, built.languages, built.data, built.device),
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
        )
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
    tasks: tuple[Task, ...], data: DataSettings, directory: RunDirectory, progress: bool
) -> dict[int, Path]:
    """The demonstration file of each task; recorded now where there is none."""
    began = time.perf_counter()
    paths = ensure_demos(
        tasks,
        data.demos,
        camera_size=(data.image_size, data.image_size),
        root=data.folder,
        progress=progress,
    )
    directory.log.append(PhaseRecord(phase="demos", seconds=time.perf_counter() - began))
    return dict(enumerate(paths))


@dataclass(frozen=True)
class DemoDatasets(Mapping[int, SequenceVLDataset]):
    """The tasks' windows by position; read when asked for, and kept for as long as somebody holds them."""

    paths: Mapping[int, Path]
    spec: PolicySpec
    languages: torch.Tensor  # (K, L)
    data: DataSettings
    device: torch.device
    _held: WeakValueDictionary[int, SequenceVLDataset] = field(default_factory=WeakValueDictionary)

    def __getitem__(self, task: int) -> SequenceVLDataset:
        dataset = self._held.get(task)
        if dataset is None:
            dataset = SequenceVLDataset.from_file(
                self.paths[task],
                spec=self.spec,
                language=self.languages[task],
                task_id=task,
                limit=self.data.demos,
                pairing=self.data.pairing,
                labels=self.data.labels,
            ).to(self.device)
            self._held[task] = dataset
        return dataset

    def __iter__(self) -> Iterator[int]:
        return iter(self.paths)

    def __len__(self) -> int:
        return len(self.paths)


def _sum_up(directory: RunDirectory, config: Mapping[str, Any]) -> None:
    """Write results.json and the report."""
    results = directory.log.read()
    write_summary(directory.path / "results.json", results, config)
    page = write_report([directory.path])
    ends = len(results.of(TaskEndRecord))
    print(f"{ends} tasks learned. Report: {page}")
