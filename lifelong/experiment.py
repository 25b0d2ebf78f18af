"""A run, step by step: build everything from the configuration, learn the task sequence, write the results."""

import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig

from libero_env.assets.pack import select_pack
from libero_env.assets.robot import robot_assets
from libero_env.cli.ending import told_if_interrupted
from libero_env.envs.batch import BatchEnv
from libero_env.errors import is_quiet
from libero_env.memory import memory_limit
from libero_env.perturbations import format_perturbations
from libero_env.sim.render import renderer_name
from libero_env.sim.scene_spec import default_drawing
from libero_env.text import counted
from lifelong.algorithms.rehearsal import Rehearsal
from lifelong.context import RunContext
from lifelong.data.demonstrations import check_folder
from lifelong.data.settings import DataSettings
from lifelong.errors import RESUME, ConfigError
from lifelong.evaluation.environments import EnvPool, held_out_shift, renderer_name_or_none, run_environment
from lifelong.policies.base import Policy
from lifelong.pretraining import policy_at_start, pretraining_context, tasks_learned
from lifelong.report.page import write_report
from lifelong.results.log import ResultLog
from lifelong.results.provenance import (
    all_conditions,
    changed_conditions,
    present_conditions,
    recorded_threads,
    start_record,
    utc_now,
)
from lifelong.results.records import PhaseRecord, RunEndRecord, RunRecord
from lifelong.results.run_directory import RunDirectory, check_writable, config_digest
from lifelong.results.summary import write_summary
from lifelong.run_demonstrations import check_learned_from, later_demos, open_datasets
from lifelong.sequence import TaskSequence, is_measured
from lifelong.settings import Configuration, RunSettings, plain_data
from lifelong.streams import TaskPlan, plan_tasks
from lifelong.training.distributed import Ranks
from lifelong.training.fit import check_warmup
from lifelong.training.memory import check_memory, policy_bytes, training_needs
from lifelong.training.precision import check_compiler, check_precision, deterministic, keep_freed_memory
from lifelong.training.settings import FitSettings

PRETRAIN_KEYS = ("pretrain", "policy", "data", "augmentation", "train", "language", "seed", "init_from")
# pixels of a batch; the published protocol has 10 million, the laptop's less than one
LARGE_FOR_CPU = 4_000_000
EXAMPLE_DIM = 384  # of instructions' embeddings, by which a policy is measured before they are computed


def run(
    config: DictConfig,
    names: Mapping[str, str],
    ranks: Ranks = Ranks(),  # noqa: B008 - frozen
    overrides: Sequence[str] = (),
) -> Path:
    """Run a configuration to its end, or resume a run that was interrupted.

    Args:
        config: Configuration composed from configs/config.yaml.
        names: Name of the file chosen in each group, such as algo -> ewc; they name the run.
        ranks: Rank of this process among those that train together.
        overrides: What the command line says, to be recorded.

    Returns:
        The run's directory, with results.json and report.html in it.

    Raises:
        LiberoError: The configuration, the data or the directory is invalid.
    """
    plain = with_chosen(plain_data(config))
    configuration = Configuration(plain)
    settings = configuration.settings()
    directory = RunDirectory(Path(settings.runs_dir) / _run_name(names, settings))
    check_writable(directory.path)
    keep_freed_memory()
    with deterministic(settings.deterministic), _threads(settings, directory.path):
        # before anything is written: an invalid configuration leaves no trace
        context, pretraining = _build_contexts(configuration, settings, directory, ranks)
        if not context.eval.back_end.is_warp and not directory.log.read().finished:
            renderer_name()
        with told_if_interrupted(RESUME), _held(context, plain, settings.resume):
            if not ranks.broadcast(_is_finished, context):
                if ranks.first:
                    _note_single_frames(context.policy, names["policy"])
                    _note_known_tasks(context, settings.init_from)
                    context.tracker.start(_run_name(names, settings), str(directory.path), plain)
                try:
                    if ranks.first:
                        _record_start(context, names, plain, overrides)
                    _run_sequence(context, pretraining, plain)
                finally:  # else the next job of a sweep would log into this run
                    if ranks.first:
                        context.tracker.finish()
            elif ranks.first:
                check_learned_from(context, pretraining, plain)
                print(
                    f"{directory.path} is finished; its report is written again (resume=false repeats the run)"
                )
            if ranks.first:
                _write_results(directory, plain)
    return directory.path


def check(config: DictConfig) -> None:
    """Check a configuration as `run` does before it writes anything, without drawing or training.

    Raises:
        LiberoError: A run would refuse the configuration, or this machine lacks what it needs.
    """
    configuration = Configuration(with_chosen(plain_data(config)))
    settings = configuration.settings()
    _, parts = _checked_parts(configuration, Ranks().device(settings.device))
    configuration.build("language")
    if not configuration.is_own("policy"):  # others are checked with the memory that they need
        configuration.build("policy", spec=parts["data"].spec(EXAMPLE_DIM))


def with_chosen(config: dict[str, Any]) -> dict[str, Any]:
    """Return a configuration that names what it leaves to be chosen, so that the saved one does.

    That is how images are drawn, and by which seed the cells of the success matrix are.
    """
    data, evaluation = config.get("data"), config.get("eval")
    if isinstance(data, dict) and data.get("drawing") is None:
        config = {**config, "data": {**data, "drawing": default_drawing(select_pack())}}
    sampled = evaluation if isinstance(evaluation, dict) and evaluation.get("cells") == "sampled" else None
    if sampled is not None and sampled.get("cells_seed") is None and "seed" in config:
        config = {**config, "eval": {**sampled, "cells_seed": config["seed"]}}
    return config


def _run_name(names: Mapping[str, str], settings: RunSettings) -> str:
    """Return the run's directory below `runs_dir`, which is also its name in W&B."""
    own = [] if settings.run_id is None else [str(settings.run_id)]
    words = [names["policy"], f"seed{settings.seed}", *own]
    return f"{names['benchmark']}/{names['algo']}/{'_'.join(words)}"


@contextmanager
def _threads(settings: RunSettings, directory: Path) -> Iterator[None]:
    """Give PyTorch its threads within the context; a resumed run has those that it was started with, as its bits need.

    They are given back, as the next job of a sweep may ask for the default.
    """
    before, threads = torch.get_num_threads(), settings.threads
    if not threads and settings.resume:
        results = ResultLog(directory / "results.jsonl").read()
        threads = 0 if results.finished else recorded_threads(results) or 0
        if threads not in (0, before):
            print(f"threads={threads}, as when this run was started: its bits depend on their number")
    if threads:
        torch.set_num_threads(threads)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _warn_of_cpu(data: DataSettings, fit: FitSettings) -> None:
    """Say on the standard error that a step is large for a CPU, such as one of the published protocol."""
    height, width = data.spec(EXAMPLE_DIM).image_size
    images = fit.batch_size * data.seq_len * len(data.views)
    if images * height * width > LARGE_FOR_CPU:
        print(
            f"warning: there is no GPU, and each training step reads {images} images of {height}x{width} pixels: "
            "on a CPU it takes many seconds, and a run of the published protocol weeks (device=cpu says that this is "
            "meant)",
            file=sys.stderr,
        )


def _build_contexts(
    config: Configuration, settings: RunSettings, directory: RunDirectory, ranks: Ranks
) -> tuple[RunContext, RunContext | None]:
    """Return the context of the run, and that of the pretraining before it if there is any."""
    device = ranks.device(settings.device)
    plan, parts = _checked_parts(config, device)
    data, evaluation = parts["data"], parts["eval"]
    if parts["fit"].steps_per_epoch and not directory.log.path.exists():
        check_warmup(parts["fit"], parts["algorithm"], 0)
    if ranks.first and settings.device == "auto" and device.type == "cpu":
        _warn_of_cpu(data, parts["fit"])

    first, said = len(plan.before), [*plan.instructions, *(task.language for task in plan.held_out)]
    languages = ranks.broadcast(lambda: config.build("language").embed(said))
    shift = ranks.broadcast(
        lambda: held_out_shift(
            evaluation.shift_perturbations(),
            plan.tasks,
            plan.perturb,
            languages[first : first + len(plan.tasks)],
            data,
            lambda words: config.build("language").embed([*said, *words])[len(said) :],
        )
    )
    spec = data.spec(languages.shape[1])

    def make_env(key: Any) -> BatchEnv:
        """Build the environment of (task, number of simulations), with any third part under the shift."""
        task, simulations, *shifted = key
        own = (*plan.perturb, *((),) * len(plan.held_out))
        perturb = shift.perturb if shifted and shift is not None else own
        acted_on = (*plan.tasks, *plan.held_out)[task]
        return run_environment(acted_on, simulations, spec, evaluation, data, perturb[task])

    progress = True if settings.progress is None and sys.stderr.isatty() else settings.progress
    context = RunContext(
        **parts,
        languages=languages[first:],
        policy=policy_at_start(config, spec, settings.seed, settings.init_from).to(device),
        envs=EnvPool(make_env, evaluation.open_environments),
        directory=directory,
        seed=settings.seed,
        device=device,
        progress=progress if ranks.first and not is_quiet() else False,
        ranks=ranks,
        shift=shift,
    )
    precisions = {"train.precision": context.fit.precision, "eval.precision": evaluation.precision}
    check_precision(context.policy, device, precisions)
    if context.learner:
        context.learner.check(context)
    if not first:
        return context, None
    if context.learner:
        raise ConfigError(
            "pretrain.suite is learned from demonstrations, for which learner=grpo has no train settings: make that "
            "run first, and give it as init_from"
        )
    pretrain = config.build("pretrain")
    # equal ones are shared by runs; the size of one-hot embeddings depends on the run's tasks, too
    keys = {key: config.values[key] for key in PRETRAIN_KEYS} | {"language_dim": languages.shape[1]}
    digest = config_digest(keys | ({"deterministic": True} if settings.deterministic else {}))
    folder = Path(settings.runs_dir) / "pretrain" / str(pretrain.suite) / digest
    return context, pretraining_context(
        context, plan.before, languages[:first], pretrain, RunDirectory(folder)
    )


def _checked_parts(config: Configuration, device: torch.device) -> tuple[TaskPlan, dict[str, Any]]:
    """Return the tasks, and the fields of the context that the configuration alone decides.

    What cannot fit into memory, or needs a package that is not there, is refused.
    """
    robot_assets()
    plan, data = plan_tasks(config), config.build("data")
    check_folder(data)
    fit, evaluation, algorithm = config.build("train"), config.build("eval"), config.build("algo")
    demos = plan.stream.demos(data.demos, len(plan.tasks), plan.group_sizes[0])
    weights = policy_bytes(config, data.spec(EXAMPLE_DIM))
    episodes = max(evaluation.episodes, evaluation.curve_episodes)
    replayed = algorithm.ratio if isinstance(algorithm, Rehearsal) else 0.0
    needs = training_needs(data, fit, weights, max(demos) * (1 + data.copies), episodes, replayed)
    on_gpu = torch.cuda.get_device_properties(device).total_memory if device.type == "cuda" else 0
    check_memory(needs, memory_limit() + on_gpu)
    if fit.compile != "off":
        check_compiler(device)
    parts = {
        name: config.build(group) for name, group in (("tracker", "tracker"), ("augment", "augmentation"))
    }
    if "learner" in config.values:
        parts["learner"] = config.build("learner")
    parts |= {"tasks": plan.tasks, "stream": plan.stream, "group_sizes": plan.group_sizes, "demos": demos}
    parts["held_out"] = plan.held_out
    parts |= {"data": data, "fit": fit, "eval": evaluation, "algorithm": algorithm}
    return plan, parts | {"perturb": plan.perturb if plan.stream.perturb else ()}


def _held(context: RunContext, plain: Mapping[str, Any], resume: bool) -> AbstractContextManager[Any]:
    """Return the context manager that holds the directory's lock, on the first rank."""
    return context.directory.opened(plain, resume) if context.ranks.first else nullcontext()


def _is_finished(context: RunContext) -> bool:
    """Return whether nothing is left to do, also where lines of the records are broken."""
    results = context.directory.log.read()
    complete = not results.problems and context.shift is None
    return results.finished and (complete or is_measured(context, results))


def _note_single_frames(policy: Policy, name: str) -> None:
    """Say where a policy that uses its history is given windows of one frame, as by the preset `laptop`."""
    if policy.uses_history and policy.spec.seq_len == 1:
        print(
            f"note: policy={name} learns and acts on single frames, as data.seq_len=1; "
            "data.seq_len=10 gives it the last ten, as in the paper",
            file=sys.stderr,
        )


def _note_known_tasks(context: RunContext, init_from: str | None) -> None:
    """Say where the run begins with weights that have learned tasks of it."""
    learned = tasks_learned(Path(init_from)) if init_from else []
    if known := [task.name for task in context.tasks if task.name in learned]:
        print(
            f"note: {init_from} has learned {len(known)} of the {len(context.tasks)} tasks, such as {known[0]}: "
            "forward transfer to them is not that to new tasks",
            file=sys.stderr,
        )


def _record_start(
    context: RunContext, names: Mapping[str, str], plain: Any, overrides: Sequence[str] = ()
) -> None:
    """Record the start; say where it is a resume under conditions that give other bits."""
    context.directory.log.append(
        start_record(
            algo=names["algo"],
            benchmark=names["benchmark"],
            policy=names["policy"],
            seed=context.seed,
            data_seed=context.data.seed,
            preset=names.get("preset", ""),
            tasks=[t.name for t in context.tasks],
            instructions=context.instructions,
            held_out=[t.name for t in context.held_out],
            perturbed=[format_perturbations(found) for found in context.perturb],
            backend=context.eval.back_end.name,
            config=plain,
            group_sizes=context.group_sizes,
            cells=context.eval.cells,
            cells_share=context.eval.cells_share if context.eval.cells == "sampled" else 1.0,
            cells_seed=context.eval.cells_seed,
            conditions=present_conditions(
                context.device, processes=context.ranks.size, renderer=renderer_name_or_none()
            ),
            transfer=context.eval.transfer_estimate,
            overrides=overrides,
        )
    )
    starts = context.directory.log.read().of(RunRecord)
    if len(starts) > 1 and (changes := changed_conditions(starts[-2], starts[-1])):
        print(
            f"resumed under other conditions ({', '.join(changes)}): from here on, bits differ from those of an "
            "uninterrupted run",
            file=sys.stderr,
        )


def _run_sequence(context: RunContext, pretraining: RunContext | None, plain: Mapping[str, Any]) -> None:
    """Make sure of the demonstrations, pretrain, and learn the task sequence."""
    began = time.perf_counter()
    with later_demos(context) as later, context.envs:
        datasets = open_datasets(context, pretraining.tasks if pretraining else (), later=later)
        TaskSequence(context, datasets, prepare=lambda: _pretrain(pretraining, context, plain)).run()
    if context.ranks.first:
        _record_end(context, began)


def _record_end(context: RunContext, began: float) -> None:
    context.directory.log.append(RunEndRecord(seconds=time.perf_counter() - began, finished=utc_now()))


def _pretrain(pretraining: RunContext | None, context: RunContext, plain: Mapping[str, Any]) -> None:
    """Train the policy on what comes before the sequence, if anything does, or load its weights if that is done."""
    if pretraining is None:
        return
    ranks, directory, began = context.ranks, pretraining.directory, time.perf_counter()
    config, suite = {key: plain[key] for key in PRETRAIN_KEYS}, str(plain["pretrain"]["suite"])
    with _held(pretraining, config, resume=True):
        done = ranks.broadcast(lambda: directory.log.read().finished)
        if done and ranks.first:
            _compare_conditions(pretraining, context)
        if not done and ranks.first:
            count = len(pretraining.tasks)
            print(f"Before the sequence: {counted(count, 'task')} of {suite} in {directory.path}", flush=True)
            names = {"algo": "multitask", "benchmark": suite, "policy": "pretrained"}
            _record_start(pretraining, names, config)
        TaskSequence(pretraining, open_datasets(pretraining, context.tasks, done)).run(evaluate=False)
        if not done and ranks.first:
            _record_end(pretraining, began)
    if ranks.first:
        seconds = time.perf_counter() - began
        context.directory.log.append(PhaseRecord(phase="pretrain", seconds=seconds))


def _compare_conditions(pretraining: RunContext, context: RunContext) -> None:
    """Say where weights that were pretrained earlier come from other conditions than those of this run."""
    starts = [one.directory.log.read().of(RunRecord)[-1:] for one in (pretraining, context)]
    was, now = (all_conditions(found[0]) if found else {} for found in starts)
    if differing := [name for name in {**was, **now} if was.get(name) != now.get(name)]:
        print(
            f"the weights in {pretraining.directory.path} were pretrained under other conditions than those of this "
            f"run: {', '.join(differing)}",
            file=sys.stderr,
        )


def _write_results(directory: RunDirectory, config: Mapping[str, Any]) -> None:
    """Write results.json and the report."""
    results = directory.log.read()
    write_summary(directory.path / "results.json", results, config)
    try:
        page = write_report([directory.path])
    except Exception as error:
        error.add_note(
            f"the run is finished and its results are kept; `libero report {directory.path}` writes its report"
        )
        raise
    print(f"{counted(results.learned_tasks(), 'task')} learned. Report: {page}")
