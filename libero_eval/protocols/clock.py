"""Policies that think while the world moves: on a virtual clock, an answer is there some time after its observation.

A chunk's actions are counted from the observation that it was made of. Those in whose place the robot has executed
actions of an earlier chunk are stale and dropped; steps in which it waited make nothing stale (as in LeRobot's
asynchronous inference, where time advances with the actions that are executed).
"""

import math
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, Protocol

import numpy as np
from pydantic import Field

from libero_env.errors import UnknownNameError
from libero_env.storage import regular_file
from libero_env.text import shown
from libero_env.timing import CONTROL_HZ
from libero_env.validation import validate_arguments
from lifelong.errors import ConfigError
from lifelong.evaluation.actors import Hears, Obs, TakesNote, WatchesWorld
from lifelong.seeding import LATENCY

DISTRIBUTIONS = ("normal", "lognormal", "uniform")  # of two numbers
UNITS = {"ms": 1.0, "steps": 1.0, "s": 1000.0}  # of a number, in the unit that is stored, ms or steps
EXPECTED = (
    "expected 120ms, 0.12s or 3steps, normal:120/20ms (mean, deviation), lognormal:120/0.4ms (median, deviation of the "
    "logarithm), uniform:50/150ms, or trace:FILE"
)
MOST_MEASURED, MOST_LETTERS = 10_000, 1 << 20  # latencies of a trace, and what is read of its file
LONGEST = 1e9  # of a latency, ms or steps
ENSEMBLE_M = 0.01  # of ACT
_REMEMBERED = 10  # latencies from which the next one is expected


@dataclass(frozen=True)
class Latency:
    """How long inference takes.

    Attributes:
        values: One number for a constant, several of a trace, or the two of a distribution.
        unit: `ms` or `steps`, control steps.
        distribution: One of `DISTRIBUTIONS`; empty for a constant and a trace.
    """

    values: tuple[float, ...] = (0.0,)
    unit: str = "ms"
    distribution: str = ""

    @classmethod
    def read(cls, text: str) -> "Latency":
        """Return the latency of a text, or of the file that it names.

        Raises:
            ConfigError: It is of another form, or a number is negative or not finite.
        """
        if text.startswith("trace:"):
            return cls._measured(Path(text.removeprefix("trace:")))
        distribution, _, numbers = text.rpartition(":")
        unit = next((unit for unit in UNITS if numbers.endswith(unit)), "")
        values = numbers.removesuffix(unit).split("/")
        if not unit or distribution not in ("", *DISTRIBUTIONS) or (distribution and len(values) != 2):
            raise ConfigError(f"clock: latency={text[:80]}: {EXPECTED}")
        first, *more = (_number(value, f"clock: latency={text[:80]}") * UNITS[unit] for value in values)
        if distribution == "lognormal":
            more = [_number(values[1], f"clock: latency={text}")]  # it has no unit
        if distribution == "uniform" and more[0] < first:
            raise ConfigError(f"clock: latency={text}: the second number is the largest latency")
        return cls((first, *more), "steps" if unit == "steps" else "ms", distribution)

    @classmethod
    def _measured(cls, path: Path) -> "Latency":
        try:
            with open(path, encoding="utf-8", opener=regular_file(MOST_LETTERS)) as file:
                unit, *lines = file.read(MOST_LETTERS).split() or [""]
        except (OSError, ValueError) as error:
            reason = "it is not text" if isinstance(error, ValueError) else error.strerror or str(error)
            raise ConfigError(f"clock: latency=trace:{path}: {reason}") from None
        if unit not in UNITS or not 1 <= len(lines) <= MOST_MEASURED:
            raise ConfigError(
                f"clock: latency=trace:{path}: expected a line with the unit ({', '.join(UNITS)}) and 1 to "
                f"{MOST_MEASURED} latencies, one a line; got {shown(unit)} and {len(lines)}"
            )
        where = f"clock: latency=trace:{path}, line {{}}"
        values = (_number(line, where.format(i)) * UNITS[unit] for i, line in enumerate(lines, 2))
        return cls(tuple(values), "steps" if unit == "steps" else "ms")

    def __str__(self) -> str:
        name = f"{self.distribution}:" if self.distribution else ""
        return name + "/".join(f"{value:.12g}" for value in self.values) + self.unit

    def draws(self, hz: int, seed: Sequence[int]) -> Iterator[int]:
        """Yield the latency of one inference after the other, [control steps], rounded up.

        Args:
            hz: Control steps per second.
            seed: Words of the episode: what is drawn depends on them alone. A trace begins at a place that is drawn.
        """
        generator = np.random.default_rng([*seed, LATENCY])
        first, last, count = self.values[0], self.values[-1], len(self.values)
        per_step = 1.0 if self.unit == "steps" else 1000 / hz
        place = int(generator.integers(count))
        while True:
            match self.distribution:
                case "normal":
                    value = generator.normal(first, last)
                case "lognormal":
                    value = first * math.exp(min(generator.normal(0.0, last), 50.0))
                case "uniform":
                    value = generator.uniform(first, last)
                case _:
                    value, place = self.values[place], (place + 1) % count
            yield math.ceil(min(max(value, 0.0), LONGEST) / per_step - 1e-9)


@dataclass(frozen=True)
class Clock:
    """When answers of a policy are used, and what is executed until then.

    Attributes:
        latency: Time from an observation to its answer.
        wait: What is executed while an answer is awaited: the `rest` of the last chunk, and where that ends, or with
            `hold`, no motion with the gripper as it is; `repeat`: the last action again.
        merge: What becomes of the last chunk when the next is there: `replace`; `ensemble`, the temporal ensembling of
            ACT (Zhao et al. 2023); `rtc`, replaced by one that continues it (Black et al. 2025).
        every: Number of actions after which the next chunk is asked for, if the last one is there; None for as many
            as the policy or its protocol executes of a chunk, and 1 with `ensemble`, as in ACT.
        m: Chunk i, from the oldest, has the weight exp(-m i) in the ensemble.
    """

    latency: Latency = Latency()
    wait: Literal["rest", "hold", "repeat"] = "rest"
    merge: Literal["replace", "ensemble", "rtc"] = "replace"
    every: Annotated[int, Field(ge=1)] | None = None
    m: float = ENSEMBLE_M

    @classmethod
    def read(cls, text: str) -> "Clock":
        """Return the clock of a text such as `latency=120ms,wait=hold`; `EXPECTED` says what a latency is.

        Raises:
            UnknownNameError: A word does not exist.
            ConfigError: A word is named twice or has another value, or two contradict each other.
        """
        given: dict[str, Any] = {}
        for part in filter(None, map(str.strip, text.split(","))):
            name, _, value = part.partition("=")
            if name not in vars(Clock()):
                raise UnknownNameError("word of a clock", name, vars(Clock()))
            if name in given:
                raise ConfigError(f"clock: {name} is named twice")
            given[name] = value
            if name == "m":
                given[name] = _number(value, f"clock: {part}")
            elif name == "every" and value.isdecimal():
                given[name] = int(value)
        latency = Latency.read(given.pop("latency", "0ms"))
        validate_arguments(cls, given, prefix=("clock",), error=ConfigError)
        clock = cls(latency, **given)
        if "m" in given and clock.merge != "ensemble":
            raise ConfigError(f"clock: m is of merge=ensemble, and merge is {clock.merge}")
        if clock.merge == "rtc" and clock.wait != "rest":
            raise ConfigError(
                f"clock: merge=rtc executes the rest of the last chunk, and wait is {clock.wait}: wait=rest"
            )
        return clock

    def __str__(self) -> str:
        default = vars(Clock())
        words = vars(self).items()
        return ",".join(f"{k}={value}" for k, value in words if k == "latency" or value != default[k])

    def check(self, chunk: int | None, inpaints: bool) -> None:
        """Check that a policy can be merged like this.

        Args:
            chunk: Number of actions of its answers; None where that is not known yet.
            inpaints: Whether it can continue a chunk.

        Raises:
            ConfigError: It cannot.
        """
        if chunk == 1 and self.merge != "replace":
            raise ConfigError(
                f"clock: merge={self.merge} merges chunks, and the policy answers with single actions: merge=replace"
            )
        if self.merge == "rtc" and not inpaints:
            raise ConfigError(
                "clock: merge=rtc needs a policy that inpaints its chunks, a run with policy/head=flow; merge=replace "
                "executes the same prefix, and then a chunk that knows nothing of it"
            )
        if chunk is not None and (self.every or 0) > chunk:
            raise ConfigError(f"clock: every={self.every}, and the policy's answers have {chunk} actions")


class Planner(Protocol):
    """Answers observations of simulations with chunks of actions."""

    @property
    def action_dim(self) -> int:
        """Dimension A of actions."""

    @property
    def views(self) -> tuple[str, ...]:
        """Names of the observed images that recorded rollouts show."""

    @property
    def replan(self) -> int | None:
        """Number of actions of a chunk that are executed before the next is asked for; None for all."""

    @property
    def observes(self) -> str:
        """Which observations it is given: `always`, also those for which nothing is asked, `asked` or `never`."""

    @property
    def plan(self) -> Callable[..., Any]:
        """Function of observations and rows that returns the chunk (H, A) of each of these simulations.

        That of a policy that inpaints takes `before`, too; see `lifelong.evaluation.actors.PolicyActor`.
        """

    def reset(self, num_envs: int) -> None:
        """Reset the history; the next observation is the first of new episodes."""


@dataclass
class _Chunk:
    actions: np.ndarray
    at: int = 0  # number of actions since its observation
    is_used: bool = False

    @property
    def left(self) -> np.ndarray:
        return self.actions[self.at :]


@dataclass
class _Episode:
    """The clock of one episode; see `ClockedActor`.

    Attributes:
        still: Action of a robot that waits before it has acted.
        relative: Whether actions are relative, so that zeros are no motion.
        every: Number of actions between two requests.
    """

    clock: Clock
    latencies: Iterator[int]
    still: np.ndarray
    relative: bool
    every: float
    now: int = 0
    due: int = 0
    since: int = 0  # actions that were executed since the last request
    # those that are there and have actions left, oldest first
    chunks: list[_Chunk] = field(default_factory=list)
    coming: _Chunk | None = None
    delays: deque[int] = field(default_factory=lambda: deque(maxlen=_REMEMBERED))
    counts: list[int] = field(default_factory=lambda: [0, 0, 0])  # requests, answers used, steps waited

    @property
    def asks(self) -> bool:
        """Whether this step's observation is sent to the policy."""
        return self.coming is None and (not self.chunks or self.since >= self.every)

    @property
    def unfinished(self) -> tuple[np.ndarray, int]:
        """What is left of the last chunk, and how many of these actions are probably executed before the next."""
        left = self.chunks[-1].left if self.chunks else np.zeros((0, len(self.still)))
        return left, max(self.delays, default=0)

    def answer(self, actions: np.ndarray) -> None:
        """Receive the answer to this step's observation, which cannot be used yet."""
        self.coming, self.since = _Chunk(actions), 0
        self.delays.append(next(self.latencies))
        self.due = self.now + self.delays[-1]
        self.counts[0] += 1
        self._arrive()

    def step(self) -> np.ndarray:
        """Return the action of this step, and go on to the next."""
        may_act = self.clock.wait == "rest" or self.coming is None
        if may_act and self.chunks:
            action = self.chunks[0].left[0]
            if len(self.chunks) > 1:
                weights = [math.exp(-self.clock.m * i) for i in range(len(self.chunks))]
                action = np.average([one.left[0] for one in self.chunks], axis=0, weights=weights)
            for one in self.chunks:
                self.counts[1] += not one.is_used
                one.is_used = True
            for one in (*self.chunks, *([self.coming] if self.coming else [])):
                one.at += 1
            self.since += 1
        else:
            action = self.still
            self.counts[2] += 1
        keeps = self.clock.wait == "repeat" or not self.relative
        self.still = action if keeps else np.append(np.zeros(len(action) - 1), action[-1])
        self.now += 1
        self._arrive()
        return action

    def _arrive(self) -> None:
        if self.coming and self.now >= self.due:
            self.chunks = [*(self.chunks if self.clock.merge == "ensemble" else []), self.coming]
            self.coming = None
        self.chunks = [one for one in self.chunks if len(one.left)]


class ClockedActor:
    """Executes the chunks of a policy; on a clock, each episode goes on while its next chunk is computed.

    Without latency an episode waits for nothing: it asks, executes, and asks again.

    Args:
        planner: The policy.
        clock: The clock; None for none, which is one without latency.
        seeds: Words of each episode, on which its latencies depend; see `Latency.draws`.
        hz: Control steps per second.
        still: Action of a robot that waits and has not acted; by default zeros. Of absolute actions its gripper, with
            the pose at the start, where the simulations are watched.
        relative: Whether actions are relative to the present pose.
    """

    def __init__(
        self,
        planner: Planner,
        clock: Clock | None = None,
        seeds: Sequence[Sequence[int]] = (),
        *,
        hz: int = CONTROL_HZ,
        still: Sequence[float] | None = None,
        relative: bool = True,
    ):
        self.action_dim, self.views = planner.action_dim, planner.views
        self._planner, self._clock, self._seeds = planner, clock, seeds
        if isinstance(planner, Hears):  # others are refused where an event changes the goal
            self.hear = planner.hear
        self._hz, self._relative = hz, relative
        self._still = np.zeros(self.action_dim) if still is None else np.asarray(still, float)
        self._episodes: list[_Episode] = []
        self._env: Any = None
        self._running: list[int] = []

    @property
    def _asking(self) -> list[int]:
        return [i for i in self._running if self._episodes[i].asks]

    @property
    def sees_next(self) -> bool:
        """Whether the next observation is given to the policy; the others need no images."""
        if self._planner.observes != "asked":
            return self._planner.observes == "always"
        return bool(self._asking)

    @property
    def timing(self) -> list[tuple[int, ...]]:
        """Requests, answers that were used and steps waited of each episode; none without a clock."""
        return [] if self._clock is None else [tuple(one.counts) for one in self._episodes]

    def watch(self, env: Any) -> None:
        """Hand on the simulations; see `lifelong.evaluation.actors.WatchesWorld`."""
        self._env = env
        if isinstance(self._planner, WatchesWorld):
            self._planner.watch(env)

    def reset(self, num_envs: int) -> None:
        """Reset the policy and begin at time 0; see `lifelong.evaluation.actors.Actor`."""
        self._planner.reset(num_envs)
        clock = self._clock or Clock()
        every = clock.every or (1 if clock.merge == "ensemble" else self._planner.replan) or math.inf
        self._episodes = [
            _Episode(clock, clock.latency.draws(self._hz, seed), self._still, self._relative, every)
            for seed in self._seeds or [()] * num_envs
        ]
        self._running = list(range(num_envs))

    def note(self, over: np.ndarray, success: np.ndarray) -> None:
        """Take note of which episodes are over; see `lifelong.evaluation.actors.TakesNote`."""
        self._running = np.flatnonzero(~over).tolist()
        if isinstance(self._planner, TakesNote):
            self._planner.note(over, success)

    def act(self, obs: Obs) -> np.ndarray:
        """Return (B, A) float64 actions, zeros for episodes that are over; see `lifelong.evaluation.actors.Actor`.

        Raises:
            ConfigError: The answers cannot be merged as the clock says.
        """
        rows = self._asking
        if rows or self._planner.observes == "always":
            rtc = self._clock is not None and self._clock.merge == "rtc"
            more = {"before": {i: self._episodes[i].unfinished for i in rows}} if rtc else {}
            for i, chunk in zip(rows, self._planner.plan(obs, rows, **more), strict=True):
                self._episodes[i].clock.check(len(chunk), rtc)
                self._episodes[i].answer(chunk)
        actions = np.zeros((len(self._episodes), self.action_dim))
        for i in self._running:
            if not (self._relative or self._episodes[i].now or self._env is None):  # the pose is held
                arm = self._env.views[i]
                from libero_env.geometry import rotation_between  # with MuJoCo

                pose = (arm.eef_pos, rotation_between(np.eye(3), arm.eef_mat))
                self._episodes[i].still = np.concatenate([*pose, self._still[-1:]])
            actions[i] = self._episodes[i].step()
        return actions


def _number(text: str, where: str) -> float:
    """Return a number of a text that is finite and not negative."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 <= value <= LONGEST:
        raise ConfigError(f"{where}: {shown(text)} is not a number from 0 to {LONGEST:g}")
    return value
