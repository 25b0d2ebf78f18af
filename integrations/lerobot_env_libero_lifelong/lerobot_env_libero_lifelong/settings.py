"""What the environments are made from; needs neither LeRobot nor PyTorch."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from libero_env.envs.config import EnvConfig
from libero_env.errors import LiberoError, require_known
from libero_env.tasks import Task, get_suite
from libero_env.timing import CONTROL_HZ, FREQUENCIES

OBS_TYPES = ("pixels_agent_pos", "pixels")
CONTROL_MODES = ("relative", "absolute")
STARTS = ("stored", "original", "new")
# LeRobot's `lerobot/envs/libero.py`, TASK_SUITE_MAX_STEPS; other suites have 500 there
MAX_STEPS = {"spatial": 280, "object": 280, "goal": 300, "10": 520, "90": 400}
OTHER_MAX_STEPS = 500
# group and name of each entry of `robot_state`, and its shape
ROBOT_STATE = (
    ("eef", "pos", (3,)),
    ("eef", "quat", (4,)),
    ("eef", "mat", (3, 3)),
    ("gripper", "qpos", (2,)),
    ("gripper", "qvel", (2,)),
    ("joints", "pos", (7,)),
    ("joints", "vel", (7,)),
)
OBSERVED = "ee_pos ee_quat gripper_states gripper_velocities joint_states joint_velocities".split()  # noqa: SIM905


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Options of the environments of a task.

    Attributes:
        cameras: Camera with the ending `_image` -> name of its image.
        size: Height and width of the images, [pixels].
        with_state: Whether observations have the state of the robot.
        max_steps: Maximum number of steps of the policy; None for LeRobot's of the suite.
        wait_steps: Number of steps before the policy acts.
        starts: Where episodes start. `stored`: in the 50 states of this package, fixtures included. `original`: as in
            LeRobot's own environments, in the states that LIBERO publishes, with fixtures placed by the episode's seed.
            `new`: in new placements, by seed.
        control_mode: `relative` or `absolute`.
        fps: Rate of control, [Hz]; data of LIBERO are of 20, those that are labelled with 10 fps, too.
        drawing: As in `libero_env.envs.config.EnvConfig`; so are `robot` and `assets`.

    Raises:
        UnknownNameError: The control mode or the starts do not exist.
        LiberoError: The rate of control, a camera's name, or a number of steps is not valid.
    """

    cameras: Mapping[str, str]
    size: tuple[int, int]
    with_state: bool = True
    max_steps: int | None = None
    wait_steps: int = 10
    starts: str = "stored"
    control_mode: str = "relative"
    fps: int = CONTROL_HZ
    drawing: str | None = None
    robot: str = "libero"
    assets: str | None = None

    def __post_init__(self) -> None:
        for name, valid in (("control_mode", CONTROL_MODES), ("starts", STARTS), ("fps", FREQUENCIES)):
            require_known(name, getattr(self, name), valid)
        if not self.cameras or not all(camera.endswith("_image") for camera in self.cameras):
            raise LiberoError(
                f"camera_name is {','.join(self.cameras)!r}; expected names such as agentview_image,"
                "robot0_eye_in_hand_image"
            )
        if len(set(self.cameras.values())) < len(self.cameras):
            raise LiberoError(f"camera_name_mapping gives two cameras one name: {dict(self.cameras)}")
        if self.wait_steps < 0 or (self.max_steps is not None and self.max_steps < 1):
            raise LiberoError(
                f"num_steps_wait is {self.wait_steps} and episode_length {self.max_steps}; "
                "expected at least 0 and at least 1"
            )

    @property
    def control_delta(self) -> bool:
        """Whether actions are relative to the current pose."""
        return self.control_mode == "relative"

    def steps(self, task: Task) -> int:
        """Return the maximum number of steps of the policy on a task."""
        steps = MAX_STEPS.get(task.suite.removeprefix("libero_"), OTHER_MAX_STEPS)
        return steps if self.max_steps is None else self.max_steps

    def env_config(self, task: Task) -> EnvConfig:
        """Return the configuration of the simulations of a task."""
        return EnvConfig(
            cameras=[camera.removesuffix("_image") for camera in self.cameras],
            camera_size=self.size,
            horizon=self.wait_steps + self.steps(task),
            observations=("rgb", *OBSERVED),
            control_delta=self.control_delta,
            control_freq=self.fps,
            drawing=self.drawing,
            robot=self.robot,
            assets=self.assets,
            observed="substep",
        )


def chosen_starts(init_states: bool, original: bool) -> str:
    """Return the `starts` of the options `init_states` and `original_starts`.

    Raises:
        LiberoError: They contradict each other.
    """
    if original and not init_states:
        raise LiberoError("original_starts are init_states, and init_states is false: leave one of them out")
    return ("original" if original else "stored") if init_states else "new"


def selected_tasks(suites: str, indices: Sequence[int] | None = None) -> dict[str, list[Task]]:
    """Return tasks by suite.

    Args:
        suites: Names of suites, separated by commas.
        indices: Indices of the tasks of each suite; None for all.

    Raises:
        UnknownNameError: A suite does not exist.
        LiberoError: No suite is named, or a task does not exist.
    """
    names = [name.strip() for name in suites.split(",") if name.strip()]
    if not names:
        raise LiberoError("task names no suite; expected names such as libero_spatial,libero_goal")
    chosen: dict[str, list[Task]] = {}
    for name in names:
        tasks = get_suite(name).tasks
        wanted = range(len(tasks)) if indices is None else sorted(set(indices))
        if wrong := [i for i in wanted if not 0 <= i < len(tasks)]:
            raise LiberoError(f"task_ids {wrong} do not exist: {name} has 0 to {len(tasks) - 1}")
        chosen[name] = [tasks[i] for i in wanted]
    return chosen
