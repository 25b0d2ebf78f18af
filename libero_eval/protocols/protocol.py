"""Protocols: everything that decides what a policy sees, and how its episodes are run and counted.

The dataclasses are the sections of a protocol's file, see `libero_eval.protocols.files`. A value of null means that the
source of the protocol does not state it: it is never guessed, and a protocol is run only when all that a run needs is
stated.
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, is_dataclass, replace
from operator import attrgetter
from typing import Any

from libero_env.tasks import Task
from libero_env.text import plain, shown, suggest
from libero_env.validation import validate
from libero_eval.protocols.sections import (
    MAX_SEED,
    Actions,
    Counting,
    Episodes,
    Language,
    Pixels,
    Proprioception,
    Sampling,
    Simulation,
)
from lifelong.errors import ProtocolError, ProtocolMismatchError

CHANGED = ", changed"  # end of the title of a protocol that is not run as it is


@dataclass(frozen=True)
class EvalProtocol:
    """A protocol; `EvalProtocol.read` checks the values.

    Attributes:
        name: Name, that of its file.
        title: What it is, in one line.
        world: What is simulated.
        episode: How an episode runs and ends.
        pixels: Images.
        proprioception: The vector of the robot's state.
        language: The instruction.
        action: What a policy's answers mean.
        sampling: Chance and arithmetic of the policy.
        counting: What the reported number is a mean of.
        sources: Section or field, such as `world.env_seed` -> where its values stand.
        changes: Field that an evaluation changed -> the value that the protocol of this name has, as plain data.
    """

    name: str
    title: str
    world: Simulation
    episode: Episodes
    pixels: Pixels
    proprioception: Proprioception
    language: Language
    action: Actions
    sampling: Sampling
    counting: Counting
    sources: Mapping[str, str]
    changes: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        sections = (self.episode, self.pixels, self.action, self.proprioception, self.world, self.language)
        problems = [text for section in sections for text in section.problems()]
        if self.world.fixture_poses == "drawn" and "reset" not in self.episode.reset_order:
            problems.append(
                "world.fixture_poses are drawn, but episode.reset_order has no reset, which draws them"
            )
        valid = (*SECTIONS, *FIELDS)
        problems += [
            f"sources.{key} is not a key of a protocol.{suggest(key, valid)}"
            for key in self.sources
            if key not in valid
        ]
        problems += [
            f"changes.{key} is not a field of a protocol" for key in self.changes if key not in FIELDS
        ]
        if problems:
            raise ProtocolError("; ".join(problems))

    @classmethod
    def read(cls, values: Mapping[str, Any], where: str) -> "EvalProtocol":
        """Return the protocol of plain data, as of a file, or of `resolved`.

        Args:
            values: Section -> field -> value, with `name`, `title` and `sources`.
            where: File that messages name.

        Raises:
            ProtocolError: A field is missing or unknown, a value has the wrong type, or two contradict each other.
        """
        content = {"sources": {}} | {k: v for k, v in values.items() if k not in ("digest", "extends")}
        return validate(cls, content, source=where, error=ProtocolError)

    def flat(self) -> dict[str, Any]:
        """Return the values of all sections by dotted name, such as `world.env_seed`."""
        return {name: attrgetter(name)(self) for name in FIELDS}

    def resolved(self) -> dict[str, Any]:
        """Return the protocol as plain data, with a digest of everything that decides a result."""
        return {**asdict(self), "digest": self.digest}

    @property
    def digest(self) -> str:
        """Digest of all values, 16 hex digits; name, title, sources, changes and an empty clock are not part of it."""
        values = self.flat()
        if not self.action.clock:
            del values["action.clock"]
        return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()[:16]

    def steps(self, task: Task) -> int:
        """Return the maximum number of the policy's steps on a task.

        Raises:
            ProtocolError: None is stated for the task's suite.
        """
        horizon = self.episode.horizon
        if isinstance(horizon, Mapping):
            own_suite = None if task.suite.startswith("libero_") else max(horizon.values())
            horizon = horizon.get(task.origin.suite, own_suite)
        if horizon is None:
            raise ProtocolError(f"protocol {self.name} states no episode.horizon for {task.suite}")
        return horizon - self.settle_steps * self.episode.settle_counted

    @property
    def settle_steps(self) -> int:
        """Number of steps before the policy acts."""
        return self.episode.settle_steps or 0

    def words(self, task: Task) -> str:
        """Return the instruction of a task."""
        return task.problem.language if self.language.source == "bddl" else task.language

    def prompt(self, task: Task) -> str:
        """Return the text that a policy receives: the instruction in the template."""
        return self.language.template.replace("{instruction}", self.words(task))

    def env_seed(self, task: Task, init_state: int) -> int | None:
        """Return the seed that the environment gets for `init_state`; None where the poses are stored.

        Raises:
            ProtocolError: It is none that NumPy's generator takes.
        """
        world = self.world
        if world.fixture_poses == "stored" or world.env_seed is None or world.seeding == "once":
            return None if world.fixture_poses == "stored" else world.env_seed
        per_start, per_task = world.seed_per_start or 0, world.seed_per_task or 0
        seed = world.env_seed + per_start * init_state + per_task * task.index
        if not 0 <= seed <= MAX_SEED:
            raise ProtocolError(
                f"protocol {self.name}: world.env_seed {world.env_seed}, seed_per_start {per_start} and seed_per_task "
                f"{per_task} give {task.id} in initial state {init_state} the seed {seed}; valid: 0 to {MAX_SEED}"
            )
        return seed

    def require(self) -> None:
        """Check that the protocol states all that a run needs.

        Raises:
            ProtocolError: It does not; the message names the fields.
        """
        needed = ["episode.settle_steps", "episode.horizon", "pixels.render_size", "pixels.orientation"]
        needed += ["pixels.resize", "proprioception.source", "action.gripper"]
        needed += ["episode.settle_action"] if self.episode.settle_steps else []
        needed += ["world.env_seed", "world.seeding"] if self.world.fixture_poses == "drawn" else []
        values = self.flat()
        if missing := [name for name in needed if values[name] is None]:
            raise ProtocolError(
                f"protocol {self.name} cannot be run: its source does not state {', '.join(missing)}. Write a file "
                f"with `extends: {self.name}` that does, and give its path to --protocol"
            )

    def changed(self, values: Mapping[str, Any]) -> "EvalProtocol":
        """Return a protocol with other values of some fields, by dotted name such as `episode.horizon`.

        Title, sources and `changes` say so, against the values of the protocol of this name.

        Raises:
            ProtocolError: A value has the wrong type, or contradicts another.
        """
        content = asdict(self)
        for name, value in values.items():
            section, _, key = name.partition(".")
            content[section][key] = value
        protocol = self.read(content, f"protocol {self.name}")
        before, now = plain(self.flat()) | dict(self.changes), plain(protocol.flat())
        changes = {name: before[name] for name in FIELDS if now[name] != before[name]}
        own = {key: text for key, text in self.sources.items() if key not in {*self.changes, *changes}}
        marks = {name: f"changed; {self.name} has {shown(value)}" for name, value in changes.items()}
        title = self.title.removesuffix(CHANGED) + (CHANGED if changes else "")
        return replace(protocol, title=title, sources=own | marks, changes=changes)

    def check(self, announced: Mapping[str, Any]) -> None:
        """Compare the protocol with what a policy announces of itself.

        Args:
            announced: Dotted name of a field, such as `action.chunk`, or a section with its fields -> value. Other
                names are ignored, as are fields that the protocol does not state.

        Raises:
            ProtocolMismatchError: Values differ; the message names both of each.
        """
        expected = {name: value for name, value in self.flat().items() if value is not None}
        by_section = {k: v for k, v in announced.items() if k in SECTIONS and isinstance(v, Mapping)}
        stated = {**announced, **{f"{s}.{k}": v for s, part in by_section.items() for k, v in part.items()}}
        wrong = [
            f"{name}: protocol {self.name} has {value!r}, the policy {shown(stated[name])}"
            for name, value in expected.items()
            if stated.get(name) is not None and plain(stated[name]) != plain(value)
        ]
        if wrong:
            raise ProtocolMismatchError(
                "the policy was made for another protocol; nothing was run. " + "; ".join(wrong)
            )


SECTIONS: dict[str, Any] = {part.name: part.type for part in fields(EvalProtocol) if is_dataclass(part.type)}
FIELDS = tuple(f"{section}.{one.name}" for section, kind in SECTIONS.items() for one in fields(kind))
