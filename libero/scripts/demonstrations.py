"""Scripts of demonstrations: record by hand, make data sets of them, look at data sets, check and download them."""

import shutil
import tempfile
from dataclasses import fields
from pathlib import Path
from typing import Literal

import h5py
from pydantic.dataclasses import dataclass

from libero._adapters.models import facade_robot
from libero.libero.benchmark import get_benchmark
from libero.libero.utils.dataset_utils import get_dataset_info as dataset_info
from libero.libero.utils.download_utils import check_libero_dataset, datasets_folder, libero_dataset_download
from libero.scripts.command import script
from libero_env.assets.robot import DEFAULT_ROBOT
from libero_env.cli.demos import check_files
from libero_env.cli.options import Positional, Positive, Side
from libero_env.cli.teleop import InputOptions, TeleopRequest, teleop
from libero_env.demos.config import RenderConfig
from libero_env.demos.contents import LOW_DIM_KEYS
from libero_env.demos.curate import find_demo_files
from libero_env.demos.observe import recorded_task
from libero_env.demos.rendering import rerender
from libero_env.demos.replay import rerun_actions
from libero_env.errors import LiberoError
from libero_env.paths import config_file
from libero_env.storage import atomic_path
from libero_env.tasks import get_suite, read_task, suite_names
from libero_env.tasks.problem import same_meaning


@dataclass(frozen=True, kw_only=True)
class Recording(InputOptions):
    """Record demonstrations by hand. An episode ends when its goal has held for ten steps.

    Attributes:
        directory: Folder of the files.
        robots: Panda is the only robot.
        config: The benchmark has one arm.
        arm: The benchmark has one arm.
        controller: OSC_POSE is the only controller.
        num_demonstration: Demonstrations in the file.
        size: Size of the recorded pictures, pixels.
    """

    directory: Path = Path("demonstration_data")
    robots: tuple[Literal["Panda"]] = ("Panda",)
    config: Literal["single-arm-opposed"] = "single-arm-opposed"
    arm: Literal["right"] = "right"
    controller: Literal["OSC_POSE"] = "OSC_POSE"
    num_demonstration: Positive = 50
    size: Side = 128

    def collect(self, bddl: Path) -> int:
        """Record into `<directory>/<problem>_<task>/demo.hdf5`; return 1 where the user stopped early.

        A file of the benchmark, in a folder of its suite's name, is recorded as the benchmark's task.
        """
        if (robot := facade_robot()) != DEFAULT_ROBOT:
            raise LiberoError(f"{config_file()} names the robot {robot}; by hand only libero is recorded")
        task, suite = read_task(bddl), bddl.absolute().parent.name
        tasks = get_suite(suite).tasks if suite in suite_names() else ()
        same = (t.id for t in tasks if t.name == task.name and same_meaning(t.problem, task.problem))
        named = next(same, None)
        which = {"bddl": bddl} if named is None else {"task": named}
        out = self.directory / f"{task.problem.name.lower()}_{task.name}" / "demo.hdf5"
        out.parent.mkdir(parents=True, exist_ok=True)
        options = {one.name: getattr(self, one.name) for one in fields(InputOptions)} | which
        size = (self.size, self.size)
        return teleop(TeleopRequest(out=out, n=self.num_demonstration, size=size, **options))


@dataclass(frozen=True, kw_only=True)
class RecordingOfFile(Recording):
    """Record demonstrations of a task file by hand. An episode ends when its goal has held for ten steps.

    Attributes:
        bddl_file: Task file.
    """

    bddl_file: Path


@dataclass(frozen=True, kw_only=True)
class RecordingOfTask(Recording):
    """Record demonstrations of a task of LIBERO-100 by hand; the task is given by its number.

    Attributes:
        task_id: 0 to 99; 90 to 99 are libero_10.
    """

    task_id: int


@script()
def collect_demonstration(request: RecordingOfFile) -> int:
    """Record demonstrations of a task file."""
    return request.collect(request.bddl_file)


@script()
def libero_100_collect_demonstrations(request: RecordingOfTask) -> int:
    """Record demonstrations of a task of LIBERO-100; raise a LiberoError if there is no such task."""
    suite = get_benchmark("libero_100")()
    if request.task_id not in range(suite.n_tasks):
        raise LiberoError(f"--task-id {request.task_id}: LIBERO-100 has 0 to {suite.n_tasks - 1}")
    return request.collect(Path(suite.get_task_bddl_file_path(request.task_id)))


@script()
def create_dataset(
    *,
    demo_file: Path,
    use_actions: bool = False,
    use_camera_obs: bool = False,
    dataset_path: Path = Path("datasets"),
    dataset_name: str = "",
    no_proprio: bool = False,
    use_depth: bool = False,
    size: Side = 128,
) -> None:
    """Make a data set of collected demonstrations: pictures and proprioception of each state; print what it holds.

    Args:
        demo_file: File with states and actions (demo.hdf5).
        use_actions: Replay the actions instead of the states.
        use_camera_obs: Draw the pictures of the cameras.
        dataset_path: Folder.
        dataset_name: File in the folder (default: SUITE/TASK_demo.hdf5).
        no_proprio: Leave out joints, gripper and end effector.
        use_depth: Draw the depth of the cameras, too.
        size: Size of the pictures, pixels.
    """
    if use_depth and not use_camera_obs:
        raise LiberoError("--use_depth draws the depth of the cameras; add --use_camera_obs")
    task = recorded_task(demo_file)
    name = dataset_name or f"{task.suite}/{task.name}_demo.hdf5"
    target = dataset_path / (name if name.endswith(".hdf5") else f"{name}.hdf5")
    modalities = ("rgb", "depth") if use_depth else ("rgb",)
    config = RenderConfig(RenderConfig().cameras if use_camera_obs else (), (size, size), modalities)
    if use_actions:
        with tempfile.TemporaryDirectory() as folder:
            rerender(rerun_actions(demo_file, Path(folder) / "rerun.hdf5"), target, config)
    else:
        rerender(demo_file, target, config)
    if no_proprio:
        _drop_proprioception(target)
    print(target)
    dataset_info(str(target))


def _drop_proprioception(file: Path) -> None:
    """Remove everything but pictures and states from a file, in one step."""
    with atomic_path(file, fsync=True) as copy:
        shutil.copyfile(file, copy)
        with h5py.File(copy, "r+") as handle:
            for demo in handle["data"].values():
                for key in [key for key in LOW_DIM_KEYS if key in demo["obs"]]:
                    del demo["obs"][key]
                if "robot_states" in demo:
                    del demo["robot_states"]


@script()
def get_dataset_info(*, dataset: str, filter_key: str | None = None, verbose: bool = False) -> int:
    """Print what a demonstration file holds: lengths, range of actions, instruction, and observations.

    Args:
        dataset: HDF5 file.
        filter_key: Name of a subset in `mask`.
        verbose: Print the arrays of each demonstration, too.
    """
    info = dataset_info(dataset, filter_key)
    if verbose:
        for name, arrays in info["structure"].items():
            print(name)
            for key, shape in arrays.items():
                print(f"    {key}: {shape}")
    within = info["action_min"] >= -1.0 and info["action_max"] <= 1.0
    if not within:
        print("actions are not in [-1, 1]")
    return int(not within)


@script()
def check_dataset_integrity(paths: Positional[tuple[Path, ...]] = (), *, num_demos: int = 50) -> int:
    """Check that demonstration files are complete: every array is read; shapes, ranges and counts are compared.

    Args:
        paths: Files or folders (default: the folder of the data sets).
        num_demos: Demonstrations expected in each file.
    """
    files = find_demo_files(paths or [datasets_folder()])
    broken = sum(bool(row["faults"]) for row in check_files(files, num_demos))
    print(f"{len(files) - broken} of {len(files)} files are complete")
    return int(broken > 0)


@script()
def download_libero_datasets(
    *,
    download_dir: Path | None = None,
    datasets: Literal["all", "libero_object", "libero_goal", "libero_spatial", "libero_100"] = "all",
    use_huggingface: bool = False,
) -> int:
    """Download the demonstrations that people recorded for the benchmark; files that exist are kept.

    Args:
        download_dir: Folder (default: that of get_libero_path('datasets')).
        datasets: Data set.
        use_huggingface: Download verified files of the Hub, not archives.
    """
    folder = download_dir or datasets_folder()
    libero_dataset_download(datasets, folder, use_huggingface=use_huggingface)
    complete = check_libero_dataset(folder)
    return int(datasets == "all" and not complete)
