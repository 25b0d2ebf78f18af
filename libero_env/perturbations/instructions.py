"""Rewording of instructions: the same meaning in other words, at a given token edit distance.

A sentence is split into clauses; each is said in another way of `data/wording.yaml`, with other names of things. The
table is this package's own, deterministic, and complete for the benchmark's sentences; of other sentences, names that
it knows are replaced, and the frame.
"""

import re
from collections.abc import Mapping, Sequence
from functools import cache

import numpy as np

from libero_env.storage import read_yaml

_WORDING = "perturbations/data/wording.yaml"
_CANDIDATES = 400
_UNSPLIT = re.compile(
    r"yellow and white|plate and the ramekin|both .+? and .+? (?=in |on )|and (?:place|put) it"
)


def edit_distance(first: str, second: str) -> float:
    """Return the normalised token edit distance: insertions, deletions and substitutions over the longer length."""
    a, b = first.split(), second.split()
    row = list(range(len(b) + 1))
    for i, word in enumerate(a, 1):
        diagonal, row[0] = row[0], i
        for j, other in enumerate(b, 1):
            diagonal, row[j] = row[j], min(row[j] + 1, row[j - 1] + 1, diagonal + (word != other))
    return row[-1] / max(len(a), len(b), 1)


def reword(sentence: str, distance: float, rng: np.random.Generator) -> str:
    """Return a sentence of the same meaning.

    Args:
        sentence: Instruction, such as `put the bowl on the stove`.
        distance: Token edit distance to aim at; the nearest of many rewordings is taken. 0 returns the sentence.
        rng: Generator of the choices.
    """
    if not distance:
        return sentence
    plain = " ".join(sentence.split())
    said = {_reworded(plain, rng) for _ in range(_CANDIDATES)} - {plain}
    return min(sorted(said), key=lambda one: abs(edit_distance(plain, one) - distance), default=plain)


@cache
def _patterns() -> Mapping[str, re.Pattern[str]]:
    wording = read_yaml(_WORDING)
    relations = "|".join(sorted(wording["relations"], key=len, reverse=True))
    return {
        name: re.compile(clause["pattern"].replace("RELATION", relations) + "$")
        for name, clause in wording["clauses"].items()
    }


def _reworded(sentence: str, rng: np.random.Generator) -> str:
    """Return one of the rewordings; how much it changes is random too."""
    wording, boldness = read_yaml(_WORDING), rng.random()
    clauses = [_say(clause, boldness, rng) for clause in split_clauses(sentence)]
    said = clauses[0]
    for clause in clauses[1:]:
        said += f" {_pick(wording['conjunctions'], boldness, rng)} {clause}"
    return _pick(wording["frames"], boldness, rng).format(s=said)


def split_clauses(sentence: str) -> list[str]:
    """Return the clauses of a sentence, which `and` joins."""
    joined = _UNSPLIT.sub(lambda match: match[0].replace(" and ", " & ").replace("and p", "& p"), sentence)
    return [clause.replace("&", "and") for clause in joined.split(" and ")]


def _say(clause: str, boldness: float, rng: np.random.Generator) -> str:
    """Return a clause in other words."""
    wording = read_yaml(_WORDING)
    for name, pattern in _patterns().items():
        if match := pattern.match(clause):
            parts = match.groupdict()
            named = {key: _rename(text, boldness, rng) for key, text in parts.items() if key != "r"}
            if relation := parts.get("r"):
                named["r"] = _pick(wording["relations"][relation], boldness, rng)
                named["at"] = _pick(wording["places"][relation], boldness, rng)
            ways = [_own_way(match), *wording["clauses"][name]["ways"]]
            return _pick(ways, boldness, rng).format(**named)
    return _rename(clause, boldness, rng)


def _own_way(match: re.Match[str]) -> str:
    """Return the way in which a clause is said, with its things and relation left open."""
    way = match.string
    for key in sorted(match.groupdict(), key=match.start, reverse=True):
        way = f"{way[: match.start(key)]}{{{key}}}{way[match.end(key) :]}"
    return way


def _rename(text: str, boldness: float, rng: np.random.Generator) -> str:
    """Return a text in which things have other names."""
    names: Mapping[str, Sequence[str]] = read_yaml(_WORDING)["names"]
    words, said, i = text.split(), [], 0
    while i < len(words):
        for end in range(len(words), i, -1):
            if (phrase := " ".join(words[i:end])) in names:
                said.append(_pick([phrase, *names[phrase]], boldness, rng))
                i = end
                break
        else:
            said.append(words[i])
            i += 1
    return " ".join(said)


def _pick(ways: Sequence[str], boldness: float, rng: np.random.Generator) -> str:
    """Return the first of several ways, or with the probability `boldness` any of the others."""
    if len(ways) == 1 or rng.random() >= boldness:
        return ways[0]
    return ways[1 + int(rng.integers(len(ways) - 1))]
