"""Functions that hang, crash or ask for all memory end in one line."""

import os
import time

import pytest

from libero_env import limited
from libero_env.errors import InvalidInputError
from libero_env.limited import call_limited, limited_process


@pytest.mark.parametrize(("function", "args", "message"), [
    (time.sleep, (60,), "f: reading it takes more than"),
    (os._exit, (0,), "f: reading it ends the process"),
    (bytearray, (1 << 40,), "f: it needs more than 3 GiB"),
    (int, ("x",), "f: it cannot be read .invalid literal"),
])  # fmt: skip
def test_what_goes_wrong_is_said_in_one_line_and_the_next_call_works(monkeypatch, function, args, message):
    monkeypatch.setattr(limited, "SECONDS", 5.0)
    with limited_process():
        with pytest.raises(InvalidInputError, match=message) as caught:
            call_limited(function, *args, about="f")
        assert "\n" not in str(caught.value)
        assert call_limited(abs, -3, about="f") == 3


def test_calls_in_a_block_share_a_process():
    with limited_process():
        first = call_limited(os.getpid, about="f")
        assert call_limited(os.getpid, about="f") == first != os.getpid()
    assert call_limited(os.getpid, about="f") not in (first, os.getpid())
