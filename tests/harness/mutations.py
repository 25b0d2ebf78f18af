"""Mutations of valid plain data and texts, as hypothesis draws them: hostile, but near to what is valid."""

import copy
import re
from collections.abc import Callable, Sequence
from typing import Any

from hypothesis import strategies as st

NUMBERS = (
    0, -1, 1, 2, 100, 10**9, 10**400, -(10**30), 0.5, -0.0, 1e-163, 1e308, -1e308, float("nan"), float("inf")
)  # fmt: skip
WORDS = (
    "", " ", "x", "..", "../../etc/passwd", "/etc/passwd", "a/b", "a\\b", "a\0b", "a\nb", "a\u202eb", "\u2028", "é",
    "İ", "😀", "$", "$x", "${x}", "$$", "%s", "{0}", "pi", "-pi/2", "nan", "1e999", "null", "true", "(", ")", "()",
    "(And)", ";", "world", "robot0_base", "robot", "main", "?x", "x" * 5000
)  # fmt: skip
OTHERS = (
    None, True, False, [], {}, [[]], [None], [0, 1], [[0, 1, 2, 3]], {"a": 1}, {"at": [0, 0]}, [1, [2, [3, [4]]]]
)  # fmt: skip

hostile = st.sampled_from(NUMBERS) | st.sampled_from(WORDS) | st.sampled_from(OTHERS)


@st.composite
def mutated(draw: Callable, originals: Sequence[Any], most: int = 3) -> Any:
    """Draw one of some plain data with one to `most` changes: a value replaced, dropped, doubled, swapped, renamed."""
    holder = [copy.deepcopy(draw(st.sampled_from(originals)))]
    for _ in range(draw(st.integers(1, most))):
        spots = list(_spots(holder))
        parent, key = draw(st.sampled_from(spots))
        match draw(st.integers(0, 7)):
            case 0 if parent is not holder:
                del parent[key]
            case 1:
                other, at = draw(st.sampled_from(spots))
                known = at in other if isinstance(other, dict) else other is not holder and at < len(other)
                if known:
                    parent[key] = copy.deepcopy(other[at])
            case 2 if isinstance(parent, dict):
                name = draw(st.sampled_from(WORDS) | st.sampled_from(list(parent)) | st.just(3))
                parent[name] = parent.pop(key)
            case 3 if isinstance(parent, list) and parent is not holder:
                parent.insert(key, copy.deepcopy(parent[key]))
            case 4:
                wrapped = [[parent[key]], {"at": parent[key]}, {str(key): parent[key]}]
                parent[key] = draw(st.sampled_from(wrapped))
            case 5 if isinstance(parent[key], str):
                parent[key] = draw(changed_text(parent[key]))
            case 6 if isinstance(parent[key], int | float):
                changed = [-parent[key], str(parent[key]), parent[key] * 1000, *NUMBERS]
                parent[key] = draw(st.sampled_from(changed))
            case _:
                parent[key] = copy.deepcopy(draw(hostile))
    return holder[0]


@st.composite
def changed_text(draw: Callable, text: str) -> str:
    """Draw a text with a word replaced, dropped, doubled, swapped or cut."""
    words = re.findall(r"[()]|[^\s()]+|\s+", text) or [""]
    i, j = draw(st.integers(0, len(words) - 1)), draw(st.integers(0, len(words) - 1))
    match draw(st.integers(0, 5)):
        case 0:
            words[i] = ""
        case 1:
            words[i] = words[j]
        case 2:
            words[i], words[j] = words[j], words[i]
        case 3:
            words[i] = draw(st.sampled_from(WORDS) | st.sampled_from(NUMBERS).map(str))
        case 4:
            words[i] = words[i][: draw(st.integers(0, len(words[i])))]
        case _:
            words.insert(i, f" {words[j]} ")
    return "".join(words)


def _spots(node: Any):
    """Yield each list or mapping with each of its indices or keys."""
    for key in list(node) if isinstance(node, dict) else range(len(node)):
        yield node, key
        if isinstance(node[key], dict | list):
            yield from _spots(node[key])


@st.composite
def damaged(draw: Callable, content: bytes, other: bytes = b"") -> bytes:
    """Draw bytes with up to four changes, near an end more often: some changed, lost, moved, repeated or of another."""
    data = bytearray(content)
    for _ in range(draw(st.integers(0, 4))):
        last = max(len(data) - 1, 0)
        at = draw(
            st.integers(0, last) | st.integers(0, min(last, 400)) | st.integers(max(last - 400, 0), last)
        )
        length = draw(st.sampled_from((1, 1, 2, 4, 8, 50, 200)))
        part = data[at : at + length]
        match draw(st.integers(0, 8)):
            case 0 if part:
                data[at] ^= 1 << draw(st.integers(0, 7))
            case 1:
                data[at : at + length] = bytes(len(part))
            case 2:
                data[at : at + length] = b"\xff" * len(part)
            case 3:
                data[at : at + 8] = draw(st.integers(0, 2**64 - 1)).to_bytes(8, "little")
            case 4:
                del data[at:]
            case 5:
                del data[at : at + length]
            case 6:
                data[at:at] = part * draw(st.sampled_from((1, 3, 200)))
            case 7:
                data[:] = data[at:] + data[:at]
            case _:
                data[at : at + length] = other[at : at + length] or draw(st.binary(max_size=length))
    return bytes(data)
