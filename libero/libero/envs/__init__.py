"""Environments under the original's names."""

from libero.libero.envs.bddl_base_domain import TASK_MAPPING, BDDLBaseDomain, register_problem
from libero.libero.envs.env_wrapper import (
    ControlEnv,
    DemoRenderEnv,
    OffScreenRenderEnv,
    SegmentationRenderEnv,
)
from libero.libero.envs.venv import BaseVectorEnv, DummyVectorEnv, SubprocVectorEnv
