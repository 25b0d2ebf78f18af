"""Evaluate a stored policy: `python libero/lifelong/evaluate.py --benchmark libero_spatial --task_id 0 ...`."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from libero._adapters.lifelong.config import group_options

benchmark_map = {f"libero_{name}": f"LIBERO_{name.upper()}" for name in ("10", "spatial", "object", "goal")}
algo_map = {
    "base": "Sequential",
    "er": "ER",
    "ewc": "EWC",
    "packnet": "PackNet",
    "multitask": "Multitask",
}
policy_map = {
    "bc_rnn_policy": "BCRNNPolicy",
    "bc_transformer_policy": "BCTransformerPolicy",
    "bc_vilt_policy": "BCViLTPolicy",
}


def parse_args(argv: Sequence[str] | None = None) -> argparse.Namespace:
    """Parse the arguments, by default those of the command line."""
    parser = argparse.ArgumentParser("lifelong.eval", description="Success of a stored policy on a task.")
    parser.add_argument("--experiment_dir", default="experiments", help="folder of the runs")
    parser.add_argument("--benchmark", required=True, help="name of the benchmark, such as libero_object")
    parser.add_argument("--task_id", type=int, required=True, help="position of the task in the benchmark")
    parser.add_argument("--algo", required=True, choices=group_options("lifelong"))
    parser.add_argument("--policy", required=True, choices=group_options("policy"))
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--ep", type=int, help="epoch of a multitask run's checkpoint; default: the last")
    parser.add_argument("--load_task", type=int, help="last task before the checkpoint; default: task_id")
    parser.add_argument("--run", type=int, help="number of the run; default: the newest")
    parser.add_argument("--device_id", type=int, default=0, help="number of the GPU, if there is one")
    parser.add_argument("--n_eval", type=int, help="number of episodes; default: as in the run")
    parser.add_argument("--max_steps", type=int, help="maximum steps of an episode; default: as in the run")
    parser.add_argument("--save-videos", action="store_true")
    return parser.parse_args(argv)


def main(argv: Sequence[str] | None = None) -> int:
    """Evaluate the checkpoint that the arguments name.

    Returns:
        The exit status, see `libero_env.cli.ending`.
    """
    from libero.lifelong.run_evaluation import evaluate
    from libero_env.cli import ending

    with ending.debugging(sys.argv[1:] if argv is None else argv) as words:
        args = parse_args(words)
        try:
            with ending.interruptible():
                evaluate(args)
        except (Exception, KeyboardInterrupt) as error:  # noqa: BLE001 - told by kind
            return ending.report(error)
    return 0


if __name__ == "__main__":
    sys.path[0] = str(Path(__file__).resolve().parents[2])  # not this folder, whose modules have common names
    sys.exit(main())
