"""Script of test_distributed.py for several processes: torchrun ... ranks_worker.py FOLDER."""

import json
import os
import signal
import sys
from dataclasses import replace
from pathlib import Path

import torch

from lifelong import Algorithm, checkpoints
from lifelong.evaluation.settings import EvalSettings
from lifelong.nn.augmentation import RandomShift
from lifelong.results.log import ResultLog
from lifelong.results.records import LossRecord
from lifelong.seeding import seeded
from lifelong.settings import build
from lifelong.training import costs
from lifelong.training.distributed import Ranks, process_group
from lifelong.training.settings import FitSettings
from tests.harness import sequences
from tests.harness.configs import CONFIGS, chosen
from tests.harness.gpu_learning import SHORT
from tests.harness.policies import small_transformer

ALGORITHMS = sorted(file.stem for file in CONFIGS.glob("algo/*.yaml"))
# those that change gradients or weights after these are summed over the ranks
CHANGING_GRADIENTS = [
    algo
    for algo in ALGORITHMS
    for kind in [type(build(chosen("algo", algo)))]
    if any(getattr(kind, name) is not getattr(Algorithm, name) for name in ("after_backward", "after_step"))
]
STEPS, TASKS = 4, 2
# Seven windows: two processes get three and four. One step is an epoch, so that records hold every step's loss.
FIT = FitSettings(
    epochs=STEPS, steps_per_epoch=1, batch_size=7, lr=3e-3, warmup_steps=2, grad_clip=1.0, precision="fp32"
)
EVAL = EvalSettings(episodes=2, curve="none", select="last", horizon=3, settle_steps=0, precision="fp32")


def learn(
    algo: str, folder: Path, ranks: Ranks, dropout: float = 0.0, **changes
) -> tuple[list[float], dict[str, torch.Tensor]]:
    """Learn two tasks with a configured algorithm; return every step's loss, and the weights at the end.

    The masks of dropout are each rank's own, so losses are those of one process without it.
    """
    sequences.ALGORITHMS[algo] = lambda: build(chosen("algo", algo, *SHORT.get(algo, [])))
    with seeded(7):
        policy = small_transformer(sequences.SPEC, dropout=dropout)
    context = replace(
        sequences.run_context(folder / algo, algo, TASKS),
        policy=policy,
        augment=RandomShift(1),
        fit=replace(FIT, **changes),
        eval=EVAL,
        ranks=ranks,
    )
    sequences.sequence(context).run()
    losses = [record.loss for record in context.directory.log.read().of(LossRecord)]
    return losses, {name: value.clone() for name, value in policy.state_dict().items()}


def refuse(*args, **kwargs):
    raise AssertionError("only the first process writes")


def learn_all(folder: Path, ranks: Ranks) -> None:
    """Communicate, then learn with all algorithms; each rank writes its weights, and the first one the losses."""
    talk(folder, ranks)
    if not ranks.first:
        checkpoints_save, checkpoints.save, ResultLog.append = checkpoints.save, refuse, refuse
    else:
        checkpoints_save = checkpoints.save
    for algo in ALGORITHMS:
        losses, weights = learn(algo, folder / "runs", ranks)
        checkpoints_save(folder / f"{algo}_{ranks.rank}.safetensors", weights)
        if ranks.first:
            (folder / f"{algo}.json").write_text(json.dumps(losses))
    for algo in CHANGING_GRADIENTS:
        _, weights = learn(algo, folder / "dropout", ranks, dropout=0.1)
        checkpoints_save(folder / f"{algo}-dropout_{ranks.rank}.safetensors", weights)
    ranks.barrier()
    (folder / f"learned_{ranks.rank}").touch()
    ranks.barrier()


def talk(folder: Path, ranks: Ranks) -> None:
    """Test the communication between processes, without training."""
    shared = ranks.broadcast(lambda: {"from": ranks.rank, "path": folder})
    assert shared == {"from": 0, "path": folder}
    a, b, c = (torch.nn.Parameter(torch.zeros(2, 2)) for _ in range(3))
    a.grad = torch.full((2, 2), float(ranks.rank + 1))
    if not ranks.first:
        b.grad = torch.arange(4.0).view(2, 2)
    ranks.sum_gradients([a, b, c])
    assert torch.equal(a.grad, torch.full((2, 2), 3.0))
    assert torch.equal(b.grad, torch.arange(4.0).view(2, 2)), "one rank alone has a gradient"
    assert c.grad is None, "no rank has one"
    drifted = torch.full((3,), float(ranks.rank), requires_grad=True)
    ranks.synchronise([drifted])
    assert torch.equal(drifted, torch.zeros(3))
    (folder / f"talked_{ranks.rank}").touch()


def die(folder: Path, ranks: Ranks) -> None:
    """Kill the second process while the first waits for it."""
    if not ranks.first:
        os.kill(os.getpid(), signal.SIGKILL)
    ranks.barrier()
    (folder / "went_on").touch()


if __name__ == "__main__":
    torch.set_num_threads(1)
    costs.count_flops = lambda: sequences.Uncounted(sequences.Uncounted())
    with process_group() as ranks:
        learn_all(Path(sys.argv[1]), ranks)
        die(Path(sys.argv[1]), ranks)
