"""Where the original's resets put fixtures: its random draws, repeated without its simulations.

Evaluations of the original call `env.seed(s)`, and for each episode `env.reset()` and then `set_init_state`. The last
restores positions and velocities, but fixtures, such as cabinets and stoves, are fixed bodies without either: they stay
where the reset has drawn them, from NumPy's global generator. The pose of a fixture in episode i so depends on the seed
and on all that the resets before it have drawn, the rejected placements of movable objects included.

Sources: libero/libero/envs/bddl_base_domain.py and regions/*.py (hf-libero 0.1.4), robosuite 1.4.0, robots/robot.py and
environments/base.py.
"""

from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from libero_env.errors import PlacementError
from libero_env.geometry import quat_to_mat
from libero_env.mujoco_compat import mujoco
from libero_env.objects.model import OPPOSITE_STATES, ObjectModel, rest_quat
from libero_env.sim.scene import Scene
from libero_env.tasks.expression import Atom
from libero_env.tasks.problem import Region
from libero_env.tasks.rules import BUILTIN_PREDICATES

_ARM_JOINTS = 7
_MAX_TRIES = 5000  # of one object, as in the original
_MAX_RESETS = 100  # for one episode: the original repeats a reset whose objects do not fit, without end
_LIFT = 0.01  # [m] of objects over their surface, and of fixtures over the underside of the table top
# Workspaces whose objects lie whole in their region.
_WITHIN_BOUNDS = ("libero_tabletop", "libero_floor", "libero_coffee_table")


class OriginalResets:
    """The resets of one environment of the original."""

    def __init__(self, scene: Scene, seed: int, loads: int = 1):
        """Seed the generator.

        Args:
            seed: Argument of the original's `env.seed`.
            loads: Number of times that the environment has loaded its model: once when it is made, and at each reset.
                Each samples each joint that the task's initial conditions open, close, turn on or off.
        """
        self.scene = scene
        self._rng = np.random.RandomState(seed)  # the generator behind `np.random.seed`
        self._loads = loads
        self._joints = [
            (
                atom.args[0],
                scene.entities[scene.owner(atom.args[0]) or ""].articulation[atom.predicate.lower()],
            )
            for atom in scene.problem.init
            if atom.predicate.lower() in OPPOSITE_STATES
        ]
        self._items = _items(scene)
        self._at_rest: dict[str, np.ndarray] = {}  # sites, where nothing moves them

    def reset(self) -> np.ndarray:
        """Return the poses of the fixtures after the next reset, (nfixtures, 7): position, quaternion wxyz.

        Raises:
            PlacementError: The objects do not fit in 100 resets; the original would not return.
        """
        for _ in range(_MAX_RESETS):
            self._loads += 1
            self._rng.randn(_ARM_JOINTS)  # noise of the arm, which LIBERO multiplies by zero
            joints: dict[str, float] = {}
            for _ in range(self._loads):
                joints = {name: self._rng.uniform(*bounds) for name, bounds in self._joints}
            try:
                return self._poses(joints)
            except PlacementError:
                continue
        raise PlacementError(
            f"{self.scene.problem.language!r}: none of {_MAX_RESETS} resets places all objects; "
            "are their regions too small?"
        )

    def _poses(self, joints: Mapping[str, float]) -> np.ndarray:
        sites, placed = self._sites(joints), dict[str, _Placed]()
        for item in self._items:
            if item.on_object:  # sampled, but of no effect here
                self._sample(((0.0, 0.0, 0.0, 0.0),), item.margin)
                self._sample_angles(item)
            else:
                placed[item.name] = self._place(item, placed, sites)
        return np.array([placed[name].pose for name in self.scene.fixtures], float).reshape(-1, 7)

    def _place(
        self, item: "_Item", placed: "Mapping[str, _Placed]", sites: Mapping[str, np.ndarray]
    ) -> "_Placed":
        """Sample the place of an entity on the workspace, or on or in a site of an entity that has been placed."""
        model, (x0, y0, z), shift = item.model, self.scene.workspace.offset, np.zeros(3)
        ranges, height = item.region.ranges, item.height + z
        if item.site:
            carrier = placed[item.region.target]
            assert carrier.pose is not None, "it has been turned"
            (x0, y0, z), shift = carrier.pos, quat_to_mat(carrier.pose[3:]) @ sites[item.site]
            half_x, half_y = self.scene.model.site(item.site).size[:2] / 2
            ranges = ((-half_x, -half_y, half_x, half_y),)
            height = z + (0.0 if item.inside else carrier.model.top_offset[2]) + shift[2]
        for _ in range(_MAX_TRIES):
            x, y = self._sample(ranges, item.margin)
            here = _Placed(model, (x + x0 + shift[0], y + y0 + shift[1], height - model.bottom_offset[2]))
            if item.fixture or not any(here.overlaps(other) for other in placed.values()):
                return here.turned(self._sample_angles(item), item.fixture)
        raise PlacementError(f"{item.name} does not fit")

    def _sample(self, ranges: Sequence[tuple[float, ...]], margin: float) -> tuple[float, float]:
        """Sample one of the rectangles (x0, y0, x1, y1), and a point in it at a distance from its edges."""
        x0, y0, x1, y1 = ranges[self._rng.randint(len(ranges))]
        x = self._rng.uniform(low=x0 + margin, high=x1 - margin)
        return x, self._rng.uniform(low=y0 + margin, high=y1 - margin)

    def _sample_angles(self, item: "_Item") -> list[float]:
        """Sample the rotation of an entity: one angle for each axis."""
        return [self._rng.uniform(low=low, high=high) for low, high in item.angles]

    def _sites(self, joints: Mapping[str, float]) -> dict[str, np.ndarray]:
        """Return the positions of the sites that objects are placed on, with all fixtures at the origin."""
        names = {item.site for item in self._items if item.site}
        if not names or (self._at_rest and not joints):
            return self._at_rest
        scene = self.scene
        origin = np.tile((0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0), (len(scene.fixtures), 1))
        with scene.posed(origin) as model:
            data = mujoco.MjData(model)
            for name, value in joints.items():
                for joint in scene.joints.get(name, ()):
                    data.qpos[model.jnt_qposadr[joint]] = value
            mujoco.mj_kinematics(model, data)
            self._at_rest = {name: data.site_xpos[model.site(name).id].copy() for name in names}
        return self._at_rest


@dataclass(frozen=True)
class _Placed:
    """An entity where it has been placed; its pose is position and quaternion wxyz, (7,)."""

    model: ObjectModel
    pos: tuple[float, float, float]
    pose: np.ndarray | None = None

    def overlaps(self, other: "_Placed") -> bool:
        """Return whether the original holds that this entity does not fit beside the other."""
        (x, y, z), (other_x, other_y, other_z) = self.pos, other.pos
        reach = other.model.horizontal_radius + self.model.horizontal_radius
        near = np.linalg.norm((x - other_x, y - other_y)) <= reach
        return bool(near and z - other_z <= other.model.top_offset[2] - self.model.bottom_offset[2])

    def turned(self, angles: Sequence[float], fixture: bool) -> "_Placed":
        """Return the entity with its pose: a fixture turned about the vertical, an object about its own axes."""
        if fixture:
            quat = np.array([np.cos(angles[0] / 2), 0.0, 0.0, np.sin(angles[0] / 2)])
        else:
            quat = rest_quat({axis: (a, a) for axis, a in zip(self.model.rotation, angles, strict=False)})
        return replace(self, pose=np.array([*self.pos, *quat]))


@dataclass(frozen=True)
class _Item:
    """An entity that an init atom places.

    Attributes:
        model: Its model, for radius and offsets.
        region: Region that it is placed in.
        fixture: Whether it is a fixture: those are placed wherever they are sampled.
        margin: Least distance of its origin from the edges of its region, m.
        angles: Ranges of its rotation, one for each sample.
        height: Height over the workspace, m.
        site: Address of the site that it is placed on; "" for none.
        inside: Whether objects are in that site, not on it.
        on_object: Whether it is placed on another object.
    """

    name: str
    model: ObjectModel
    region: Region
    fixture: bool
    margin: float
    angles: tuple[tuple[float, float], ...]
    height: float
    site: str = ""
    inside: bool = False
    on_object: bool = False


def _items(scene: Scene) -> list[_Item]:
    """Return what a reset places, in order: on the workspace, on sites, in sites, on other objects."""
    atoms = [
        atom
        for atom in scene.problem.init
        if len(atom.args) == 2
        and atom.predicate in BUILTIN_PREDICATES
        and atom.predicate.lower() not in OPPOSITE_STATES
    ]
    filled = {atom.args[1] for atom in atoms if atom.predicate != "On"}
    groups: list[list[_Item]] = [[], [], [], []]
    for atom in atoms:
        item = _item(scene, atom, filled)
        if item.on_object:
            groups[3].append(item)
        elif item.site:
            groups[1 if atom.predicate == "On" else 2].append(item)
        elif item.region.ranges:
            groups[0].append(item)
    return [item for group in groups for item in group]


def _item(scene: Scene, atom: Atom, filled: Container[str]) -> _Item:
    name, target = atom.args
    model, region = scene.entities[name], scene.problem.region(target) or Region(target, target)
    if name in scene.fixtures:
        yaw = region.yaw[0] if region.yaw else (0.0, 0.0)
        height = _LIFT - scene.workspace.parameters.get("table_thickness", 0.05)
        return _Item(name, model, region, True, 0.0, ((min(yaw), max(yaw)),), height)
    on_site = region.target in scene.entities and not region.ranges and target not in scene.entities
    inside = on_site and target in filled
    whole = not inside if on_site else scene.problem.name.lower().startswith(_WITHIN_BOUNDS)
    return _Item(
        name,
        model,
        region,
        fixture=False,
        margin=model.horizontal_radius if whole else 0.0,
        angles=tuple((min(r), max(r)) for r in model.rotation.values()) or ((0.0, 2 * np.pi),),
        height=0.0 if on_site else _LIFT,
        site=target if on_site else "",
        inside=inside,
        on_object=atom.predicate == "On" and target in scene.objects,
    )


def drawn_fixtures(scene: Scene, seed: int, resets: int, loads: int = 1) -> Iterator[np.ndarray]:
    """Yield the poses of the fixtures after each of the first resets of the original, (nfixtures, 7).

    Args:
        seed: Argument of the original's `env.seed`.
        loads: As in `OriginalResets`.
    """
    original = OriginalResets(scene, seed, loads)
    for _ in range(resets):
        yield original.reset()
