"""Small demonstrations of random numbers, and an expert that fails."""

from pathlib import Path

import h5py
import numpy as np
import pytest

from libero_env.demos.config import DemoConfig
from libero_env.demos.generate import RecordingJob, make_demos
from libero_env.demos.read import Episode
from libero_env.demos.write import DemoWriter, make_header
from libero_env.errors import DemoError
from libero_env.expert.expert import Attempt

STEPS = 12  # of an episode by `wander`


def header(**more):
    return make_header(
        problem_name="LIBERO_Floor_Manipulation",
        language="pick up the butter and place it in the basket",
        bddl_name="libero_object/pick_up_the_butter.bddl",
        bddl_text="(define (problem LIBERO_Floor_Manipulation))",
        env_kwargs={"robots": ["Panda"]},
        **({"pairing": "aligned", "seed": 1} | more),
    )


def episode(seed: int, steps: int = 11, size: int = 16) -> Episode:
    rng = np.random.default_rng(seed)
    image = lambda: rng.integers(0, 256, (steps, size, size, 3), np.uint8)  # noqa: E731
    obs = {"agentview_rgb": image(), "eye_in_hand_rgb": image()}
    obs |= {"joint_states": rng.normal(size=(steps, 7)), "gripper_states": rng.normal(size=(steps, 2))}
    obs |= {"ee_pos": rng.normal(size=(steps, 3)), "ee_ori": rng.normal(size=(steps, 3))}
    actions = rng.uniform(-1, 1, (steps, 7))
    return Episode(actions, rng.normal(size=(steps, 30)), rng.normal(size=(steps, 9)), obs, actions * 0.5)


def write(path, episodes, **more):
    writer = DemoWriter(path, header(**more))
    for i, one in enumerate(episodes):
        writer.write(i, one)
    return writer.finish()


def write_noise(path, spec, lengths, *, pairing=None, labels=False, seed=0):
    """Write a file of noise in the original's layout, images upside down; `labels` adds `expert_actions`."""
    rng = np.random.default_rng(seed)
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        if pairing is not None:
            data.attrs["pairing"] = pairing
        for number, steps in enumerate(lengths):
            group = data.create_group(f"demo_{number}")
            group.attrs["num_samples"] = steps
            for key in ("actions", "expert_actions")[: 1 + labels]:
                group[key] = rng.uniform(-1, 1, (steps, spec.action_dim))
            for view in spec.views:
                group[f"obs/{view}"] = rng.integers(0, 256, (steps, *spec.image_size, 3), dtype=np.uint8)
            for name, size in spec.proprio.items():
                group[f"obs/{name}"] = rng.normal(size=(steps, size))
    return path


def generate(task, n, *, path, camera_size=(128, 128), workers=0, progress=None, **options):
    """Record the first `n` demonstrations of a task into one file; raise an error if the file is not complete."""
    job = RecordingJob(DemoConfig(task, camera_size, **options), path)
    (report,) = make_demos([job], n, workers=workers, progress=progress).values()
    if report.error:
        raise DemoError(f"{path.name}: {report.error}")
    return path


def wander(env, experts, noise, max_steps):
    """Replace `run_experts` by a random walk of the arm that is reported as a success."""
    rng = np.random.default_rng(5)
    states, actions = [[] for _ in experts], [[] for _ in experts]
    for _ in range(STEPS):
        action = rng.uniform(-1, 1, (env.num_envs, 7))
        for i in range(len(experts)):
            states[i].append(env.simulations.physics_state(i))
            actions[i].append(action[i])
        env.step(action)
    for i, rows in enumerate(states):
        rows.append(env.simulations.physics_state(i))
    return [
        Attempt(True, np.array(s), np.array(a), np.array(a), 0, "", env.simulations.fixtures[i].copy())
        for i, (s, a) in enumerate(zip(states, actions, strict=True))
    ]


def record_wander(path: Path, task: str, size: tuple[int, int]) -> Path:
    """Record two demonstrations of random walks."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("libero_env.demos.record.run_experts", wander)
        return generate(task, 2, path=path, camera_size=size, workers=1, progress=False)
