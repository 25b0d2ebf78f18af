"""Make a data set of collected demonstrations: pictures and proprioception of each state."""

import argparse
import shutil
import tempfile
from pathlib import Path

import h5py

from libero.libero.utils.dataset_utils import get_dataset_info
from libero.scripts.command import option, script
from libero_env.demos.config import RenderConfig
from libero_env.demos.contents import LOW_DIM_KEYS
from libero_env.demos.observe import recorded_task
from libero_env.demos.rendering import rerender
from libero_env.demos.replay import rerun_actions
from libero_env.storage import atomic_path


@script(
    option("--demo-file", type=Path, required=True, help="file with states and actions (demo.hdf5)"),
    option("--use-actions", action="store_true", help="replay the actions instead of the states"),
    option("--use-camera-obs", action="store_true", help="draw the pictures of the cameras"),
    option("--dataset-path", type=Path, default=Path("datasets"), help="folder (default: datasets)"),
    option("--dataset-name", default="", help="file in the folder (default: <suite>/<task>_demo.hdf5)"),
    option("--no-proprio", action="store_true", help="leave out joints, gripper and end effector"),
    option("--use-depth", action="store_true", help="draw depth, too"),
    option("--size", type=int, default=128, help="size of the pictures, pixels (default: 128)"),
)
def main(args: argparse.Namespace) -> None:
    """Write the data set and print what it holds."""
    task = recorded_task(args.demo_file)
    name = args.dataset_name or f"{task.suite}/{task.name}_demo.hdf5"
    target = args.dataset_path / (name if name.endswith(".hdf5") else f"{name}.hdf5")
    modalities = ("rgb", "depth") if args.use_depth else ("rgb",)
    cameras = RenderConfig().cameras if args.use_camera_obs else ()
    config = RenderConfig(cameras, (args.size, args.size), modalities)
    if args.use_actions:
        with tempfile.TemporaryDirectory() as folder:
            rerender(rerun_actions(args.demo_file, Path(folder) / "rerun.hdf5"), target, config)
    else:
        rerender(args.demo_file, target, config)
    if args.no_proprio:
        drop_proprioception(target)
    print(target)
    get_dataset_info(str(target))


def drop_proprioception(file: Path) -> None:
    """Remove everything but pictures and states from a file, in one step."""
    with atomic_path(file, fsync=True) as copy:
        shutil.copyfile(file, copy)
        with h5py.File(copy, "r+") as handle:
            for demo in handle["data"].values():
                for key in [key for key in LOW_DIM_KEYS if key in demo["obs"]]:
                    del demo["obs"][key]
                if "robot_states" in demo:
                    del demo["robot_states"]
