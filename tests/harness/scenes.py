"""Scenes and meshes, as users of the facade define them."""

from pathlib import Path

import numpy as np

from libero.libero.utils.mu_utils import InitialSceneTemplates, register_mu


def register_scene(name: str, furniture: str, yaw: tuple[float, float] = (0.0, 0.0), **objects):
    """Register a kitchen with furniture at the back of the table and objects at (x, y) of it; return the class."""

    class Scene(InitialSceneTemplates):
        def __init__(self):
            fixtures = {"kitchen_table": 1, furniture: 1}
            super().__init__("kitchen_table", fixtures, dict.fromkeys(objects, 1))

        def define_regions(self):
            self.place(furniture, (0.0, -0.3), 0.01, yaw)
            for one, middle in objects.items():
                self.place(one, middle, 0.025, (0.0, 0.0))

        def place(self, one, middle, half, turned):
            region = f"{one}_init_region"
            self.regions |= self.get_region_dict(middle, region, self.workspace_name, half, turned)

        @property
        def init_states(self):
            names = (*objects, furniture)
            return [("On", f"{one}_1", f"kitchen_table_{one}_init_region") for one in names]

    Scene.__name__ = name
    return register_mu(scene_type="kitchen")(Scene)


def write_box(path: Path, half: float, offset: float = 0.0) -> None:
    """Write a cube of 12 triangles as OBJ, its middle `offset` m up."""
    corners = [(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
    lines = ["v {} {} {}".format(*np.multiply(corner, half) + (0, 0, offset)) for corner in corners]
    quads = ((1, 2, 4, 3), (5, 7, 8, 6), (1, 5, 6, 2), (3, 4, 8, 7), (1, 3, 7, 5), (2, 6, 8, 4))
    lines += [f"f {a} {b} {c}\nf {a} {c} {d}" for a, b, c, d in quads]
    path.write_text("\n".join(lines))
