"""Samplers of placements on workspaces under the original's path."""

from libero.libero.envs.regions.samplers import (  # noqa: F401 - names of the original
    Libero100TableRegionSampler,
    ObjectBasedSampler,
    TableRegionSampler,
)
