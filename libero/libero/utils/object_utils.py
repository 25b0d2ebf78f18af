"""Regions of objects: the drawers of a cabinet, the inside of a basket."""

from collections.abc import Iterable

from libero._adapters.models import facade_pack
from libero_env.errors import LiberoError
from libero_env.mujoco_compat import mujoco

# Category -> its site that is no region, with the category before its name.
EXCEPTION_DICT = {"flat_stove": "flat_stove_burner"}


def update_exception_dict(object_name: str, site_name: str) -> None:
    """Leave out a site of a category."""
    EXCEPTION_DICT[object_name] = site_name


def get_affordance_regions(objects: Iterable[str], verbose: bool = False) -> dict[str, list[str]]:
    """Return category -> names of its regions: the box-shaped sites of its model, without that in `EXCEPTION_DICT`.

    Categories without regions or without a model are left out; one that does not exist raises an UnknownNameError.
    """
    pack, regions = facade_pack(), {}
    for category in objects:
        try:
            sites = pack.build(category).spec.sites
        except LookupError:
            raise
        except LiberoError:  # the original's files lack a few
            continue
        names = [site.name for site in sites if site.type == mujoco.mjtGeom.mjGEOM_BOX]
        left_out = EXCEPTION_DICT.get(category)
        if names := [name for name in names if f"{category}_{name}" != left_out]:
            regions[category] = names
    if verbose:
        for category, names in regions.items():
            print(f"{category}: {', '.join(names)}")
    return regions
