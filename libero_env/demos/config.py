"""What demonstrations depend on: how they are recorded, what is rendered, and what a file states about both."""

import hashlib
import json
from collections.abc import Iterator
from dataclasses import fields, replace
from functools import cached_property
from importlib import metadata
from typing import Annotated, Any

import numpy as np
from pydantic import Field, PlainValidator

from libero_env.assets.pack import select_pack
from libero_env.assets.robot import DEFAULT_ROBOT
from libero_env.demos.contents import Pairing
from libero_env.demos.write import make_header
from libero_env.doors import enter
from libero_env.envs.config import Cameras, Drawing, Names, Robot, Size
from libero_env.sim.backend import Backend
from libero_env.sim.observations import DEFAULT_CAMERAS, segmentation_labels
from libero_env.sim.scene import Scene, build_scene
from libero_env.sim.scene_spec import FAST, default_drawing
from libero_env.storage import read_yaml
from libero_env.tasks import Task, get_task
from libero_env.tasks.cameras import camera_name
from libero_env.tasks.suites import OWN
from libero_env.tasks.task import FILE
from libero_env.validation import checked

GENERATOR = "scripted-expert-16"  # change it when the same seed yields different demonstrations
PERTURBED_HEADER = ("perturb", "perturb_draws")  # attributes of a file that was rendered under perturbations
MASK_NAMES = "segmentation_names"  # attribute: JSON, number in a segmentation -> name
PERTURB_DRAWS = 1  # change it when the same perturbation of the same demonstration gives other observations

_IN_PATH = ("source", "camera_size", "seed")  # options that the path of a file names anyhow


def changed_options(config: Any) -> dict[str, Any]:
    """Return the values of a configuration that are not the defaults, by the name of their field."""
    values = {field.name: (getattr(config, field.name), field.default) for field in fields(config)}
    return {name: value for name, (value, default) in values.items() if value != default}


def _rendered(value: Any) -> tuple[Any, ...]:
    return enter("perturbations", "read_rendered")(value) if value else ()


@checked
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


@checked
class RenderConfig:
    """What is rendered of each state.

    Attributes:
        cameras: As for `EnvConfig`.
        size: (height, width) of the images, pixels.
        modalities: Kinds of image: `rgb`, `depth`, and at most one of `segmentation_instance`, `segmentation_class`
            and `segmentation_element`.
        drawing: How images are drawn, one of `DRAWINGS`; None for the default of the models.
        perturb: Perturbations, as for `EnvConfig`, of kinds that change what is seen or said, and no physics.

    Raises:
        UnknownNameError: A kind of perturbation does not exist.
        InvalidInputError: A value is not valid, or a perturbation changes what happens.
    """

    cameras: Cameras = DEFAULT_CAMERAS
    size: Size = (128, 128)
    modalities: Names = ("rgb",)
    drawing: Drawing | None = None
    perturb: Annotated[tuple[Any, ...], PlainValidator(_rendered)] = ()

    def header(self) -> dict[str, Any]:
        """Return the attributes of a file; the default cameras and modalities, and `fast`, are left out."""
        attributes: dict[str, Any] = {"camera_size": list(self.size)}
        if self.cameras != DEFAULT_CAMERAS:
            attributes["cameras"] = list(self.cameras)
        if self.modalities != ("rgb",):
            attributes["pictures"] = list(self.modalities)
        if self.drawing not in (None, FAST):
            attributes["drawing"] = self.drawing
        if self.perturb:
            text = ",".join(map(str, self.perturb))
            attributes |= zip(PERTURBED_HEADER, (text, PERTURB_DRAWS), strict=True)
        return attributes

    def mask_names(self, scene: Scene) -> dict[str, str]:
        """Return the attribute of a file that says what each number of its segmentation is; empty without one."""
        kinds = [one.partition("_")[2] for one in self.modalities if one.startswith("segmentation_")]
        names = {
            str(number): name
            for kind in kinds
            for number, name in segmentation_labels(scene, kind).names.items()
        }
        return {MASK_NAMES: json.dumps(names)} if names else {}


@checked
class DemoConfig:
    """What the demonstrations of a task depend on.

    Attributes:
        source: A task, its name such as `libero_object/3`, or the path of a task file.
        camera_size: (height, width) of the images, pixels.
        seed: Seed of the starts, motion styles and action noise.
        pairing: Which observation is stored with an action, see `libero_env.demos.read`.
        disturb: Whether noise is added to the executed actions; the file then also holds the expert's own actions.
        variation: How the demonstrations differ from each other.
        cameras: As for `RenderConfig`.
        modalities: As for `RenderConfig`.
        drawing: As for `RenderConfig`.
        robot: Model of the arm, see `libero_env.assets.robot`.
        backend: Back end of the physics, such as `warp,device=cuda:1`, see `libero_env.sim.backend`. Images are drawn
            from the states by OpenGL with all of them.
    """

    source: Task | str
    camera_size: Size = (128, 128)
    seed: Annotated[int, Field(ge=0)] = 0
    pairing: Pairing = "aligned"
    disturb: bool = True
    variation: Variation = Variation()
    cameras: Cameras = DEFAULT_CAMERAS
    modalities: Names = ("rgb",)
    drawing: Drawing | None = None
    robot: Robot = DEFAULT_ROBOT
    backend: Annotated[Backend, PlainValidator(Backend.read)] = Backend()

    def __post_init__(self) -> None:
        self.backend.require_installed()

    @cached_property
    def drawn(self) -> str:
        """How images are drawn, one of `DRAWINGS`."""
        return self.drawing or default_drawing(select_pack())

    @property
    def batch(self) -> int:
        """Largest number of demonstrations that are simulated together, and written before the next ones."""
        return 50 if self.backend.is_warp else 10

    @cached_property
    def task(self) -> Task:
        """The task that `source` names."""
        return self.source if isinstance(self.source, Task) else get_task(self.source)

    @property
    def render_config(self) -> RenderConfig:
        """What is rendered of each state."""
        return RenderConfig(self.cameras, self.camera_size, self.modalities, self.drawn)

    def options(self) -> dict[str, Any]:
        """Return the options that are not the defaults, beside task, size and seed, as plain data."""
        drawing = None if self.drawn == FAST else self.drawn
        options = changed_options(replace(self, drawing=drawing, backend=Backend(self.backend.name)))
        if "variation" in options:
            options["variation"] = changed_options(self.variation)
        if "backend" in options:
            options["backend"] = self.backend.name
        return {name: value for name, value in options.items() if name not in _IN_PATH}

    def header(self) -> dict[str, Any]:
        """Return the attributes of the file. This compiles the scene, for its digest."""
        task, pack = self.task, select_pack()
        versions = {name: metadata.version(name) for name in ("mujoco", "h5py")}
        scene = build_scene(task.problem, drawing=self.drawn, robot=self.robot)
        extra = self.render_config.header() | self.render_config.mask_names(scene)
        if variation := changed_options(self.variation):
            extra["variation"] = json.dumps(variation)
        # the user's models also have regions, grasps, ... that are in no compiled model
        if scene.workspace.own or any(item.digest for item in scene.entities.values()):
            extra["own_models"] = scene.digest
        if self.backend.is_warp:  # files without it are of MuJoCo
            extra["backend"] = self.backend.name
        return make_header(
            problem_name=task.problem.name,
            language=task.language,
            bddl_name=f"{task_home(task)}/{task.name}.bddl",
            bddl_text=task.bddl_text,
            env_kwargs={**read_yaml("demos/original_env.yaml"), **camera_kwargs(self.render_config)},
            pairing=self.pairing,
            seed=self.seed,
            generator=GENERATOR,
            disturbed=self.disturb,
            robot=self.robot,
            model_digest=model_digest(scene.model),
            models=json.dumps({"pack": pack.name, "digest": pack.digest}),
            versions=json.dumps(versions),
            **extra,
        )


def task_home(task: Task) -> str:
    """Return the folder of a task's demonstrations: its suite, or its own name where it is the user's."""
    return task.name if task.suite in (FILE, OWN) else task.suite


def model_digest(model: Any) -> str:
    """Return 16 hex digits that change with anything in a compiled scene, its appearance included.

    Where its files are installed does not matter: paths and what depends on their lengths are left out.
    """
    digest = hashlib.sha256()
    for name, content in _contents(model):
        digest.update(name.encode() + b"\0" + content)
    return digest.hexdigest()[:16]


def _contents(part: Any) -> Iterator[tuple[str, bytes]]:
    """Yield the name and the bytes of each value of a compiled model, or of a structure in it."""
    for name in dir(part):
        if name.startswith("_") or "path" in name or name in ("nbuffer", "signature"):
            continue
        value = getattr(part, name)
        if isinstance(value, np.ndarray):
            yield name, f"{value.shape} {value.dtype}".encode() + value.tobytes()
        elif isinstance(value, bytes | int | float):
            yield name, repr(value).encode()
        elif not callable(value):  # opt, vis, stat
            yield from ((f"{name}.{own}", content) for own, content in _contents(value))


def camera_kwargs(render: RenderConfig) -> dict[str, Any]:
    """Return those arguments of the original's environment that say what is rendered."""
    height, width = render.size
    return {
        "camera_names": sorted(map(camera_name, render.cameras), reverse=True),
        "camera_heights": height,
        "camera_widths": width,
        "camera_depths": "depth" in render.modalities,
    }
