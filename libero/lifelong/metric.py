"""Success and loss of an algorithm's policy on a benchmark's tasks.

Rollouts are those of `lifelong.evaluation.rollout`: many simulations at once in this process.

Shape legend: B episodes, C H W image, D dimension of a proprioceptive input, L language embedding.
"""

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, closing, nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from libero._adapters.batches import image_tensor, map_tensors
from libero._adapters.files import generated_paths
from libero._adapters.lookup import lookup
from libero._adapters.models import facade_robot
from libero.lifelong.utils import available_device, safe_device
from libero_env.envs.batch import BatchEnv
from libero_env.errors import SimulationError
from libero_env.init_states.pickles import read_states
from libero_env.init_states.store import NUM_INIT_STATES
from libero_env.tasks import Task, get_suite, read_task, suite_names
from lifelong.errors import ConfigError
from lifelong.evaluation.environments import Obs
from lifelong.evaluation.rollout import Episode, run_episodes
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
    *,
    selecting: bool = False,
) -> float:
    """Return the success rate on a task, from its first `eval.n_eval` initial states.

    Args:
        cfg: Configuration; `eval` has the number of episodes, their length, and how many run at once.
        algo: Algorithm whose policy acts, with torch's global generator seeded by `cfg.seed`.
        task_emb: Embedding of the instruction, (L,).
        task_id: Position in the benchmark.
        sim_states: `n_eval` lists to which the states [time, qpos, qvel] of each episode are appended: that in which
            the policy begins, and one after each of its actions.
        task_str: Name of the evaluation; it has no effect.
        selecting: Whether the result selects a checkpoint. With `eval.selection=apart` such episodes begin in other
            states than reported ones.
    """
    total, first = int(cfg.eval.n_eval), 0
    if selecting and cfg.eval.get("selection", "reporting") == "apart":
        own = user_states(cfg, task)
        count = NUM_INIT_STATES if own is None else len(own)
        if 2 * total > count:
            raise ConfigError(
                f"eval.n_eval is {total}: with eval.selection=apart at most half of the {count} states can be "
                "those of selection"
            )
        first = count - total
    rows = range(first, first + total)
    episodes = rollouts(cfg, algo, task, task_emb, task_id, rows, sim_states=sim_states)
    return sum(episode.success for episode in episodes) / total


def rollouts(
    cfg: Any,
    algo: Any,
    task: Any,
    task_emb: Tensor,
    task_id: int,
    init_states: Sequence[int],
    *,
    sim_states: list | None = None,
    on_step: Callable[[int, Obs, np.ndarray], None] | None = None,
) -> list[Episode]:
    """Run episodes of an algorithm's policy, `eval.num_procs` at once.

    Args:
        cfg, algo, task, task_emb, task_id, sim_states: See `evaluate_one_task_success`.
        init_states: Indices of the initial states; the first follows the last.
        on_step: Function called after each step with the position of the first of the episodes, their observations
            (B, ...), and which of them are over, (B,) bool.
    """
    _check_observations(cfg)
    own = user_states(cfg, task)
    count = NUM_INIT_STATES if own is None else len(own)
    at_once = min(int(cfg.eval.num_procs), len(init_states)) if cfg.eval.use_mp else 1
    episodes: list[Episode] = []
    with seeded(int(cfg.seed), task_id, device=available_device(cfg.device)), acting(algo, task_id) as actor:
        for start in range(0, len(init_states), at_once):
            rows = [i % count for i in init_states[start : start + at_once]]
            states = None if sim_states is None else sim_states[start : start + at_once]
            watch = on_step and partial(on_step, start)
            with closing(_EvalEnv(cfg, task, len(rows), own, states, watch)) as env:
                policy = _PolicyActor(actor, cfg, task_emb, tuple(cfg.data.obs.modality.rgb))
                horizon = int(cfg.eval.max_steps)
                part = run_episodes(policy, env, rows, horizon=horizon, settle_steps=SETTLE_STEPS)
                if part.failed:
                    raise SimulationError(part.failed)
                episodes += part.episodes
    return episodes


def evaluate_success(
    cfg: Any,
    algo: Any,
    benchmark: Any,
    task_ids: Sequence[int],
    result_summary: Mapping[str, Any] | None = None,
    *,
    key: str | None = None,
    selecting: bool = False,
) -> np.ndarray:
    """Return the success rate on each of the given tasks, (n,).

    Args:
        cfg, algo, selecting: See `evaluate_one_task_success`.
        benchmark: Benchmark with the tasks and their embeddings.
        task_ids: Positions in the benchmark.
        result_summary: Receives simulator states under `key` if `eval.save_sim_states` is set.
        key: Key in `result_summary`; by default `k<last task>_p<task>` for each task.
    """
    algo.eval()
    stored: Mapping[str, Any] = (result_summary or {}) if cfg.eval.save_sim_states else {}
    rates, count = [], cfg.eval.n_eval
    for place, i in enumerate(task_ids):
        states = stored.get(f"k{task_ids[-1]}_p{i}")
        if key:  # the lists of each task after those of the last
            states = stored.get(key) and stored[key][place * count : (place + 1) * count]
        arguments = benchmark.get_task(i), benchmark.get_task_emb(i), i, states
        rates.append(evaluate_one_task_success(cfg, algo, *arguments, selecting=selecting))
    return np.array(rates)


def evaluate_multitask_training_success(
    cfg: Any, algo: Any, benchmark: Any, task_ids: Sequence[int]
) -> np.ndarray:
    """Return the success rate on each of the given tasks while they are learned together, (n,)."""
    return evaluate_success(cfg, algo, benchmark, task_ids, selecting=True)


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


def user_states(cfg: Any, task: Any) -> np.ndarray | None:
    """Return the initial states of a task in the configured folder, (n, size); None where they are this package's."""
    folder = cfg.get("init_states_folder")
    path = Path(folder or "", task.problem_folder, task.init_states_file)
    is_users = folder and folder != generated_paths()["init_states"] and path.is_file()
    return read_states(path) if is_users else None


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
    path = Path(bddl_folder or "", task.problem_folder, task.bddl_file)
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
            return obs[key][:, ::-1] if key in self.views else obs[key]

        data = _policy_input(read, self.task_emb, self.cfg)
        return np.asarray(self.algo.policy.get_action(data), np.float64).reshape(len(data["task_emb"]), -1)


class _EvalEnv(BatchEnv):
    """Simulations of a task that begin in the configured states; see `rollouts` for `sim_states` and `on_step`."""

    def __init__(
        self,
        cfg: Any,
        task: Any,
        num_envs: int,
        rows: np.ndarray | None,
        sim_states: list | None,
        on_step: Any,
    ):
        super().__init__(
            native_task(task, cfg.get("bddl_folder")),
            num_envs,
            cameras=[lookup(CAMERAS, "view", view) for view in cfg.data.obs.modality.rgb],
            camera_size=(int(cfg.data.img_h), int(cfg.data.img_w)),
            horizon=int(cfg.eval.max_steps) + SETTLE_STEPS,
            robot=cfg.get("robot") or facade_robot(),
        )
        if rows is not None:
            self.scene.check_states(rows, task.init_states_file)
        self.rows, self.sim_states, self.on_step = rows, sim_states, on_step
        self.settling = SETTLE_STEPS

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[dict, dict]:
        if self.rows is not None and options is not None:
            indices = np.asarray(options["init_state"])
            rows = self.rows[indices]
            # poses of the fixtures, where the user's states have none
            poses = self.init_states[indices % len(self.init_states), rows.shape[1] :]
            options = {**options, "start": np.hstack([rows, poses])}
        return super().reset(seed=seed, options=options)

    def step(self, actions: np.ndarray) -> tuple[dict, np.ndarray, np.ndarray, np.ndarray, dict]:
        running = self.running
        result = super().step(actions)
        simulations, fields = self.simulations, self.simulations.fields
        self.settling -= 1
        if self.settling > 0:
            return result
        if self.sim_states is not None:
            for i in np.flatnonzero(running).tolist():
                self.sim_states[i].append(np.r_[simulations.time(i), fields["qpos"][i], fields["qvel"][i]])
        if self.on_step is not None:
            self.on_step(result[0], ~self.running)
        return result
