"""`libero demos generate`: record demonstrations with the expert."""

import re
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic.dataclasses import dataclass

from libero_env.cli.options import (
    Field,
    FilePath,
    Positive,
    ProcessesOrAll,
    Seed,
    Segmentation,
    Size,
    TaskName,
    arg,
    modalities,
)
from libero_env.errors import InvalidInputError

if TYPE_CHECKING:
    from libero_env.demos.config import DemoConfig, Variation
    from libero_env.demos.record import RecordingReport

Drawing = Literal["fast", "faithful"]
ActionKind = Literal["delta", "absolute", "joint"]
Cameras = Annotated[tuple[str, ...], Field(min_length=1)]
SHOWN_REASONS = 3  # most frequent reasons of failure that are listed for a task


@dataclass(frozen=True, kw_only=True)
class RecordingRequest:
    """Record with the scripted expert; an interrupted recording can be resumed.

    Attributes:
        benchmark: All tasks of a suite, such as libero_object.
        task: One task, such as libero_goal/3.
        bddl: A user-defined task file.
        n: Demonstrations of each task.
        size: Size of the images, 128 or 120x160 (default: 128, or that of --for).
        training: Overrides of libero train, such as preset=laptop: size, drawing, robot and seed are those of this
            run.
        cameras: Cameras to render: names, or texts such as "top,pos=0.4 0 1.6,lookat=0 0 0.9,fovy=60,body=world",
            each of which adds a camera (default: agentview robot0_eye_in_hand).
        no_images: Record states, proprioception and actions only; `rerender` can add images later.
        drawing: How images are drawn (default: that of the models).
        depth: Record depth too, in metres.
        segmentation: Record a segmentation too.
        robot: Model of the arm, libero or robosuite-1.4.1 (default: libero, or that of --for).
        backend: Physics, mujoco, or warp on a GPU, as in warp,device=cuda:1.
        seed: Seed of starts, motion styles and action noise (default: 0, or that of --for).
        reserved: Start from the 50 stored states, which evaluation uses.
        variation: What varies: the motion style, noise on the executed actions, pushes; or none.
        noise: Standard deviation of the noise on actions (default: 0.12).
        pairing: Store the observation before an action, or the one after it as the original does.
        workers: Number of processes; 0: one per core.
        folder: Where to keep the files (default: LIBERO_DEMOS, or in the cache).
    """

    benchmark: Annotated[TaskName | None, arg(aliases=["--suite"])] = None
    task: TaskName | None = None
    bddl: FilePath | None = None
    n: Positive = 50
    size: Size | None = None
    training: Annotated[tuple[str, ...], arg(name="for", metavar="OVERRIDE ...")] = ()
    cameras: Cameras | None = None
    no_images: bool = False
    drawing: Drawing | None = None
    depth: bool = False
    segmentation: Segmentation | None = None
    robot: str | None = None
    backend: str = "mujoco"
    seed: Seed | None = None
    reserved: bool = False
    variation: tuple[Literal["style", "noise", "pushes", "none"], ...] = ("style", "noise", "pushes")
    noise: Annotated[float, Field(ge=0, le=10)] | None = None
    pairing: Literal["aligned", "libero"] = "aligned"
    workers: ProcessesOrAll = 0
    folder: FilePath | None = None


def generate(request: RecordingRequest) -> int:
    """Record what is missing, then list the files and the failures; return 1 if a task is not complete."""
    from libero_env.curating.curate import describe
    from libero_env.demos.generate import RecordingJob, demo_path, make_demos
    from libero_env.paths import demos_dir

    root = request.folder or demos_dir()
    jobs = [RecordingJob(config, demo_path(root, config)) for config in demo_configs(request)]
    reports = make_demos(jobs, request.n, workers=request.workers, replace=True)
    for path, report in reports.items():
        print(describe(path) if path.is_file() else f"{path}: not complete")
        for line in report_lines(report):
            print(f"    {line}")
    if len(reports) > 1:
        print(summary(reports, request.n))
    return int(any(report.error for report in reports.values()))


def demo_configs(request: RecordingRequest) -> "list[DemoConfig]":
    """Return the configurations of the demonstrations that a request asks for, one per task.

    Raises:
        InvalidInputError: Not exactly one of suite, task and task file is given, or options exclude each other.
    """
    from libero_env.demos.config import DemoConfig
    from libero_env.sim.backend import Backend
    from libero_env.tasks import get_suite, get_task, read_task

    if sum(one is not None for one in (request.benchmark, request.task, request.bddl)) != 1:
        raise InvalidInputError("give one of --suite SUITE, --task TASK and --bddl FILE")
    if request.benchmark:
        tasks = get_suite(request.benchmark).tasks
    elif request.task:
        tasks = (get_task(request.task),)
    else:
        tasks = (read_task(Path(str(request.bddl))),)
    shown = () if request.no_images else modalities(depth=request.depth, segmentation=request.segmentation)
    if request.no_images:
        given = ("cameras", "size", "drawing", "depth", "segmentation")
        refuse("with --no-images", **{name: getattr(request, name) for name in given})
    return [
        DemoConfig(
            task,
            request.size or DemoConfig.camera_size,
            request.seed or 0,
            request.pairing,
            disturb=bool({"noise", "pushes"} & set(request.variation)),
            variation=variation(request),
            cameras=() if request.no_images else request.cameras or DemoConfig.cameras,
            modalities=shown,
            drawing=request.drawing,
            robot=request.robot or DemoConfig.robot,
            backend=Backend.read(request.backend),
        )
        for task in tasks
    ]


def refuse(condition: str, **options: Any) -> None:
    """Refuse options of a command that have no effect under a condition.

    Raises:
        InvalidInputError: One of them is given: neither None nor False.
    """
    given = [f"--{name}" for name, value in options.items() if value is not None and value is not False]
    if given:
        names, they = ", ".join(given).replace("_", "-"), "them" if len(given) > 1 else "it"
        raise InvalidInputError(f"{names} cannot be used {condition}; leave {they} out")


def variation(request: RecordingRequest) -> "Variation":
    """Return how the demonstrations differ from each other.

    Raises:
        InvalidInputError: `none` does not stand alone, or the noise is given and does not vary.
    """
    from libero_env.demos.config import Variation

    if "none" in request.variation and len(request.variation) > 1:
        words = " ".join(request.variation)
        raise InvalidInputError(f"--variation {words}: none stands alone; leave it out, or the others")
    if "noise" not in request.variation:
        refuse("without noise in --variation", noise=request.noise)
    default = Variation()
    noise = default.noise if request.noise is None else request.noise
    return Variation(
        style="style" in request.variation,
        noise=noise if "noise" in request.variation else 0.0,
        push_rate=default.push_rate if "pushes" in request.variation else 0.0,
        reserved=request.reserved,
    )


def report_lines(report: "RecordingReport") -> list[str]:
    """Return the outcome of one task: the share of attempts that succeeded, and why others failed."""
    if not report.attempts:
        return [report.error] if report.error else []
    failed = report.failure_reasons.total()
    share = f"{report.attempts - failed} of {report.attempts} attempts successful"
    lines = [f"{share} ({100 * (1 - failed / report.attempts):.0f} %)"]
    reasons: Counter[str] = Counter()
    for reason, count in report.failure_reasons.items():
        reasons[re.sub(r"(?<!\w)\d+(\.\d+)?", "N", reason)] += count  # reasons may differ in numbers only
    lines += [f"{count} x {reason}" for reason, count in reasons.most_common(SHOWN_REASONS)]
    return lines + ([f"ERROR {report.error}"] if report.error else [])


def summary(reports: "Mapping[Path, RecordingReport]", n: int) -> str:
    """Return one line about all tasks."""
    done = sum(not report.error and report.recorded >= n for report in reports.values())
    attempts = sum(report.attempts for report in reports.values())
    failed = sum(report.failure_reasons.total() for report in reports.values())
    share = f", {100 * (1 - failed / attempts):.1f} % of {attempts} attempts successful" if attempts else ""
    return f"{done} of {len(reports)} tasks complete{share}"
