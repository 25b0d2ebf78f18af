"""Shelves, racks, containers and books: what is seen is what is touched, and compartments are open."""

import itertools

import mujoco
import numpy as np
import pytest

from libero_env.objects import get_object

pytestmark = pytest.mark.sim

BOOKS = ("black_book", "yellow_book")
FURNITURE = (
    *BOOKS,
    "desk_caddy",
    "rack",
    "white_storage_box",
    "wine_rack",
    "wooden_shelf",
    "wooden_tray",
    "wooden_two_layer_shelf",
)
OPENINGS = {  # category -> (site of the region, the way into it from outside)
    "desk_caddy": [(f"{place}_contain_region", (0, 0, -1)) for place in ("left", "right", "front", "back")],
    "white_storage_box": [("bottom_side", (0, 1, 0)), ("bottom_side", (0, -1, 0))],
    "wooden_shelf": [(f"{place}_region", (0, 1, 0)) for place in ("bottom", "middle", "top")],
    "wooden_tray": [("contain_region", (0, 0, -1))],
    "wooden_two_layer_shelf": [(f"{place}_region", (0, 1, 0)) for place in ("bottom", "top")],
}
SOLID, SEEN = 0, 1  # geom groups
SPACING = 0.006  # between rays, metres


def distance(model: mujoco.MjModel, data: mujoco.MjData, start, way, group: int) -> float:
    """Along a ray to the first geom of a group, metres; -1 where there is none."""
    groups = np.zeros(mujoco.mjNGROUP, np.uint8)
    groups[group] = 1
    geom = np.zeros(1, np.int32)
    return mujoco.mj_ray(model, data, np.array(start, float), np.array(way, float), groups, 1, -1, geom)


def posed(category: str) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """The object alone, its body's axes being the world's."""
    model = get_object(category).spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


@pytest.mark.parametrize("way", [(0, 0, -1), (0, 1, 0), (1, 0, 0), (-1, 0, 0)], ids=str)
@pytest.mark.parametrize("category", FURNITURE)
def test_what_is_seen_is_where_the_collision_shapes_are(category, way):
    """Rays meet picture and collision shapes in points that lie within 8 mm of each other, nearly all."""
    model, data = posed(category)
    across = [axis for axis in range(3) if way[axis] == 0]
    points = {SEEN: [], SOLID: []}
    for s, t in itertools.product(np.arange(-0.24, 0.34, SPACING), repeat=2):
        start = -np.array(way, float)
        start[across] = s, t
        for group, met in points.items():
            depth = distance(model, data, start, way, group)
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
    model, data = posed(category)
    middle = data.site(site).xpos.copy()
    if site == "bottom_side":
        middle[2] = data.site("top_side").xpos[2] / 2
    for group in (SEEN, SOLID):
        met = distance(model, data, middle - 0.5 * np.array(way), way, group)
        assert met < 0 or met > 0.5


def test_shelves_and_boxes_stand_with_their_tops_up():
    """Fixtures are never turned but about the vertical: the last axis of the body is up."""
    for category in ("wooden_shelf", "wooden_two_layer_shelf", "white_storage_box", "wine_rack"):
        _, data = posed(category)
        name = "top_region" if category == "wine_rack" else "top_side"
        assert data.site(name).xpos[2] > 0.13


@pytest.mark.parametrize("category", BOOKS)
def test_books_show_their_colour_from_all_sides_but_the_pages(category):
    pixels = get_object(category).spec.compile().tex_data.reshape(-1, 3).astype(float)
    dark, yellow = pixels.max(axis=1) < 60, (pixels[:, 0] > 200) & (pixels[:, 2] < 90) & (pixels[:, 1] > 150)
    assert np.mean(dark if category == "black_book" else yellow) > 0.3
