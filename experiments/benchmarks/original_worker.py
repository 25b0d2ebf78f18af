"""The original's end of `compare_original.py`: runs in the original's interpreter and imports nothing of ours.

It answers one JSON request per line of standard input, `{"do": <function>, ...}`, with another. Times are seconds.
What the original prints goes to standard error.
"""

import json
import os
import sys
import time

START = time.perf_counter()
ANSWERS = os.fdopen(os.dup(1), "w")
os.dup2(2, 1)  # the original prints

import numpy as np  # noqa: E402

import libero.libero as original  # noqa: E402

CONFIG = {key: original.get_libero_path(key) for key in ("assets", "bddl_files", "init_states")}
if os.path.isdir(CONFIG["assets"]):
    original._assets_path_cache = CONFIG["assets"]  # it would look into its package, then download

import mujoco  # noqa: E402
import robosuite  # noqa: E402

from libero.libero.envs.env_wrapper import ControlEnv  # noqa: E402

IMPORTED = time.perf_counter() - START
ENVS: dict[str, ControlEnv] = {}


def about() -> dict:
    """Versions, paths, and what importing took."""
    versions = {m.__name__: m.__version__ for m in (mujoco, np, robosuite)}
    return {"versions": versions, **CONFIG, "assets": original.get_assets_path(), "import_s": IMPORTED}


def build(name: str, file: str, cameras: bool) -> dict:
    """Make an environment as `OffScreenRenderEnv` does, or one without cameras."""
    start = time.perf_counter()
    ENVS[name] = ControlEnv(
        bddl_file_name=file,
        camera_heights=128,
        camera_widths=128,
        use_camera_obs=cameras,
        ignore_done=True,
        has_renderer=False,
        has_offscreen_renderer=cameras,
    )
    return {"s": time.perf_counter() - start}


def reset(name: str, state: list[float] | None = None) -> dict:
    """Reset to a new placement; with a state as published evaluations do: reset, then put the state."""
    start = time.perf_counter()
    ENVS[name].reset()
    if state is not None:
        ENVS[name].set_init_state(np.array(state))
    return {"s": time.perf_counter() - start}


def put(name: str, state: list[float], fixtures: dict[str, list[float]] | None = None) -> dict:
    """Put [time, qpos, qvel]; before that fixtures (pos, quat wxyz) where they stood in ours."""
    env = ENVS[name]
    model = env.sim.model._model
    for body, pose in (fixtures or {}).items():
        model.body(body).pos[:], model.body(body).quat[:] = pose[:3], pose[3:]
    start = time.perf_counter()
    env.set_init_state(np.array(state))
    return {"s": time.perf_counter() - start}


def steps(name: str, actions: list[list[float]]) -> dict:
    """Control steps, one time for each; and where the grip site is at the end."""
    env, times = ENVS[name], []
    for action in np.array(actions):
        start = time.perf_counter()
        env.step(action)
        times.append(time.perf_counter() - start)
    data = env.sim.data._data
    grip = env.sim.model._model.site("gripper0_grip_site").id
    return {"s": times, "grip": data.site_xpos[grip].tolist(), "contacts": int(data.ncon)}


def main() -> None:
    """Answers requests until standard input ends."""
    functions = {f.__name__: f for f in (about, build, reset, put, steps)}
    for line in sys.stdin:
        request = json.loads(line)
        print(json.dumps(functions[request.pop("do")](**request)), file=ANSWERS, flush=True)
    for env in ENVS.values():
        env.close()
    ANSWERS.flush()
    os._exit(0)  # its GL contexts complain when the interpreter takes them down


if __name__ == "__main__":
    main()
