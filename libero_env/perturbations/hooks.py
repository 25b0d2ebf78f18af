"""What perturbations and their events do in the episodes of a batch."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from libero_env.envs.hooks import Entries, Hooks
from libero_env.errors import PlacementError
from libero_env.perturbations.episodes import TRIES, PerturbedEpisodes
from libero_env.perturbations.events import NEVER, PHASES, has_begun, require_moment
from libero_env.perturbations.kinds import start_name
from libero_env.tasks import Task


class PerturbationHooks(Hooks):
    """Samples of episodes, and filters of what is observed and done."""

    def __init__(self, perturbed: PerturbedEpisodes, base: Task):
        self.perturbed, self._base, self.has_memory = perturbed, base, perturbed.has_memory

    def attach(self, batch: Any) -> None:
        """Get to know the environment."""
        self._batch, self._observer, self._goal = batch, batch.observer, batch.goal
        controller = batch.simulations.controller_state.controller
        self._low, self._high = controller.low, controller.high

    def before_reset(self, ids: np.ndarray, states: np.ndarray, names: Sequence[object]) -> np.ndarray:
        """Return what the perturbations make of states; the goal does not hold there.

        Raises:
            PlacementError: They make no valid start of a state.
        """
        named = zip(ids, names or map(start_name, states), states, strict=True)
        return np.stack([self._start(int(i), name, state) for i, name, state in named])

    def _start(self, i: int, name: object, state: np.ndarray) -> np.ndarray:
        perturbed = self.perturbed
        paired = perturbed.paired(i, name, state)
        for again in range(TRIES if perturbed.samples_starts else 1):
            start = perturbed.begin(i, name, paired, again)
            if not perturbed.is_physical:
                return start
            self._batch.place(np.array([i]), start[None])
            self._goal.forget(np.array([i]))
            if not self._goal.goals[0].check([i])[0][0]:
                return start
        raise PlacementError(f"{self._base.id}, start {name}: the perturbed goal holds at the start")

    def after_reset(self, ids: np.ndarray) -> None:
        """Show episodes as they are sampled."""
        self.perturbed.moved[ids] = False
        for i in map(int, ids):
            self.show(i)

    def show(self, i: int) -> None:
        """Let a simulation look, and judge it, as what has begun says."""
        self._observer.set_appearance(i, self.perturbed.appearance(i))
        self._goal.which[i] = self.perturbed.has_new_goal(i)

    def before_step(self, ids: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """Return the actions that are executed."""
        return self.perturbed.act(ids, np.clip(actions, self._low, self._high))

    def observe(self, ids: np.ndarray, images: Entries, entries: Entries) -> None:
        """Change what arrives."""
        self.perturbed.see_images(ids, images)
        self.perturbed.see_state(entries)

    def info(self) -> dict[str, Any]:
        """Return `attempts` (num_envs, n), `began` (num_envs, events) and `moved` (num_envs,) bool."""
        found = self.perturbed
        return {"attempts": found.attempts.copy(), "began": found.began.copy(), "moved": found.moved.copy()}

    def state(self, i: int) -> np.ndarray:
        """Return the name of the start, the numbers of the samples, and the steps of events."""
        return np.concatenate(self.perturbed.kept(i))

    def restore(self, i: int, values: np.ndarray | None) -> None:
        """Go on with an episode, or begin one of the start that was the last."""
        if values is not None:
            kept = self.perturbed.kept(i)
            for part, value in zip(kept, np.split(values, np.cumsum([len(p) for p in kept])), strict=False):
                part[:] = value
        self.perturbed.moved[i] = False
        self.perturbed.resume(i, int(self._batch.steps[i]), begins=values is None)
        self.show(i)


class EventHooks(Hooks):
    """Perturbations that begin during an episode.

    Args:
        perturbed: Samples and filters of the perturbations.
        shown: What shows a simulation in which one has begun.
    """

    def __init__(self, perturbed: PerturbedEpisodes, shown: PerturbationHooks):
        self.perturbed, self._shown = perturbed, shown

    def attach(self, batch: Any) -> None:
        """Get to know the environment, whose episodes are watched from here on.

        Raises:
            InvalidInputError: No episode has the step of a trigger.
        """
        self._batch, self._horizon = batch, batch.config.horizon
        triggers = [one.trigger for one in self.perturbed.perturbations]
        for trigger in triggers:
            require_moment(trigger, self._horizon)
        self._watch = batch.watch
        batch.watching.is_kept = not {*triggers}.isdisjoint(PHASES)

    def after_reset(self, ids: np.ndarray) -> None:
        """Forget the events of earlier episodes."""
        states = self.perturbed.event_states
        for key in [key for key in states if key[0] in ids]:
            del states[key]

    def before_step(self, ids: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """Let the events begin whose moment has come."""
        perturbed = self.perturbed
        perturbed.moved[:] = False
        for i in map(int, ids):
            for event, k in enumerate(perturbed.events):
                trigger, steps = perturbed.perturbations[k].trigger, int(perturbed.steps[i])
                waits = perturbed.began[i, event] == NEVER and perturbed.attempts[i, k] < TRIES
                if waits and has_begun(trigger, steps, self._horizon, self._watch, i):
                    self._begin(i, event)
        return actions

    def _begin(self, i: int, event: int) -> None:
        """Let an event begin in simulation i; one that finds no valid place does not happen."""
        perturbed, batch = self.perturbed, self._batch
        state, size = batch.simulations.get_state(i), batch.scene.state_size
        try:
            row = perturbed.begin_event(i, event, state[:size])
        except PlacementError:
            return
        if not np.array_equal(row, state[:size]):
            batch.simulations.set_state(i, np.concatenate([row, state[size:]]))
            self._watch.measure_from_here(i)
        self._shown.show(i)
        self._watch.goals[i] = batch.goal.wanted(i)
        perturbed.moved[i] |= perturbed.perturbations[perturbed.events[event]].definition.physical
        perturbed.event_states[i, event] = batch.get_state(i)
