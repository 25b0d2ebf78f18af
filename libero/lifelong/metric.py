"""Success and loss of an algorithm's policy on a benchmark's tasks.

Rollouts are those of `lifelong.evaluation.rollout`: many simulations at once in this process.

Shape legend: B episodes, C H W image, D dimension of a proprioceptive input, L language embedding.
"""

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, closing, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from libero._adapters.batches import image_tensor, map_tensors
from libero._adapters.lookup import lookup
from libero._adapters.models import facade_robot
from libero.libero import get_libero_path
from libero.lifelong.utils import available_device, safe_device
from libero_env.envs.batch import BatchEnv
from libero_env.errors import SimulationError
from libero_env.images import flip_rows
from libero_env.init_states.pickles import read_states
from libero_env.tasks import Task, get_suite, read_task, suite_names
from lifelong.errors import ConfigError
from lifelong.evaluation.actors import Obs
from lifelong.evaluation.rollout import run_episodes
from lifelong.seeding import seeded

CAMERAS = {"agentview_rgb": "agentview", "eye_in_hand_rgb": "robot0_eye_in_hand"}
# entries of the demonstration files -> the original's observations
OBSERVATIONS = {view: f"{camera}_image" for view, camera in CAMERAS.items()}
OBSERVATIONS |= {"gripper_states": "robot0_gripper_qpos", "joint_states": "robot0_joint_pos"}
OBSERVATIONS["ee_pos"] = "robot0_eef_pos"
SETTLE_STEPS = 5


def raw_obs_to_tensor_obs(obs: Any, task_emb: Tensor, cfg: Any) -> dict[str, Any]:
    """Convert observations of the original's environments to the input of a policy that acts.

    Args:
        obs: One dictionary for each environment; images (H, W, C) uint8, bottom row first.
        task_emb: Embedding of the instruction, (L,).
        cfg: Configuration. `data.obs.modality` names the entries, `data.obs_key_mapping` their names in `obs`.

    Returns:
        `obs` {view: (B, C, H, W) in [0, 1], proprioceptive input: (B, D)} and `task_emb` (B, L), on `cfg.device`.
    """
    names = cfg.data.obs_key_mapping
    return _policy_input(lambda key: np.stack([one[names.get(key, key)] for one in obs]), task_emb, cfg)


def _policy_input(read: Callable[[str], np.ndarray], task_emb: Tensor, cfg: Any) -> dict[str, Any]:
    """Convert (B, ...) arrays, read by their names in the demonstration files; images are bottom row first."""
    modality = cfg.data.obs.modality
    obs = {key: image_tensor(read(key)) for key in modality.get("rgb") or []}
    obs |= {key: torch.as_tensor(read(key), dtype=torch.float32) for key in modality.get("low_dim") or []}
    data = {"obs": obs, "task_emb": torch.as_tensor(task_emb).expand(len(next(iter(obs.values()))), -1)}
    return map_tensors(data, lambda x: safe_device(x, cfg.device))


def evaluate_one_task_success(
    cfg: Any,
    algo: Any,
    task: Any,
    task_emb: Tensor,
    task_id: int,
    sim_states: list | None = None,
    task_str: str = "",
) -> float:
    """Return the success rate on a task, from its first `eval.n_eval` initial states, `eval.num_procs` at once.

    Args:
        cfg: Configuration.
        algo: Algorithm whose policy acts, with torch's global generator seeded by `cfg.seed`.
        task_emb: Embedding of the instruction, (L,).
        task_id: Position in the benchmark.
        sim_states: None: no states are kept.
        task_str: Name of the evaluation; it has no effect.

    Raises:
        ConfigError: States are to be kept, or rollouts would read other observations than the configuration names.
    """
    if sim_states is not None or cfg.eval.save_sim_states:
        raise ConfigError(
            "eval.save_sim_states is true: states are not kept; libero eval --videos records episodes"
        )
    _check_observations(cfg)
    total, successes = int(cfg.eval.n_eval), 0
    states = _init_states(cfg, task)
    at_once = min(int(cfg.eval.num_procs), total) if cfg.eval.use_mp else 1
    with seeded(int(cfg.seed), task_id, device=available_device(cfg.device)), acting(algo, task_id) as actor:
        for start in range(0, total, at_once):
            rows = [i % len(states) for i in range(start, min(start + at_once, total))]
            with closing(_EvalEnv(cfg, task, len(rows), states)) as env:
                policy = _PolicyActor(actor, cfg, task_emb, tuple(cfg.data.obs.modality.rgb))
                horizon = int(cfg.eval.max_steps)
                part = run_episodes(policy, env, rows, horizon=horizon, settle_steps=SETTLE_STEPS)
            if part.failed:
                raise SimulationError(part.failed)
            successes += sum(episode.success for episode in part.episodes)
    return successes / total


def evaluate_success(
    cfg: Any,
    algo: Any,
    benchmark: Any,
    task_ids: Sequence[int],
    result_summary: Mapping[str, Any] | None = None,
) -> np.ndarray:
    """Return the success rate on each of the given tasks, (n,).

    Args:
        cfg, algo: See `evaluate_one_task_success`.
        benchmark: Benchmark with the tasks and their embeddings.
        task_ids: Positions in the benchmark.
        result_summary: Without effect: no states are kept.
    """
    algo.eval()
    tasks = [(benchmark.get_task(i), benchmark.get_task_emb(i), i) for i in task_ids]
    return np.array([evaluate_one_task_success(cfg, algo, *task) for task in tasks])


evaluate_multitask_training_success = evaluate_success


def evaluate_loss(cfg: Any, algo: Any, benchmark: Any, datasets: Sequence[Dataset]) -> np.ndarray:
    """Return the mean loss on each of the given datasets, (n,), without augmentation or dropout."""
    algo.eval()
    size, losses = int(cfg.data.task_group_size), []
    for i, dataset in enumerate(datasets):
        with acting(algo, i * size) as actor:
            losses.append(mean_loss(actor, dataset, cfg.eval.batch_size, cfg.eval.num_workers))
    return np.array(losses)


def mean_loss(algo: Any, dataset: Dataset, batch_size: int, num_workers: int) -> float:
    """Return the mean over a dataset's batches of `algo.eval_observe`."""
    loader = DataLoader(dataset, batch_size=batch_size, num_workers=num_workers)
    return float(np.mean([algo.eval_observe(data) for data in loader]))


def acting(algo: Any, task_id: int) -> AbstractContextManager[Any]:
    """Return a context in which an algorithm has the weights that it acts with on a task."""
    return algo.acting_on(task_id) if hasattr(algo, "acting_on") else nullcontext(algo)


def _init_states(cfg: Any, task: Any) -> np.ndarray:
    """Return the initial states of a task in the configured folder, (n, size)."""
    folder = cfg.get("init_states_folder") or get_libero_path("init_states")
    return read_states(Path(folder, task.problem_folder, task.init_states_file))


def _check_observations(cfg: Any) -> None:
    """Raise a ConfigError where rollouts would read other observations than the configuration names."""
    used = {*cfg.data.obs.modality.rgb, *(cfg.data.obs.modality.get("low_dim") or ())}
    for key, name in cfg.data.obs_key_mapping.items():
        if key in used and OBSERVATIONS.get(key) != name:
            raise ConfigError(
                f"data.obs_key_mapping.{key} is {name}: rollouts read {OBSERVATIONS.get(key, key)}; "
                "data.obs.modality chooses among the observations"
            )


def native_task(task: Any, bddl_folder: str | None) -> Task:
    """Return a benchmark's task as a `Task`: that of the suite, unless the folder has another file of its name."""
    folder = bddl_folder or get_libero_path("bddl_files")
    path = Path(folder, task.problem_folder, task.bddl_file)
    tasks = get_suite(task.problem_folder).tasks if task.problem_folder in suite_names() else ()
    native = next((t for t in tasks if f"{t.name}.bddl" == task.bddl_file), None)
    if native is not None and (not path.is_file() or path.read_text(encoding="utf-8") == native.bddl_text):
        return native
    return read_task(path)


@dataclass
class _PolicyActor:
    """Policy of an algorithm; see `lifelong.evaluation.actors.Actor`."""

    algo: Any
    cfg: Any
    task_emb: Tensor
    views: tuple[str, ...]
    action_dim: int = 7

    def reset(self, num_envs: int) -> None:
        self.algo.eval()
        self.algo.reset()

    def act(self, obs: Obs) -> np.ndarray:
        def read(key: str) -> np.ndarray:
            if key == "ee_states":  # position and rotation in the demonstration files
                return np.concatenate([obs["ee_pos"], obs["ee_ori"]], axis=-1)
            return flip_rows(obs[key], 1) if key in self.views else obs[key]

        data = _policy_input(read, self.task_emb, self.cfg)
        return np.asarray(self.algo.policy.get_action(data), np.float64).reshape(len(data["task_emb"]), -1)


class _EvalEnv(BatchEnv):
    """Simulations of a task that begin in given states, (n, size)."""

    def __init__(self, cfg: Any, task: Any, num_envs: int, rows: np.ndarray):
        super().__init__(
            native_task(task, cfg.get("bddl_folder")),
            num_envs,
            cameras=[lookup(CAMERAS, "view", view) for view in cfg.data.obs.modality.rgb],
            camera_size=(int(cfg.data.img_h), int(cfg.data.img_w)),
            horizon=int(cfg.eval.max_steps) + SETTLE_STEPS,
            robot=cfg.get("robot") or facade_robot(),
        )
        self.scene.check_states(rows, task.init_states_file)
        self.rows = rows

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[dict, dict]:
        indices = np.asarray((options or {})["init_state"])
        start = self.rows[indices]
        if start.shape[1] < self.init_states.shape[1]:  # the original's, without poses of the fixtures
            start = np.hstack([start, self.init_states[indices % len(self.init_states), start.shape[1] :]])
        return super().reset(seed=seed, options={**(options or {}), "start": start})
