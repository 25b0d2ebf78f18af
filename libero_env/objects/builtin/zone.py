"""The target zone: a coloured rectangle that marks a place, without collisions."""

import mujoco

from libero_env.objects.model import ROOT_BODY, ObjectModel

HALF = (0.05, 0.05, 0.001)  # [m] half extents
COLOR = (0.85, 0.15, 0.15, 0.5)


def target_zone() -> ObjectModel:
    """Return a flat translucent rectangle; its site `default_site` is the place, slightly above the rectangle."""
    spec, box = mujoco.MjSpec(), mujoco.mjtGeom.mjGEOM_BOX
    spec.modelname = "target_zone"
    spec.compiler.degree = False
    body = spec.worldbody.add_body(name=ROOT_BODY, explicitinertial=True, mass=0.0, inertia=(0.0, 0.0, 0.0))
    body.add_geom(name="visual", type=box, size=HALF, rgba=COLOR, group=1, contype=0, conaffinity=0, mass=0.0)
    body.add_site(name="default_site", type=box, size=(*HALF[:2], 0.007), rgba=(0.0, 0.0, 0.0, 0.0), group=3)
    return ObjectModel(category="target_zone", spec=spec, horizontal_radius=HALF[0])


BUILDERS = {"target_zone": target_zone}
