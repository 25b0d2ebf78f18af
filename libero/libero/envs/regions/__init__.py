"""Samplers of positions and of joint positions, by problem and region."""

from libero._adapters.lookup import alias_modules, lookup
from libero.libero.envs.regions.samplers import (
    InSiteRegionRandomSampler,
    Libero100TableRegionSampler,
    MultiRegionRandomSampler,
    ObjectBasedSampler,
    ObjectPropertySampler,
    OpenCloseSampler,
    SiteRegionRandomSampler,
    SiteSequentialCompositeSampler,
    TableRegionSampler,
    TurnOnOffSampler,
)

_TABLES = {
    "libero_tabletop_manipulation": ("table", TableRegionSampler),
    "libero_kitchen_tabletop_manipulation": ("kitchen_table", Libero100TableRegionSampler),
    "libero_living_room_tabletop_manipulation": ("living_room_table", Libero100TableRegionSampler),
    "libero_study_tabletop_manipulation": ("study_table", Libero100TableRegionSampler),
    "libero_coffee_table_manipulation": ("coffee_table", Libero100TableRegionSampler),
    "libero_floor_manipulation": ("floor", TableRegionSampler),
}
REGION_SAMPLERS: dict[str, dict[str, type]] = {
    problem: {category: type(f"{base.__name__}_{category}", (base,), {"category": category})}
    for problem, (category, base) in _TABLES.items()
}


def get_region_samplers(problem_name: str, region_sampler_name: str) -> type:
    """Return the sampler of a workspace in a problem; raise an UnknownNameError if there is none."""
    samplers = lookup(REGION_SAMPLERS, "problem", problem_name)
    return lookup(samplers, f"region sampler of {problem_name}", region_sampler_name)


def update_region_samplers(problem_name: str, region_sampler_name: str, region_sampler: type) -> None:
    """Add a sampler or replace one."""
    REGION_SAMPLERS.setdefault(problem_name, {})[region_sampler_name] = region_sampler


alias_modules(
    __name__,
    base_region_sampler="InSiteRegionRandomSampler MultiRegionRandomSampler SiteRegionRandomSampler "
    "SiteSequentialCompositeSampler",
    workspace_region_sampler="Libero100TableRegionSampler ObjectBasedSampler TableRegionSampler",
    object_property_sampler="ObjectPropertySampler OpenCloseSampler TurnOnOffSampler",
)
