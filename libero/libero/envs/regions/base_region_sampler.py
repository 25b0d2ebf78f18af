"""Samplers of placements under the original's path."""

from libero.libero.envs.regions.samplers import (  # noqa: F401 - names of the original
    InSiteRegionRandomSampler,
    MultiRegionRandomSampler,
    SiteRegionRandomSampler,
    SiteSequentialCompositeSampler,
)
