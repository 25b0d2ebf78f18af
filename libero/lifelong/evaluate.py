"""Evaluate a stored policy: `python libero/lifelong/evaluate.py --benchmark libero_spatial --task_id 0 ...`."""

import sys
from collections.abc import Sequence
from pathlib import Path

from libero._adapters.config import Evaluation
from libero.scripts.command import script
from libero_env.cli.options import parse

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
