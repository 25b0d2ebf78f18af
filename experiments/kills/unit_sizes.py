"""How long an episode takes in units of several sizes: the default of `libero eval --unit-starts` follows from it.

    python experiments/kills/unit_sizes.py RUN_DIR            # a policy of a run, or my_policy:make
    python experiments/kills/unit_sizes.py evaluations:make         # the small policy beside this file

Every size runs the same episodes, in turns; the fastest turn counts, as other processes only ever slow one down.
Processor time is that of the process with all its threads.
"""

import argparse
import sys
import tempfile
import time
from pathlib import Path

from libero_eval.plan import plan_evaluation
from libero_eval.requests import EvalRequest
from libero_eval.work.scheduler import policy_threads


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("policy")
    parser.add_argument("--sizes", type=int, nargs="+", default=[1, 2, 5, 10, 25, 50])
    parser.add_argument("--task", default="libero_object/0")
    parser.add_argument("--horizon", type=int, default=20)
    parser.add_argument("--turns", type=int, default=2)
    parser.add_argument("--threads", type=int, default=0)
    args = parser.parse_args()
    sys.path.insert(0, str(Path(__file__).parent))
    best: dict[int, tuple[float, float]] = {}
    for _ in range(args.turns):
        for size in args.sizes:
            found = measure(args, size)
            best[size] = min(found, best.get(size, found))
    print(
        f"{'episodes of a unit':>18} {'s per 600 steps':>15} {'of the processor':>16} {'episodes an hour':>16}"
    )
    for size, (seconds, processor) in best.items():
        print(f"{size:>18} {seconds:>15.2f} {processor:>16.2f} {3600 / seconds:>16,.0f}")


def measure(args: argparse.Namespace, size: int) -> tuple[float, float]:
    """Return wall and processor time per episode of 600 steps, [s], without the first unit, which opens the scene."""
    with tempfile.TemporaryDirectory() as folder:
        request = EvalRequest(
            policy=args.policy,
            suite=(args.task,),
            out=Path(folder),
            unit_starts=size,
            horizon=args.horizon,
            threads=args.threads,
        )
        plan = plan_evaluation(request)
        with plan.pool() as pool, policy_threads(plan):
            plan.evaluate(plan.units[0], pool)
            wall, processor = time.perf_counter(), time.process_time()
            units = plan.units[-max(1, 10 // size) :]
            for unit in units:
                plan.evaluate(unit, pool)
            count = sum(len(unit.init_states) for unit in units) * args.horizon / 600
            return (time.perf_counter() - wall) / count, (time.process_time() - processor) / count


if __name__ == "__main__":
    main()
