"""YAML texts of any kind, read with their line numbers."""

from hypothesis import given
from hypothesis import strategies as st

from libero_env.storage import parse_yaml_text
from tests.harness.fuzz import examples, survive

PIECES = [
    *("a: ", "b: 1\n", "- ", "[", "]", "{", "}", "&x ", "*x", "<<: *x\n", "!!set ", "!!binary "),
    *("\n  ", "\n", "'", '"', "#", "2020-01-40", ".inf", "0o7", "? ", ": ", "|", ">", "%YAML"),
    *("---\n", "...\n", "\t", "\x00", "é", "\ud7ff"),
]


@given(st.lists(st.sampled_from(PIECES) | st.text(max_size=4), max_size=60).map("".join))
@examples(short=150, long=3000)
def test_any_text_is_read_or_refused(text):
    survive("yaml", lambda: parse_yaml_text(text))
