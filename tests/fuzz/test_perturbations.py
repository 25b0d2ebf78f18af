"""Texts and values of perturbations, of any kind: they are perturbations, or refused in one line."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from libero_env.perturbations import KINDS, Perturbation, format_perturbations, parse_perturbations
from libero_env.perturbations.instructions import edit_distance, reword
from libero_env.tasks import get_suite
from tests.harness.fuzz import examples, survive

NUMBER = st.one_of(st.floats().map(repr), st.integers().map(str), st.text(max_size=5), st.just("0.5"))
PART = st.builds(
    "".join,
    st.tuples(
        st.one_of(st.sampled_from(list(KINDS)), st.text(max_size=8)),
        st.sampled_from(["=", "", "==", " = ", "@"]),
        NUMBER,
        st.sampled_from(["", "@1", "@", "@-1", "@9223372036854775808", ","]),
    ),
)
VALUE = st.one_of(
    st.none(), st.integers(), st.floats(), st.text(max_size=8), st.binary(max_size=4), st.booleans()
)


@given(text=st.one_of(st.text(max_size=40), st.lists(PART, max_size=4).map(",".join)))
@examples(50, 5000)
def test_texts(text):
    found = survive("perturbations as text", lambda: parse_perturbations(text))
    if found:
        again = parse_perturbations(format_perturbations(found))
        assert [one.kind for one in again] == [one.kind for one in found if one.severity]


@given(kind=st.one_of(st.sampled_from(list(KINDS)), st.text(max_size=4)), severity=VALUE, seed=VALUE)
@examples(60, 3000)
def test_values(kind, severity, seed):
    survive("perturbation", lambda: Perturbation(kind, severity, seed))


@given(
    words=st.lists(
        st.one_of(
            st.sampled_from(" ".join(t.language for t in get_suite("libero_goal").tasks).split()),
            st.text(max_size=6),
            st.sampled_from(["{x}", "{", "}", "and", "put", "it", "%s"]),
        ),
        max_size=12,
    ),
    distance=st.floats(0, 1),
)
@examples(10, 500)
def test_instructions_of_others(words, distance):
    sentence = " ".join(words)
    said = survive("instructions", lambda: reword(sentence, distance, np.random.default_rng(0)))
    assert isinstance(said, str) and 0 <= edit_distance(sentence, said) <= 1
