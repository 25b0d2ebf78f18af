"""Success that others published of checkpoints, and whether an evaluation contradicts it."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Annotated, Any

import yaml
from pydantic import Field

from libero_env.errors import UnknownNameError
from libero_env.storage import read_yaml_file
from libero_env.tasks import get_suite
from libero_env.text import Table, plain
from libero_env.validation import validate
from libero_eval.evaluation_file import EvaluationResult
from libero_eval.judging.page import interval_text, p_text, points
from libero_eval.protocols.files import load_protocol
from libero_eval.protocols.naming import differing, flat_values
from libero_eval.stats.episodes import agreeing_successes, fisher_exact
from lifelong.errors import ComparisonError
from lifelong.stats.intervals import ALPHA, Estimate, difference_of, holm, mean_success

PLANNED = 500  # episodes of a suite, of which `agreeing` is told


@dataclass(frozen=True, kw_only=True)
class Published:
    """What is published of a checkpoint, and how it is evaluated here; `published.yaml` has the values.

    Attributes:
        title: Its name.
        checkpoint: Where its weights are.
        server: Command of another project that serves it.
        address: Address of that server.
        conditions: Protocol of this package under which it was measured.
        protocol: Protocol of the evaluation here, as a file says it: `extends`, and what is changed.
        episodes: Number of episodes of each suite.
        successes: Number of successes of each suite.
        sources: What is told -> its address.
        mujoco: Version of MuJoCo; None where it is not stated.
        run_here: Address of a result that was measured with this package.
    """

    title: str
    checkpoint: str
    server: str
    address: str
    conditions: str
    protocol: Mapping[str, Any]
    episodes: Annotated[int, Field(ge=1)]
    successes: Mapping[str, Annotated[int, Field(ge=0)]]
    sources: Mapping[str, Annotated[str, Field(pattern="^https://")]]
    mujoco: str | None = None
    run_here: str | None = None

    def agreeing(self, suite: str) -> tuple[int, int]:
        """Return the fewest and the most successes of 500 episodes of a suite that do not contradict it."""
        return agreeing_successes(self.successes[suite], self.episodes, PLANNED)

    def command(self, name: str) -> str:
        """Return the command that evaluates it, under a name."""
        used = self.protocol["extends"] if len(self.protocol) == 1 else f"{name}.yaml"
        return (
            f"libero eval {self.address} --name {name} --protocol {used} --suite {' '.join(self.successes)} "
            f"--out eval/{name}"
        )


@dataclass(frozen=True)
class Agreement:
    """Success in a suite beside what is published; `difference` is found minus published, in [-1, 1]."""

    suite: str
    published: float
    found: float
    episodes: int
    difference: Estimate
    p_value: float
    adjusted: float


def published() -> dict[str, Published]:
    """Return what is published, by name."""
    return dict(_read())


@cache
def _read() -> dict[str, Published]:
    path = Path(str(resources.files("libero_eval"))) / "judging" / "published.yaml"
    return validate(dict[str, Published], read_yaml_file(path).data, source=path.name)


def agreement(result: EvaluationResult, name: str) -> tuple[list[Agreement], list[str]]:
    """Test the success in each suite against what is published, and return that with all conditions that differ.

    Fisher's exact test is of independent episodes with one chance of success; where tasks differ in difficulty it
    rejects less often than it may. The p-values are adjusted by Holm over the suites.

    Args:
        result: Evaluation of the checkpoint.
        name: Name of what is published, such as `pi05`.

    Raises:
        UnknownNameError: Nothing is published under that name.
        ComparisonError: The evaluation was stopped early, or has all tasks of no suite that is published.
    """
    known = published()
    if name not in known:
        raise UnknownNameError("published policy", name, known)
    if result.stopped:
        raise ComparisonError(
            f"{result.stop_note}: the test is of a number of episodes that was fixed before"
        )
    one, rows, notes = known[name], list[tuple[str, Estimate, Estimate, int, float]](), list[str]()
    for suite, tasks in result.by_suite.items():
        if suite not in one.successes or len(tasks) < len(get_suite(suite).tasks):
            notes.append(f"{suite}: {len(tasks)} tasks, of which nothing is published alone; not tested")
            continue
        won, count = sum(sum(t.successes) for t in tasks), sum(len(t.successes) for t in tasks)
        stated = one.successes[suite], one.episodes
        p_value = fisher_exact(*stated, won, count)
        rows.append((suite, mean_success(*stated), mean_success(won, count), count, p_value))
    if not rows:
        raise ComparisonError(
            f"nothing of {name} can be tested: {'; '.join(notes)}. {name} has {', '.join(one.successes)}"
        )
    adjusted = holm([row[-1] for row in rows])
    found = [
        Agreement(suite, there.value, here.value, count, difference_of(here, there), p, q)
        for (suite, there, here, count, p), q in zip(rows, adjusted, strict=True)
    ]
    return found, notes + list(_conditions(result, one))


def _conditions(result: EvaluationResult, one: Published) -> Iterator[str]:
    before = plain(load_protocol(one.conditions).flat())
    if one.protocol["extends"] == one.conditions:
        before |= flat_values(one.protocol)
    yield from differing(flat_values(result.protocol), before, result.suites)
    here = result.versions.get("mujoco")
    if one.mujoco != here:
        yield f"MuJoCo {here or 'not recorded'} ({one.mujoco or 'not stated'})"


def render(found: list[Agreement], notes: list[str], name: str, alpha: float = ALPHA) -> str:
    """Return a table of the suites, one sentence on what they show, and the conditions that differ."""
    one = published()[name]
    rows = list[list[object]]()
    for row in found:
        gap, interval = points(row.difference).split(" ", 1)[0], interval_text(row.difference)
        told = (f"{100 * row.published:.1f}", f"{100 * row.found:.1f}", row.episodes, gap, interval)
        rows.append([row.suite, *told, p_text(row.p_value), p_text(row.adjusted)])
    against = [row.suite for row in found if row.adjusted <= alpha]
    verdict = (
        f"contradicts what is published in {', '.join(against)}"
        if against
        else "agrees with what is published"
    )
    lines = [
        f"{one.title} ({one.checkpoint}): this evaluation {verdict} (Fisher's exact test, unpaired; Holm)."
    ]
    heads = ("", "published %", "here %", "episodes", "difference", "95 %", "p", "Holm")
    lines += ["", str(Table(heads, rows))]
    lines += ["", "here, and in brackets there:", *(f"  {note}" for note in notes)] if notes else []
    return "\n".join(lines)


def protocol_file(one: Published) -> str:
    """Return the protocol of an evaluation as the text of a file; empty where a protocol of the package is used."""
    return yaml.safe_dump(dict(one.protocol), sort_keys=False) if len(one.protocol) > 1 else ""
