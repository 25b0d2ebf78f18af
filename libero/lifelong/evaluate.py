"""Evaluate a run of `main.py`: `python libero/lifelong/evaluate.py --benchmark libero_spatial --task_id 0 ...`."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from pydantic.dataclasses import dataclass

from libero.scripts.command import script
from libero_env.cli.options import parse

benchmark_map = {f"libero_{name}": f"LIBERO_{name.upper()}" for name in ("10", "spatial", "object", "goal")}
algo_map = {"base": "Sequential", "er": "ER", "ewc": "EWC", "packnet": "PackNet", "multitask": "Multitask"}
policy_map = {
    "bc_rnn_policy": "BCRNNPolicy",
    "bc_transformer_policy": "BCTransformerPolicy",
    "bc_vilt_policy": "BCViLTPolicy",
}


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """Measure the success of a run's policy on a task, by `libero eval`.

    Attributes:
        experiment_dir: Folder of the runs.
        benchmark: Name of the benchmark, such as libero_object.
        task_id: Index of the task in the suite.
        algo: Algorithm of the run.
        policy: Policy of the run.
        seed: Seed of the run.
        load_task: Last task that the policy has learned (default: task_id; of multitask: all).
        device_id: Number of the GPU, if there is one.
        save_videos: Write a video of each episode.
    """

    experiment_dir: Path = Path("experiments")
    benchmark: str
    task_id: int
    algo: Literal["agem", "base", "er", "ewc", "multitask", "packnet", "single_task"]
    policy: Literal["bc_rnn_policy", "bc_transformer_policy", "bc_vilt_policy"]
    seed: int
    load_task: int | None = None
    device_id: int = 0
    save_videos: bool = False


def parse_args(argv: Sequence[str] | None = None) -> Evaluation:
    """Parse the arguments, by default those of the command line."""
    return parse(Evaluation, sys.argv[1:] if argv is None else argv, "lifelong.eval")()


@script("lifelong.eval")
def main(request: Evaluation) -> int:
    """Evaluate the policy that the request names; return the exit status."""
    from libero_cli.main import main as libero

    suite, algo = request.benchmark.lower(), "sequential" if request.algo == "base" else request.algo
    run = (
        request.experiment_dir / suite / algo / f"{request.policy.removesuffix('_policy')}_seed{request.seed}"
    )
    words = ["eval", str(run), "--suite", f"{suite}/{request.task_id}"]
    if request.algo != "multitask":
        words += ["--after", str(request.task_id if request.load_task is None else request.load_task)]
    words += ["--device", f"cuda:{request.device_id}"] * bool(request.device_id)
    return libero([*words, *["--videos", "50"] * request.save_videos])


if __name__ == "__main__":
    sys.path[0] = str(Path(__file__).resolve().parents[2])  # not this folder, whose modules have common names
    sys.exit(main())
