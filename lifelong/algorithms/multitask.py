"""All tasks at once, the upper bound."""

from lifelong.algorithms.base import Algorithm, Phase


class Multitask(Algorithm):
    """Train once on the windows of all tasks, shuffled together (LIBERO, section 4: MTL).

    There is no order, so nothing is transferred or forgotten: only success on each task at the end is
    measured. The weights are those after the last epoch, because there is no learning curve to choose them by. The
    windows of all tasks are in memory at the same time.
    """

    def stages(self, tasks: int) -> tuple[tuple[int, ...], ...]:
        """Return one stage with all tasks."""
        return (tuple(range(tasks)),)

    def phases(self) -> tuple[Phase, ...]:
        """Return one phase, without a learning curve."""
        return (Phase("joint", measures_transfer=False),)
