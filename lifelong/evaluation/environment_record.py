"""What the numbers of an evaluation may depend on besides its protocol: models, renderer, processor, threads."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch

from libero_env.errors import RenderError
from libero_env.sim.render import renderer_name
from lifelong.evaluation.environments import VectorEnv


def describe_environment(env: VectorEnv) -> dict[str, Any]:
    """Return the models, robot, drawing and back end of an environment, and the machine that runs it, as plain data.

    Args:
        env: Environment; one that is not a `libero_env.envs.batch.BatchEnv` contributes nothing.
    """
    found: dict[str, Any] = {}
    scene, simulations = getattr(env, "scene", None), getattr(env, "simulations", None)
    if scene is not None and simulations is not None:
        found |= {
            "models": scene.pack.name,
            "models_digest": getattr(scene.pack, "digest", None),
            "robot": scene.robot,
            "drawing": scene.drawing,
            **simulations.record(),
        }
    if (config := getattr(env, "config", None)) is not None and config.cameras and not config.backend.is_warp:
        backend, renderer = renderer_name()
        found |= {"gl": backend, "renderer": renderer}
    return found | {
        "instruction_set": torch.backends.cpu.get_cpu_capability(),
        "policy_threads": torch.get_num_threads(),
    }


def renderer_name_or_none() -> str | None:
    """Return the name of the OpenGL renderer, such as `llvmpipe (LLVM 15.0.6)`; None where nothing can be drawn."""
    try:
        return renderer_name()[1]
    except RenderError:  # said where something is drawn
        return None


def common_environment(found: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the environments of several processes as one; a value that differs becomes the list of its values."""
    together: dict[str, Any] = {}
    for name in dict.fromkeys(key for one in found for key in one):
        values: list[Any] = []
        for one in found:
            if one.get(name) not in values:
                values.append(one.get(name))
        together[name] = values[0] if len(values) == 1 else values
    return together
