"""Labels of segmentation images."""

from dataclasses import dataclass

import numpy as np

from libero_env.errors import UnknownNameError
from libero_env.sim.scene import Scene

SEGMENTATIONS = ("instance", "class", "element")
ARENA, ARM, GRIPPER = "arena", "robot", "gripper"


@dataclass(frozen=True)
class Labels:
    """Labels of rendered elements, and the names of the labels.

    Attributes:
        of_element: Label of each number that `libero_env.sim.render` writes, (1 + ngeom + nsite,) int32.
        names: Name of each label.
    """

    of_element: np.ndarray
    names: dict[int, str]


def segmentation_labels(scene: Scene, kind: str) -> Labels:
    """Return the labels of a kind of segmentation.

    `instance`: 0 is the arena and everything without a name of its own, 1 the robot with its mount, 2 the gripper, then
    objects and fixtures in the order of the task file. `class`: the same, with one number for each category.
    `element`: 1 + index of the geom, or 1 + number of geoms + index of the site; 0 for the background.

    Args:
        scene: Scene that is rendered.
        kind: `instance`, `class` or `element`.

    Raises:
        UnknownNameError: The kind does not exist.
    """
    model = scene.model
    if kind == "element":
        geoms = {1 + i: model.geom(i).name or f"geom{i}" for i in range(model.ngeom)}
        sites = {1 + model.ngeom + i: model.site(i).name or f"site{i}" for i in range(model.nsite)}
        return Labels(
            np.arange(1 + model.ngeom + model.nsite, dtype=np.int32), {0: "nothing", **geoms, **sites}
        )
    if kind not in SEGMENTATIONS:
        raise UnknownNameError("segmentation", kind, SEGMENTATIONS)
    entities = {name: name if kind == "instance" else item.category for name, item in scene.entities.items()}
    names = dict(enumerate(dict.fromkeys((ARENA, ARM, GRIPPER, *entities.values()))))
    numbers = {name: number for number, name in names.items()}
    of_body = np.zeros(model.nbody, np.int32)
    for body in range(model.nbody):
        name = model.body(body).name
        if name.startswith(("robot0_", "mount0_")):
            of_body[body] = numbers[ARM]
        elif name.startswith("gripper0_"):
            of_body[body] = numbers[GRIPPER]
    for name, label in entities.items():
        of_body[scene.bodies[name]] = numbers[label]
    of_element = np.concatenate([[0], of_body[model.geom_bodyid], of_body[model.site_bodyid]])
    return Labels(of_element.astype(np.int32), names)
