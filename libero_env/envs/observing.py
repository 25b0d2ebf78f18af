"""What is observed of a batch, when, and what of it arrives."""

from collections.abc import Callable
from functools import cached_property

import numpy as np

from libero_env.envs.config import AFTER, EnvConfig
from libero_env.envs.hooks import Entries
from libero_env.sim.observations import Observer, is_of_joints
from libero_env.sim.simulation import Indices, Watch


class Observing:
    """Images and other observations of all simulations.

    Args:
        observer: Observer of the simulations.
        config: When a step is observed.

    Attributes:
        images: Images that were rendered last, (num_envs, H, W, ...) by name.
        render_images: See `libero_env.envs.batch.BatchEnv`.
        arrives: Hooks `observe`.
        has_memory: Whether one of them depends on earlier images.
    """

    def __init__(self, observer: Observer, config: EnvConfig):
        self._observer, self._moments = observer, observer.simulations.watched
        self._is_after = config.observed == AFTER
        self.images, self.render_images = observer.empty_images(), True
        self.arrives: list[Callable[[np.ndarray, Entries, Entries], None]] = []
        self.has_memory = False
        self._seen: Entries = {}

    @cached_property
    def _unseen(self) -> Entries:
        return self._observer.empty_images()

    def state(self) -> Entries:
        """Return all observations except images: name -> (num_envs, length) float64."""
        entries = self._observer.state()
        for arrive in self.arrives:
            arrive(np.arange(0), {}, entries)
        return entries

    def render(self, ids: Indices, images: Entries | None = None) -> None:
        """Render images of simulations into rows of arrays, by default of `images`."""
        images = self.images if images is None else images
        self._observer.render_cameras(ids, images)
        for arrive in self.arrives:
            arrive(np.asarray(ids), images, {})

    def look(self, ids: Indices) -> Entries:
        """Render simulations, unseen where only a hook remembers it; return all observations except images."""
        self._render_wanted(ids)
        return self.state()

    def before_step(self) -> Watch | None:
        """Return what watches the substeps of a control step; None where it is observed at its end."""
        if not self._is_after:
            self._seen = self.state()
        return None if self._is_after else self._watch

    def after_step(self, ids: Indices) -> Entries:
        """Return the observations of a control step, except images."""
        return self.look(ids) if self._is_after else self._seen

    def with_images(self, entries: Entries) -> Entries:
        """Return copies of the images, with the given observations of the state."""
        return {name: values.copy() for name, values in self.images.items()} | entries

    def _watch(self, done: int, rows: np.ndarray) -> None:
        """Observe poses and images in a substep, and joints in the next, as the original does."""
        first, second = self._moments
        if done not in self._moments:
            return
        now = self.state()
        if done == first:
            self._render_wanted(rows)
        for name, values in now.items():
            if (done == second) == is_of_joints(name):
                self._seen[name][rows] = values[rows]

    def _render_wanted(self, ids: Indices) -> None:
        if self.render_images:
            self.render(ids)
        elif self.has_memory:
            self.render(ids, self._unseen)
