"""Progress of long work: bars of a terminal, and lines of a log."""

import math
import sys
from typing import Any

from tqdm import tqdm

from libero_env.errors import is_quiet

LINE_SECONDS = 15.0  # between two lines of progress where there is no terminal
FIRST_ESTIMATE = 30.0  # [s] before the time that is left is told


_LEAST_TIMED = 5.0  # [s] of work from which a speed is taken
_LARGEST_RATIO = 4.0  # of the bounds on a total; their geometric mean is then right within a factor of two


def progress_bar(*iterable: Any, progress: bool | None = None, **options: Any) -> "ProgressBar":
    """Return a progress bar on stderr; where that is no terminal, it is a line every fifteen seconds.

    Args:
        iterable: Iterable to go through, if any.
        progress: True shows the bar anywhere, False shows nothing, None shows what fits stderr.
        options: Further arguments of `tqdm.tqdm`.
    """
    if progress is None and not sys.stderr.isatty() and not is_quiet():
        return _ProgressLines(*iterable, **options)
    return ProgressBar(*iterable, disable=progress is False or is_quiet(), **options)


def tell_progress(text: str) -> None:
    """Print a line on stderr, above the bar of a terminal, unless the user wants to see no progress."""
    if not is_quiet():
        tqdm.write(text, file=sys.stderr)


class ProgressBar(tqdm):
    """A bar that tells the time left from half a minute on, at the speed since the first piece was finished.

    What starts and compiles before that does not count.

    Attributes:
        least_total: Lower bound of the total, where that is an upper one, see `estimated_total`.
    """

    least_total: float | None = None
    _work, _begun, _is_told_work = 0.0, None, False

    def add_work(self, amount: float) -> None:
        """Count work, in the unit of the bar, where pieces of it are done before `update` shows one as finished."""
        self._is_told_work = True
        self._work += amount

    def update(self, n: float | None = 1) -> bool | None:
        """Count pieces of work that are finished."""
        if not self._is_told_work:
            self._work += n or 0
        if n and self._begun is None and not self.disable:
            self._begun = self._work, self._time()
        return super().update(n)

    @property
    def format_dict(self) -> Any:
        """What a line is made of; the rate is such that the time left follows from it."""
        shown = super().format_dict
        if shown["total"] and shown["n"] < shown["total"]:
            shown["rate"] = self._rate(shown["n"], shown["total"], shown["elapsed"])
        return shown

    def _rate(self, n: float, total: float, elapsed: float) -> float:
        """Return the number of pieces per second that makes the time left what it is; 0 where it is not known yet."""
        work, since = self._begun or (0.0, math.inf)
        expected = total if self.least_total is None else estimated_total(max(self.least_total, n), total)
        seconds = self._time() - since
        if elapsed < FIRST_ESTIMATE or seconds < _LEAST_TIMED or self._work <= work or math.isnan(expected):
            return 0.0
        speed = (self._work - work) / seconds
        left = max(expected - self.initial - self._work, 0.0)
        return (total - n) * speed / left if left else math.inf


def estimated_total(least: float, most: float) -> float:
    """Return the geometric mean of two bounds on a total where both are within a factor of two of it, NaN otherwise."""
    return math.sqrt(least * most) if 0 < most <= _LARGEST_RATIO * least else math.nan


class _ProgressLines(ProgressBar):
    """Progress as lines for a file; work that is done sooner than the first line is not told."""

    def __init__(self, *iterable: Any, **options: Any):
        self.disable = False
        self._lines = False  # tqdm shows the bar when it is made
        form = "{desc}: {n_fmt} of {total_fmt}, {elapsed} passed, {remaining} left{postfix}"
        intervals = {"mininterval": LINE_SECONDS, "miniters": 1, "leave": False}
        super().__init__(*iterable, **{**options, **intervals}, bar_format=form)
        self._lines = True

    def display(self, msg: str | None = None, pos: int | None = None) -> bool:
        """Write a line, but not when the bar is removed."""
        if self._lines and msg is None:
            self.fp.write(f"{self}\n")
            self.fp.flush()
        return True

    def close(self) -> None:
        """End without a line; tqdm would move the cursor."""
        if not self.disable:
            self.disable = True
            self._decr_instances(self)
