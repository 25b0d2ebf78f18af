"""Saliency maps of a policy: how much its action changes when a place of the image is blurred.

Greydanus et al., "Visualizing and understanding Atari agents" (ICML 2018). Around a place (i, j) the image I is mixed
with a blurred copy A of it by a Gaussian mask M centred there,
    I' = I (1 - M) + A M                                   (eq. 1),
which removes the local content without introducing new edges or colours. Saliency is the change of the output, here
the mean action,
    S(i, j) = 1/2 |π(I) - π(I')|²                          (eq. 2).

A place is blurred in every frame of the window. Blurred pixels are rounded to integers, the input type of the
policy: where blurring changes nothing (a plain surface), the saliency is zero. `draw_saliency` draws the maps of an
episode of a run.
"""

import math
import sys
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor
from torch.nn import functional

from libero_env.errors import SimulationError
from libero_env.storage import atomic_path, atomic_write_text, own_folder
from libero_eval.requests import SaliencyRequest
from lifelong.errors import ConfigError, PolicyError
from lifelong.evaluation.actors import Obs, PolicyActor, observe
from lifelong.evaluation.restore import LoadedRun, restore
from lifelong.evaluation.rollout import run_episodes
from lifelong.policies.base import Policy, in_mode
from lifelong.policies.bc_rnn import BCRNN
from lifelong.seeding import generator
from lifelong.types import Batch, Observation

SHEET_HEIGHT = 128  # [pixels] minimum height of an image on the sheet
_CHUNK = 32  # [windows] per batch of the policy
_MASK_RADIUS = 3.0  # [standard deviations] beyond which a mask is zero


@dataclass(frozen=True)
class SaliencySettings:
    """Resolution of saliency maps; lengths above 0, in pixels of an image of height 128, scaled for others.

    Attributes:
        stride: Distance between two places (5 in the paper, for images of height 80).
        sigma: Standard deviation of the mask (5 in the paper).
        blur: Standard deviation of the blur (3 in the paper).
    """

    stride: float = 8.0
    sigma: float = 6.0
    blur: float = 5.0


@torch.no_grad()
def saliency(
    policy: Policy,
    batch: Batch,
    settings: SaliencySettings = SaliencySettings(),  # noqa: B008 - frozen
) -> Tensor:
    """Return maps of how much each place of each image affects a policy's last action on one window, eq. 2.

    Args:
        policy: Policy with `predict`. Its mode is unchanged.
        batch: One window (B = 1), on the policy's device.
        settings: Resolution of the maps.

    Returns:
        (V, H, W) float32, at least 0: values at the places, interpolated between them.

    Raises:
        ConfigError: The batch has not one window.
        PolicyError: The policy has no `predict`.
    """
    if len(batch) != 1:
        raise ConfigError(f"saliency needs a batch of one window; this one has {len(batch)}")
    images = batch.observation.images  # (1, T, V, H, W, 3)
    height, width = images.shape[3:5]
    scale = height / 128
    rows, cols = (_places(n, settings.stride * scale) for n in (height, width))
    blurred = _blur(images, settings.blur * scale)
    with in_mode(policy, training=False):
        reference = policy.predict(batch)[:, -1]
        maps = []
        for view in range(images.shape[2]):
            changes = []
            for places in torch.cartesian_prod(rows, cols).split(_CHUNK):
                masks = _masks(places, (height, width), settings.sigma * scale).to(images.device)
                outputs = policy.predict(_perturbed(batch, blurred, masks, view))[:, -1]
                changes.append(0.5 * (outputs - reference).square().sum(-1))
            maps.append(torch.cat(changes).view(1, 1, len(rows), len(cols)))
    values = torch.cat(maps, dim=1).float()  # at places that are the cell centres of a regular grid
    if (len(rows), len(cols)) != (height, width):
        values = functional.interpolate(values, size=(height, width), mode="bilinear", align_corners=False)
    return values[0]


def overlay(image: np.ndarray, heat: np.ndarray, strongest: float) -> np.ndarray:
    """Return an image with its saliency map: grey where it is zero, from blue to yellow where it is not.

    Args:
        image: (H, W, 3) uint8 image.
        heat: (H, W) saliency, at least 0.
        strongest: Saliency of the brightest colour; the same for images that are compared.

    Returns:
        (H, W, 3) uint8.
    """
    from matplotlib import colormaps  # only needed here

    share = np.clip(heat / strongest, 0, 1) if strongest > 0 else np.zeros_like(heat)
    grey = np.repeat(image.mean(-1, keepdims=True), 3, axis=-1)
    colour = 255 * np.asarray(colormaps["plasma"](share))[..., :3]
    weight = 0.75 * np.sqrt(share)[..., None]
    mixed = (1 - weight) * (0.35 * image + 0.65 * grey) + weight * colour
    return np.clip(mixed, 0, 255).round().astype(np.uint8)


def contact_sheet(
    pictures: Sequence[np.ndarray], heats: Sequence[np.ndarray], enlarge: int = 1, gap: int = 4
) -> np.ndarray:
    """Return images of several moments with their saliency maps: a column per moment, two rows per camera.

    Args:
        pictures: Images of each moment, (V, H, W, 3) uint8.
        heats: Saliency maps of each moment, (V, H, W).
        enlarge: Integer factor of the size.
        gap: Number of white pixels between images.

    Returns:
        (height, width, 3) uint8. In a camera's second row all moments share one colour scale.
    """
    views = range(len(pictures[0]))
    rows = []
    for view in views:
        strongest = max(float(heat[view].max()) for heat in heats)
        drawn = [overlay(p[view], h[view], strongest) for p, h in zip(pictures, heats, strict=True)]
        rows += [[p[view] for p in pictures], drawn]
    frame = ((gap // 2, gap - gap // 2), (gap // 2, gap - gap // 2), (0, 0))
    enlarged = [[np.kron(p, np.ones((enlarge, enlarge, 1), np.uint8)) for p in row] for row in rows]
    return np.concatenate(
        [np.concatenate([np.pad(p, frame, constant_values=255) for p in row], axis=1) for row in enlarged]
    )


def window_at(frames: Sequence[Mapping[str, Tensor]], step: int, length: int) -> dict[str, Tensor]:
    """Return the last observations up to a step, concatenated along time.

    Args:
        frames: Observations of each step, (1, 1, ...) tensors by name.
        step: Last step of the window.
        length: Maximum number of steps of the window.
    """
    window = frames[max(0, step + 1 - length) : step + 1]
    return {name: torch.cat([frame[name] for frame in window], dim=1) for name in window[0]}


def frames_used(policy: Policy, step: int) -> int:
    """Return how many frames, the last ones, a policy's action depends on that it takes at a step of an episode.

    Raises:
        PolicyError: The policy plans several actions at once, of which most depend on earlier frames.
    """
    if policy.chunk > 1:
        raise PolicyError(
            f"saliency explains the action of the last frame, and this policy plans {policy.chunk} actions at once"
        )
    length, memory = policy.spec.seq_len, policy.memory if isinstance(policy, BCRNN) else "window"
    return {"window": length, "reset": step % length + 1, "none": 1}[memory]


def _places(size: int, stride: float) -> Tensor:
    """Return evenly spaced centres about a stride apart; the outer ones are half a distance from the edge."""
    count = max(1, round(size / stride))
    return (torch.arange(count) + 0.5) * (size / count) - 0.5


def _masks(places: Tensor, size: tuple[int, int], sigma: float) -> Tensor:
    """Return the masks M (N, H, W) of places (N, 2): 1 at the centre, 0 beyond three standard deviations."""
    ys, xs = torch.arange(size[0]), torch.arange(size[1])
    squares = (ys - places[:, :1])[:, :, None].square() + (xs - places[:, 1:])[:, None].square()
    return torch.where(squares <= (_MASK_RADIUS * sigma) ** 2, (-squares / (2 * sigma**2)).exp(), 0.0)


def _blur(images: Tensor, sigma: float) -> Tensor:
    """Return the blurred copies A (float32) of images (..., H, W, 3), with replicated edges."""
    radius = min(math.ceil(_MASK_RADIUS * sigma), min(images.shape[-3:-1]) - 1)
    line = torch.arange(-radius, radius + 1, device=images.device)
    weights = (-line.square() / (2 * sigma**2)).exp()
    weights = weights / weights.sum()
    flat = images.flatten(0, -4).movedim(-1, 1).float()  # (N, 3, H, W)
    flat = functional.pad(flat.flatten(0, 1)[:, None], (radius,) * 4, mode="replicate")
    flat = functional.conv2d(functional.conv2d(flat, weights.view(1, 1, -1, 1)), weights.view(1, 1, 1, -1))
    return flat.view(-1, 3, *images.shape[-3:-1]).movedim(1, -1).reshape(images.shape)


def _perturbed(batch: Batch, blurred: Tensor, masks: Tensor, view: int) -> Batch:
    """Return a batch of N copies of the window, each blurred in one view with one of the masks (N, H, W)."""
    count, obs = len(masks), batch.observation
    repeat = lambda x: x.expand(count, *x.shape[1:])  # noqa: E731
    images = repeat(obs.images).clone()
    original, weight = obs.images[:, :, view].float(), masks[:, None, :, :, None]
    images[:, :, view] = torch.lerp(original, blurred[:, :, view], weight).round().to(torch.uint8)
    proprio = {name: repeat(value) for name, value in obs.proprio.items()}
    return replace(
        batch,
        observation=replace(obs, images=images, proprio=proprio, language=repeat(obs.language)),
        actions=repeat(batch.actions),
        task_ids=repeat(batch.task_ids),
        window_ids=repeat(batch.window_ids),
    )


@dataclass
class RecordingActor(PolicyActor):
    """A policy that records the observations it receives.

    Attributes:
        seen: Observations of each step.
    """

    seen: list[Observation] = field(default_factory=list)

    def act(self, obs: Obs) -> np.ndarray:
        """Return the policy's actions; see `Actor`."""
        self.seen.append(observe(obs, self.policy.spec, self.language, self.device))
        return super().act(obs)


def draw_saliency(request: SaliencyRequest) -> Path:
    """Run one episode of a run's policy, and draw where the policy looks at some moments.

    Args:
        request: Run, task and moments; these are evenly distributed over the episode from its first step on.

    Returns:
        The contact sheet, `saliency/task_<k>_after_<l>_start_<s>.png` in the run's directory, with its caption in a
        text file beside it.

    Raises:
        ConfigError: The task does not exist, or the folder is a link.
        LiberoError: The run cannot be read, or its policy has no `predict` or plans several actions at once.
    """
    run = restore(request.run, after=request.after, device=request.device, allow=request.allow)
    task, settings = request.task, SaliencySettings(stride=request.stride)
    if task >= len(run.tasks):
        raise ConfigError(f"there is no task {task}; valid: tasks 0 to {len(run.tasks) - 1}")
    folder = own_folder(run.path, "saliency", error=ConfigError)
    horizon = request.horizon or run.eval.horizon
    frames, success = _run_episode(run, task, request.start, horizon)
    steps = sorted({round(i) for i in np.linspace(0, len(frames) - 1, request.moments)})
    if len(steps) < request.moments:
        print(f"note: {len(steps)} moments, as the rollout has no more steps", file=sys.stderr)
    language = run.embed(task).to(run.device)
    with run.acting(task) as policy:
        windows = [window_at(frames, step, frames_used(policy, step)) for step in steps]
        batches = [_batch(window, language, policy) for window in windows]
        heats = [saliency(policy, batch, settings).cpu().numpy() for batch in batches]
    pictures = [frames[step]["images"][0, 0].cpu().numpy() for step in steps]
    enlarge = -(-SHEET_HEIGHT // pictures[0].shape[1])
    folder.mkdir(exist_ok=True)
    path = folder / f"task_{task:02d}_after_{run.learned:02d}_start_{request.start:02d}.png"
    with atomic_path(path) as part:
        Image.fromarray(contact_sheet(pictures, heats, enlarge)).save(part, "PNG")
    outcome = "success" if success else "failure"
    if horizon != run.eval.horizon:
        outcome += f" within {horizon} steps, and the run's horizon is {run.eval.horizon}"
    caption = f"{run.learned_task(task).language}: {outcome}, after learning {run.learned + 1} tasks"
    caption += f"; start {request.start}, steps {', '.join(map(str, steps))}"
    atomic_write_text(path.with_suffix(".txt"), f"{caption}\n")
    return path


def _run_episode(run: LoadedRun, task: int, start: int, horizon: int) -> tuple[list[dict[str, Tensor]], bool]:
    """Return the policy's observations at each step, (1, 1, ...) tensors by name, and the episode's success."""
    language, draws = run.embed(task), [generator(run.seed, start)]
    with closing(run.environment(task, 1, horizon)) as env, run.acting(task) as policy:
        actor = RecordingActor(policy, language, run.device, run.eval.precision, draws)
        done = run_episodes(actor, env, [start], horizon=horizon, settle_steps=run.eval.settle_steps)
    if done.failed:
        raise SimulationError(done.failed)
    return [{"images": o.images, **o.proprio} for o in actor.seen], done.episodes[0].success


def _batch(window: dict[str, torch.Tensor], language: torch.Tensor, policy: Policy) -> Batch:
    """Return a window as a batch; its actions are not read."""
    proprio = {name: value for name, value in window.items() if name != "images"}
    images = window["images"]
    ids = torch.zeros(1, dtype=torch.int64, device=images.device)
    actions = images.new_zeros((1, images.shape[1], policy.spec.action_dim), dtype=torch.float32)
    return Batch(Observation(images, proprio, language[None]), actions, ids, ids)
