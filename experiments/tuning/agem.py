"""How often A-GEM's constraint acts, and what is forgotten if AdamW's update is projected instead of the gradient.

python experiments/tuning/agem.py gradient update --stream 61,62
"""

import argparse
import json
from pathlib import Path

import torch
from held_out import errors, open_both

from lifelong.algorithms import AGEM
from lifelong.composition import compose_run
from lifelong.data.memory import ReplayMemory
from lifelong.settings import BenchmarkSettings, plain_data
from lifelong.tuning.trials import Trial, learn

COSINES: list[float] = []  # of each step's gradient and reference


class Watched(AGEM):
    """A-GEM that notes the cosine of gradient and reference, and projects the gradient or the update."""

    def __init__(self, *, projected: str, budget: int = 10_000):
        super().__init__(memory=ReplayMemory(budget))
        self.projected, self._before, self._references = projected, [], None

    def after_backward(self, policy):
        if self.reference is None:
            return
        params = [p for p in policy.parameters() if p.requires_grad]
        loss = policy.loss(self.reference)
        grads = torch.autograd.grad(loss, params, allow_unused=True)
        pairs = [(p, r) for p, r in zip(params, grads, strict=True) if r is not None and p.grad is not None]
        mine = torch.cat([p.grad.flatten() for p, _ in pairs])
        theirs = torch.cat([r.flatten() for _, r in pairs])
        COSINES.append(torch.cosine_similarity(mine, theirs, 0).item())
        if self.projected == "gradient":
            super().after_backward(policy)
            return
        self.reference, self._references = None, pairs
        self._before = [p.detach().clone() for p, _ in pairs]

    @torch.no_grad()
    def after_step(self, policy):
        if self.projected == "gradient" or self._references is None:
            return
        moved = [p - before for (p, _), before in zip(self._references, self._before, strict=True)]
        rise = sum((m * r).sum() for m, (_, r) in zip(moved, self._references, strict=True))
        if rise > 0:  # the step would raise the loss on the reference to first order
            share = rise / sum(r.square().sum() for _, r in self._references)
            for p, r in self._references:
                p.sub_(share * r)
        self._references = None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("projected", nargs="+", choices=["gradient", "update"])
    parser.add_argument("--stream", default="61,62")
    parser.add_argument("--out", type=Path, default=Path("runs/tuning"))
    parser.add_argument("--set", nargs="*", default=[], metavar="OVERRIDE")
    args = parser.parse_args()
    tasks = BenchmarkSettings("libero_90", tasks=[int(t) for t in args.stream.split(",")]).sequence()
    for projected in args.projected:
        COSINES.clear()
        config = plain_data(compose_run(["data.demos=60", *args.set, "algo=sequential"])[0])
        config["algo"] = {"_target_": f"{Watched.__module__}.Watched", "projected": projected}
        data, batches = open_both(config, tasks, config["data"]["demos"] // 3)
        *_, (algorithm, policy) = learn(Trial(config, tasks, 1, 160), data, args.out / "agem")
        cosines = torch.tensor(COSINES)
        print(
            json.dumps(
                {
                    "projected": projected,
                    "errors": [round(e, 4) for e in errors(algorithm, policy, batches)],
                    "steps": len(cosines),
                    "opposed": round((cosines < 0).float().mean().item(), 3) if COSINES else None,
                    "mean_cosine": round(cosines.mean().item(), 3) if COSINES else None,
                }
            ),
            flush=True,
        )


if __name__ == "__main__":
    torch.set_num_threads(1)
    main()
