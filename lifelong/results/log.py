"""The append-only file of a run's records."""

import hashlib
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO

from libero_env.storage import regular_file
from lifelong.errors import ResultsError
from lifelong.results.records import DemonstrationsRecord, Record, RunRecord, from_line, to_line
from lifelong.results.results import Results

MAX_LINE = 4 << 20  # [bytes]
_open_own = regular_file(4 << 30, links=False)  # the folder may be somebody else's

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

        Raises:
            ResultsError: The file cannot be written.
        """
        line = to_line(record)
        record, known = from_line(line), self._file_stamp() == self._stamp  # as another process would read it
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with open(self.path, "a+b", buffering=0, opener=_open_own) as file:
                size, separator = _end_of_records(file)
                known = known and not separator  # else what is before it is read again
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
        records: list[tuple[int, Record]] = []
        problems: list[tuple[int, str]] = []
        lines: dict[bytes, int] = {}  # digest of each line -> its number
        try:
            with open(self.path, "rb", opener=_open_own) as file:
                for number, line in _lines(file):
                    try:
                        if len(line) > MAX_LINE:
                            raise ValueError(f"longer than {MAX_LINE >> 20} MiB, which no record is")
                        record = from_line(line)
                        first = lines.setdefault(
                            hashlib.blake2b(line.strip(), digest_size=16).digest(), number
                        )
                        if first != number and not isinstance(record, RunRecord | DemonstrationsRecord):
                            raise ValueError(f"repeats line {first}")
                        records.append((number, record))
                    except ValueError as error:
                        if line.endswith(b"\n"):  # else the last line is incomplete, not invalid
                            problems.append((number, str(error)))
        except OSError as error:
            raise ResultsError(f"{self.path}: cannot be read ({error})") from error
        kept, odd = _of_one_run(records)
        found = (f"{self.path}:{n}: {text}; the line is ignored" for n, text in sorted(problems + odd))
        return Results(tuple(kept), tuple(found))

    def _file_stamp(self) -> _Stamp | None:
        try:
            found = self.path.stat()
        except FileNotFoundError:
            return None
        except OSError as error:
            raise ResultsError(f"{self.path}: cannot be read ({error})") from error
        return found.st_ino, found.st_size, found.st_mtime_ns


def _lines(file: IO[bytes]) -> Iterator[tuple[int, bytes]]:
    """Yield each line that is not empty with its number; of one that is too long, a beginning that is too long too."""
    number = 0
    while line := file.readline(MAX_LINE + 1):
        number += 1
        rest = line
        while rest and not rest.endswith(b"\n"):
            rest = file.readline(MAX_LINE)
        ended = rest.endswith(b"\n")
        if len(line) > MAX_LINE and not line.endswith(b"\n") and ended:
            line += b"\n"
        if line.strip():
            yield number, line


def _of_one_run(records: Sequence[tuple[int, Record]]) -> tuple[list[Record], list[tuple[int, str]]]:
    """Divide records into those of the run that the first of them names, and faults of the others by line."""
    run = next((record for _, record in records if isinstance(record, RunRecord)), None)
    kept: list[Record] = []
    odd: list[tuple[int, str]] = []
    for number, record in records:
        task, learned = getattr(record, "task", 0), getattr(record, "learned", 0)
        unlearned = len(run.held_out) if run and getattr(record, "phase", "") in ("initial", "unseen") else 0
        if run is not None and max(task - unlearned, learned) >= len(run.tasks):
            highest = max(task, learned)
            odd.append((number, f"a {record.kind!r} record of task {highest}, of {len(run.tasks)} from 0 on"))
        elif isinstance(record, RunRecord) and run is not None and record.tasks != run.tasks:
            odd.append((number, "a 'run' record of other tasks than the first one's"))
        else:
            kept.append(record)
    return kept, odd


def _end_of_records(file: IO[bytes]) -> tuple[int, bytes]:
    """Return the size of the complete records, and a newline if only that is missing after them."""
    size = file.seek(0, os.SEEK_END)
    if size == 0:
        return 0, b""
    file.seek(max(0, size - MAX_LINE))
    _, newline, fragment = file.read().rpartition(b"\n")
    if not newline and size > MAX_LINE:
        return size, b"\n"  # no record is as long: it is not removed, and reported as broken
    if not fragment:
        return size, b""
    try:
        from_line(fragment)
    except ValueError:
        return size - len(fragment), b""
    return size, b"\n"
