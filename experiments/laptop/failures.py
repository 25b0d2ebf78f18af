"""How do failed rollouts of a task just learned end: where is the hand, and what did the objects touch on their way?

    python experiments/laptop/failures.py runs/libero_goal/sequential/bc_mlp_small_seed1 --task 3

For each rollout that fails: each time an object of the goal is carried, the steps, how high it came and what it
touched; then where the hand is at the end, whether it still moves, and how far the fingers are open. Last, what was
touched on the way in failures and in successes.

With `--draw-fingers` a policy with a mixture acts by its mean but for the fingers, whose action is that of a component
that is drawn.
"""

import argparse
from collections import Counter
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from libero_env.envs.batch import BatchEnv
from libero_env.sim.state import StateView
from lifelong.evaluation.restore import LoadedRun, restore
from lifelong.evaluation.rollout import Rollouts, rollout
from lifelong.nn import GMMHead

CARRIED = 0.02  # height above the start from which an object counts as carried, m
STILL = 0.01  # way of the hand in its last steps below which it stands, m
LAST = 40  # steps in which the hand stands or moves


@dataclass
class Carry:
    """One time that an object was carried.

    Attributes:
        name: The object.
        start: Step in which it was lifted.
        end: Step in which it was down again, or the last one.
        top: Largest height above its place at the start, m.
        touched: Entities other than the robot, with the number of steps that they were touched.
    """

    name: str
    start: int
    end: int = 0
    top: float = 0.0
    touched: Counter[str] = field(default_factory=Counter)

    def __str__(self) -> str:
        touched = ", ".join(f"{name} {n}" for name, n in self.touched.most_common()) or "nothing"
        return f"{self.name} carried in steps {self.start}-{self.end}, up to {self.top:.2f} m, touching {touched}"


class Watched:
    """Environment that notes what is carried, and where the hand is.

    Attributes:
        carries: For each simulation, what was carried, in order.
        hands: Position of the hand, (steps, simulations, 3), m.
    """

    def __init__(self, env: BatchEnv):
        self._env = env
        scene = env.scene
        self._owner = {int(b): name for name, bodies in scene.bodies.items() for b in bodies}
        words = {word for atom in env.atoms for word in atom.replace("(", " ").replace(",", " ").split()}
        self._objects = [name for name in scene.objects if name in words]
        self._heights: dict[tuple[int, str], float] = {}
        self._now: dict[tuple[int, str], Carry] = {}
        self.carries: list[list[Carry]] = [[] for _ in range(env.num_envs)]
        self.hands: list[np.ndarray] = []

    def __getattr__(self, name: str) -> Any:
        return getattr(self._env, name)

    def step(self, actions: np.ndarray) -> tuple:
        """Step all simulations; see `BatchEnv`."""
        running = np.flatnonzero(self._env.running)
        found = self._env.step(actions)
        for i in running.tolist():
            self._note(self._env.views[i], i)
        self.hands.append(np.array([view.eef_pos for view in self._env.views]))
        return found

    def _note(self, view: StateView, i: int) -> None:
        step = len(self.hands)
        for name in self._objects:
            height = view.body_pos(name)[2]
            above = height - self._heights.setdefault((i, name), height)
            if above < CARRIED:
                self._now.pop((i, name), None)
                continue
            if (i, name) not in self._now:
                self._now[i, name] = Carry(name, step)
                self.carries[i].append(self._now[i, name])
            carry = self._now[i, name]
            carry.end, carry.top = step, max(carry.top, above)
            carry.touched.update(set(self._touched(view, name)) - {name, "robot"})

    def _touched(self, view: StateView, name: str) -> Iterator[str]:
        model = view.scene.model
        for pair in model.geom_bodyid[view.simulations.contact_geoms(view.index)].tolist():
            owners = [self._owner.get(body, "workspace") for body in pair]
            if name in owners:
                yield from owners

    def end(self, i: int, length: int) -> str:
        """Return where the hand of a simulation is after a number of steps, and whether it stands."""
        path = np.array(self.hands)[max(0, length - LAST) : length, i]
        way = float(np.linalg.norm(path - path[-1], axis=1).max())
        view = self._env.views[i]
        entities = {
            name: float(np.linalg.norm(view.body_pos(name) - path[-1])) for name in view.scene.entities
        }
        near = min(entities, key=lambda name: entities[name])
        opening = float(np.abs(view.finger_pos).sum()) * 1000
        manner = "stands" if way < STILL else f"moved {way:.2f} m in the last {LAST} steps"
        return f"hand {entities[near]:.2f} m from {near}, {manner}, fingers {opening:.0f} mm apart"


class FingersDrawn(GMMHead):
    """Mixture of which a policy that draws takes the mean, and for the fingers a drawn component's mean."""

    def sample(self, params: dict[str, torch.Tensor], generator: torch.Generator | None) -> torch.Tensor:
        """Return an action, (1, A), of a mixture (1, K, A)."""
        choice = torch.multinomial(params["logits"].softmax(-1), 1, generator=generator)
        fingers = params["means"][..., -1].gather(-1, choice)
        return torch.cat([self.mean(params)[..., :-1], fingers], dim=-1)


def watch(run: LoadedRun, task: int, starts: int, draw_fingers: bool) -> tuple[Rollouts, Watched, list[str]]:
    """Run a task's rollouts, watched; return the outcomes and how each ends."""
    horizon = run.eval.horizon
    with closing(run.environment(task, starts, horizon)) as env, run.acting(run.tasks[task]) as policy:
        if draw_fingers:
            if not isinstance(policy.head, GMMHead):
                raise SystemExit("--draw-fingers: the policy has no mixture")
            policy.stochastic, policy.head.__class__ = True, FingersDrawn
        watched = Watched(env)
        done = rollout(
            policy,
            watched,
            range(starts),
            language=run.embed(run.learned_task(task)),
            horizon=horizon,
            settle_steps=run.eval.settle_steps,
            device=run.device,
            precision=run.eval.precision,
        )
        ends = [watched.end(i, e.length + run.eval.settle_steps) for i, e in enumerate(done.episodes)]
    return done, watched, ends


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path, help="directory of a run of one task after the other")
    parser.add_argument("--task", type=int, required=True, help="position of the task, from 0")
    parser.add_argument("--starts", type=int, default=40, help="number of rollouts (default: %(default)s)")
    parser.add_argument("--draw-fingers", action="store_true", help="draw the fingers' action of a mixture")
    args = parser.parse_args()
    run = restore(args.run, after=args.task)
    done, watched, ends = watch(run, args.task, args.starts, args.draw_fingers)
    touched: dict[bool, Counter[str]] = {True: Counter(), False: Counter()}
    for i, episode in enumerate(done.episodes):
        touched[episode.success].update({name for carry in watched.carries[i] for name in carry.touched})
        if not episode.success:
            print(f"start {episode.init_state}, {episode.length} steps: {ends[i]}")
            for carry in watched.carries[i]:
                print(f"    {carry}")
    for success, word in ((False, "failures"), (True, "successes")):
        count = sum(e.success is success for e in done.episodes)
        print(f"touched on the way in {count} {word}:", dict(touched[success].most_common()))


if __name__ == "__main__":
    main()
