"""Texts of clocks, and traces of latencies: they are clocks whose latencies are whole steps, or refused in one line."""

from itertools import islice

from hypothesis import given
from hypothesis import strategies as st

from libero_eval.protocols.clock import DISTRIBUTIONS, UNITS, Clock, Latency
from tests.harness.fuzz import examples, survive

NUMBER = st.one_of(st.floats().map(repr), st.integers(), st.text(max_size=3), st.just("0.5")).map(str)
LATENCY = st.builds(
    lambda name, numbers, unit: f"{name}{'/'.join(numbers)}{unit}",
    st.sampled_from(["", ":", *(f"{name}:" for name in DISTRIBUTIONS)]),
    st.lists(NUMBER, max_size=3),
    st.one_of(st.sampled_from(list(UNITS)), st.text(max_size=2)),
)
WORD = st.one_of(
    LATENCY.map("latency={}".format),
    st.builds(
        "{}={}".format,
        st.sampled_from(["wait", "merge", "every", "m", "latency", ""]),
        st.one_of(st.sampled_from(["rest", "hold", "repeat", "replace", "ensemble", "rtc"]), NUMBER),
    ),
)


def check(latency: Latency) -> None:
    assert all(type(n) is int and n >= 0 for n in islice(latency.draws(20, (0,)), 5))


@given(text=st.one_of(st.text(max_size=30), st.lists(WORD, max_size=4).map(",".join)))
@examples(100, 10_000)
def test_texts(text):
    if (found := survive("a clock as text", lambda: Clock.read(text))) is not None:
        again = Clock.read(str(found))
        assert str(again) == str(found)
        check(again.latency)


@given(
    content=st.one_of(
        st.binary(max_size=40), st.lists(NUMBER, max_size=5).map(lambda n: "\n".join(["ms", *n]).encode())
    )
)
@examples(50, 3000)
def test_traces(content, tmp_path_factory):
    path = tmp_path_factory.getbasetemp() / "trace.txt"
    path.write_bytes(content)
    if (found := survive("a trace", lambda: Latency.read(f"trace:{path}"))) is not None:
        check(found)
