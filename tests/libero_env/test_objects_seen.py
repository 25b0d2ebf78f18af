"""What is seen of objects is what is touched: a hand must neither grasp air nor sink in, and compartments are open."""

import itertools

import mujoco
import numpy as np
import pytest

from libero_env.objects import get_object

pytestmark = pytest.mark.sim

SOLID, SEEN = 0, 1  # geom groups
SPACING = 0.006  # between rays, metres
BOOKS = ("black_book", "yellow_book")
FURNITURE = (
    *BOOKS, "desk_caddy", "rack", "white_storage_box", "wine_rack", "wooden_shelf", "wooden_tray",
    "wooden_two_layer_shelf"
)  # fmt: skip
OPENINGS = {  # category -> (site of the region, the way into it from outside)
    "desk_caddy": [(f"{place}_contain_region", (0, 0, -1)) for place in ("left", "right", "front", "back")],
    "white_storage_box": [("bottom_side", (0, 1, 0)), ("bottom_side", (0, -1, 0))],
    "wooden_shelf": [(f"{place}_region", (0, 1, 0)) for place in ("bottom", "middle", "top")],
    "wooden_tray": [("contain_region", (0, 0, -1))],
    "wooden_two_layer_shelf": [(f"{place}_region", (0, 1, 0)) for place in ("bottom", "top")],
}
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


class Alone:
    """One object alone, its body's axes being the world's, or standing as it rests."""

    def __init__(self, category: str, at_rest: bool = False):
        model, scene = get_object(category), mujoco.MjSpec()
        quat = model.rest_quat() if at_rest else (1, 0, 0, 0)
        scene.attach(model.spec, prefix="a_", frame=scene.worldbody.add_frame(quat=quat))
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
    thing, inside = Alone(category, at_rest=True), np.array(WALLS[category])
    apart = []
    for angle in np.arange(36) * np.pi / 18:
        outwards = np.array([np.cos(angle), np.sin(angle), 0.0])
        start = inside + 0.4 * outwards
        apart.append(thing.reach(start, -outwards, SEEN) - thing.reach(start, -outwards, SOLID))
    assert np.median(np.abs(apart)) < 0.0055


@pytest.mark.parametrize("category", OPEN)
def test_what_lies_inside_lies_on_the_floor_that_is_seen(category):
    thing, start = Alone(category, at_rest=True), np.array(WALLS[category]) + (0.003, 0.002, 0.2)
    seen, felt = (thing.reach(start, (0, 0, -1), group) for group in (SEEN, SOLID))
    assert seen == pytest.approx(felt, abs=0.002)


@pytest.mark.parametrize("category", HANDLES)
def test_handles_are_seen_where_they_are_felt(category):
    thing = Alone(category, at_rest=True)
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


@pytest.mark.parametrize("way", [(0, 0, -1), (0, 1, 0), (1, 0, 0), (-1, 0, 0)], ids=str)
@pytest.mark.parametrize("category", FURNITURE)
def test_what_is_seen_is_where_the_collision_shapes_are(category, way):
    """Rays meet picture and collision shapes in points that lie within 8 mm of each other, nearly all."""
    thing = Alone(category)
    across = [axis for axis in range(3) if way[axis] == 0]
    points = {SEEN: [], SOLID: []}
    for s, t in itertools.product(np.arange(-0.24, 0.34, SPACING), repeat=2):
        start = -np.array(way, float)
        start[across] = s, t
        for group, met in points.items():
            depth = thing.reach(start, way, group)
            if depth >= 0:
                met.append(start + depth * np.array(way))
    seen, solid = (np.array(points[group]) for group in (SEEN, SOLID))
    apart = np.linalg.norm(seen[:, None] - solid[None], axis=2)
    assert min(apart.shape) > 20
    assert np.mean(apart.min(axis=1) < 0.008) > 0.92
    assert np.mean(apart.min(axis=0) < 0.008) > 0.92


@pytest.mark.parametrize(
    ("category", "site", "way"), [(c, *o) for c, several in OPENINGS.items() for o in several]
)
def test_compartments_are_open(category, site, way):
    """No visual or collision geom is between the outside and the centre of a region."""
    thing = Alone(category)
    middle = thing.data.site(f"a_{site}").xpos.copy()
    if site == "bottom_side":
        middle[2] = thing.data.site("a_top_side").xpos[2] / 2
    for group in (SEEN, SOLID):
        met = thing.reach(middle - 0.5 * np.array(way), way, group)
        assert met < 0 or met > 0.5


@pytest.mark.parametrize("category", BOOKS)
def test_books_show_their_colour_from_all_sides_but_the_pages(category):
    pixels = get_object(category).spec.compile().tex_data.reshape(-1, 3).astype(float)
    dark, yellow = pixels.max(axis=1) < 60, (pixels[:, 0] > 200) & (pixels[:, 2] < 90) & (pixels[:, 1] > 150)
    assert np.mean(dark if category == "black_book" else yellow) > 0.3
