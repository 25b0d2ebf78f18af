"""Flow matching: a chunk of actions from noise, by integrating a learned velocity.

Shape legend: B batch, T time, H chunk, E latent, A action.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Annotated

import torch
from pydantic import Field
from torch import Tensor, nn

from lifelong.errors import PolicyError
from lifelong.nn.heads import ActionHead, full_precision
from lifelong.types import Depth, Unfinished, Width, to_device

_EVAL_SEED = 0
_OCTAVES = 6  # frequencies that encode the time
_GUIDANCE = 5.0  # the largest weight of what is left of a chunk, beta


class FlowHead(ActionHead):
    """Chunks of H actions by flow matching (Lipman et al., ICLR 2023; for robots: Black et al., pi0, 2024).

    Between noise e and a chunk a the path is straight, x(s) = (1 - s) e + s a for s in [0, 1], and a network learns
    its velocity a - e (Lipman et al., eq. 23 with no noise left at the end). Actions come from integrating the
    network's velocity from s = 0 to 1 by Euler steps.

    A window holds actions only up to its end. The chunk of its step t therefore has min(H, T - t) of its slots
    filled; the network is given a mask of them, the others are zero and count in no loss. Whole chunks are learned at
    the first T - H + 1 steps of a window only: a policy that acts must not look back further than that.

    In training, noise and times come from torch's default generator, as dropout's do. In eval mode they are the same
    for every window, so that a window's loss depends neither on chance nor on its batch.

    `plan` can continue a chunk that is being executed: real-time chunking (Black, Galliker & Levine, "Real-time
    execution of action chunking flow policies", 2025), its guidance with the soft mask.

    Args:
        in_dim: E.
        action_dim: A.
        chunk: H, the number of actions planned at once.
        execute: Number of actions of a chunk that are executed before the next chunk is planned.
        steps: Number of Euler steps of the integration.
        hidden: Width of the network.
        layers: Number of residual blocks of the network.

    Raises:
        PolicyError: More actions are executed than a chunk has.
    """

    inpaints = True

    def __init__(
        self,
        *,
        in_dim: int,
        action_dim: int,
        chunk: Width = 5,
        execute: Width = 3,
        steps: Annotated[int, Field(ge=1, le=1000)] = 10,
        hidden: Width = 1024,
        layers: Depth = 2,
    ) -> None:
        super().__init__()
        if execute > chunk:
            raise PolicyError(f"policy.head.execute is {execute}; it must be {chunk} (chunk) at most")
        self.chunk, self.execute, self.steps, self.action_dim = chunk, execute, steps, action_dim
        self.velocity = VelocityField(
            in_dim=in_dim, action_dim=action_dim, chunk=chunk, hidden=hidden, layers=layers
        )

    def forward(self, latent: Tensor) -> dict[str, Tensor]:
        """Return the parameters for latents of windows (B, T, E) or of single steps (B, E), which have no end.

        Returns:
            `latent` as given, and `slots` (B, T, H) or (B, H) float32: 1 where an action of the chunk exists.
        """
        slots = latent.new_ones(*latent.shape[:-1], self.chunk, dtype=torch.float32)
        if latent.dim() == 3:
            t = latent.shape[1]
            step = torch.arange(t, device=latent.device)[:, None]
            slots = slots * (step + torch.arange(self.chunk, device=latent.device) < t)
        return {"latent": latent, "slots": slots}

    def losses(self, params: dict[str, Tensor], actions: Tensor) -> Tensor:
        """Return the velocity's squared error at a random time, mean over a chunk's actions, (B, T, A) -> (B, T)."""
        latent, slots = params["latent"], params["slots"]
        chunks = self._chunks(actions.float())
        noise, time = self._draw(chunks)
        here = time[..., None, None]
        velocity = self.velocity((1 - here) * noise + here * chunks, time, latent, slots)
        error = (velocity - (chunks - noise)).square().mean(-1) * slots
        return error.sum(-1) / slots.sum(-1)

    def _chunks(self, actions: Tensor) -> Tensor:
        """Gather each step's action and those after it, (B, T, A) -> (B, T, H, A), repeating the window's last."""
        t = actions.shape[1]
        step = torch.arange(t, device=actions.device)[:, None]
        index = (step + torch.arange(self.chunk, device=actions.device)).clamp(max=t - 1)
        return actions[:, index]

    def _draw(self, chunks: Tensor) -> tuple[Tensor, Tensor]:
        """Draw noise (B, T, H, A) and times (B, T) in [0, 1)."""
        if self.training:
            return torch.randn_like(chunks), torch.rand(chunks.shape[:2], device=chunks.device)
        draws = torch.Generator().manual_seed(_EVAL_SEED)
        noise = torch.randn(chunks.shape[1:], generator=draws)
        time = torch.rand(chunks.shape[1], generator=draws)
        noise, time = (to_device(x, chunks.device) for x in (noise, time))
        return noise.expand_as(chunks), time.expand(chunks.shape[:2])

    def integrate(self, params: dict[str, Tensor], noise: Tensor) -> Tensor:
        """Carry `noise` (..., H, A) along the flow to a chunk of the same shape, float32, with gradients."""
        x = noise
        for k in range(self.steps):
            time = x.new_full(x.shape[:-2], k / self.steps)
            x = x + self.velocity(x, time, params["latent"], params["slots"]) / self.steps
        return x

    def mean(self, params: dict[str, Tensor]) -> Tensor:
        """Return the first action of the chunk from zero noise, (..., A), with gradients through all steps.

        One evaluation at s = 0 would be the distribution's exact mean, but it lies between the choices where there
        are several, and distilling it would constrain the network at s = 0 only, not along the path of actions.
        """
        return self.integrate(params, torch.zeros_like(self._empty(params)))[..., 0, :]

    def sample(self, params: dict[str, Tensor], generator: torch.Generator | None) -> Tensor:
        """Draw a chunk and return its first action, (..., A)."""
        shape, device = self._empty(params).shape, params["latent"].device
        noise = to_device(torch.randn(shape, generator=generator), device)
        return self.integrate(params, noise)[..., 0, :]

    def plan(
        self,
        params: dict[str, Tensor],
        generators: Sequence[torch.Generator] | None,
        before: Mapping[int, Unfinished] | None = None,
    ) -> Tensor:
        """Return chunks, (B, H, A); see `ActionHead`."""
        noise = torch.zeros_like(self._empty(params))
        if generators is not None:
            draws = [torch.randn(noise.shape[1:], generator=generator) for generator in generators]
            noise = to_device(torch.stack(draws), noise.device)
        return self.integrate(params, noise) if before is None else self._continue(params, noise, before)

    def _continue(self, params: dict[str, Tensor], noise: Tensor, before: Mapping[int, Unfinished]) -> Tensor:
        """Carry noise (B, H, A) to chunks that begin as unfinished ones go on, (B, H, A)."""
        target, weight = torch.zeros_like(noise), torch.zeros_like(noise)
        for row, one in before.items():
            length = min(len(one.actions), self.chunk)
            target[row, :length] = one.actions[:length].to(target)
            weight[row, :length] = prefix_weights(length, one.delay).to(target)[:, None]
        x = noise
        for k in range(self.steps):
            s = k / self.steps
            with torch.enable_grad():
                x = x.detach().requires_grad_()
                velocity = self.velocity(x, x.new_full(x.shape[:-2], s), params["latent"], params["slots"])
                end = x + (1 - s) * velocity
                (pull,) = torch.autograd.grad(end, x, (target - end.detach()) * weight)
            strength = min(_GUIDANCE, (s**2 + (1 - s) ** 2) / (s * (1 - s))) if k else _GUIDANCE
            x = x.detach() + (velocity.detach() + strength * pull) / self.steps
        return x

    def _empty(self, params: dict[str, Tensor]) -> Tensor:
        """Return uninitialised chunks, (..., H, A) float32."""
        slots = params["slots"]
        return slots.new_empty(*slots.shape, self.action_dim)


def prefix_weights(length: int, delay: int) -> Tensor:
    """Return how much each action that is left of a chunk binds the next chunk, (length,).

    Those that are executed before it is there bind fully, the later ones less and less.
    """
    place = (length - torch.arange(length)) / (length - min(delay, length) + 1)
    return torch.where(torch.arange(length) < delay, 1.0, place * place.expm1() / math.expm1(1))


class VelocityField(nn.Module):
    """Velocity of a chunk on its path from noise, given the latent: pre-norm residual blocks.

    Args:
        in_dim: E.
        action_dim: A.
        chunk: H.
        hidden: Width of the network.
        layers: Number of residual blocks.
    """

    def __init__(self, *, in_dim: int, action_dim: int, chunk: int, hidden: int, layers: int) -> None:
        super().__init__()
        self.enter = nn.Linear(in_dim + chunk * (action_dim + 1) + 2 * _OCTAVES, hidden)
        self.blocks = nn.ModuleList(
            nn.Sequential(
                nn.LayerNorm(hidden), nn.Linear(hidden, hidden), nn.GELU(), nn.Linear(hidden, hidden)
            )
            for _ in range(layers)
        )
        self.leave = nn.Sequential(nn.LayerNorm(hidden), nn.Linear(hidden, chunk * action_dim))

    def forward(self, x: Tensor, time: Tensor, latent: Tensor, slots: Tensor) -> Tensor:
        """Return the velocity at `x`.

        Args:
            x: Chunks (..., H, A).
            time: Position on the path (...), in [0, 1].
            latent: Latents (..., E).
            slots: Mask (..., H), 1 where an action exists.

        Returns:
            Velocities (..., H, A) float32, zero where no action exists.
        """
        flat = (x * slots[..., None]).flatten(-2)
        with full_precision(x):
            h = self.enter(torch.cat([latent.float(), flat, slots, _time_code(time)], dim=-1))
            for block in self.blocks:
                h = h + block(h)
            return self.leave(h).view(x.shape) * slots[..., None]


def _time_code(time: Tensor) -> Tensor:
    """Encode times (...) in [0, 1] as sine and cosine of a quarter turn and its doublings, (..., 2 octaves)."""
    angle = time[..., None] * (0.5 * math.pi * 2.0 ** torch.arange(_OCTAVES, device=time.device))
    return torch.cat([angle.sin(), angle.cos()], dim=-1)
