"""From the words of a command line to the call of a function, by tyro; and the types of options that commands share.

The parameters of a command's function are its options, with their types, defaults and bounds; their help is its
docstring. A function whose only parameter is a dataclass has the fields of that as options. Some commands return an
`Answer`, which is printed as text or as JSON.
"""

import contextlib
import dataclasses
import functools
import inspect
import io
import re
import sys
import webbrowser
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, NoReturn, get_type_hints

import tyro
from pydantic import AfterValidator, Field, TypeAdapter, ValidationError
from tyro.conf import Positional, arg
from tyro.constructors import PrimitiveConstructorSpec

from libero_env.cli import ending
from libero_env.errors import InvalidInputError
from libero_env.text import suggest, to_json

__all__ = ["Positional", "arg"]

MAX_SIDE = 16384  # pixels; what OpenGL draws here, which may be less, libero_env.sim.render knows
MAX_PROCESSES = 1024  # also of threads
MAX_STEPS = 1_000_000  # of an episode; 14 hours
MAX_SEED = 2**63 - 1  # what HDF5 and JSON readers keep

Natural = Annotated[int, Field(ge=0)]
Positive = Annotated[int, Field(ge=1)]
Seed = Annotated[int, Field(ge=0, le=MAX_SEED)]
Processes = Annotated[int, Field(ge=1, le=MAX_PROCESSES)]
ProcessesOrAll = Annotated[int, Field(ge=0, le=MAX_PROCESSES)]  # 0: one for each core
Horizon = Annotated[int, Field(ge=1, le=MAX_STEPS)]
Side = Annotated[int, Field(ge=1, le=MAX_SIDE)]
Share = Annotated[float, Field(ge=0, le=1)]
Probability = Annotated[float, Field(gt=0, lt=1)]
Seconds = Annotated[float, Field(gt=0, lt=1e6)]
Device = Annotated[str, Field(pattern=r"^(auto|cpu|mps|xpu|cuda(:\d{1,3})?)$")]


def _check_path(path: Path) -> Path:
    if not str(path).strip():
        raise ValueError("a path is needed, not an empty text; this folder is .")
    return path


def _check_task(name: str) -> str:
    if not name.endswith((".bddl", ".yaml", ".yml")):  # which are read by what asks for them
        from libero_env.tasks import find_tasks

        find_tasks([name])
    return name


def _read_size(words: list[str]) -> tuple[int, int]:
    sides = words[0].split("x")
    if not all(side.isdecimal() for side in sides) or len(sides) > 2:
        raise ValueError(f"{words[0]} is neither N nor HEIGHTxWIDTH")
    return int(sides[0]), int(sides[-1])


FilePath = Annotated[Path, AfterValidator(_check_path)]
TaskName = Annotated[str, AfterValidator(_check_task)]  # of a task, a suite or a task file
Size = Annotated[  # height, width
    tuple[Side, Side],
    PrimitiveConstructorSpec(
        nargs=1,
        metavar="N|HEIGHTxWIDTH",
        instance_from_str=_read_size,
        is_instance=lambda value: isinstance(value, tuple),
        str_from_instance=lambda size: ["x".join(map(str, size if size[0] != size[1] else size[:1]))],
    ),
]
Segmentation = Literal["instance", "class", "element"]


def modalities(*, depth: bool, segmentation: str | None) -> tuple[str, ...]:
    """Return the kinds of image that the options ask for, as `RenderConfig` names them."""
    return (
        "rgb",
        *(("depth",) if depth else ()),
        *((f"segmentation_{segmentation}",) if segmentation else ()),
    )


def parse(
    function: Callable[..., Any], words: Sequence[str], prog: str, flags: Sequence[str] = ()
) -> Callable[[], Any]:
    """Read words as arguments of a function.

    Args:
        function: Function of a command.
        words: Words of the command line after the command's name.
        prog: The command, such as `libero demos generate`.
        flags: Which of `libero_env.cli.options.FLAGS` it has, in addition to its own options.

    Returns:
        The call, to be made without arguments. After `--help`, or after an error, the process ends.
    """
    target = options_of(function)
    captured = capture(target, flags)
    told = io.StringIO()
    try:
        with contextlib.redirect_stderr(told):
            arguments = tyro.cli(captured, prog=prog, args=list(words), config=CONFIG)
    except SystemExit as ended:
        if not ended.code:
            raise
        with contextlib.redirect_stdout(io.StringIO()) as text, contextlib.suppress(SystemExit):
            tyro.cli(captured, args=["--help"], config=CONFIG)
        known = [*options_in(text.getvalue()), *ending.EVERYWHERE]
        names = [word.partition("=")[0].replace("_", "-") for word in words if word.startswith("--")]
        if unknown := [name for name in names if name not in known]:
            _fail(f"unknown option {unknown[0]}.{suggest(unknown[0], known)}", prog)
        print(told.getvalue(), end="", file=sys.stderr)
        raise
    chosen = [flag for flag in flags if arguments.pop(flag)]
    values = _checked(target, arguments, prog)
    if target is function:
        call = functools.partial(function, **values)
    else:
        call = functools.partial(function, target(**values))
    return functools.partial(tell, call, chosen) if flags else call


def options_of(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return what holds the options of a command: its function, or the dataclass that is its only parameter."""
    hints = [hint for name, hint in get_type_hints(function).items() if name != "return"]
    return hints[0] if len(hints) == 1 and dataclasses.is_dataclass(hints[0]) else function  # type: ignore[return-value]


CONFIG = (
    tyro.conf.FlagCreatePairsOff,
    tyro.conf.DisallowNone,
    tyro.conf.HelptextFromCommentsOff,
    tyro.conf.PositionalMetavarFromFieldName,
)


def capture(target: Callable[..., Any], flags: Sequence[str] = ()) -> Callable[..., dict[str, Any]]:
    """Return a function with the options of another, and with flags, that returns its arguments, for tyro."""

    def captured(**arguments: Any) -> dict[str, Any]:
        return arguments

    hints = get_type_hints(target, include_extras=True)
    fields = dataclasses.fields(target) if dataclasses.is_dataclass(target) else ()
    made = {f.name: f.default_factory() for f in fields if f.default_factory is not dataclasses.MISSING}
    parameter = functools.partial(inspect.Parameter, kind=inspect.Parameter.KEYWORD_ONLY)
    parameters = []
    for name, one in inspect.signature(target).parameters.items():
        default = made.get(name, one.default)
        parameters.append(parameter(name, default=default, annotation=_quiet(hints[name], default)))
    for flag in flags:
        kind = Annotated[bool, arg(help=FLAGS[flag], help_behavior_hint="")]
        parameters.append(parameter(flag, default=False, annotation=kind))
    captured.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    captured.__annotations__ = {p.name: p.annotation for p in parameters} | {"return": dict[str, Any]}
    captured.__doc__ = _documentation(target)
    return captured


def _documentation(target: Callable[..., Any]) -> str:
    """Return a docstring in which the attributes of a dataclass, those of its bases first, are arguments."""
    text = inspect.getdoc(target) or ""
    if not inspect.isclass(target):
        return text
    texts = [
        inspect.getdoc(kind) or "" for kind in reversed(target.__mro__) if dataclasses.is_dataclass(kind)
    ]
    blocks = [found[1] for one in texts if (found := re.search(r"(?m)^Attributes:\n((?:    .*\n?)+)", one))]
    return "\n".join([text.partition("Attributes:")[0] + "Args:", *(block.rstrip() for block in blocks)])


def _quiet(hint: Any, default: Any) -> Any:
    """Return a type whose help does not show a default that says nothing: None, False, nothing."""
    return (
        Annotated[hint, arg(help_behavior_hint="")]
        if default is None or default is False or default == ()
        else hint
    )


def _checked(target: Callable[..., Any], arguments: dict[str, Any], prog: str) -> dict[str, Any]:
    """Return the arguments within the bounds of their types; end with one line where one is not."""
    hints = get_type_hints(target, include_extras=True)
    values = {}
    for name, value in arguments.items():
        try:
            values[name] = TypeAdapter(hints[name]).validate_python(value)
        except ValidationError as error:
            first = error.errors(include_url=False)[0]
            if first["type"] == "too_short":
                _fail(f"{name} are missing: name at least {first['ctx']['min_length']}", prog)
            text = first["msg"].removeprefix("Value error, ")
            shown = "" if text.startswith(str(first["input"])) else f" {first['input']}"
            _fail(f"--{name.replace('_', '-')}{shown}: {text[0].lower()}{text[1:]}", prog)
    return values


def options_in(text: str) -> list[str]:
    """Return the options that a help names, in its order."""
    return list(dict.fromkeys(re.findall(r"(?<![\w-])--\w[\w-]*", text)))


def _fail(message: str, prog: str) -> NoReturn:
    print(f"error: {message}{'' if message.endswith('?') else ';'} see {prog} --help", file=sys.stderr)
    raise SystemExit(ending.MISTAKE)


FLAGS = {
    "json": "Print the answer as JSON, and nothing else on the standard output.",
    "open": "Show the page in the browser.",
}


@dataclass(frozen=True)
class Answer:
    """What a command found.

    Attributes:
        text: Lines for a terminal.
        data: The same as plain data.
        page: Page that was written; its path is printed after the text.
        status: Exit status.
    """

    text: str
    data: Any = None
    page: Path | None = None
    status: int = 0


def tell(command: Callable[[], Answer], flags: Collection[str]) -> int:
    """Run a command, and print its answer in the form that the flags ask for; return its exit status.

    What the command itself prints, such as rows of a table as they become known, is left out with `--json`.

    Raises:
        InvalidInputError: `--open` is given, and no page was written.
    """
    with contextlib.redirect_stdout(io.StringIO()) if "json" in flags else contextlib.nullcontext():
        answer = command()
    if "json" in flags:
        print(to_json(answer.data), end="")
    elif lines := [str(part) for part in (answer.text, answer.page) if part]:
        print("\n".join(lines))
    if "open" in flags:
        if answer.page is None:
            raise InvalidInputError(
                "--open shows a page, and none was written: name a folder for it with --out"
            )
        if not webbrowser.open(answer.page.resolve().as_uri()):
            print(f"note: no browser could be started; the page is {answer.page}", file=sys.stderr)
    return answer.status
