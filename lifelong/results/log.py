"""The append-only file of a run's records."""

import os
from pathlib import Path
from typing import IO

from lifelong.errors import ResultsError
from lifelong.results.records import Record, from_line, to_line
from lifelong.results.results import Results

_Stamp = tuple[int, int, int]  # inode, size, time of the last change


class ResultLog:
    """Append-only `results.jsonl`. Each record is on disk when `append` returns.

    The records are kept in memory, so `read` parses the file again only if another process changed it.
    """

    def __init__(self, path: Path | str):
        self.path = Path(path)
        self._results = Results(())
        self._stamp: _Stamp | None = None  # of the file that `_results` was read from; None: no file

    def append(self, record: Record) -> None:
        """Append one line, flushed and synced.

        An incomplete line that a killed process left at the end is removed first. If the line cannot be written
        whole (disk full), the part that was written is removed, so the file stays readable.

        Args:
            record: Record to append.

        Raises:
            ResultsError: The file cannot be written.
        """
        line = to_line(record)
        record, known = from_line(line), self._file_stamp() == self._stamp  # as another process would read it
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with open(self.path, "a+b", buffering=0) as file:
                size, separator = _end_of_records(file)
                try:
                    file.truncate(size)
                    if file.write(separator + line) != len(separator + line):
                        raise OSError("only a part of the line was written")
                    os.fsync(file.fileno())
                except OSError:
                    file.truncate(size)
                    raise
        except OSError as error:
            raise ResultsError(
                f"{self.path}: cannot append a {record.kind!r} record ({error}). What was recorded before "
                "is intact; free some space or fix the permissions, then run the same command again"
            ) from error
        if known:
            self._results = Results((*self._results.records, record), self._results.problems)
            self._stamp = self._file_stamp()

    def read(self) -> Results:
        """Return everything recorded so far; nothing if there is no file yet. The file is never changed."""
        stamp = self._file_stamp()
        if stamp != self._stamp:
            self._results = Results(()) if stamp is None else self._parse()
            self._stamp = stamp
        return self._results

    def _parse(self) -> Results:
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
                if number < len(lines):  # the last line has no newline: it is incomplete, not invalid
                    problems.append(f"{self.path}:{number}: {error}; the line is ignored")
        return Results(tuple(records), tuple(problems))

    def _file_stamp(self) -> _Stamp | None:
        try:
            found = self.path.stat()
        except FileNotFoundError:
            return None
        except OSError as error:
            raise ResultsError(f"{self.path}: cannot be read ({error})") from error
        return found.st_ino, found.st_size, found.st_mtime_ns


def _end_of_records(file: IO[bytes]) -> tuple[int, bytes]:
    """Return the size of the complete records, and a newline if only that is missing after them."""
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
