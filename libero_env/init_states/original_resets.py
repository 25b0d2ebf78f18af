"""Where the original's resets put fixtures: its random draws, repeated without its simulations.

Evaluations of the original call `env.seed(s)`, and for each episode `env.reset()` and then `set_init_state`. The last
restores positions and velocities, but fixtures, such as cabinets and stoves, are fixed bodies without either: they stay
where the reset has drawn them, from NumPy's global generator. The pose of a fixture in episode i so depends on the seed
and on all that the resets before it have drawn, the rejected placements of movable objects included.

Sources: libero/libero/envs/bddl_base_domain.py and regions/*.py (hf-libero 0.1.4), robosuite 1.4.0, robots/robot.py and
environments/base.py.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from libero_env.errors import PlacementError
from libero_env.geometry import quat_to_mat
from libero_env.objects.model import OPPOSITE_STATES, ObjectModel, rest_quat
from libero_env.sim.scene import Scene
from libero_env.tasks.problem import Atom, Region

_ARM_JOINTS = 7
_MAX_TRIES = 5000  # of one object, as in the original
_MAX_RESETS = 100  # for one episode: the original repeats a reset whose objects do not fit, without end
_LIFT = 0.01  # [m] of objects over their surface, and of fixtures over the underside of the table top
_WITHIN_BOUNDS = (
    "libero_tabletop",
    "libero_floor",
    "libero_coffee_table",
)  # whose objects lie whole in their region


class OriginalResets:
    """The resets of one environment of the original.

    Attributes:
        scene: Compiled scene of the task.
    """

    def __init__(self, scene: Scene, seed: int, loads: int = 1):
        """Seed the generator.

        Args:
            scene: Compiled scene of the task.
            seed: Argument of the original's `env.seed`.
            loads: Number of times that the environment has loaded its model: once when it is made, and at each reset.
                Each adds a draw for each joint that the task's initial conditions open, close, turn on or off.
        """
        self.scene = scene
        self._rng = np.random.RandomState(seed)  # the generator behind `np.random.seed`
        self._loads = loads
        self._plan = _Plan.of(scene)

    def reset(self) -> np.ndarray:
        """Return the poses of the fixtures after the next reset, (nfixtures, 7): position, quaternion wxyz.

        Raises:
            PlacementError: The objects do not fit in 100 resets; the original would not return.
        """
        for _ in range(_MAX_RESETS):
            self._loads += 1
            self._rng.randn(_ARM_JOINTS)  # noise of the arm, which LIBERO multiplies by zero
            joints = [self._rng.uniform(*bounds) for bounds in self._plan.joints * self._loads]
            try:
                return self._poses(joints[len(joints) - len(self._plan.joints) :])
            except PlacementError:
                continue
        raise PlacementError(
            f"{self.scene.problem.language!r}: none of {_MAX_RESETS} resets places all objects; "
            "are their regions too small?"
        )

    def _poses(self, joints: Sequence[float]) -> np.ndarray:
        placed: dict[str, _Placed] = {}
        for item in self._plan.items:
            placed[item.name] = self._place(item, placed)
        sites = self._plan.sites(self.scene, joints)
        for item in self._plan.on_sites:
            placed[item.name] = self._place_on_site(item, placed, sites[item.site])
        for item in self._plan.on_objects:
            self._draw(item, (0.0, 0.0, 0.0, 0.0))
            self._turn(item)
        return np.array([placed[name].pose for name in self.scene.fixtures], float).reshape(-1, 7)

    def _place(self, item: "_Item", placed: dict[str, "_Placed"]) -> "_Placed":
        """Draw the place of an entity on the workspace."""
        ox, oy, oz = self.scene.workspace.offset
        for _ in range(_MAX_TRIES):
            x, y = self._draw(item, *item.region.ranges)
            found = _Placed(item.model, x + ox, y + oy, item.height + oz - item.model.bottom_offset[2])
            if item.fixture or not any(found.overlaps(other) for other in placed.values()):
                return found.turned(self._turn(item), item.fixture)
        raise PlacementError(f"{item.name} does not fit")

    def _place_on_site(self, item: "_Item", placed: dict[str, "_Placed"], site: "_Site") -> "_Placed":
        """Draw the place of an object on or in a site of an entity that has been placed."""
        carrier = placed[site.carrier]
        assert carrier.pose is not None, "it has been turned"
        dx, dy, dz = quat_to_mat(carrier.pose[3:]) @ site.pos
        half_x, half_y = site.size / 2
        top = 0.0 if site.inside else carrier.model.top_offset[2]
        for _ in range(_MAX_TRIES):
            x, y = self._draw(item, (-half_x, -half_y, half_x, half_y), shrink=not site.inside)
            height = carrier.z + top + dz - item.model.bottom_offset[2]
            found = _Placed(item.model, x + carrier.x + dx, y + carrier.y + dy, height)
            if not any(found.overlaps(other) for other in placed.values()):
                return found.turned(self._turn(item), item.fixture)
        raise PlacementError(f"{item.name} does not fit")

    def _draw(
        self, item: "_Item", *ranges: tuple[float, float, float, float], shrink: bool | None = None
    ) -> tuple[float, float]:
        """Draw one of the rectangles (x0, y0, x1, y1), and a point in it."""
        x0, y0, x1, y1 = ranges[self._rng.randint(len(ranges))]
        edge = item.model.horizontal_radius if (item.within if shrink is None else shrink) else 0.0
        x = self._rng.uniform(low=x0 + edge, high=x1 - edge)
        return x, self._rng.uniform(low=y0 + edge, high=y1 - edge)

    def _turn(self, item: "_Item") -> list[float]:
        """Draw the rotation of an entity: one angle for each axis."""
        return [self._rng.uniform(low=low, high=high) for low, high in item.angles]


@dataclass(frozen=True)
class _Placed:
    """An entity where it has been placed; its pose is position and quaternion wxyz, (7,)."""

    model: ObjectModel
    x: float
    y: float
    z: float
    pose: np.ndarray | None = None

    def overlaps(self, other: "_Placed") -> bool:
        """Return whether the original holds that this entity does not fit beside the other."""
        near = np.linalg.norm((self.x - other.x, self.y - other.y)) <= (
            other.model.horizontal_radius + self.model.horizontal_radius
        )
        return bool(near and self.z - other.z <= other.model.top_offset[2] - self.model.bottom_offset[2])

    def turned(self, angles: Sequence[float], fixture: bool) -> "_Placed":
        """Return the entity with its pose: a fixture turned about the vertical, an object about its own axes."""
        if fixture:
            quat = np.array([np.cos(angles[0] / 2), 0.0, 0.0, np.sin(angles[0] / 2)])
        else:
            quat = rest_quat({axis: (a, a) for axis, a in zip(self.model.rotation, angles, strict=False)})
        return replace(self, pose=np.array([self.x, self.y, self.z, *quat]))


@dataclass(frozen=True)
class _Item:
    """An entity that an init atom places.

    Attributes:
        name: Name.
        model: Its model, for radius and offsets.
        region: Region on the workspace.
        fixture: Whether it is a fixture: those are placed wherever they are drawn.
        within: Whether it lies whole in its region.
        angles: Ranges of its rotation, one for each draw.
        height: Height over the workspace, m.
        site: Address of the site that it is placed on; "" for the workspace.
    """

    name: str
    model: ObjectModel
    region: Region
    fixture: bool = False
    within: bool = False
    angles: tuple[tuple[float, float], ...] = ()
    height: float = 0.0
    site: str = ""


@dataclass(frozen=True)
class _Site:
    """A site as the original sees it: its world position while the carrier is still at the origin."""

    carrier: str
    pos: np.ndarray
    size: np.ndarray
    inside: bool


@dataclass(frozen=True)
class _Plan:
    """What a reset draws, in order: joints, entities on the workspace, objects on sites, objects on objects."""

    joints: tuple[tuple[float, float], ...]
    joint_names: tuple[str, ...]
    items: tuple[_Item, ...]
    on_sites: tuple[_Item, ...]
    on_objects: tuple[_Item, ...]
    inside: frozenset[str]

    @classmethod
    def of(cls, scene: Scene) -> "_Plan":
        """Return the plan of a scene."""
        joints: list[Atom] = []
        items, on, within, on_objects = list[_Item](), list[_Item](), list[_Item](), list[_Item]()
        for atom in scene.problem.init:
            if atom.predicate.lower() in OPPOSITE_STATES:
                joints.append(atom)
            elif len(atom.args) == 2:
                item = _item(scene, atom)
                if atom.predicate == "On" and atom.args[1] in scene.objects:
                    on_objects.append(item)
                elif item.site:
                    (on if atom.predicate == "On" else within).append(item)
                elif item.region.ranges:
                    items.append(item)
        ranges = tuple(_joint_range(scene, atom) for atom in joints)
        names = tuple(atom.args[0] for atom in joints)
        inside = frozenset(item.site for item in within)
        return cls(ranges, names, tuple(items), (*on, *within), tuple(on_objects), inside)

    def sites(self, scene: Scene, joints: Sequence[float]) -> dict[str, _Site]:
        """Return the sites that objects are placed on, with the joints as drawn and the fixtures at the origin."""
        if not self.on_sites:
            return {}
        model = scene.model_with(np.tile((0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0), (len(scene.fixtures), 1)))
        data = mujoco.MjData(model)
        for name, value in zip(self.joint_names, joints, strict=True):
            for joint in scene.joints.get(name, ()):
                data.qpos[model.jnt_qposadr[joint]] = value
        mujoco.mj_kinematics(model, data)
        found = {}
        for item in self.on_sites:
            site = model.site(item.site).id
            found[item.site] = _Site(
                item.region.target,
                data.site_xpos[site].copy(),
                model.site_size[site][:2].copy(),
                item.site in self.inside,
            )
        return found


def _item(scene: Scene, atom: Atom) -> _Item:
    name, target = atom.args
    model, fixture = scene.entities[name], name in scene.fixtures
    region = scene.problem.region(target) or Region(target, target)
    own = region.target in scene.entities and not region.ranges
    if fixture:
        yaw = region.yaw[0] if region.yaw else (0.0, 0.0)
        height = _LIFT - scene.workspace.parameters.get("table_thickness", 0.05)
        return _Item(name, model, region, True, False, ((min(yaw), max(yaw)),), height)
    within = scene.problem.name.lower().startswith(_WITHIN_BOUNDS)
    angles = tuple((min(r), max(r)) for r in model.rotation.values()) or ((0.0, 2 * np.pi),)
    site = target if own and target not in scene.entities else ""
    return _Item(name, model, region, False, within, angles, 0.0 if site else _LIFT, site)


def _joint_range(scene: Scene, atom: Atom) -> tuple[float, float]:
    owner = scene.owner(atom.args[0])
    assert owner is not None
    return scene.entities[owner].articulation[atom.predicate.lower()]


def drawn_fixtures(scene: Scene, seed: int, resets: int, loads: int = 1) -> Iterator[np.ndarray]:
    """Yield the poses of the fixtures after each of the first resets of the original, (nfixtures, 7).

    Args:
        scene: Compiled scene of the task.
        seed: Argument of the original's `env.seed`.
        resets: Number of resets.
        loads: As in `OriginalResets`.
    """
    original = OriginalResets(scene, seed, loads)
    for _ in range(resets):
        yield original.reset()
