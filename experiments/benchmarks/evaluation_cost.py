"""Where the time of an evaluation goes: CPU time of a step of one simulation, by part, on one thread.

    OMP_NUM_THREADS=1 python experiments/benchmarks/evaluation_cost.py [preset=laptop benchmark=libero_object ...]

A policy with initial weights acts in as many simulations at once as a cell of the success matrix has, and never
succeeds. The last line is the time that it takes to tell whether rollouts would repeat recorded ones: the digest of all
that acts.
"""

import sys
import time
from collections.abc import Callable
from pathlib import Path

import torch
from hydra import compose, initialize_config_dir

from lifelong.evaluation.environments import run_environment
from lifelong.evaluation.rollout import rollout
from lifelong.sequence.measuring import digest
from lifelong.settings import build

CONFIGS = Path(__file__).parents[2] / "configs"
STEPS = 30


class Clock:
    """CPU time that calls of methods take, by name."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    def watch(self, owner: object, method: str, name: str) -> None:
        """Add the time of a method of an object to a name."""
        call = getattr(owner, method)

        def timed(*args: object, **kwargs: object) -> object:
            began = time.process_time()
            try:
                return call(*args, **kwargs)
            finally:
                self.seconds[name] = self.seconds.get(name, 0.0) + time.process_time() - began

        setattr(owner, method, timed)


def best(call: Callable[[], object], repeats: int) -> float:
    """Shortest CPU time of a call, s."""
    times = []
    for _ in range(repeats):
        began = time.process_time()
        call()
        times.append(time.process_time() - began)
    return min(times)


def main() -> None:
    """Print the parts of a step."""
    torch.set_num_threads(1)
    with initialize_config_dir(str(CONFIGS), version_base="1.3"):
        config = compose("config", ["preset=laptop", "eval.sim_threads=1", *sys.argv[1:]])
    tasks, settings, data = (build(config[key]) for key in ("benchmark", "eval", "data"))
    tasks = tasks.sequence()[:1]
    language = build(config.language).embed([task.language for task in tasks])
    data = data if data.drawing else type(data)(**{**vars(data), "drawing": "fast"})
    spec = data.spec(language.shape[1])
    policy = build(config.policy, spec=spec).eval()
    env, clock = run_environment(tasks[0], settings.episodes, spec, settings, data), Clock()

    def run() -> None:
        rollout(policy, env, range(settings.episodes), language=language[0], horizon=STEPS, settle_steps=0)

    run()
    clock.watch(env.observer, "render_cameras", "drawing")
    clock.watch(env.simulations, "step", "physics and controller")
    clock.watch(env, "proprioception", "readings")
    clock.watch(env.goals, "check", "goal")
    clock.watch(policy, "act", "policy")
    began = time.process_time()
    run()
    whole, count = time.process_time() - began, STEPS * settings.episodes
    parts = clock.seconds | {"all else": whole - sum(clock.seconds.values())}
    for name, seconds in {**parts, "a step of one simulation": whole}.items():
        print(f"{name:26s} {1000 * seconds / count:7.2f} ms  {seconds / whole:5.0%}")
    size = sum(p.numel() for p in policy.parameters())
    print(f"digest of {size / 1e6:.2f} M numbers   {1000 * best(lambda: digest({}, policy), 20):.2f} ms")
    env.close()


if __name__ == "__main__":
    main()
