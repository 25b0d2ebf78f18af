"""The environment type `libero_lifelong` of LeRobot: its options, features and processors."""

from dataclasses import dataclass, field

from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig, HubEnvConfig
from lerobot.processor import LiberoProcessorStep, PolicyProcessorPipeline
from lerobot.utils.constants import ACTION, OBS_IMAGES, OBS_STATE

from lerobot_env_libero_lifelong.settings import (
    OBS_TYPES,
    ROBOT_STATE,
    Settings,
    chosen_starts,
    selected_tasks,
)
from lerobot_env_libero_lifelong.vector import TaskEnvs

DEFAULT_NAMES = {"agentview_image": "image", "robot0_eye_in_hand_image": "image2"}


@EnvConfig.register_subclass("libero_lifelong")
@dataclass
class LiberoLifelongEnv(HubEnvConfig):
    """LIBERO's tasks, with the options of LeRobot's own type `libero` and four of libero-lifelong.

    Attributes:
        task: Names of suites, separated by commas: `libero_spatial,libero_goal`.
        task_ids: Indices of the tasks of each suite; None for all.
        fps: Rate of control, [Hz], which divides 500; data of LIBERO are of 20.
        episode_length: Maximum number of steps of the policy; None for those of LeRobot, 280 to 520 by suite.
        obs_type: `pixels_agent_pos`, images and state, or `pixels`.
        render_mode: `rgb_array`.
        camera_name: Cameras with the ending `_image`, separated by commas.
        camera_name_mapping: Camera -> name of its image; by default `image` and `image2`.
        init_states: Whether episodes start in the 50 stored states in turn, or in new placements by seed.
        observation_height: Height of images, [pixels].
        observation_width: Width of images, [pixels].
        control_mode: `relative` or `absolute` actions.
        original_starts: Whether these states are those that LIBERO publishes, with fixtures placed by the episode's
            seed, as in LeRobot's own type; needs the original's models and states.
        num_steps_wait: Number of steps before the policy acts, with the gripper opened.
        drawing: `faithful` as the original, or `fast`; None for the default of the models.
        robot: Model of the arm: `libero`, or `robosuite-1.4.1`.
        assets: Models: `builtin`, a folder of the original's, or None for the user's choice.
        hub_path: Repository of the Hugging Face Hub whose `env.py` makes the environments; None for this package.
    """

    task: str = "libero_10"
    task_ids: list[int] | None = None
    fps: int = 20
    episode_length: int | None = None
    obs_type: str = "pixels_agent_pos"
    render_mode: str = "rgb_array"
    camera_name: str = "agentview_image,robot0_eye_in_hand_image"
    camera_name_mapping: dict[str, str] | None = None
    init_states: bool = True
    observation_height: int = 360
    observation_width: int = 360
    control_mode: str = "relative"
    original_starts: bool = False
    num_steps_wait: int = 10
    drawing: str | None = "faithful"
    robot: str = "libero"
    assets: str | None = None
    features: dict[str, PolicyFeature] = field(default_factory=dict)
    features_map: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.obs_type not in OBS_TYPES:
            raise ValueError(f"obs_type is {self.obs_type!r}; valid: {', '.join(OBS_TYPES)}")
        self.features = {ACTION: PolicyFeature(type=FeatureType.ACTION, shape=(7,))}
        self.features_map = {ACTION: ACTION}
        size = (self.observation_height, self.observation_width, 3)
        for camera, name in self.settings().cameras.items():
            self.features[f"pixels/{camera}"] = PolicyFeature(type=FeatureType.VISUAL, shape=size)
            self.features_map[f"pixels/{camera}"] = f"{OBS_IMAGES}.{name}"
        if self.obs_type == "pixels_agent_pos":
            for group, name, shape in ROBOT_STATE:
                key = f"robot_state/{group}/{name}"
                self.features[key] = PolicyFeature(type=FeatureType.STATE, shape=shape)
                prefix = "joint" if group == "joints" else group
                self.features_map[key] = f"{OBS_STATE}.{prefix}_{name}"

    def settings(self) -> Settings:
        """Return the options of the environments without those of LeRobot; see `Settings` for what is refused."""
        names = {**DEFAULT_NAMES, **(self.camera_name_mapping or {})}
        cameras = [camera.strip() for camera in self.camera_name.split(",") if camera.strip()]
        return Settings(
            cameras={camera: names.get(camera, camera) for camera in cameras},
            size=(self.observation_height, self.observation_width),
            with_state=self.obs_type == "pixels_agent_pos",
            max_steps=self.episode_length,
            wait_steps=self.num_steps_wait,
            starts=chosen_starts(self.init_states, self.original_starts),
            control_mode=self.control_mode,
            fps=self.fps,
            drawing=self.drawing,
            robot=self.robot,
            assets=self.assets,
        )

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, dict[int, TaskEnvs]]:
        """Return the environments of each task by suite and index; none is built before it is used."""
        settings = self.settings()
        return {
            suite: {
                task.index: TaskEnvs(task, n_envs, settings, processes=use_async_envs and n_envs > 1)
                for task in tasks
            }
            for suite, tasks in selected_tasks(self.task, self.task_ids).items()
        }

    def get_env_processors(self) -> tuple[PolicyProcessorPipeline, PolicyProcessorPipeline]:
        """Return LeRobot's processors of LIBERO: images turned by 180 degrees, state of 8 numbers."""
        return PolicyProcessorPipeline(steps=[LiberoProcessorStep()]), PolicyProcessorPipeline(steps=[])
