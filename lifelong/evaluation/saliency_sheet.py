"""Pictures of where a run's policy looks while it acts."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from libero_env.envs.batch import BatchEnv
from lifelong.data.settings import CAMERAS
from lifelong.errors import ConfigError
from lifelong.evaluation.actors import Obs, PolicyActor, observe
from lifelong.evaluation.restore import Restored, restore
from lifelong.evaluation.rollout import play
from lifelong.evaluation.saliency import SaliencySettings, contact_sheet, saliency, window_at
from lifelong.policies.base import Policy
from lifelong.seeding import generator
from lifelong.types import Batch, Observation

SHEET_HEIGHT = 128  # pixels of a picture at least


@dataclass
class _Remembering:
    """An actor that keeps what it was shown."""

    actor: PolicyActor
    seen: list[Obs] = field(default_factory=list)

    @property
    def action_dim(self) -> int:
        return self.actor.action_dim

    @property
    def views(self) -> tuple[str, ...]:
        return self.actor.views

    def reset(self, num_envs: int) -> None:
        self.seen.clear()
        self.actor.reset(num_envs)

    def act(self, obs: Obs) -> np.ndarray:
        self.seen.append({name: np.array(value) for name, value in obs.items()})
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
) -> Path:
    """Lets a run's policy act on one of its tasks, and draws where it looks at some moments.

    Args:
        source: The run's directory, or one of its checkpoints.
        task: Position of the task in the run's sequence.
        after: See `lifelong.evaluation.restore.restore`.
        start: Initial state.
        moments: Number of columns; evenly over the rollout, its beginning included.
        horizon: Most control steps.
        settings: How finely is looked.
        device: See `lifelong.evaluation.restore.restore`.

    Returns:
        The contact sheet, `saliency/task_<k>_after_<l>.png` in the run's directory; a text file beside it has the
        caption.

    Raises:
        ConfigError: No such task, or no moments.
        LiberoError: The run cannot be read, or its policy gives no `predict`.
    """
    found = restore(source, after=after, device=device)
    if not 0 <= task < len(found.tasks) or moments < 1:
        raise ConfigError(
            f"task {task}, {moments} moments; there are tasks 0 to {len(found.tasks) - 1}, and 1 moment or more"
        )
    steps, pictures, heats, success = _look(found, task, start, moments, horizon, settings)
    enlarge = -(-SHEET_HEIGHT // pictures[0].shape[1])
    folder = found.path / "saliency"
    folder.mkdir(exist_ok=True)
    path = folder / f"task_{task:02d}_after_{found.learned:02d}.png"
    Image.fromarray(contact_sheet(pictures, heats, enlarge)).save(path)
    outcome = "success" if success else "failure"
    told = f"{found.tasks[task].language}: {outcome}, after learning {found.learned + 1} tasks"
    path.with_suffix(".txt").write_text(f"{told}; steps {', '.join(map(str, steps))}\n", encoding="utf-8")
    return path


def _look(
    found: Restored, task: int, start: int, moments: int, horizon: int, settings: SaliencySettings
) -> tuple[list[int], list[np.ndarray], list[np.ndarray], bool]:
    """Steps, what was seen at each (V, H, W, 3), what mattered there (V, H, W), and whether the goal was reached."""
    spec, language = found.policy.spec, found.embed(found.tasks[task])
    with found.acting(found.tasks[task]) as policy:
        draws = [generator(found.seed, start)]
        actor = _Remembering(PolicyActor(policy, language, found.device, found.eval.precision, draws))
        env = BatchEnv(
            found.tasks[task],
            1,
            cameras=tuple(CAMERAS[view] for view in spec.views),
            camera_size=spec.image_size,
            horizon=horizon + found.eval.settle_steps,
        )
        try:
            done = play(actor, env, [start], horizon=horizon, settle_steps=found.eval.settle_steps)
        finally:
            env.close()
        frames = [_parts(observe(obs, spec, language, found.device)) for obs in actor.seen]
        steps = sorted({round(i) for i in np.linspace(0, len(frames) - 1, moments)})
        heats = []
        for step in steps:
            seen = window_at(frames, step, spec.seq_len)
            heats.append(
                saliency(policy, _batch(seen, language.to(found.device), policy), settings).cpu().numpy()
            )
    pictures = [frames[step]["images"][0, 0].cpu().numpy() for step in steps]
    return steps, pictures, heats, done.episodes[0].success


def _parts(observation: Observation) -> dict[str, torch.Tensor]:
    return {"images": observation.images, **observation.proprio}


def _batch(seen: dict[str, torch.Tensor], language: torch.Tensor, policy: Policy) -> Batch:
    """A window as a batch; its actions are not read."""
    proprio = {name: value for name, value in seen.items() if name != "images"}
    images = seen["images"]
    none = torch.zeros(1, dtype=torch.int64, device=images.device)
    actions = images.new_zeros((1, images.shape[1], policy.spec.action_dim), dtype=torch.float32)
    return Batch(Observation(images, proprio, language[None]), actions, none, none)
