"""`libero demos`: record demonstrations; describe, check, replay, show, render again, filter and convert files."""

import sys
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from libero_env.cli.options import (
    Answer,
    Field,
    FilePath,
    Natural,
    Positional,
    Seed,
    Segmentation,
    Size,
    arg,
    modalities,
)
from libero_env.cli.recording import ActionKind, Cameras, Drawing, refuse
from libero_env.doors import enter
from libero_env.errors import DemoError

if TYPE_CHECKING:
    from libero_env.tasks import Task

Files = Positional[tuple[FilePath, ...]]


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
    from libero_env.curating.curate import describe, find_demo_files

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
    from libero_env.curating.curate import find_demo_files

    rows = check_files(find_demo_files(paths))
    return Answer("", rows, status=int(any(row["faults"] for row in rows)))


def check_files(files: Iterable[Path], num_demos: int | None = None) -> list[dict[str, Any]]:
    """Read files completely and print one line about each; return path, demonstrations, faults and notes of each.

    Args:
        files: Demonstration files.
        num_demos: Number of demonstrations that each file must have; None for any.
    """
    from libero_env.curating.curate import examine
    from libero_env.demos.agreement import differing, stated_facts

    facts: dict[Path, dict[str, str]] = {}
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
        facts[path] = stated_facts(path)
    for line in differing(facts):
        print(f"note  the files differ in {line}")
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
    from libero_env.assets.pack import select_pack
    from libero_env.curating.video import check_video_path, write_video
    from libero_env.demos.agreement import UNSTATED, models_here, recorded_frequency, stated_facts
    from libero_env.demos.replay import replay

    if video:
        check_video_path(video)
    else:
        refuse("without --video", cameras=cameras, size=size)
    shown_models, here = stated_facts(file)["models"], models_here(select_pack(assets))
    if shown_models not in (UNSTATED, here):
        print(f"note: {file} shows the models {shown_models}; it is replayed in {here}", file=sys.stderr)
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
    written = enter("exports", "rerun")(file, rerun, demos=demos, task=task_of(bddl))
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
    from libero_env.curating.curate import describe
    from libero_env.curating.rendering import rerender
    from libero_env.demos.config import RenderConfig
    from libero_env.demos.observe import recorded_rendering
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
    from libero_env.curating.curate import examine, filter_demos

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
    despite: tuple[Literal["models", "expert", "labels"], ...] = (),
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
        despite: In what the files may differ, such as expert (default: nothing).
    """
    from libero_env.curating.curate import find_demo_files

    lines = enter("exports", "demonstrations")(
        find_demo_files(files),
        out,
        form,
        labels=labels,
        actions=actions,
        settle=settle,
        assets=assets,
        drawing=drawing,
        task=task_of(bddl),
        despite=despite,
    )
    print("\n".join(lines))
