"""Names and values of what stands behind an environment: arm, controller, gripper, models, objects and their states.

`python inventory.py OUT.json FILE ...` writes those of task files. It needs nothing but the package `libero` that is
found: the original wrote `tests/libero/data/original_names.json`.
"""

import json
import re
import sys
from pathlib import Path

import numpy as np

START = [0.1, -0.2, 0.05, -2.3, 0.1, 2.2, 0.8, 0.03, -0.03]  # joints of arm and fingers
ACTIONS = [[0.3, -0.2, 0.4, 0.1, 0.05, -0.2, 1.0], [0.2, 0.1, 0.3, 0.0, -0.1, 0.1, -1.0]] * 2
_LARGEST = 60  # entries that are kept
_PRIVATE = re.compile(r"_(?!hand_|eef_x|ref_|joint_|action_dim|visualizations)")  # names that nobody uses


def plain(value):
    """Return a value as JSON: arrays with their type, a dictionary as its entries, others as their kind."""
    if isinstance(value, np.ndarray):
        numbers = value.round(9).tolist() if value.size <= _LARGEST else "large"
        return {"dtype": str(value.dtype), "shape": list(value.shape), "value": numbers}
    if isinstance(value, np.generic):
        return {"dtype": str(value.dtype), "value": value.item()}
    if isinstance(value, str) and value.startswith("/"):
        return "a path"
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, set):
        return sorted(map(str, value))
    if type(value) in (list, tuple):
        return [plain(item) for item in value] if len(value) <= _LARGEST else "large"
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()} if len(value) <= _LARGEST else "large"
    if hasattr(value, "push"):
        return {"current": plain(value.current), "average": plain(value.average)}
    return "callable" if callable(value) else "object"


def names_of(item, asked=()):
    """Return all names of an object, and those of `asked` that it knows besides, with their values."""
    found = {}
    for name in sorted({*dir(item), *asked}):
        if _PRIVATE.match(name):
            continue
        try:
            found[name] = plain(getattr(item, name))
        except Exception as error:  # noqa: BLE001 - whatever the original raises
            if not (name in asked and isinstance(error, AttributeError)):
                found[name] = f"raises {type(error).__name__}"
    return found


def inventory(path, asked=None):
    """Return the names and values behind an environment of a task file, after four steps from a given pose.

    `asked` are names by part besides those that are listed.
    """
    from libero.libero.envs.env_wrapper import ControlEnv

    env = ControlEnv(bddl_file_name=path, use_camera_obs=False, has_offscreen_renderer=False)
    env.reset()
    state = np.asarray(env.get_sim_state())
    state[1:10], state[1 + env.sim.model.nq : 10 + env.sim.model.nq] = START, 0.0
    env.set_init_state(state)
    for action in ACTIONS:
        step = env.step(np.array(action))
    domain, robot = env.env, env.env.robots[0]
    parts = {
        "domain": domain,
        "robot": robot,
        "controller": robot.controller,
        "gripper": robot.gripper,
        "robot_model": robot.robot_model,
        "mount": robot.robot_model.mount,
        "model": domain.model,
        "observable": domain._observables["robot0_eef_pos"],
    }
    for kind in ("objects", "fixtures", "object_sites"):
        for name, item in list(getattr(domain, f"{kind}_dict").items())[:1]:
            parts |= {kind: item, f"state of {kind}": domain.object_states_dict[name]}
    found = {part: names_of(item, (asked or {}).get(part, ())) for part, item in parts.items()}
    model = env.sim.model
    kinds = ("joint", "site", "sensor", "camera")
    found["elements"] = {kind: list(getattr(model, f"{kind}_names")) for kind in kinds}
    robots = ("robot0_", "gripper0_", "mount0_")
    found["elements"]["robot"] = [name for name in model.geom_names if (name or "").startswith(robots)]
    found["step"] = {name: plain(value) for name, value in step[0].items() if name.startswith("robot0_")}
    env.close()
    return found


if __name__ == "__main__":
    made = {Path(path).stem: inventory(path) for path in sys.argv[2:]}
    Path(sys.argv[1]).write_text(json.dumps(made, sort_keys=True) + "\n")
