"""Regions of objects: the drawers of a cabinet, the inside of a basket."""

from collections.abc import Iterable, Mapping, Sequence

from libero._adapters.models import facade_pack
from libero_env.errors import LiberoError
from libero_env.mujoco_compat import mujoco

# Category -> names of its regions, where they differ from those of its model.
EXCEPTION_DICT: dict[str, list[str]] = {}


def update_exception_dict(exceptions: Mapping[str, Sequence[str]]) -> dict[str, list[str]]:
    """Set the regions of some categories, and return `EXCEPTION_DICT`."""
    EXCEPTION_DICT.update({category: list(regions) for category, regions in exceptions.items()})
    return EXCEPTION_DICT


def get_affordance_regions(objects: Iterable[str], verbose: bool = False) -> dict[str, list[str]]:
    """Return category -> names of its regions: the box-shaped sites of its model, or those in `EXCEPTION_DICT`.

    Categories without regions or without a model are left out; one that does not exist raises an UnknownNameError.
    """
    pack, regions = facade_pack(), {}
    for category in objects:
        if category in EXCEPTION_DICT:
            names = EXCEPTION_DICT[category]
        else:
            try:
                sites = pack.build(category).spec.sites
            except LookupError:
                raise
            except LiberoError:  # the original's files lack a few
                continue
            names = [site.name for site in sites if site.type == mujoco.mjtGeom.mjGEOM_BOX]
        if names:
            regions[category] = list(names)
    if verbose:
        for category, names in regions.items():
            print(f"{category}: {', '.join(names)}")
    return regions
