"""Success and loss of an algorithm's policy on a benchmark's tasks.

Rollouts are those of `lifelong.evaluation.rollout`, many simulations at once in this process.

Shape legend: B episodes, C H W image, L language embedding.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from libero._adapters.envs.files import generated_paths
from libero._adapters.lifelong.batches import map_tensors
from libero._adapters.lifelong.observations import picture
from libero.lifelong.utils import present, safe_device
from libero_env.envs.batch import BatchEnv
from libero_env.init_states.pickles import read_states
from libero_env.init_states.store import NUM_INIT_STATES, split_row
from libero_env.tasks import Task, get_suite, read_task, suite_names
from lifelong.evaluation.actors import Obs
from lifelong.evaluation.rollout import Rollouts, play
from lifelong.seeding import seeded

CAMERAS = {"agentview_rgb": "agentview", "eye_in_hand_rgb": "robot0_eye_in_hand"}
SETTLE_STEPS = 5


def raw_obs_to_tensor_obs(obs: Any, task_emb: Tensor, cfg: Any) -> dict[str, Any]:
    """What the original's environments observe, as a policy takes it when acting.

    Args:
        obs: one dictionary for each environment; pictures (H, W, C) uint8, lowest row first.
        task_emb: (L,).
        cfg: `data.obs.modality` says what is taken, `data.obs_key_mapping` its name in the environment.

    Returns:
        `obs` {view: (B, C, H, W) in [0, 1], reading: (B, D)} and `task_emb` (B, L), on `cfg.device`.
    """
    names = cfg.data.obs_key_mapping
    stacked = {key: np.stack([one[names.get(key, key)] for one in obs]) for key in _keys(cfg)}
    return as_data(stacked, task_emb, cfg)


def as_data(stacked: Mapping[str, np.ndarray], task_emb: Tensor, cfg: Any) -> dict[str, Any]:
    """The same from arrays (B, ...) by the names of the demonstration files, pictures lowest row first."""
    rgb = set(cfg.data.obs.modality.get("rgb") or [])
    found = {
        key: picture(value) if key in rgb else torch.from_numpy(np.asarray(value, np.float32))
        for key, value in stacked.items()
    }
    batch = len(next(iter(found.values())))
    data = {"obs": found, "task_emb": torch.as_tensor(task_emb).expand(batch, -1)}
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
    """Share of successes on a task, from its first `eval.n_eval` initial states.

    Args:
        cfg: `eval` says how many episodes, how long, and how many at once.
        algo: its policy acts, with torch's global generator seeded by `cfg.seed`.
        task: of a benchmark.
        task_emb: (L,).
        task_id: position in the benchmark.
        sim_states: if given, `n_eval` lists to which the states [time, qpos, qvel] of each episode are appended.
        task_str: a name for the evaluation; it has no effect.
        selecting: whether the result chooses a checkpoint. With `eval.selection=apart` other states are used then.
    """
    total = int(cfg.eval.n_eval)
    apart = selecting and cfg.eval.get("selection", "reporting") == "apart"
    first = max(NUM_INIT_STATES - total, 0) if apart else 0
    rows = [(first + i) % NUM_INIT_STATES for i in range(total)]
    episodes = rollouts(cfg, algo, task, task_emb, task_id, rows, sim_states=sim_states)
    return sum(e.success for part in episodes for e in part.episodes) / total


def rollouts(
    cfg: Any,
    algo: Any,
    task: Any,
    task_emb: Tensor,
    task_id: int,
    init_states: Sequence[int],
    *,
    sim_states: list | None = None,
    watch: Any = None,
) -> list[Rollouts]:
    """Episodes of an algorithm's policy, as many at once as `eval.num_procs` says.

    Args:
        cfg, algo, task, task_emb, task_id, sim_states: as in `evaluate_one_task_success`.
        init_states: where the episodes begin.
        watch: called with the positions of the episodes, their pictures (B, H, W, C) and which are over, at each step.
    """
    at_once = min(int(cfg.eval.num_procs), len(init_states)) if cfg.eval.use_mp else 1
    done: list[Rollouts] = []
    with seeded(int(cfg.seed), task_id, device=present(cfg.device)), acting(algo, task_id) as own:
        for start in range(0, len(init_states), at_once):
            rows = init_states[start : start + at_once]
            with _opened(cfg, task, len(rows)) as env:
                env.states = None if sim_states is None else sim_states[start : start + at_once]
                env.watch = watch and (lambda *seen, s=start: watch(s, *seen))
                actor = _PolicyActor(own, cfg, task_emb, tuple(cfg.data.obs.modality.rgb))
                horizon = int(cfg.eval.max_steps)
                done.append(play(actor, env, rows, horizon=horizon, settle_steps=SETTLE_STEPS))
    return done


def evaluate_success(
    cfg: Any,
    algo: Any,
    benchmark: Any,
    task_ids: Sequence[int],
    result_summary: Mapping[str, Any] | None = None,
) -> np.ndarray:
    """Success on each of the tasks, (n,).

    Args:
        cfg, algo: see `evaluate_one_task_success`.
        benchmark: tasks and their embeddings.
        task_ids: positions.
        result_summary: where `eval.save_sim_states` keeps states, under `k<last task>_p<task>`.
    """
    algo.eval()
    rates = []
    for i in task_ids:
        keep = cfg.eval.save_sim_states and result_summary is not None
        states = result_summary[f"k{task_ids[-1]}_p{i}"] if keep else None  # type: ignore[index]
        task, emb = benchmark.get_task(i), benchmark.get_task_emb(i)
        rates.append(evaluate_one_task_success(cfg, algo, task, emb, i, sim_states=states))
    return np.array(rates)


def evaluate_multitask_training_success(
    cfg: Any, algo: Any, benchmark: Any, task_ids: Sequence[int]
) -> np.ndarray:
    """Success on each of the tasks while they are learned together, (n,)."""
    algo.eval()
    return np.array(
        [
            evaluate_one_task_success(
                cfg, algo, benchmark.get_task(i), benchmark.get_task_emb(i), i, selecting=True
            )
            for i in task_ids
        ]
    )


def evaluate_loss(cfg: Any, algo: Any, benchmark: Any, datasets: Sequence[Dataset]) -> np.ndarray:
    """Mean loss on each of the datasets, (n,), without augmentation or dropout."""
    algo.eval()
    size, losses = int(cfg.data.task_group_size), []
    for i, dataset in enumerate(datasets):
        loader = DataLoader(dataset, batch_size=cfg.eval.batch_size, num_workers=cfg.eval.num_workers)
        with acting(algo, i * size) as own:
            losses.append(np.mean([own.eval_observe(data) for data in loader]))
    return np.array(losses)


@contextmanager
def acting(algo: Any, task_id: int) -> Iterator[Any]:
    """The algorithm with the weights it uses for a task."""
    with algo.acting_on(task_id) if hasattr(algo, "acting_on") else nullcontext(algo) as own:
        yield own


def native_task(task: Any, bddl_folder: str | None) -> Task:
    """A benchmark's task as `libero_env` has it: its own, unless the folder has another file of that name."""
    path = Path(bddl_folder or "", task.problem_folder, task.bddl_file)
    known = get_suite(task.problem_folder).tasks if task.problem_folder in suite_names() else ()
    own = next((t for t in known if f"{t.name}.bddl" == task.bddl_file), None)
    if own is not None and (not path.is_file() or path.read_text(encoding="utf-8") == own.bddl_text):
        return own
    return read_task(path)


@dataclass
class _PolicyActor:
    """An algorithm's policy; see `lifelong.evaluation.actors.Actor`."""

    algo: Any
    cfg: Any
    task_emb: Tensor
    views: tuple[str, ...]
    action_dim: int = 7

    def reset(self, num_envs: int) -> None:
        self.algo.eval()
        self.algo.reset()

    def act(self, obs: Obs) -> np.ndarray:
        stacked = {
            key: obs[key][:, ::-1] if key in self.views else _reading(obs, key) for key in _keys(self.cfg)
        }
        actions = self.algo.policy.get_action(as_data(stacked, self.task_emb, self.cfg))
        return np.asarray(actions, np.float64).reshape(len(next(iter(stacked.values()))), -1)


class _WatchedEnv:
    """A `BatchEnv` that begins in given states, and whose states and pictures are noted on the way."""

    def __init__(self, env: BatchEnv, rows: np.ndarray | None):
        self.env, self.rows, self.num_envs = env, rows, env.num_envs
        self.states: list | None = None
        self.watch: Any = None

    @property
    def atoms(self) -> tuple[str, ...]:
        return self.env.atoms

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Obs, dict]:
        obs, info = self.env.reset(seed=seed, options=options)
        if self.rows is not None and options is not None:
            self._place(self.rows[np.asarray(options["init_state"]) % len(self.rows)])
        return obs, info

    def step(self, actions: np.ndarray) -> tuple[Obs, np.ndarray, np.ndarray, np.ndarray, dict]:
        running = self.env.running
        result = self.env.step(actions)
        for i in np.flatnonzero(running) if self.states is not None else ():
            self.states[i].append(self._state(int(i)))  # type: ignore[index]
        if self.watch is not None:
            self.watch(result[0], ~self.env.running)
        return result

    def close(self) -> None:
        self.env.close()

    def _state(self, i: int) -> np.ndarray:
        simulations = self.env.world.simulations
        fields = simulations.fields
        return np.concatenate([[simulations.time(i)], fields["qpos"][i], fields["qvel"][i]])

    def _place(self, rows: np.ndarray) -> None:
        """Start in rows of an initial-state file; fixtures stay where they are if the rows do not have them."""
        world, ids = self.env.world, range(self.num_envs)
        model = world.scene.model
        qpos, qvel, fixtures = split_row(model, rows)
        world.simulations.reset(ids, qpos, qvel, fixtures=fixtures if fixtures.size else None)


@contextmanager
def _opened(cfg: Any, task: Any, num: int) -> Iterator[_WatchedEnv]:
    """The task's simulations, begun in the configured states."""
    env = BatchEnv(
        native_task(task, cfg.get("bddl_folder")),
        num,
        cameras=[CAMERAS[view] for view in cfg.data.obs.modality.rgb],
        camera_size=(int(cfg.data.img_h), int(cfg.data.img_w)),
        horizon=int(cfg.eval.max_steps) + SETTLE_STEPS,
    )
    try:
        yield _WatchedEnv(env, _foreign_states(cfg.get("init_states_folder"), task))
    finally:
        env.close()


def _foreign_states(folder: str | None, task: Any) -> np.ndarray | None:
    """Initial states of a folder that is not this package's own; None where there are none for the task."""
    path = Path(folder or "", task.problem_folder, task.init_states_file)
    if not folder or folder == generated_paths()["init_states"] or not path.is_file():
        return None
    return read_states(path)


def _reading(obs: Obs, key: str) -> np.ndarray:
    """A reading under its name in the demonstration files, where position and rotation of the hand are one."""
    return np.concatenate([obs["ee_pos"], obs["ee_ori"]], axis=-1) if key == "ee_states" else obs[key]


def _keys(cfg: Any) -> list[str]:
    modality = cfg.data.obs.modality
    return [*(modality.get("rgb") or []), *(modality.get("low_dim") or [])]
