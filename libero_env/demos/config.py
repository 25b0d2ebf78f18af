"""What the demonstrations of a task depend on, and what a file states about how it was made."""

import hashlib
import json
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from importlib import metadata
from pathlib import Path
from typing import Annotated, Any

import mujoco
import numpy as np
from pydantic import Field

from libero_env.assets.pack import select_pack
from libero_env.assets.robot import DEFAULT_ROBOT, ROBOTS, robosuite_version
from libero_env.demos.contents import Pairing
from libero_env.demos.observe import RenderConfig
from libero_env.demos.write import DemoWriter, make_header
from libero_env.errors import UnknownNameError
from libero_env.sim.engine import MUJOCO, BackEnd
from libero_env.sim.observations import DEFAULT_CAMERAS
from libero_env.sim.osc import POSITION_SCALE, ROTATION_SCALE
from libero_env.sim.scene import FAST, build_scene, default_drawing
from libero_env.tasks import Task, get_task, read_task
from libero_env.timing import CONTROL_HZ
from libero_env.validation import validate, validate_arguments

GENERATOR = "scripted-expert-14"  # change it when the same seed yields different demonstrations


@dataclass(frozen=True)
class Variation:
    """How the demonstrations of a task differ from each other.

    Attributes:
        style: Whether the motion style is sampled for each demonstration; if not, all have the same.
        noise: Standard deviation of the smooth noise on the executed actions, in units of the action.
        push_rate: Pushes started per control step.
        reserved: Whether demonstration k starts from stored state k (modulo 50), which evaluation uses, instead of
            from a newly sampled one.
    """

    style: bool = True
    noise: Annotated[float, Field(ge=0, le=10)] = 0.12
    push_rate: Annotated[float, Field(ge=0, le=1)] = 0.02
    reserved: bool = False

    def __post_init__(self) -> None:
        validate_arguments(Variation, vars(self))

    def header(self) -> dict[str, str]:
        """Return the attributes of a file: the values that are not the defaults."""
        changed = {key: value for key, value in vars(self).items() if value != getattr(Variation, key)}
        return {"variation": json.dumps(changed)} if changed else {}


@dataclass(frozen=True)
class DemoConfig:
    """What the demonstrations of a task depend on.

    Attributes:
        source: A task, its name such as `libero_object/3`, or the path of a BDDL file.
        camera_size: (height, width) of the images, pixels.
        seed: Seed of the starts, motion styles and action noise.
        pairing: Which observation is stored with an action, see `libero_env.demos.read`.
        disturb: Whether noise is added to the executed actions; the file then also holds the expert's own actions.
        variation: How the demonstrations differ from each other.
        cameras: Names of the cameras in the model.
        modalities: Kinds of image, see `RenderConfig`.
        drawing: How images are drawn, one of `DRAWINGS`; None for the default of the models.
        robot: Model of the arm, see `libero_env.assets.robot`.
        backend: Back end of the physics, such as `warp,device=cuda:1`, see `libero_env.sim.engine`. Images are drawn
            from the states by OpenGL with all of them.
    """

    source: Task | str
    camera_size: tuple[int, int] = (128, 128)
    seed: int = 0
    pairing: Pairing = "aligned"
    disturb: bool = True
    variation: Variation = Variation()
    cameras: tuple[str, ...] = DEFAULT_CAMERAS
    modalities: tuple[str, ...] = ("rgb",)
    drawing: str | None = None
    robot: str = DEFAULT_ROBOT
    backend: str = MUJOCO

    def __post_init__(self) -> None:
        validate(Annotated[int, Field(ge=0)], self.seed, prefix=("seed",))
        self.back_end.require_installed()
        validate(Pairing, self.pairing, prefix=("pairing",))
        if self.robot not in ROBOTS:
            raise UnknownNameError("robot", self.robot, ROBOTS)

    @cached_property
    def drawn(self) -> str:
        """How images are drawn, one of `DRAWINGS`."""
        return self.drawing or default_drawing(select_pack())

    @property
    def back_end(self) -> BackEnd:
        """Back end of the physics."""
        return BackEnd.read(self.backend)

    @property
    def batch(self) -> int:
        """Number of demonstrations that are simulated together, and written before the next ones."""
        return 50 if self.back_end.is_warp else 5

    @cached_property
    def task(self) -> Task:
        """The task that `source` names."""
        if isinstance(self.source, Task):
            return self.source
        return read_task(self.source) if self.source.endswith(".bddl") else get_task(self.source)

    @property
    def render_config(self) -> RenderConfig:
        """What is rendered of each state."""
        return RenderConfig(self.cameras, self.camera_size, self.modalities, self.drawn)

    def header(self) -> dict[str, Any]:
        """Return the attributes of the file. This compiles the scene, for its digest."""
        task = self.task
        versions = {
            "mujoco": metadata.version("mujoco"),
            "robosuite": robosuite_version(),
            "h5py": metadata.version("h5py"),
        }
        return make_header(
            problem_name=task.problem.name,
            language=task.language,
            bddl_name=f"{task.suite}/{task.name}.bddl",
            bddl_text=task.bddl_text,
            env_kwargs=_env_kwargs(self.render_config),
            pairing=self.pairing,
            seed=self.seed,
            generator=GENERATOR,
            disturbed=self.disturb,
            robot=self.robot,
            **(
                {"backend": self.back_end.name} if self.back_end.is_warp else {}
            ),  # files without it are of mujoco
            model_digest=model_digest(task, self.drawn, self.robot),
            models=json.dumps({"pack": (pack := select_pack()).name, "digest": pack.digest}),
            versions=json.dumps(versions),
            **self.render_config.header(),
            **self.variation.header(),
        )

    def key(self) -> str:
        """Return a text that is the same for equal configurations of any task.

        Folders of recorded demonstrations are named by a checksum of it, so it must never change. It contains the names
        that classes and fields had when the first files were recorded.
        """
        v = self.variation
        variation = (
            f"Variation(style={v.style!r}, noise={v.noise!r}, push_rate={v.push_rate!r}, "
            f"reserved={v.reserved!r})"
        )
        robot = "" if self.robot == DEFAULT_ROBOT else f", robot={self.robot!r}"
        robot += f", backend={self.back_end.name!r}" if self.back_end.is_warp else ""
        return (
            f"Recipe(source='', camera_size={self.camera_size!r}, seed={self.seed!r}, pairing={self.pairing!r}, "
            f"disturb={self.disturb!r}, variation={variation}, cameras={self.cameras!r}, "
            f"pictures={self.modalities!r}{'' if self.drawn == FAST else f', drawing={self.drawn!r}'}{robot})"
        )


@dataclass(frozen=True)
class RecordingJob:
    """A demonstration file to record.

    Attributes:
        config: What its demonstrations depend on.
        path: File to write.
        header: Attributes of the file.
    """

    config: DemoConfig
    path: Path
    header: dict[str, Any] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "header", self.config.header())

    def writer(self) -> DemoWriter:
        """Return a writer of the file."""
        return DemoWriter(self.path, self.header)


@lru_cache(maxsize=16)
def model_digest(task: Task, drawing: str | None = None, robot: str = DEFAULT_ROBOT) -> str:
    """Return 16 hex digits that change with anything in the task's compiled scene, its appearance included."""
    model = build_scene(task.problem, drawing=drawing, robot=robot).model
    buffer = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return hashlib.sha256(buffer.tobytes()).hexdigest()[:16]


def _env_kwargs(render: RenderConfig) -> dict[str, Any]:
    """Return the arguments that the original's environment would be made with."""
    height, width = render.size
    controller = {
        "type": "OSC_POSE",
        "input_max": 1,
        "input_min": -1,
        "output_max": [POSITION_SCALE] * 3 + [ROTATION_SCALE] * 3,
        "output_min": [-POSITION_SCALE] * 3 + [-ROTATION_SCALE] * 3,
        "kp": 150,
        "damping_ratio": 1,
        "impedance_mode": "fixed",
        "control_delta": True,
        "uncouple_pos_ori": True,
        "interpolation": None,
    }
    return {
        "robots": ["Panda"],
        "controller_configs": controller,
        "control_freq": CONTROL_HZ,
        "camera_names": sorted(render.cameras, reverse=True),
        "camera_heights": height,
        "camera_widths": width,
        "camera_depths": "depth" in render.modalities,
        "use_camera_obs": True,
        "has_renderer": False,
        "has_offscreen_renderer": True,
        "ignore_done": True,
        "reward_shaping": True,
    }
