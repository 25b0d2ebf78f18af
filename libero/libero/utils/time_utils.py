"""A stopwatch."""

import time


class Timer:
    """Measures the duration of its block."""

    value: float | None = None

    def __enter__(self) -> "Timer":
        self.start = time.perf_counter()
        return self

    def __exit__(self, *error: object) -> None:
        self.value = time.perf_counter() - self.start

    def get_elapsed_time(self) -> float | None:
        """Return the duration of the block in seconds; None before its end."""
        return self.value
