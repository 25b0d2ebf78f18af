"""Every public name says what it takes, gives and raises: each argument, shapes of arrays, units of numbers, errors."""

import ast
import dataclasses
import importlib
import inspect
import re
import textwrap
from collections.abc import Iterator
from typing import Any

import pytest

PACKAGES = ("libero_env", "lifelong", "libero_eval")
ARRAYS = re.compile(r"\b(ndarray|NDArray|Tensor|ArrayLike|Floats)\b")
SHAPE = re.compile(r"\((?:[\w+.]+, ?)+[\w+.]*\)|\bscalar\b|\bshape|\b(?:as|see|of) `")  # (B, 7), (..., 4)
UNITS = re.compile(
    r"\[(?:m|s|rad|Hz|control steps|m, rad)[^\]]*\]|\bin [\[(]0|\b(?:share|rate|probability|level|margin|factor|scale|"
    r"weight|strength|success|severity|reward|seconds|norm|quaternion|moments)\b",
    re.IGNORECASE,
)
OURS = re.compile(r"\b(?:lifelong|libero_env|libero_eval)\.|\bCallable\b")
OWN = ("AssertionError", "NotImplementedError", "StopIteration", "AttributeError")


def described(doc: str, section: str) -> dict[str, str]:
    """The entries of a section of a docstring, by name."""
    found = re.search(rf"^{section}:\n((?:(?: {{4}}.*)?\n?)+)", doc, re.M)
    entries = {}
    for entry in re.split(r"\n(?= {4}\S)", found[1] if found else ""):
        names, colon, text = entry.partition(":")
        if colon:
            entries.update({name.strip(" *`"): " ".join(text.split()) for name in names.split(",")})
    return entries


def members(one: Any) -> Iterator[tuple[str, Any]]:
    """The public functions that a class defines itself."""
    for name, value in vars(one).items():
        value = value.__func__ if isinstance(value, classmethod | staticmethod) else value
        value = value.fget if isinstance(value, property) else value
        own = inspect.isfunction(value) and value.__qualname__.startswith(one.__name__)
        if own and not name.startswith("_"):
            yield name, value


def callables() -> Iterator[Any]:
    for package in PACKAGES:
        module = importlib.import_module(package)
        for name in module.__all__:
            one = getattr(module, name)
            yield pytest.param(one, "", id=f"{package}.{name}")
            if inspect.isclass(one) and not issubclass(one, Exception):
                for method, function in members(one):
                    about = inspect.getdoc(one)
                    yield pytest.param(function, about, id=f"{package}.{name}.{method}")


def arguments(function: Any) -> list[str]:
    """The names in a function's own list of arguments, whatever signature it shows."""
    code = getattr(inspect.unwrap(function), "__code__", (lambda: None).__code__)
    names = code.co_varnames[: code.co_argcount + code.co_kwonlyargcount]
    return [name for name in names if name not in ("self", "cls", "__dataclass_self__")]


def raised(function: Any) -> set[str]:
    """Errors that a function's own lines raise."""
    tree = ast.parse(textwrap.dedent(inspect.getsource(function)))
    calls = [node.exc for node in ast.walk(tree) if isinstance(node, ast.Raise)]
    names = [call.func for call in calls if isinstance(call, ast.Call)]
    return {name.id for name in names if isinstance(name, ast.Name)} - {*OWN}


@pytest.mark.parametrize(("one", "of_class"), list(callables()))
def test_a_public_name_is_described(one, of_class):
    doc = inspect.getdoc(one) or ""
    assert re.match(r"[A-Z].*?\.(\s|$)", doc, re.S), "it begins with a sentence"
    if inspect.isclass(one) and issubclass(one, Exception):
        return
    function = one.__init__ if inspect.isclass(one) else one
    types = {n: str(function.__annotations__.get(n, "")) for n in arguments(function)}
    types = {n: t for n, t in types.items() if not OURS.search(t)}  # what a class is, the class says
    if inspect.isclass(one):
        bases = [inspect.getdoc(base) or "" for base in one.__mro__ if base.__module__.startswith(PACKAGES)]
        entries = {k: v for d in bases for s in ("Attributes", "Args") for k, v in described(d, s).items()}
    else:
        entries = {n: doc for n in types if re.search(rf"\b{n}\b|\b{n.rstrip('s')}", doc)}
        entries |= described(doc, "Args")
    returns = "" if inspect.isclass(one) else str(function.__annotations__.get("return"))
    missing = [name for name in types if not entries.get(name)]
    assert not missing, "each argument is described"
    assert not [n for n, t in types.items() if ARRAYS.search(t) and not SHAPE.search(entries[n])], "shapes"
    floats = [n for n, t in types.items() if re.search(r"\bfloat\b", t)]
    assert not [n for n in floats if not UNITS.search(entries[n])], "units"
    assert not ARRAYS.search(returns) or SHAPE.search(doc), "the shape of what is returned"
    if inspect.isfunction(function) and not dataclasses.is_dataclass(one):
        said = described(doc, "Raises") | described(of_class, "Raises")
        assert not raised(function) - {*said}, "errors"
