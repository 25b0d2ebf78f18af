"""Files of records after damage of any kind: a broken line costs that line; nothing is read that was not written."""

import json
import tempfile
from pathlib import Path

from hypothesis import given
from hypothesis import strategies as st

from libero_eval.check import examine
from lifelong.results.log import ResultLog
from lifelong.results.records import (
    CostRecord,
    DemonstrationsRecord,
    LossRecord,
    PhaseRecord,
    RunEndRecord,
    TaskEndRecord,
    signed_line,
    to_line,
)
from lifelong.results.summary import summarize
from lifelong.stats.metrics import lifelong_metrics
from tests.harness.fuzz import examples, survive
from tests.harness.mutations import damaged
from tests.harness.records import evaluation, run_start

NAMES = ["first", "second"]
START = run_start(NAMES)
TRUTHS = dict.fromkeys(("atoms_at_start", "atoms_ever", "atoms_at_end"), ((True,), (False,)))
EVER = {"atoms": ("(On a b)",), **TRUTHS}


RECORDS = [
    START,
    DemonstrationsRecord(counts=(50, 10), generators=("expert", ""), digests=("aa", "bb")),
    PhaseRecord(phase="demos", seconds=3.0),
    *(evaluation("curve", task, epoch, task, 1, 2, **EVER) for task in (0, 1) for epoch in (0, 1)),
    *(LossRecord(task=task, epoch=1, loss=0.5 + task, seconds=2.0) for task in (0, 1)),
    *(evaluation("matrix", learned, 1, task, 1, 2, **EVER) for learned in (0, 1) for task in range(learned + 1)),
    CostRecord(task=0, costs={"stored_bytes": 3.0}),
    *(TaskEndRecord(task=task, best_epoch=1, seconds=3.0) for task in (0, 1)),
    RunEndRecord(seconds=9.0, finished="2026-01-01T00:00:00+00:00"),
]  # fmt: skip
LINES = [to_line(record) for record in RECORDS]
ODD = st.sampled_from(
    [None, True, -1, 0, 1.5, 10**30, 10**400, 1e308, float("nan"), "", "zero", [], [[]], {}, [1, "a"]]
)


@st.composite
def edited_line(draw) -> bytes:
    """A line whose values are of other types or out of range, with its checksum."""
    values = json.loads(draw(st.sampled_from(LINES)))
    del values["crc32"]
    for _ in range(draw(st.integers(1, 2))):
        key = draw(st.sampled_from([*values, "other"]))
        match draw(st.sampled_from(["set", "drop", "nest"])):
            case "set":
                values[key] = draw(ODD)
            case "drop":
                values.pop(key, None)
            case "nest":
                values[key] = [values.get(key)]
    try:
        return signed_line(values)
    except (RecursionError, ValueError):  # JSON has no such number
        return json.dumps(values).encode() + b"\n"


# lines some of whose bytes are changed or lost
DAMAGED = (
    st.sampled_from(LINES)
    .flatmap(lambda line: damaged(line[:-1]))
    .map(lambda b: b.replace(b"\n", b"") + b"\n")
)


def read(content: bytes):
    """Read the records and everything that is computed from them."""
    with tempfile.TemporaryDirectory() as folder:
        log = ResultLog(Path(folder, "results.jsonl"))
        log.path.write_bytes(content)
        results = log.read()
        try:
            summarize(results)
            if results.learned_tasks():
                lifelong_metrics(results.scores())
        finally:
            examine(Path(folder))
            assert log.path.read_bytes() == content, "reading changes nothing"
        return results


@given(st.lists(DAMAGED, min_size=1, max_size=3), st.data())
@examples(short=120, long=3000)
def test_damaged_lines_cost_themselves(lines, data):
    content = list(LINES)
    for line in lines:
        content.insert(data.draw(st.integers(1, len(content))), line)
    results = survive("results", lambda: read(b"".join(content)))
    found = set(map(repr, results.records))
    assert found == set(map(repr, RECORDS)), "what was damaged is no record, and nothing else is lost"


@given(
    st.lists(edited_line() | st.binary(max_size=60).map(lambda b: b + b"\n"), min_size=1, max_size=4),
    st.data(),
)
@examples(short=150, long=4000)
def test_records_of_others_are_refused_or_used_without_a_traceback(lines, data):
    content = list(LINES)
    for line in lines:
        place = data.draw(st.integers(0, len(content)))
        content[place : place + data.draw(st.integers(0, 1))] = [line]
    survive("results", lambda: read(b"".join(content)))
