"""Scripts of demonstrations: record by hand, make data sets of them, download them."""

import tempfile
from dataclasses import fields
from pathlib import Path
from typing import Literal

from pydantic.dataclasses import dataclass

from libero._adapters.models import facade_robot
from libero.libero.utils.dataset_utils import get_dataset_info as dataset_info
from libero.libero.utils.download_utils import check_libero_dataset, datasets_folder, libero_dataset_download
from libero.scripts.command import script
from libero_env.assets.robot import DEFAULT_ROBOT
from libero_env.cli.options import Positive, Side
from libero_env.cli.teleop import InputOptions, TeleopRequest, teleop
from libero_env.curating.rendering import rerender
from libero_env.demos.config import RenderConfig
from libero_env.demos.observe import recorded_task
from libero_env.demos.replay import rerun_actions
from libero_env.errors import LiberoError
from libero_env.paths import config_file
from libero_env.tasks import get_suite, read_task, suite_names
from libero_env.tasks.problem import same_meaning


@dataclass(frozen=True, kw_only=True)
class Recording(InputOptions):
    """Record demonstrations of a task file by hand. An episode ends when its goal has held for ten steps.

    Attributes:
        bddl_file: Task file.
        directory: Folder of the files.
        robots: Panda is the only robot.
        config: The benchmark has one arm.
        arm: The benchmark has one arm.
        controller: OSC_POSE is the only controller.
        num_demonstration: Demonstrations in the file.
        size: Size of the recorded pictures, pixels.
    """

    bddl_file: Path
    directory: Path = Path("demonstration_data")
    robots: tuple[Literal["Panda"]] = ("Panda",)
    config: Literal["single-arm-opposed"] = "single-arm-opposed"
    arm: Literal["right"] = "right"
    controller: Literal["OSC_POSE"] = "OSC_POSE"
    num_demonstration: Positive = 50
    size: Side = 128

    def collect(self) -> int:
        """Record into `<directory>/<problem>_<task>/demo.hdf5`; return 1 where the user stopped early.

        A file of the benchmark, in a folder of its suite's name, is recorded as the benchmark's task.
        """
        if (robot := facade_robot()) != DEFAULT_ROBOT:
            raise LiberoError(f"{config_file()} names the robot {robot}; by hand only libero is recorded")
        task, suite = read_task(self.bddl_file), self.bddl_file.absolute().parent.name
        tasks = get_suite(suite).tasks if suite in suite_names() else ()
        same = (t.id for t in tasks if t.name == task.name and same_meaning(t.problem, task.problem))
        named = next(same, None)
        which = {"bddl": self.bddl_file} if named is None else {"task": named}
        out = self.directory / f"{task.problem.name.lower()}_{task.name}" / "demo.hdf5"
        out.parent.mkdir(parents=True, exist_ok=True)
        options = {one.name: getattr(self, one.name) for one in fields(InputOptions)} | which
        size = (self.size, self.size)
        return teleop(TeleopRequest(out=out, n=self.num_demonstration, size=size, **options))


@script()
def collect_demonstration(request: Recording) -> int:
    """Record demonstrations of a task file."""
    return request.collect()


@script()
def create_dataset(
    *,
    demo_file: Path,
    use_actions: bool = False,
    use_camera_obs: bool = False,
    dataset_path: Path = Path("datasets"),
    dataset_name: str = "",
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
    print(target)
    dataset_info(str(target))


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
        use_huggingface: Without effect; the files of the Hub are downloaded.
    """
    folder = download_dir or datasets_folder()
    libero_dataset_download(datasets, folder, use_huggingface=use_huggingface)
    complete = check_libero_dataset(folder)
    return int(datasets == "all" and not complete)
