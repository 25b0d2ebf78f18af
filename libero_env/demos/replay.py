"""Going through recorded demonstrations again: by their states or by their actions, and with other cameras."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import mujoco
import numpy as np
from tqdm import tqdm

from libero_env.assets.pack import Pack
from libero_env.demos.curate import header_of, read_episodes, task_of
from libero_env.demos.observe import Filmer, Shots, fixtures_of
from libero_env.demos.read import BrokenDemoError
from libero_env.demos.write import DemoWriter, Episode
from libero_env.errors import DemoError
from libero_env.sim.observations import entry
from libero_env.sim.scene import Scene

BY = ("state", "action")


@dataclass(frozen=True)
class Replay:
    """What came of going through a demonstration.

    Attributes:
        name: `demo_3`.
        recorded: whether the file says that it reached the goal.
        success: whether it did now.
        steps: that it took.
        drift: largest distance of an object from where it was recorded, m, (T,); 0 where states are replayed.
        arm_drift: likewise of the arm's joints, rad, (T,).
        frames: pictures side by side, (T, H, W, 3) uint8.
    """

    name: str
    recorded: bool
    success: bool
    steps: int
    drift: np.ndarray = field(repr=False)
    arm_drift: np.ndarray = field(repr=False)
    frames: np.ndarray | None = field(default=None, repr=False)


def replay(
    file: Path,
    *,
    by: str = "action",
    demos: Sequence[str] | None = None,
    cameras: Sequence[str] = (),
    size: tuple[int, int] = (256, 256),
    assets: Pack | str | Path | None = None,
) -> Iterator[Replay]:
    """Go through demonstrations from their first state, with their fixtures where they stood.

    Args:
        file: whose demonstrations.
        by: `action` lets the recorded actions act; `state` puts the simulation into each recorded state, and lets
            only the last action act.
        demos: names of those wanted; None for all.
        cameras: to be filmed; none by default.
        size: (height, width) of the film, pixels.
        assets: where models come from, as in `LiberoEnv`.

    Raises:
        DemoError: the file is broken, does not fit its task's scene, or has no such demonstration.
    """
    if by not in BY:
        raise DemoError(f"replay by {by!r}; valid: {', '.join(BY)}")
    filmer = Filmer(task_of(file), Shots(tuple(cameras), size), assets)
    found = set()
    try:
        for name, episode in read_episodes(file):
            if demos is None or name in demos:
                found.add(name)
                fixtures = _fitting(file, name, episode, filmer.scene)
                yield _replayed(
                    filmer, name, episode, fixtures, by, [entry(camera, "rgb") for camera in cameras]
                )
    finally:
        filmer.close()
    if absent := set(demos or ()) - found:
        raise DemoError(f"{file}: no demonstration {', '.join(sorted(absent))}")


def _replayed(
    filmer: Filmer, name: str, episode: Episode, fixtures: np.ndarray, by: str, keys: list[str]
) -> Replay:
    env, states, scene = filmer.env, episode.states, filmer.scene
    objects = _object_positions(scene)
    filmer.pose_fixtures(fixtures)
    obs = env.set_state(states[0])
    drift, arm_drift, frames, terminated = [], [], [], False
    for t, action in enumerate(episode.actions):
        if by == "state" and t:
            obs = env.set_state(states[t])
        qpos, then = env.world.simulations.fields["qpos"][0], states[t, 1 : 1 + scene.model.nq]
        away = qpos[objects] - then[objects]  # (n, 3)
        drift.append(np.linalg.norm(away, axis=1).max(initial=0.0))
        arm_drift.append(np.abs(qpos[:7] - then[:7]).max())
        frames += [np.concatenate([obs[key] for key in keys], axis=1)] if keys else []
        if by == "action" or t == len(states) - 1:
            obs, _, terminated, _, _ = env.step(action)
            if terminated:
                break
    return Replay(
        name,
        episode.success,
        bool(terminated),
        t + 1,
        np.array(drift),
        np.array(arm_drift),
        np.stack(frames) if frames else None,
    )


def rerender(
    file: Path,
    target: Path,
    shots: Shots,
    *,
    assets: Pack | str | Path | None = None,
    progress: bool | None = None,
) -> Path:
    """Write a file's demonstrations again, observed anew: other cameras, resolution, depth or segmentation.

    The observations are those of the recorded states, so the new file has "aligned" pairing whatever the old one had.
    It goes on where it was stopped.

    Args:
        file: to read.
        target: to write.
        shots: what is drawn.
        assets: where models come from, as in `LiberoEnv`.
        progress: show a bar; None where stderr is a terminal.

    Raises:
        DemoError: the file is broken or does not fit its task's scene; the target was made otherwise.
    """
    if target.exists() and target.samefile(file):
        raise DemoError(f"{target} is the file to read; choose another name")
    header = {k: v for k, v in header_of(file).items() if k not in ("cameras", "pictures")}
    writer = DemoWriter(target, {**header, **shots.header(), "pairing": "aligned"})
    done = writer.recorded()
    filmer = Filmer(task_of(file), shots, assets)
    try:
        shown = tqdm(read_episodes(file), unit="demo", disable=None if progress is None else not progress)
        for name, episode in shown:
            if (index := int(name[5:])) not in done:
                fixtures = _fitting(file, name, episode, filmer.scene)
                obs, robot = filmer.film(episode.states, fixtures)
                writer.write(index, replace(episode, obs=obs, robot_states=robot))
    finally:
        filmer.close()
    return writer.finish()


def _fitting(file: Path, name: str, episode: Episode, scene: Scene) -> np.ndarray:
    """The demonstration's fixtures, after a look whether its states fit the scene."""
    length = 1 + scene.model.nq + scene.model.nv
    if episode.states.shape[1] != length:
        raise BrokenDemoError(
            f"{file}: {name}/states is {episode.states.shape}; expected (T, {length}) for {scene.problem.language!r}"
        )
    return fixtures_of(episode.attrs, scene, f"{file}: {name}")


def _object_positions(scene: Scene) -> np.ndarray:
    """Addresses in qpos of the positions of free bodies, (n, 3)."""
    free = scene.model.jnt_type == mujoco.mjtJoint.mjJNT_FREE
    return scene.model.jnt_qposadr[free][:, None] + np.arange(3)
