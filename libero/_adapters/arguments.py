"""Arguments of the original's environments: those that change something here, and those of which one value is valid."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from libero_env.assets.original_arena import SCENES
from libero_env.errors import InvalidInputError, UnknownNameError
from libero_env.init_states.placement import ARM_NOISE
from libero_env.sim.scene_spec import workspace_of
from libero_env.storage import read_yaml
from libero_env.tasks.problem import Problem
from libero_env.text import shown
from libero_env.timing import TIMESTEP

# Without effect in the original's own problem classes, which set them, or about a window or the choice of a GPU.
WITHOUT_EFFECT = """
    arena_type custom_material env_configuration env_name has_offscreen_renderer render_gpu_device_id renderer_config
    robot_configs table_friction table_full_size table_offset use_latch visualization_sites_list workspace_name
    workspace_offset z_offset
""".split()  # noqa: SIM905
# Of these, other values would change something in the original.
ONLY: dict[str, tuple[Any, ...]] = {
    "gripper_types": ("default", "PandaGripper"),
    "mount_types": ("default",),
    "object_property_initializers": (None, []),
    "render_collision_mesh": (False,),
    "render_visual_mesh": (True,),
    "renderer": ("mujoco", "default"),
}
_USUAL_STYLES = {"floor": "light-gray", "wall": "light-gray-plaster"}  # of the original's arenas
DEFAULT_NOISE = {"magnitude": ARM_NOISE, "type": "gaussian"}


def check_arguments(given: Mapping[str, Any], valid: Mapping[str, Any]) -> None:
    """Check further arguments of an environment.

    Args:
        given: Arguments by name.
        valid: Names of the other valid arguments.

    Raises:
        UnknownNameError: There is no such argument.
        InvalidInputError: A value is not supported.
    """
    for key, value in given.items():
        if key not in WITHOUT_EFFECT and key not in ONLY:
            raise UnknownNameError("argument", key, [*valid, *ONLY, *WITHOUT_EFFECT])
        one = value[0] if isinstance(value, list | tuple) and len(value) == 1 else value
        if key in ONLY and one not in ONLY[key]:
            values = " or ".join(map(repr, ONLY[key]))
            raise InvalidInputError(f"{key}={shown(value)}: not supported; leave {values}")


def check_horizon(horizon: Any) -> None:
    """Raise an InvalidInputError unless a horizon is above 0; robosuite takes infinity, too."""
    number = isinstance(horizon, int | float | np.integer | np.floating) and not isinstance(horizon, bool)
    if not number or not horizon > 0:
        raise InvalidInputError(f"horizon is {shown(horizon)}; expected at least 1")


def substeps_of(control_freq: Any) -> int:
    """Return the number of physics steps of a control step, as robosuite rounds it; raise an InvalidInputError."""
    is_number = isinstance(control_freq, int | float | np.integer | np.floating)
    if not is_number or not 0 < control_freq <= 1 / TIMESTEP:
        valid = f"a number above 0 and up to {1 / TIMESTEP:g} Hz"
        raise InvalidInputError(f"control_freq={shown(control_freq)}; expected {valid}")
    return int(1.0 / float(control_freq) / TIMESTEP)


def noise_of(noise: Any) -> dict[str, Any]:
    """Return magnitude, rad, and type of the noise of the arm's first joints; raise an InvalidInputError."""
    noise = noise[0] if isinstance(noise, list | tuple) and len(noise) == 1 else noise
    if noise is None:
        return {"magnitude": 0.0, "type": "gaussian"}
    if isinstance(noise, str) and noise == "default":
        return dict(DEFAULT_NOISE)
    try:
        magnitude, kind = float(noise["magnitude"] or 0.0), noise["type"]
    except (TypeError, KeyError, ValueError, IndexError):
        magnitude, kind = -1.0, None
    if kind not in ("gaussian", "uniform") or not 0 <= magnitude < np.inf:
        valid = "'default', None, or {'magnitude': 0.02, 'type': 'gaussian'} or of type 'uniform'"
        raise InvalidInputError(f"initialization_noise={shown(noise)}; expected {valid}")
    return {"magnitude": magnitude, "type": kind}


def with_room(problem: Problem, scene_xml: Any, scene_properties: Any) -> Problem:
    """Return a problem with the room of the original's arguments.

    Args:
        problem: Task.
        scene_xml: Scene file of the original, such as `scenes/libero_floor_warm_style.xml`; None for the task's own.
        scene_properties: `floor_style` and `wall_style`, as names of the original's textures; None for the task's own.

    Raises:
        InvalidInputError: The file is not a scene of the task's workspace.
    """
    if scene_xml is None and scene_properties is None:
        return problem
    workspace = workspace_of(problem)[1]
    room = {**workspace.parameters["styles"], **problem.scene_properties}
    if scene_xml is not None:
        styles = ("base", *read_yaml("assets/original.yaml")["scene_styles"].get(workspace.name, ()))
        files = {f"scenes/{SCENES[workspace.name]}_{style}_style.xml": style for style in styles}
        if str(scene_xml) not in files:
            valid = " or ".join(files)
            raise InvalidInputError(f"scene_xml={shown(scene_xml)}: not supported; expected {valid}")
        room["scene"] = files[str(scene_xml)]
    if scene_properties is not None:
        if not isinstance(scene_properties, Mapping):
            raise InvalidInputError(f"scene_properties={shown(scene_properties)}; expected a dictionary")
        room |= _USUAL_STYLES | {str(k).removesuffix("_style"): v for k, v in scene_properties.items()}
    return replace(problem, scene_properties=room)
