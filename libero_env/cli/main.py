"""The `libero` command: a table of commands, each a function that is imported when it is run.

`libero_env.cli.options` turns the words after a command's name into the arguments of its function.
"""

import importlib
import io
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from libero_env.cli import ending
from libero_env.errors import InvalidInputError, MissingPackageError, UnknownNameError


@dataclass(frozen=True)
class Command:
    """A command.

    Attributes:
        target: Its function, as `module:name`. It returns the exit status, or None for 0.
        help: What it does, for lists of commands.
        resume: How to go on after an interruption.
        reads_words: Whether the function takes the words as they are, as its only argument.
    """

    target: str
    help: str
    resume: str = ""
    reads_words: bool = False


_SAME = "the same command goes on"
COMMANDS: dict[str, dict[str, Command]] = {
    "Benchmark": {
        "tasks list": Command("libero_env.cli.tasks:list_tasks", "the tasks of one suite, or of all"),
        "tasks show": Command("libero_env.cli.tasks:show", "the BDDL of a task"),
        "tasks new": Command("libero_env.cli.tasks:new", "write a template of a user-defined task"),
        "tasks preview": Command(
            "libero_env.cli.tasks:preview", "pictures of a task's initial states, and a video of the expert"
        ),
        "tasks lint": Command(
            "libero_env.cli.tasks:lint", "report what is wrong or doubtful in tasks, and how to fix it"
        ),
        "tasks certify": Command(
            "libero_env.cli.tasks:certify_tasks",
            "measure the success of the expert; resumes where it was stopped",
            f"what is measured is kept; {_SAME}",
        ),
        "tasks init-states": Command(
            "libero_env.cli.tasks:init_states",
            "generate the 50 stored initial states of a suite or task file again",
        ),
        "objects add": Command(
            "libero_env.cli.objects:add", "convert an MJCF, OBJ, GLB, glTF, STL or PLY file into an object"
        ),
        "objects list": Command(
            "libero_env.cli.objects:list_objects",
            "list user-defined objects; with --all also those of the benchmark",
        ),
        "objects show": Command(
            "libero_env.cli.objects:show", "print the properties of an object: size, mass, regions, grasp"
        ),
        "objects preview": Command("libero_env.cli.objects:preview", "render an object from all sides"),
        "objects remove": Command("libero_env.cli.objects:remove", "remove user-defined objects"),
        "perturb list": Command(
            "libero_env.cli.perturb:list_kinds", "the kinds, with the unit and what severity 1 is"
        ),
        "perturb show": Command(
            "libero_env.cli.perturb:show",
            "a picture of a start without and with perturbations, side by side",
        ),
        "perturb certify": Command(
            "libero_env.cli.perturb:certify",
            "whether the expert solves what is sampled; samples again what it does not; resumes",
            f"what is measured is kept; {_SAME}",
        ),
    },
    "Demonstrations": {
        "demos generate": Command(
            "libero_env.cli.demos:generate",
            "record with the scripted expert; an interrupted recording can be resumed",
            f"what is recorded is kept; {_SAME}",
        ),
        "demos download": Command(
            "libero_env.cli.demos:download",
            "download the original's human demonstrations; an interrupted download can be resumed",
            f"what is downloaded is kept; {_SAME}",
        ),
        "demos info": Command("libero_env.cli.demos:info", "list the demonstration files in a folder"),
        "demos check": Command(
            "libero_env.cli.demos:check", "read files completely and report what is in them or broken"
        ),
        "demos replay": Command(
            "libero_env.cli.demos:replay_file", "replay demonstrations and report success and drift"
        ),
        "demos rerender": Command(
            "libero_env.cli.demos:rerender_file",
            "render the recorded states again, with other cameras or under perturbations",
        ),
        "demos filter": Command(
            "libero_env.cli.demos:filter_file", "write some of the demonstrations or steps of a file"
        ),
        "demos export": Command(
            "libero_env.cli.demos:export", "write files as one data set in another format"
        ),
        "teleop": Command(
            "libero_env.cli.teleop:teleop",
            "record demonstrations by hand: keyboard or 3D mouse",
            f"what is recorded is kept; {_SAME}",
        ),
    },
    "Learning": {
        "train": Command(
            "lifelong.cli.train:train",
            "learn a sequence of tasks and measure forgetting and transfer",
            reads_words=True,
        ),
        "tune": Command(
            "lifelong.cli.tune:tune", "choose a setting by what it keeps and what it lets learn", _SAME
        ),
        "sweep status": Command("lifelong.cli.sweep:status", "what runs, what failed, and what is left"),
        "report": Command(
            "lifelong.cli.report:report", "a page about one run, or about several side by side"
        ),
    },
    "Evaluation": {
        "eval": Command(
            "libero_eval.cli.evaluate:evaluate",
            "success of a policy on tasks; resumes where it was stopped",
        ),
        "robustness": Command(
            "libero_eval.cli.evaluate:robustness",
            "what perturbations do to a policy: success against severity, kind by kind",
        ),
        "compare": Command(
            "libero_eval.cli.compare:compare",
            "whether evaluated policies differ, start by start, and what chance alone makes",
        ),
        "power": Command("libero_eval.cli.compare:power", "how many episodes a difference in success needs"),
        "results export": Command(
            "libero_eval.cli.compare:export", "write a result as another tool's result file"
        ),
        "protocols list": Command("libero_eval.cli.protocols:list_protocols", "the protocols of the package"),
        "protocols show": Command(
            "libero_eval.cli.protocols:show", "all values of a protocol, and where they stand"
        ),
        "protocols diff": Command(
            "libero_eval.cli.protocols:diff", "the values in which two protocols differ"
        ),
        "serve": Command("libero_eval.cli.runs:serve", "serve a run's policy in openpi's WebSocket protocol"),
        "relearn": Command(
            "libero_eval.cli.runs:relearn",
            "steps until the forgotten tasks of a run are back",
            "what is measured is kept: the same command goes on with the rest",
        ),
        "saliency": Command(
            "libero_eval.cli.runs:saliency", "images of where a policy looks during a rollout"
        ),
        "check": Command(
            "libero_eval.cli.runs:check",
            "whether run directories are intact: checksums, records, what belongs together",
        ),
    },
    "Tools": {
        "doctor": Command(
            "libero_env.cli.doctor:doctor", "what this machine has and lacks, and how to fix it"
        ),
        "assets install": Command(
            "libero_env.cli.assets:install",
            "install the original's models (340 MB) with pip, the pinned version, verified",
        ),
        "assets download": Command(
            "libero_env.cli.assets:download",
            "download the same from the Hugging Face Hub (420 MB); resumes where it was stopped",
            f"what is downloaded is kept; {_SAME}",
        ),
        "assets info": Command(
            "libero_env.cli.assets:info", "print which models scenes are built from, and why"
        ),
        "assets check": Command(
            "libero_env.cli.assets:check", "check that all files of the models exist and are unchanged"
        ),
    },
}
ALL = {name: command for group in COMMANDS.values() for name, command in group.items()}
_LEARNING_PACKAGES = ("hydra", "jinja2", "matplotlib", "omegaconf", "safetensors", "torch")


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command.

    Args:
        argv: The words after `libero`. None: those of this process.

    Returns:
        The exit status, see `libero_env.cli.ending`.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # names of files need not be text
            stream.reconfigure(errors="backslashreplace")
    with ending.debugging(sys.argv[1:] if argv is None else argv) as words:
        try:
            status = _run(words)
            sys.stdout.flush()
        except (Exception, KeyboardInterrupt) as error:  # noqa: BLE001 - told by kind
            return ending.report(error)
    return status


def _run(words: list[str]) -> int:
    if any("\0" in word for word in words):  # from Python only: a system passes none
        raise InvalidInputError("a word of the command line has a null character, which no name can have")
    if "" in words:
        before = words[words.index("") - 1] if words[0] else "libero"
        raise InvalidInputError(
            f"the word after {before} is empty, as from a variable of the shell that is not set"
        )
    if (name := find(words)) is None:
        return _overview(words)
    with ending.interruptible():
        try:
            return bind(name, words[name.count(" ") + 1 :])() or 0
        except KeyboardInterrupt as error:
            if resume := ALL[name].resume:
                error.add_note(resume)
            raise


def find(words: Sequence[str]) -> str | None:
    """Return the name of the command with which a command line begins; None if there is none."""
    return next((name for count in (2, 1) if (name := " ".join(words[:count])) in ALL), None)


def bind(name: str, words: Sequence[str]) -> Callable[[], int | None]:
    """Read the words after a command's name, and return the call that they ask for.

    Raises:
        SystemExit: The words are not valid, or ask for help.
    """
    command = ALL[name]
    function = load(command)
    if command.reads_words:
        return partial(function, words)
    from libero_env.cli.options import parse

    return parse(function, words, f"libero {name}")


def load(command: Command) -> Callable[..., Any]:
    """Import the function of a command.

    Raises:
        MissingPackageError: A package that learning needs is not installed.
    """
    module, _, name = command.target.partition(":")
    try:
        return getattr(importlib.import_module(module), name)
    except ModuleNotFoundError as error:
        if error.name not in _LEARNING_PACKAGES:
            raise
        raise MissingPackageError(
            f"{error.name} is not installed", "pip install 'libero-lifelong[train]'"
        ) from None


def _overview(words: Sequence[str]) -> int:
    """Print the commands; return 0 where they were asked for, otherwise the status of a mistake."""
    topics = dict.fromkeys(name.partition(" ")[0] for name in ALL)
    topic = words[0] if words and words[0] in topics else ""
    asked = bool({"-h", "--help"} & set(words[:2]))
    given = [word for word in words[bool(topic) :] if not word.startswith("-")]
    if given and not asked:
        known = [n.partition(" ")[2] for n in ALL if n.startswith(f"{topic} ")] if topic else list(topics)
        raise UnknownNameError(f"command of libero {topic}".rstrip(), given[0], known)
    print("\n".join(_lines(topic)), file=sys.stdout if asked else sys.stderr)
    return 0 if asked else ending.MISTAKE


def _lines(topic: str) -> Iterator[str]:
    yield f"usage: libero {topic or 'COMMAND'}{' COMMAND' if topic else ''} ...\n"
    if not topic:
        yield "Lifelong robot learning on LIBERO.\n"
    for heading, group in COMMANDS.items():
        rows = {name: c for name, c in group.items() if not topic or name.partition(" ")[0] == topic}
        if rows:
            yield f"{heading}:" if not topic else "Commands:"
        for name, command in rows.items():
            yield f"  {name:18} {command.help}"
        if rows:
            yield ""
    yield "libero COMMAND --help explains one; --debug shows the traceback of every error"
