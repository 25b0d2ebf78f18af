"""Measure how well the cameras, or the pose of the arm alone, tell where the object is, on held-out demonstrations.

    python experiments/laptop/localise.py --task 5

Networks are trained on the position of the object instead of the action, in half the steps of the laptop preset.
"""

import argparse
import time
from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor, nn

from libero_env.demos.generate import ensure_demos
from libero_env.demos.read import Episode, read_demos
from libero_env.envs.env import LiberoEnv
from libero_env.tasks import Task, get_suite
from lifelong.nn import RandomShift, ResNetFiLMEncoder

VIEWS = ("agentview_rgb", "eye_in_hand_rgb")
STEPS, BATCH, RATE, UNIT = 800, 64, 2e-3, 0.03  # UNIT: [m] of the position that is learned
LOW = 0.10  # [m] of the hand above the object


def positions(task: Task, demos: Sequence[Episode]) -> Tensor:
    """Return the position of the goal's first object from the grip site in every frame, (F, 3), [m]."""
    env = LiberoEnv(task, cameras=())
    view, found = env.batch.views[0], []
    name = env.batch.goals.atoms[0].args[0]
    for demo in demos:
        for state in demo.states:
            env.set_state(state)
            found.append(view.body_pos(name) - view.eef_pos)
    env.close()
    return torch.tensor(np.array(found), dtype=torch.float32)


def train(
    net: nn.Module,
    inputs: Callable[[Tensor, torch.Generator | None], Tensor],
    target: Tensor,
    learned: Tensor,
) -> float:
    """Fit a network to the target by absolute error; return the seconds of processor time."""
    draws, began = torch.Generator().manual_seed(1), time.process_time()
    optimizer = torch.optim.AdamW(net.parameters(), lr=RATE)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, RATE, STEPS, pct_start=0.06)
    for _ in range(STEPS):
        rows = learned[torch.randint(len(learned), (BATCH,), generator=draws)]
        loss = (net(inputs(rows, draws)) - target[rows]).abs().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    return time.process_time() - began


class Seen(nn.Module):
    """Encoders as in the policy, one for each camera, and a hidden layer."""

    def __init__(self, views: Sequence[int], blocks: int):
        super().__init__()
        self.views = tuple(views)
        small = {"width": 16, "stage_blocks": (blocks,), "stem_stride": 4, "stem_pool": False}
        self.encoders = nn.ModuleList(
            ResNetFiLMEncoder(image_size=(64, 64), language_dim=1, readout="flat", keypoints=32, **small)
            for _ in views
        )
        self.head = nn.Sequential(
            nn.Linear(64 * len(views), 256), nn.LayerNorm(256), nn.GELU(), nn.Linear(256, 3)
        )

    def forward(self, images: Tensor) -> Tensor:
        """Map images (N, 1, V, H, W, C) to positions (N, 3) in units of `UNIT`."""
        language = torch.zeros(len(images), 1)
        seen = [net(images[:, 0, v], language) for v, net in zip(self.views, self.encoders, strict=True)]
        return self.head(torch.cat(seen, dim=-1))


def main() -> None:
    """Print the error of each network along x, y and z."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--task", type=int, default=5, help="position in the order 0 of libero_object")
    parser.add_argument("--demos", type=int, default=110)
    parser.add_argument("--held-out", type=int, default=30)
    parser.add_argument("--folder", default=None)
    args = parser.parse_args()
    torch.set_num_threads(1)
    task = get_suite("libero_object").order(0)[args.task]
    (path,) = ensure_demos([task], args.demos, camera_size=(64, 64), root=args.folder)
    demos = read_demos(path, [*VIEWS, "ee_pos", "joint_states"], args.demos, pairing="aligned")
    images = torch.from_numpy(np.concatenate([np.stack([d.obs[v] for v in VIEWS], 1) for d in demos]))[
        :, None
    ]
    pose = np.concatenate([np.concatenate([d.obs["ee_pos"] * 10, d.obs["joint_states"]], 1) for d in demos])
    reaching = np.concatenate([np.arange(len(d)) < np.argmax(d.actions[:, 6] > 0) for d in demos])
    numbers = np.repeat(np.arange(len(demos)), [len(d) for d in demos])
    offset = positions(task, demos)
    held = numbers >= args.demos - args.held_out
    learned = torch.from_numpy(np.flatnonzero(~held & reaching))
    tested = torch.from_numpy(np.flatnonzero(held & reaching & (-offset[:, 2].numpy() < LOW)))
    readings = torch.tensor((pose - pose.mean(0)) / pose.std(0), dtype=torch.float32)
    shift = RandomShift(2)

    def pictures(rows: Tensor, draws: torch.Generator | None) -> Tensor:
        return images[rows] if draws is None else shift.images(images[rows], draws)

    arm = nn.Sequential(
        *(nn.Linear(10, 256), nn.LayerNorm(256), nn.GELU(), nn.Linear(256, 256), nn.GELU(), nn.Linear(256, 3))
    )
    nets = {
        "arm": (arm, lambda rows, draws: readings[rows]),
        "both cameras, stem": (Seen((0, 1), 0), pictures),
        "both cameras, two blocks": (Seen((0, 1), 2), pictures),
        "wrist, stem": (Seen((1,), 0), pictures),
        "agent, stem": (Seen((0,), 0), pictures),
    }
    for name, (net, inputs) in nets.items():
        seconds = train(net, inputs, offset / UNIT, learned)
        with torch.no_grad():
            error = (net(inputs(tested, None)) * UNIT - offset[tested]).abs().mean(0) * 1000
        shown = ", ".join(f"{axis} {value:.1f} mm" for axis, value in zip("xyz", error.tolist(), strict=True))
        print(f"{name:26}{shown}   {seconds:.0f} s", flush=True)


if __name__ == "__main__":
    main()
