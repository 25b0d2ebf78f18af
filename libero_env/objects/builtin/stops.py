"""Where a moving part meets the body that it hangs on.

MuJoCo leaves out contacts of a body with its parent, except where the parent is fixed to the world. The original's
fixtures are; ours stand on mocap bodies, so those contacts that limit a joint are named here: a drawer that is pushed
in stops at its shelf, before the joint's limit, and the sash of the window at the frame.
"""

from collections.abc import Mapping

import mujoco

_CHEST = (("g5", "g9"), ("g7", "g18"), ("g7", "g27"))
STOPS: Mapping[str, tuple[tuple[str, str], ...]] = {  # category -> pairs of collision geoms: fixed, moving
    "short_cabinet": (("g5", "g8"), ("g5", "g18"), ("g5", "g28")),
    "white_cabinet": _CHEST,
    "window": (("g2", "g10"),),
    "wooden_cabinet": _CHEST,
}


def add_stops(spec: mujoco.MjSpec, category: str) -> None:
    """Lets those shapes of an object collide that its category names, as its shapes touch others."""
    geoms = {geom.name: geom for geom in spec.geoms}
    for fixed, moving in STOPS.get(category, ()):
        one = geoms[moving]
        slide, spin, roll = one.friction
        spec.add_pair(
            name=f"stop_{fixed}_{moving}",
            geomname1=fixed,
            geomname2=moving,
            condim=one.condim,
            friction=(slide, slide, spin, roll, roll),
            solref=one.solref,
            solimp=one.solimp,
        )
