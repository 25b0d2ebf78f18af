"""Visuals of kitchenware match its collision boxes: a hand must neither grasp air nor sink in."""

import mujoco
import numpy as np
import pytest

from libero_env.objects import get_object

pytestmark = pytest.mark.sim

SOLID, SEEN = 0, 1  # geom groups
WALLS = {  # category -> a point inside, on the axis, at rest
    "akita_black_bowl": (0.0, 0.0, 0.04),
    "bowl_drainer": (0.0, 0.04, 0.08),
    "chefmate_8_frypan": (0.0, 0.0075, 0.03),
    "glazed_rim_porcelain_ramekin": (0.0, 0.0, 0.03),
    "moka_pot": (0.0, 0.0, -0.04),
    "plate": (0.0, 0.0, 0.012),
    "porcelain_mug": (-0.0016, -0.0162, 0.07),
    "red_coffee_mug": (-0.001, 0.0178, 0.07),
    "white_bowl": (0.0, 0.0, 0.026),
    "white_yellow_mug": (-0.0008, 0.018, 0.06),
    "wine_bottle": (0.0, 0.0, 0.03),
}
OPEN = sorted(set(WALLS) - {"moka_pot", "wine_bottle"})
HANDLES = {  # category -> points (y, z) on the middle line of the handle, at rest
    "chefmate_8_frypan": [(0.16, 0.040), (0.20, 0.045), (0.24, 0.050)],
    "moka_pot": [(-0.055, 0.060), (-0.076, 0.045), (-0.072, 0.025)],
    "porcelain_mug": [(0.050, 0.083), (0.060, 0.056), (0.045, 0.030)],
    "red_coffee_mug": [(-0.035, 0.111), (-0.055, 0.092), (-0.037, 0.050)],
    "white_yellow_mug": [(-0.045, 0.080), (-0.064, 0.055), (-0.040, 0.026)],
}


class AtRest:
    """One object alone, standing as it rests."""

    def __init__(self, category: str):
        model, scene = get_object(category), mujoco.MjSpec()
        scene.attach(model.spec, prefix="a_", frame=scene.worldbody.add_frame(quat=model.rest_quat()))
        self.model = scene.compile()
        self.data = mujoco.MjData(self.model)
        mujoco.mj_forward(self.model, self.data)

    def reach(self, start, direction, group: int) -> float:
        """Way to the first surface of a geom group; -1 without one."""
        groups, hit = np.zeros(mujoco.mjNGROUP, np.uint8), np.zeros(1, np.int32)
        groups[group] = 1
        start, direction = np.asarray(start, float), np.asarray(direction, float)
        return mujoco.mj_ray(self.model, self.data, start, direction, groups, 1, -1, hit)


@pytest.mark.parametrize("category", WALLS)
def test_walls_are_seen_where_they_are_felt(category):
    thing, inside = AtRest(category), np.array(WALLS[category])
    apart = []
    for angle in np.arange(36) * np.pi / 18:
        outwards = np.array([np.cos(angle), np.sin(angle), 0.0])
        start = inside + 0.4 * outwards
        apart.append(thing.reach(start, -outwards, SEEN) - thing.reach(start, -outwards, SOLID))
    assert np.median(np.abs(apart)) < 0.0055


@pytest.mark.parametrize("category", OPEN)
def test_what_lies_inside_lies_on_the_floor_that_is_seen(category):
    thing, start = AtRest(category), np.array(WALLS[category]) + (0.003, 0.002, 0.2)
    seen, felt = (thing.reach(start, (0, 0, -1), group) for group in (SEEN, SOLID))
    assert seen == pytest.approx(felt, abs=0.002)


@pytest.mark.parametrize("category", HANDLES)
def test_handles_are_seen_where_they_are_felt(category):
    thing = AtRest(category)
    for y, z in HANDLES[category]:
        for side in (-1, 1):
            seen, felt = (thing.reach((0.3 * side, y, z), (-side, 0, 0), group) for group in (SEEN, SOLID))
            assert seen > 0 and seen == pytest.approx(felt, abs=0.003), (y, z)


def test_vessels_can_be_distinguished():
    """Where two have nearly the same size, their mean colors differ."""
    size, color = {}, {}
    for category in WALLS:
        model = get_object(category).spec.compile()
        size[category] = np.ptp(model.mesh_vert, axis=0)
        color[category] = model.tex_data.reshape(-1, 3).mean(axis=0)
    for one in WALLS:
        for two in WALLS:
            alike = one != two and np.abs(size[one] - size[two]).max() < 0.012
            assert not alike or np.abs(color[one] - color[two]).max() > 8, (one, two)
