"""The append-only file of a run's records."""

import os
from pathlib import Path
from typing import IO

from lifelong.errors import ResultsError
from lifelong.results.records import Record, from_line, to_line
from lifelong.results.results import Results


class ResultLog:
    """Append-only `results.jsonl`. Each record is on disk when `append` returns."""

    def __init__(self, path: Path | str):
        self.path = Path(path)

    def append(self, record: Record) -> None:
        """Adds one line, flushed and synced.

        A fragment that a killed process left at the end is removed first. If the line cannot be written
        whole (disk full), what was written of it is taken back, so the file stays readable.

        Raises:
            ResultsError: The file cannot be written.
        """
        line = to_line(record)
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with open(self.path, "a+b", buffering=0) as file:
                size, separator = _end_of_records(file)
                try:
                    file.truncate(size)
                    if file.write(separator + line) != len(separator + line):
                        raise OSError("the line was written in part only")
                    os.fsync(file.fileno())
                except OSError:
                    file.truncate(size)
                    raise
        except OSError as error:
            raise ResultsError(
                f"{self.path}: cannot append a {record.kind!r} record ({error}). What was recorded before "
                "is intact; free some space or mend the permissions, then start the same command again"
            ) from error

    def read(self) -> "Results":
        """Everything recorded so far; empty if the file does not exist yet. Never changes the file."""
        if not self.path.exists():
            return Results(())
        try:
            raw = self.path.read_bytes()
        except OSError as error:
            raise ResultsError(f"{self.path}: cannot be read ({error})") from error
        records: list[Record] = []
        problems: list[str] = []
        lines = raw.split(b"\n")
        for number, line in enumerate(lines, start=1):
            if not line.strip():
                continue
            try:
                records.append(from_line(line))
            except ValueError as error:
                if number < len(lines):  # the last line has no newline: it was cut off, not broken
                    problems.append(f"{self.path}:{number}: {error}; the line is left out")
        return Results(tuple(records), tuple(problems))


def _end_of_records(file: IO[bytes]) -> tuple[int, bytes]:
    """Where the next record goes, and what must be written before it: a newline if only that is missing."""
    size = file.seek(0, os.SEEK_END)
    if size == 0:
        return 0, b""
    file.seek(size - 1)
    if file.read(1) == b"\n":
        return size, b""
    file.seek(0)
    fragment = file.read().rpartition(b"\n")[2]
    try:
        from_line(fragment)
    except ValueError:
        return size - len(fragment), b""
    return size, b"\n"
