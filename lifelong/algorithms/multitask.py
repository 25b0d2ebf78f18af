"""All tasks at once, the upper bound."""

from lifelong.algorithms.base import Algorithm, Phase


class Multitask(Algorithm):
    """Train once on the windows of all tasks, shuffled together (LIBERO, section 4: MTL).

    There is no order, so nothing is transferred or forgotten: only success on each task at the end is
    measured. The weights are those after the last epoch, as there is no learning curve to choose by. The
    windows of all tasks are in memory together.
    """

    def stages(self, tasks: int) -> tuple[tuple[int, ...], ...]:
        """One stage with all tasks."""
        return (tuple(range(tasks)),)

    def phases(self) -> tuple[Phase, ...]:
        """One stretch, without a learning curve."""
        return (Phase("joint", measures_transfer=False),)
