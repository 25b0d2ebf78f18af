"""When an evaluation may stop before all episodes are run: `--until`."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from libero_env.tasks import Task
from libero_env.text import flatten, json_safe, shorten, shown
from libero_eval.evaluation_file import EvaluationResult, TaskResult, by_start
from libero_eval.protocols.naming import compared
from libero_eval.protocols.protocol import EvalProtocol
from libero_eval.stats.sequential import anytime_interval, log_evidence
from lifelong.errors import ConfigError
from lifelong.stats.intervals import ALPHA, LEAST_EPISODES

_EXPECTED = "expected width=0.05, against=RESULT, or against=RESULT,margin=0.05; numbers are between 0 and 1"


@dataclass(frozen=True)
class StoppingRule:
    """What is to be known, looked at after each round over all tasks: their first starts, their second starts, ...

    It depends on the outcomes in this order, and not on the order in which they come in.

    Attributes:
        text: Text that it was read from.
        width: Width of the always-valid interval of the mean success; None for a comparison.
        margin: Loss of success that is accepted: whether this policy is better or worse than the other by that.
        other: Whether the other policy succeeded, by task and start.
        world: What the outcomes depend on by design, where they are those of the other policy: models, robot, drawing.
    """

    text: str
    width: float | None = None
    margin: float = 0.0
    other: Mapping[tuple[str, int], bool] = field(default_factory=dict)
    world: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def read(
        cls, text: str, protocol: EvalProtocol, tasks: Sequence[Task], starts: Sequence[int]
    ) -> "StoppingRule":
        """Return the rule of a text for an evaluation.

        Raises:
            ConfigError: It is no rule, cannot stop anything, or names a policy that was evaluated otherwise.
            EvaluationFileError: The result that it names cannot be read.
        """
        parts = [part.partition("=") for part in text.split(",")]
        values = {name.strip(): value.strip() for name, _, value in parts}
        try:
            numbers = {name: float(value) for name, value in values.items() if name != "against"}
        except ValueError:
            numbers = {"": 0.0}
        valid = ({"width"}, {"against"}, {"against", "margin"})
        if {*values} not in valid or len(parts) > len(values) or not all(0 < n < 1 for n in numbers.values()):
            raise ConfigError(f"--until {shown(text)}: {_EXPECTED}")
        if len(starts) < 2:
            raise ConfigError(
                "--until looks after each start of all tasks, and there is only one: --episodes 50"
            )
        if "against" not in values:
            return cls(text, numbers["width"])
        result = EvaluationResult.read(Path(values["against"]))
        if result.protocol.get("digest") != protocol.digest:
            here, there = (
                flatten(compared(one)) for one in (json_safe(protocol.resolved()), result.protocol)
            )
            differ = sorted(k for k in here.keys() | there.keys() if here.get(k) != there.get(k))
            raise ConfigError(f"--until {text}: the protocol there differs in {', '.join(differ)}")
        here = {task.id: (protocol.words(task), task.digest) for task in tasks}
        for one in result.tasks:
            words, digest = here.get(one.task, (one.instruction, one.digest))
            drawn = bool(protocol.world.perturb)  # other words are
            reworded = one.instruction != words and not drawn
            if reworded or one.digest not in ("", digest):
                raise ConfigError(f"--until {text}: {one.task} there is another task, or has other objects")
        known = {(task.task, start) for task in result.tasks for start in task.starts}
        if lacking := [(task, start) for start in starts for task in here if (task, start) not in known]:
            raise ConfigError(
                f"--until {text}: no episode of {lacking[0][0]}, start {lacking[0][1]} is there"
            )
        return cls(text, None, numbers.get("margin", 0.0), by_start(result.tasks), result.world)

    def check_world(self, world: Mapping[str, Any]) -> None:
        """Check that episodes were run as those of the other policy were.

        Raises:
            ConfigError: Models, robot or drawing are others.
        """
        both = sorted(self.world.keys() & world.keys())
        if differ := [key for key in both if self.world[key] != world[key]]:
            values = {key: [shorten(str(one[key]), 60) for one in (self.world, world)] for key in differ}
            texts = (f"{key} is {there} there and {here} here" for key, (there, here) in values.items())
            raise ConfigError(f"--until {self.text}: {', '.join(texts)}")

    def starts_needed(self, tasks: Sequence[TaskResult], starts: Sequence[int]) -> int | None:
        """Return from how many of the starts each task has to be run; None for more than these.

        Args:
            tasks: Results of each task from at least these starts.
            starts: Starts in order.
        """
        won, lost, episodes = self._counts(tasks, starts)
        if self.width is None:
            known = log_evidence(won, lost, episodes - won - lost, self.margin) >= -np.log(ALPHA)
        else:
            ends = [anytime_interval(int(w), int(n)) for w, n in zip(won, episodes, strict=True)]
            known = np.array([end.high - end.low < self.width for end in ends])
        known &= episodes >= LEAST_EPISODES
        return int(known.argmax()) + 1 if known.any() else None

    def verdict(self, tasks: Sequence[TaskResult], starts: Sequence[int]) -> str:
        """Return what is known after these starts, as text."""
        count = self.starts_needed(tasks, starts)
        if count is None:
            return "not known"
        if self.width is not None:
            return "known"
        won, lost, episodes = self._counts(tasks, starts[:count])
        return "above" if won[-1] - lost[-1] > -self.margin * episodes[-1] else "below"

    def _counts(self, tasks: Sequence[TaskResult], starts: Sequence[int]) -> np.ndarray:
        """Return how many episodes were won, lost, and counted after each start: (3, starts); of pairs, against one."""
        found, counts = by_start(tasks), np.zeros((3, len(starts)), np.int64)
        for k, start in enumerate(starts):
            for key in ((task.task, start) for task in tasks):
                if key in found and (self.width or key in self.other):  # no simulation error ended it
                    other = self.other.get(key, False)
                    counts[:, k] += (found[key] and not other, other and not found[key], 1)
        return counts.cumsum(axis=1)
