"""The twenty scenes of LIBERO-100 as templates, `KitchenScene1` to `StudyScene4`; see `mu_utils`."""

from libero.libero.utils.mu_utils import BENCHMARK_SCENES, InitialSceneTemplates, register_mu  # noqa: F401

globals().update(BENCHMARK_SCENES)
