"""What a server announces of itself in the words of protocol cards, so that a mismatch is found before a run."""

from collections.abc import Callable, Mapping
from typing import Any

from libero_eval.servers.wires import plain
from lifelong.errors import ProtocolMismatchError

# Formats that vla-eval's own LIBERO benchmark takes: `vla_eval/benchmarks/libero/benchmark.py`, get_action_spec. `raw`
# stands for no convention.
_VLA_EVAL_ACTIONS = {
    "position": ("delta_xyz", "raw"),
    "rotation": ("axis_angle", "raw"),
    "gripper": ("binary_close_positive", "raw"),
}
# `observation_params` are arguments of that benchmark
_VLA_EVAL_FIELDS: dict[str, tuple[str, Callable[[Any], Any]]] = {
    "seed": ("world.env_seed", int),
    "env_seed": ("world.env_seed", int),  # goes before `seed`
    "num_steps_wait": ("episode.settle_steps", int),
    "max_steps": ("episode.horizon", int),
    "absolute_action": ("world.delta", lambda value: not value),
}


def openpi_fields(metadata: Mapping[str, Any]) -> dict[str, Any]:
    """Return what openpi's metadata say; names of cards, such as `action.replan`, are taken as they are."""
    return plain(metadata)


def vla_eval_fields(hello: Mapping[str, Any]) -> dict[str, Any]:
    """Return what a vla-eval hello says: formats of actions, and parameters of the observations.

    Raises:
        ProtocolMismatchError: The server's actions have another format than those of vla-eval's LIBERO benchmark.
    """
    wrong = []
    for name, spec in (hello.get("action_spec") or {}).items():
        valid = _VLA_EVAL_ACTIONS.get(name)
        if valid and isinstance(spec, Mapping) and spec.get("format") not in valid:
            wrong.append(
                f"action_spec {name}: LIBERO takes {valid[0]}, the server sends {spec.get('format')}"
            )
    if wrong:
        raise ProtocolMismatchError(
            "the policy was made for another convention; nothing was run. " + "; ".join(wrong)
        )
    params = hello.get("observation_params") or {}
    found = {
        field: convert(params[name])
        for name, (field, convert) in _VLA_EVAL_FIELDS.items()
        if params.get(name) is not None
    }
    if params.get("send_state") and "quat_no_antipodal" in params:
        kept = params["quat_no_antipodal"]
        found["proprioception.rotation"] = "axis_angle" if kept else "axis_angle_positive"
    return found


def groot_fields(modalities: Mapping[str, Any]) -> dict[str, Any]:
    """Return what a GR00T modality configuration says: the number of actions of a chunk."""
    steps = modalities["action"].get("delta_indices")
    return {"action.chunk": len(steps)} if steps else {}
