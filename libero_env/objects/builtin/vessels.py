"""Turned vessels: bowls, cups, pans, bottles as one profile around a vertical axis."""

from collections.abc import Sequence

import numpy as np

from libero_env.objects.builtin.mesh import Mesh, Ring, loft, seamless

Profile = Sequence[tuple[float, float]]  # points (radius, height) [m]

RIM_V, INNER_V, FLOOR_V = (
    0.44,
    0.46,
    0.90,
)  # v in the texture: outside up to RIM_V, then inside
SPARE = (0.0, 0.94, 1.0, 0.99)  # part of the texture that the vessel itself does not show
CREASE = np.radians(50.0)  # [rad] angle from which an edge of the profile is sharp


def vessel(
    outside: Profile, inside: Profile, *, segments: int = 28, center: tuple[float, float] = (0.0, 0.0)
) -> Mesh:
    """Return the surface of a vessel with a wall.

    In the texture, v is the share of the length of the profile: the outside from the centre of the foot (0)
    to the rim (RIM_V), the inside from the rim (INNER_V) to the centre of the floor (FLOOR_V). u is 0 at the
    back and 1 at the front, so that both sides show the same.

    Args:
        outside: Profile of the outside, from the axis at the bottom to the rim.
        inside: Profile of the inside, from the rim to the axis on the floor.
        segments: Number of vertices around the axis.
        center: Position (x, y) of the axis, [m].
    """
    points = np.array([*outside, *inside], float)
    v = np.concatenate([_shares(outside, 0.0, RIM_V), _shares(inside, INNER_V, FLOOR_V)])
    sharp = _sharp(points)
    rings = [
        Ring(z, r, r, height, crease=edge) for (r, z), height, edge in zip(points, v, sharp, strict=True)
    ]
    return seamless(loft(rings, segments, center), segments)


def _shares(profile: Profile, start: float, end: float) -> np.ndarray:
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(profile, axis=0), axis=1))])
    return start + (end - start) * length / length[-1]


def _sharp(points: np.ndarray) -> list[bool]:
    # sharp where the profile turns by more than CREASE
    steps = np.diff(points, axis=0)
    turn = np.abs(np.diff(np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))))
    return [False, *(turn > CREASE).tolist(), False]
