"""Demonstrations that were collected, observed anew, as a data set: pictures and proprioception of each state."""

import argparse
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
from tqdm import tqdm

from libero.libero.utils.dataset_utils import get_dataset_info
from libero.scripts.command import run
from libero_env.demos.curate import header_of, read_episodes, task_of
from libero_env.demos.observe import Filmer, Shots, fixtures_of
from libero_env.demos.read import LOW_DIM_KEYS
from libero_env.demos.replay import rerender
from libero_env.demos.write import DemoWriter


def main(argv: Sequence[str] | None = None) -> int:
    """The script."""
    parser = argparse.ArgumentParser(prog="create_dataset.py", description=__doc__)
    add = parser.add_argument
    add("--demo-file", type=Path, required=True, help="demonstrations with states and actions (demo.hdf5)")
    add("--use-actions", action="store_true", help="let the actions act instead of replaying the states")
    add("--use-camera-obs", action="store_true", help="draw the cameras' pictures")
    add("--dataset-path", type=Path, default=Path("datasets"), help="folder (default: datasets)")
    add("--dataset-name", default="", help="file below it (default: <suite>/<task>_demo.hdf5)")
    add("--no-proprio", action="store_true", help="leave out joints, gripper and end effector")
    add("--use-depth", action="store_true", help="draw depth, too")
    add("--size", type=int, default=128, help="of the pictures, pixels (default: 128)")
    return run(parser, create, argv)


def create(args: argparse.Namespace) -> None:
    """Write the data set and say what is in it."""
    task = task_of(args.demo_file)
    name = args.dataset_name or f"{task.suite}/{task.name}_demo.hdf5"
    target = args.dataset_path / (name if name.endswith(".hdf5") else f"{name}.hdf5")
    pictures = ("rgb", "depth") if args.use_depth else ("rgb",)
    cameras = Shots().cameras if args.use_camera_obs else ()
    shots = Shots(cameras, (args.size, args.size), pictures)
    if args.use_actions:
        with tempfile.TemporaryDirectory() as folder:
            rerender(acted(args.demo_file, Path(folder) / "acted.hdf5"), target, shots)
    else:
        rerender(args.demo_file, target, shots)
    if args.no_proprio:
        drop_proprioception(target)
    print(target)
    get_dataset_info(str(target))


def acted(file: Path, target: Path) -> Path:
    """A copy of demonstrations with the states that their actions lead to from the first one.

    Raises:
        DemoError: the file is broken or does not fit its task's scene.
    """
    filmer, writer = Filmer(task_of(file), Shots(())), DemoWriter(target, header_of(file))
    world = filmer.env.world
    try:
        for name, episode in tqdm(read_episodes(file), desc="acting", unit="demo", disable=None):
            filmer.pose_fixtures(fixtures_of(episode.attrs, filmer.scene, f"{file}: {name}"))
            filmer.env.set_state(episode.states[0])
            states = []
            for action in episode.actions:
                states.append(world.physics_state(0))
                world.step([0], action[None])
            success = bool(world.judge(0)[0])
            writer.write(int(name[5:]), replace(episode, states=np.array(states), success=success))
    finally:
        filmer.close()
    return writer.finish()


def drop_proprioception(file: Path) -> None:
    """Leave out everything but pictures and states."""
    with h5py.File(file, "r+") as handle:
        for demo in handle["data"].values():
            for key in [key for key in LOW_DIM_KEYS if key in demo["obs"]]:
                del demo["obs"][key]
            if "robot_states" in demo:
                del demo["robot_states"]


if __name__ == "__main__":
    raise SystemExit(main())
