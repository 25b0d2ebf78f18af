"""`libero demos`: record demonstrations; describe, check, replay, show, render again, filter and convert files."""

import importlib
import re
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic.dataclasses import dataclass

from libero_env.cli.options import (
    Answer,
    Field,
    FilePath,
    Natural,
    Positional,
    Positive,
    ProcessesOrAll,
    Seed,
    Segmentation,
    Size,
    arg,
    modalities,
)
from libero_env.errors import DemoError, InvalidInputError

if TYPE_CHECKING:
    from libero_env.demos.config import DemoConfig, Variation
    from libero_env.demos.record import RecordingReport
    from libero_env.tasks import Task

Drawing = Literal["fast", "faithful"]
ActionKind = Literal["delta", "absolute", "joint"]
Cameras = Annotated[tuple[str, ...], Field(min_length=1)]
Files = Positional[tuple[FilePath, ...]]
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

    benchmark: Annotated[str | None, arg(aliases=["--suite"])] = None
    task: str | None = None
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
    from libero_env.demos.curate import describe
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
    size, drawing, robot = request.size or DemoConfig.camera_size, request.drawing, request.robot
    seed = request.seed
    if request.training:
        data = importlib.import_module("lifelong.cli.runs").data_settings(request.training)
        size, drawing = request.size or (data.image_size, data.image_size), drawing or data.drawing
        robot, seed = robot or data.robot, data.seed if seed is None else seed
    return [
        DemoConfig(
            task,
            size,
            seed or 0,
            request.pairing,
            disturb=bool({"noise", "pushes"} & set(request.variation)),
            variation=variation(request),
            cameras=() if request.no_images else request.cameras or DemoConfig.cameras,
            modalities=shown,
            drawing=drawing,
            robot=robot or DemoConfig.robot,
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


def download(
    names: Positional[Annotated[tuple[str, ...], Field(min_length=1)]],
    *,
    dest: FilePath | None = None,
    revision: str | None = None,
    overwrite: bool = False,
) -> None:
    """Download the original's human demonstrations; an interrupted download can be resumed.

    Args:
        names: Suites such as libero_object, or tasks such as libero_object/3.
        dest: Folder to write (default: where demonstrations are kept).
        revision: Commit, tag or branch of the data set (default: a pinned commit).
        overwrite: Replace existing files of other contents.
    """
    from libero_env.demos.download import REVISION, download_demos

    for path in download_demos(names, dest, revision=revision or REVISION, overwrite=overwrite):
        print(f"{path}: complete; it has the digest that the server lists")


def info(paths: Files = ()) -> int:
    """Print one line about each demonstration file; return 1 if one cannot be read.

    Args:
        paths: Files or folders (default: where demonstrations are kept).
    """
    from libero_env.demos.curate import describe, find_demo_files

    broken = 0
    for path in find_demo_files(paths):
        try:
            print(describe(path))
        except DemoError as error:
            broken += 1
            print(f"FAIL  {error}")
    return int(broken > 0)


def check(paths: Files = ()) -> Answer:
    """Read files completely; report what is in them, broken, or missing for training; return 1 if one is broken.

    Args:
        paths: Files or folders (default: where demonstrations are kept).
    """
    from libero_env.demos.curate import find_demo_files

    rows = check_files(find_demo_files(paths))
    return Answer("", rows, status=int(any(row["faults"] for row in rows)))


def check_files(files: Iterable[Path], num_demos: int | None = None) -> list[dict[str, Any]]:
    """Read files completely and print one line about each; return path, demonstrations, faults and notes of each.

    Args:
        files: Demonstration files.
        num_demos: Number of demonstrations that each file must have; None for any.
    """
    from libero_env.demos.curate import examine

    rows: list[dict[str, Any]] = []
    for path in files:
        try:
            stats = examine(path)
        except DemoError as error:
            rows.append({"path": path, "demonstrations": None, "faults": [str(error)], "notes": []})
            print(f"FAIL  {error}")
            continue
        faults = list(map(str, stats.faults))
        if num_demos not in (None, len(stats.lengths)):
            faults.append(f"{len(stats.lengths)} demonstrations; expected {num_demos}")
        rows.append(
            {"path": path, "demonstrations": len(stats.lengths), "faults": faults, "notes": list(stats.notes)}
        )
        for fault in faults:
            print(f"FAIL  {path}: {fault}")
        if not faults:
            print(f"ok    {path}: {len(stats.lengths)} demonstrations, {stats}")
        for note in stats.notes:
            print(f"note  {path}: {note}")
    return rows


def task_of(bddl: Path | None) -> "Task | None":
    """Return the task of a task file, None without one."""
    from libero_env.tasks import read_task

    return read_task(bddl) if bddl else None


def replay_file(
    file: Positional[FilePath],
    *,
    by: Literal["action", "state"] = "action",
    actions: ActionKind = "delta",
    demo: tuple[Natural, ...] = (),
    video: FilePath | None = None,
    cameras: Cameras | None = None,
    size: Size | None = None,
    assets: str | None = None,
    bddl: FilePath | None = None,
) -> Answer:
    """Replay demonstrations and report success and drift; return 1 if one that succeeded does not any more.

    Args:
        file: Demonstration file.
        by: What is replayed.
        actions: As recorded: delta, or goals of the hand, absolute, or of the joints, joint, by their controllers.
        demo: Numbers of demonstrations (default: all).
        video: Video to write, .mp4, .webp or .gif.
        cameras: Cameras of the video, as of `demos generate` (default: agentview).
        size: Size of each picture of the video, 128 or 120x160 (default: 256).
        assets: Where models come from: builtin, original, or a folder with the original's.
        bddl: Task file of what was recorded (default: the task that the file states).
    """
    from libero_env.demos.observe import recorded_frequency
    from libero_env.demos.replay import replay
    from libero_env.demos.video import check_video_path, write_video

    if video:
        check_video_path(video)
    else:
        refuse("without --video", cameras=cameras, size=size)
    demos = [f"demo_{number}" for number in demo] or None
    results, lost = [], 0
    how: dict[str, Any] = {"by": by, "actions": actions, "demos": demos, "size": size or (256, 256)}
    shown = (cameras or ("agentview",)) if video else ()
    for result in replay(file, **how, cameras=shown, assets=assets, task=task_of(bddl)):
        lost += result.recorded and not result.success
        outcome = "success" if result.success else "no success"
        drift = f"objects {1000 * result.drift.max():.2f} mm, arm {1000 * result.arm_drift.max():.2f} mrad"
        print(f"{result.name}: {outcome} after {result.steps} steps, largest drift: {drift}")
        results.append(result)
    lines = [f"{sum(result.success for result in results)} of {len(results)} successful by {by}"]
    if video and results:
        import numpy as np

        frames = [result.frames for result in results if result.frames is not None]
        lines.append(str(write_video(video, np.concatenate(frames), recorded_frequency(file))))
    data = [
        {"demonstration": one.name, "success": one.success, "recorded": one.recorded, "steps": one.steps}
        | {"drift": one.drift.max(), "arm_drift": one.arm_drift.max()}
        for one in results
    ]
    return Answer("\n".join(lines), data, status=int(lost > 0))


def show_file(
    file: Positional[FilePath],
    *,
    rerun: FilePath,
    demo: tuple[Natural, ...] = (),
    bddl: FilePath | None = None,
) -> None:
    """Write cameras, states, actions and the atoms of the goal on one timeline, for Rerun's viewer.

    Args:
        file: Demonstration file.
        rerun: File to write, .rrd.
        demo: Numbers of demonstrations (default: all).
        bddl: Task file of what was recorded (default: the task that the file states).
    """
    demos = [f"demo_{number}" for number in demo] or None
    write_rerun = import_module("libero_integrations.exports.rerun").write_rerun
    written = write_rerun(file, rerun, demos=demos, task=task_of(bddl))
    print(f"{rerun}: {written} demonstrations; open it with: rerun {rerun}")


def rerender_file(
    file: Positional[FilePath],
    out: Positional[FilePath],
    *,
    perturb: Annotated[str | None, arg(metavar="KIND=SEVERITY,...")] = None,
    perturb_seed: Seed | None = None,
    size: Size | None = None,
    cameras: Cameras | None = None,
    drawing: Drawing | None = None,
    depth: bool = False,
    segmentation: Segmentation | None = None,
    assets: str | None = None,
    bddl: FilePath | None = None,
) -> None:
    """Render the recorded states again, with other cameras or under perturbations, and describe the new file.

    Args:
        file: Demonstration file.
        out: The new file.
        perturb: Perturbations that change what is seen or said, such as camera=0.3,light=0.5, sampled for each
            demonstration. Size, cameras and drawing are then by default those of the file.
        perturb_seed: Seed of the samples (default: 0).
        size: Size of the images, 128 or 120x160 (default: 128).
        cameras: Cameras to render, as of `demos generate` (default: agentview robot0_eye_in_hand).
        drawing: How images are drawn (default: that of the models).
        depth: Render depth too, in metres.
        segmentation: Render a segmentation too; the file's attribute segmentation_names names its numbers.
        assets: Where models come from: builtin, original, or a folder with the original's.
        bddl: Task file of what was recorded (default: the task that the file states).
    """
    from libero_env.demos.config import RenderConfig
    from libero_env.demos.curate import describe
    from libero_env.demos.observe import recorded_rendering
    from libero_env.demos.rendering import rerender
    from libero_env.perturbations import parse_perturbations

    config = RenderConfig(drawing=drawing)
    if perturb is None:
        refuse("without --perturb", perturb_seed=perturb_seed)
    else:
        config = replace(recorded_rendering(file), perturb=parse_perturbations(perturb, perturb_seed or 0))
    chosen: dict[str, Any] = {"cameras": cameras, "size": size, "drawing": drawing}
    if depth or segmentation or perturb is None:
        chosen["modalities"] = modalities(depth=depth, segmentation=segmentation)
    config = replace(config, **{key: value for key, value in chosen.items() if value is not None})
    print(describe(rerender(file, out, config, assets=assets, task=task_of(bddl))))


def filter_file(
    file: Positional[FilePath],
    out: Positional[FilePath],
    *,
    success: bool = False,
    no_ops: bool = False,
    threshold: Annotated[float, Field(ge=0, le=1)] = 1e-3,
    bddl: FilePath | None = None,
) -> None:
    """Write some of the demonstrations or steps of a file, and print the contents of both.

    Args:
        file: Demonstration file.
        out: The new file.
        success: Keep only demonstrations that reached the goal.
        no_ops: Leave out steps in which the action does nothing.
        threshold: Largest motion of a no-op.
        bddl: Task file of what was recorded, which the new file states (default: the task that the file states).
    """
    from libero_env.demos.curate import examine, filter_demos

    print(f"{file}: {examine(file, threshold=threshold)}")
    task = task_of(bddl)
    stats = filter_demos(
        file, out, success_only=success, without_noops=no_ops, threshold=threshold, task=task
    )
    print(f"{out}: {stats}")


def export(
    files: Positional[Annotated[tuple[FilePath, ...], Field(min_length=1)]],
    *,
    out: FilePath,
    form: Annotated[str, arg(name="as", metavar="FORM")] = "lerobot",
    labels: Literal["expert", "executed"] = "expert",
    actions: ActionKind | None = None,
    settle: Annotated[int, Field(ge=0, le=1000)] | None = None,
    assets: str | None = None,
    drawing: Drawing | None = None,
    bddl: FilePath | None = None,
) -> None:
    """Write files as one data set in another format, and print its size.

    Args:
        files: Files or folders.
        out: A new folder.
        form: As recorded for lerobot, gr00t or rlds; or what a published set is, lerobot/libero,
            physical-intelligence/libero, IPEC-COMMUNITY/libero or openvla/modified_libero_rlds: demonstrations are run
            again without no-ops, successes kept, images of 256 pixels turned as there.
        labels: Actions that the expert asked for, or those that were executed.
        actions: As recorded: delta, or goals of the hand, absolute, or of the joints, joint (default: delta).
        settle: As a published set: waiting steps before the first action (default: 10).
        assets: As a published set: where models come from (default: the original's where they are installed).
        drawing: As a published set: how images are drawn (default: faithful).
        bddl: Task file of what was recorded (default: the tasks that the files state).
    """
    from libero_env.demos.curate import find_demo_files

    lines = import_module("libero_integrations.exports.demonstrations").export(
        find_demo_files(files),
        out,
        form,
        labels=labels,
        actions=actions,
        settle=settle,
        assets=assets,
        drawing=drawing,
        task=task_of(bddl),
    )
    print("\n".join(lines))
