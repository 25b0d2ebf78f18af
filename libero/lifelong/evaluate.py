"""Evaluate a stored policy: `python libero/lifelong/evaluate.py --benchmark libero_spatial --task_id 0 ...`."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from pydantic.dataclasses import dataclass

from libero.scripts.command import script
from libero_env.cli.options import Positive, parse


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """Measure the success of a stored policy on a task.

    Attributes:
        experiment_dir: Folder of the runs.
        benchmark: Name of the benchmark, such as libero_object.
        task_id: Position of the task in the benchmark.
        algo: Algorithm of the run.
        policy: Policy of the run.
        seed: Seed of the run.
        ep: Epoch of a multitask run's checkpoint (default: the last).
        load_task: Last task before the checkpoint of another run (default: task_id).
        run: Number of the run (default: the newest).
        device_id: Number of the GPU, if there is one.
        n_eval: Number of episodes (default: as in the run).
        max_steps: Maximum steps of an episode (default: as in the run).
        save_videos: Write a video of each episode.
    """

    experiment_dir: Path = Path("experiments")
    benchmark: str
    task_id: int
    algo: Literal["agem", "base", "er", "ewc", "multitask", "packnet", "single_task"]
    policy: Literal["bc_rnn_policy", "bc_transformer_policy", "bc_vilt_policy"]
    seed: int
    ep: int | None = None
    load_task: int | None = None
    run: Positive | None = None
    device_id: int = 0
    n_eval: Positive | None = None
    max_steps: Positive | None = None
    save_videos: bool = False


benchmark_map = {f"libero_{name}": f"LIBERO_{name.upper()}" for name in ("10", "spatial", "object", "goal")}
algo_map = {"base": "Sequential", "er": "ER", "ewc": "EWC", "packnet": "PackNet", "multitask": "Multitask"}
policy_map = {
    "bc_rnn_policy": "BCRNNPolicy",
    "bc_transformer_policy": "BCTransformerPolicy",
    "bc_vilt_policy": "BCViLTPolicy",
}


def parse_args(argv: Sequence[str] | None = None) -> Evaluation:
    """Parse the arguments, by default those of the command line."""
    return parse(Evaluation, sys.argv[1:] if argv is None else argv, "lifelong.eval")()


@script("lifelong.eval")
def main(request: Evaluation) -> None:
    """Evaluate the checkpoint that the request names."""
    from libero.lifelong.run_evaluation import evaluate

    evaluate(request)


if __name__ == "__main__":
    sys.path[0] = str(Path(__file__).resolve().parents[2])  # not this folder, whose modules have common names
    sys.exit(main())
