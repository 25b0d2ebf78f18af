"""A compiled task as objects of the original: instances, regions, and the instance of each geom."""

from collections.abc import Callable, Sequence
from itertools import product
from typing import Any

import numpy as np

from libero.libero.envs.base_object import OBJECTS_DICT, BaseObject, BuiltinObject, class_name
from libero.libero.envs.objects import SiteObject
from libero.libero.envs.robots import Panda
from libero_env.mujoco_compat import mujoco
from libero_env.objects.model import ObjectModel
from libero_env.sim.scene import Scene


def scene_objects(scene: Scene) -> dict[str, BaseObject]:
    """Return the movable objects by name."""
    return {name: _instance(name, model) for name, model in scene.objects.items()}


def scene_fixtures(scene: Scene) -> dict[str, Any]:
    """Return the fixtures by name."""
    fixtures = {name: _instance(name, model) for name, model in scene.fixtures.items()}
    for fixture in fixtures.values():
        fixture._fixed = True
    return fixtures


def _instance(name: str, model: ObjectModel) -> BaseObject:
    cls = OBJECTS_DICT.get(model.category)
    if cls is None:  # a category that is registered only with `libero_env`
        cls = type(class_name(model.category), (BuiltinObject,), {})
        return cls(name=name, model=model)
    takes_model = (
        isinstance(cls, type) and issubclass(cls, BuiltinObject) and cls.__init__ is BuiltinObject.__init__
    )
    return cls(name=name, model=model) if takes_model else cls(name=name)


def scene_sites(scene: Scene) -> dict[str, SiteObject]:
    """Return the regions by address."""
    model, sites = scene.model, {}
    for region in scene.problem.regions:
        site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, region.address)
        if site >= 0:
            joints = [model.joint(j).name for j in scene.joints.get(region.address, ())]
            sites[region.address] = SiteObject(
                region.address,
                region.target
                if region.target in scene.entities
                else None,  # a zone of the workspace has none
                joints=joints,
                size=model.site_size[site].copy(),
                rgba=model.site_rgba[site].copy(),
                site_pos=model.site_pos[site].copy(),
                site_quat=model.site_quat[site].copy(),
            )
    return sites


class TaskModel:
    """Instance and class of each geom and site.

    Attributes:
        mujoco_objects, mujoco_robots: Objects and fixtures; the arm.
        instances_to_ids, classes_to_ids: Name -> `geom` and `site` -> indices.
        geom_ids_to_instances, geom_ids_to_classes, site_ids_to_instances, site_ids_to_classes: Index -> name.
        segments: `instance` and `class` -> number of each geom, (ngeom + 1,), from 1; 0 is everything else.
    """

    name = "base"

    def __init__(
        self,
        scene: Scene,
        model: mujoco.MjModel,
        xml: Callable[[], str],
        objects: Sequence[BaseObject],
        robot: Panda,
    ):
        self.mujoco_model, self.mujoco_objects, self.mujoco_robots = model, list(objects), [robot]
        self._xml = xml
        bodies = {name: scene.bodies[name] for name in scene.entities}
        parts = {part.name: part for part in (robot, *robot.models)}
        own = {name: [model.body(body).id for body in part.bodies] for name, part in parts.items()}
        categories = {name: item.category for name, item in scene.entities.items()}
        classes = {name: getattr(OBJECTS_DICT.get(c), "__name__", c) for name, c in categories.items()}
        classes |= {name: type(part).__name__ for name, part in parts.items()}
        self.instances_to_ids = {name: _ids(model, indices) for name, indices in (bodies | own).items()}
        self.classes_to_ids: dict[str, dict[str, list[int]]] = {}
        for name, ids in self.instances_to_ids.items():
            of_class = self.classes_to_ids.setdefault(classes[name], {"geom": [], "site": []})
            for kind in ids:
                of_class[kind] += ids[kind]
        for kind, what in product(("geom", "site"), ("instances", "classes")):
            ids = getattr(self, f"{what}_to_ids")
            names = {index: name for name, kinds in ids.items() for index in kinds[kind]}
            setattr(self, f"{kind}_ids_to_{what}", names)
        ids_of = {"instance": self.instances_to_ids, "class": self.classes_to_ids}
        self.segments = {kind: _numbers(ids, model.ngeom) for kind, ids in ids_of.items()}

    def get_xml(self) -> str:
        """Return the scene as MJCF."""
        return self._xml()


def _ids(model: mujoco.MjModel, bodies: Sequence[int] | np.ndarray) -> dict[str, list[int]]:
    """Return the geoms and sites of bodies."""
    owners = {"geom": model.geom_bodyid, "site": model.site_bodyid}
    return {kind: np.flatnonzero(np.isin(owner, bodies)).tolist() for kind, owner in owners.items()}


def _numbers(ids: dict[str, dict[str, list[int]]], ngeom: int) -> np.ndarray:
    table = np.zeros(ngeom + 1, np.int32)
    for number, kinds in enumerate(ids.values()):
        table[kinds["geom"]] = number + 1
    return table
