"""A stopwatch."""

import time
from types import TracebackType


class Timer:
    """Measures the seconds that its block takes."""

    value: float | None = None

    def __enter__(self) -> "Timer":
        self.start = time.perf_counter()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.value = time.perf_counter() - self.start

    def get_elapsed_time(self) -> float | None:
        """Seconds of the block, None before its end."""
        return self.value
