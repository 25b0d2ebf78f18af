"""Contact sheets of a run's saliency: images of where its policy looks while it acts."""

from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from libero_eval.saliency import SaliencySettings, contact_sheet, saliency, window_at
from lifelong.errors import ConfigError
from lifelong.evaluation.actors import PolicyActor, observe
from lifelong.evaluation.inputs import Obs
from lifelong.evaluation.restore import LoadedRun, restore
from lifelong.evaluation.rollout import run_episodes
from lifelong.policies.base import Policy
from lifelong.seeding import generator
from lifelong.types import Batch, Observation

SHEET_HEIGHT = 128  # [pixels] minimum height of an image on the sheet


@dataclass
class RecordingActor:
    """An actor that records the observations it receives."""

    actor: PolicyActor
    observations: list[Obs] = field(default_factory=list)

    @property
    def action_dim(self) -> int:
        return self.actor.action_dim

    @property
    def views(self) -> tuple[str, ...]:
        return self.actor.views

    def reset(self, num_envs: int) -> None:
        self.observations.clear()
        self.actor.reset(num_envs)

    def act(self, obs: Obs) -> np.ndarray:
        self.observations.append({name: np.array(value) for name, value in obs.items()})
        return self.actor.act(obs)


def draw_saliency(
    source: Path,
    *,
    task: int,
    after: int | None = None,
    start: int = 0,
    moments: int = 6,
    horizon: int = 200,
    settings: SaliencySettings = SaliencySettings(),  # noqa: B008 - frozen
    device: str = "auto",
    allow: Sequence[str] = (),
) -> Path:
    """Run one episode of a run's policy, and draw where the policy looks at some moments.

    Args:
        source: Directory of the run, or one of its checkpoints.
        task: Position of the task in the run's sequence.
        after: See `lifelong.evaluation.restore.restore`.
        start: Index of the initial state.
        moments: Number of columns, evenly distributed over the episode from its first step on.
        horizon: Maximum number of control steps.
        settings: Resolution of the saliency maps.
        device: See `lifelong.evaluation.restore.restore`.
        allow: See `lifelong.evaluation.restore.restore`.

    Returns:
        The contact sheet, `saliency/task_<k>_after_<l>.png` in the run's directory, with its caption in a text file
        beside it.

    Raises:
        ConfigError: The task does not exist, or there are no moments.
        LiberoError: The run cannot be read, or its policy has no `predict`.
    """
    run = restore(source, after=after, device=device, allow=allow)
    if not 0 <= task < len(run.tasks) or moments < 1:
        raise ConfigError(
            f"task {task} and {moments} moments; valid: tasks 0 to {len(run.tasks) - 1}, and 1 moment or more"
        )
    frames, success = _run_episode(run, task, start, horizon)
    steps = sorted({round(i) for i in np.linspace(0, len(frames) - 1, moments)})
    heats = _saliency_maps(run, task, frames, steps, settings)
    pictures = [frames[step]["images"][0, 0].cpu().numpy() for step in steps]
    enlarge = -(-SHEET_HEIGHT // pictures[0].shape[1])
    folder = run.path / "saliency"
    folder.mkdir(exist_ok=True)
    path = folder / f"task_{task:02d}_after_{run.learned:02d}.png"
    Image.fromarray(contact_sheet(pictures, heats, enlarge)).save(path)
    outcome = "success" if success else "failure"
    caption = f"{run.learned_task(task).language}: {outcome}, after learning {run.learned + 1} tasks"
    path.with_suffix(".txt").write_text(f"{caption}; steps {', '.join(map(str, steps))}\n", encoding="utf-8")
    return path


def _run_episode(
    run: LoadedRun, task: int, start: int, horizon: int
) -> tuple[list[dict[str, torch.Tensor]], bool]:
    """Return the policy's observations at each step, (1, 1, ...) tensors by name, and the episode's success."""
    spec, language = run.policy.spec, run.embed(run.learned_task(task))
    with closing(run.environment(task, 1, horizon)) as env, run.acting(run.tasks[task]) as policy:
        draws = [generator(run.seed, start)]
        actor = RecordingActor(PolicyActor(policy, language, run.device, run.eval.precision, draws))
        done = run_episodes(actor, env, [start], horizon=horizon, settle_steps=run.eval.settle_steps)
    frames = [_tensors(observe(obs, spec, language, run.device)) for obs in actor.observations]
    return frames, done.episodes[0].success


def _saliency_maps(
    run: LoadedRun,
    task: int,
    frames: list[dict[str, torch.Tensor]],
    steps: list[int],
    settings: SaliencySettings,
) -> list[np.ndarray]:
    """Return the saliency (V, H, W) of the windows that end at the steps."""
    language = run.embed(run.learned_task(task)).to(run.device)
    with run.acting(run.tasks[task]) as policy:
        windows = [window_at(frames, step, run.policy.spec.seq_len) for step in steps]
        return [
            saliency(policy, _batch(window, language, policy), settings).cpu().numpy() for window in windows
        ]


def _tensors(observation: Observation) -> dict[str, torch.Tensor]:
    return {"images": observation.images, **observation.proprio}


def _batch(window: dict[str, torch.Tensor], language: torch.Tensor, policy: Policy) -> Batch:
    """Return a window as a batch; its actions are not read."""
    proprio = {name: value for name, value in window.items() if name != "images"}
    images = window["images"]
    ids = torch.zeros(1, dtype=torch.int64, device=images.device)
    actions = images.new_zeros((1, images.shape[1], policy.spec.action_dim), dtype=torch.float32)
    return Batch(Observation(images, proprio, language[None]), actions, ids, ids)
