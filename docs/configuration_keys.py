"""The reference of the configuration, for `generate.py`: what `configs/` holds, with what the code says of each key."""

import inspect
import re
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import yaml

CONFIGS = Path(__file__).parents[1] / "configs"


def groups() -> dict[str, list[Path]]:
    """Return the files of each configuration group, in the order of configs/config.yaml; subgroups after theirs."""
    defaults = yaml.safe_load((CONFIGS / "config.yaml").read_text(encoding="utf-8"))["defaults"]
    keys = [next(iter(d)) for d in defaults if isinstance(d, dict)]
    names = dict.fromkeys(key.removeprefix("optional ").partition("@")[0] for key in keys)
    folders = [f for name in names for f in (CONFIGS / name, *sorted((CONFIGS / name).glob("*/")))]
    found = {f.relative_to(CONFIGS).as_posix(): sorted(f.glob("*.yaml")) for f in folders}
    return {name: files for name, files in found.items() if files}


def top_keys() -> str:
    """A table of the keys at the top."""
    from lifelong.settings import RunSettings

    comments = _comments(CONFIGS / "config.yaml")
    top = yaml.safe_load((CONFIGS / "config.yaml").read_text(encoding="utf-8"))
    rows = [
        f"| `{k}` | {_value(v)} | {_valid('lifelong.settings.RunSettings', k)} | {as_cell(comments.get(k, ''))} |"
        for k, v in top.items()
        if k in RunSettings.__dataclass_fields__
    ]
    return "\n".join(["| key | default | valid | what |", "|---|---|---|---|", *rows])


def configuration_reference() -> dict[str, str]:
    """A page for each group of keys, with a section for itself and one for each of its subgroups."""
    top = yaml.safe_load((CONFIGS / "config.yaml").read_text(encoding="utf-8"))
    chosen = {k: v for d in top["defaults"] if isinstance(d, dict) for k, v in d.items()}
    found: dict[str, str] = {}
    for name, files in groups().items():
        section = f"## {name}\n\n{_group(name, files, chosen.get(name))}\n\n"
        page = name.partition("/")[0]
        found[page] = found.get(page, "") + section
    return found


def _group(name: str, files: list[Path], default: str | None) -> str:
    listed = [f"- `{name}={f.stem}`{_default(name, f.stem, default)}{_about(f)}" for f in files]
    whole, targets = [], {}
    for file in files:
        values = yaml.safe_load(file.read_text(encoding="utf-8")) or {}
        if "_target_" not in values or any(isinstance(x, dict) for x in values.get("augmentations", ())):
            whole.append(f"`configs/{name}/{file.name}`\n\n```yaml\n{file.read_text(encoding='utf-8')}```")
        else:
            targets.setdefault(values["_target_"], []).append(file)
    tables = [_table(name, target, own) for target, own in targets.items()]
    return "\n\n".join(["\n".join(listed), *tables, *whole])


def _default(name: str, option: str, default: str | None) -> str:
    """Return what to add to an option: whether it is the default, and whether the default preset changes that."""
    chosen = yaml.safe_load((CONFIGS / "config.yaml").read_text(encoding="utf-8"))["defaults"]
    preset = next(d["preset"] for d in chosen if isinstance(d, dict) and "preset" in d)
    values = yaml.safe_load((CONFIGS / "preset" / f"{preset}.yaml").read_text(encoding="utf-8"))
    replaced = {
        k.removeprefix("override /"): v
        for d in values["defaults"]
        if isinstance(d, dict)
        for k, v in d.items()
    }
    if replaced.get(name, default) != default:
        by_preset = {default: "default before the preset", replaced[name]: f"default, by `preset={preset}`"}
        return f" ({by_preset[option]})" if option in by_preset else ""
    if option != default:
        return ""
    return (
        f" (default before the preset: `preset={preset}` sets some of its keys)"
        if name in values
        else " (default)"
    )


def leaves(node: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, str, str, Any]]:
    """Yield dotted key, target, key of the target and value of a node and of the components in it."""
    for key, value in node.items():
        if isinstance(value, dict):
            yield from leaves(value, f"{prefix}{key}.")
        elif key not in ("_target_", "_partial_", "defaults"):
            yield f"{prefix}{key}", node["_target_"], key, value


def _table(group: str, target: str, files: list[Path]) -> str:
    """Return the keys of the files that build one class, with their values in each file."""
    found = {f.stem: list(leaves(yaml.safe_load(f.read_text(encoding="utf-8")))) for f in files}
    values = {stem: {dotted: value for dotted, *_, value in own} for stem, own in found.items()}
    sources = {dotted: (built, key) for own in found.values() for dotted, built, key, _ in own}
    title = f"`{target}`"
    if not sources:
        return f"{title} has no keys."
    rows = [
        f"| `{group.replace('/', '.')}.{dotted}` | {' | '.join(_value(v.get(dotted)) for v in values.values())} "
        f"| {_valid(built, key)} | {as_cell(meaning(built, key, files))} |"
        for dotted, (built, key) in sources.items()
    ]
    head = "| key | " + " | ".join(f"`{stem}`" for stem in values) + " | valid | what |"
    return "\n".join([title, "", head, "|---" * (len(values) + 3) + "|", *rows])


def _valid(target: str, key: str) -> str:
    """The values that a key takes, by its annotation; upper ends beyond what any machine can do are left out."""
    from hydra.utils import get_object

    from libero_env.validation import parameters_of

    known = parameters_of(get_object(target))
    words = accepted(known.types[key]) if known and key in known.types else ""
    return as_cell(re.sub(r", (at most 1000000(000)?|below 9223372036854775808)\b", "", words))


def meaning(target: str, key: str, files: list[Path]) -> str:
    """What a key means: the docstring of what it builds, with the comment in the file where that lists choices."""
    comment = next((c for c in (_comments(f).get(key) for f in files) if c), "")
    text = _entry(target, key)
    if not text:
        return comment
    found = [leaf for f in files for leaf in leaves(yaml.safe_load(f.read_text(encoding="utf-8")))]
    values = [value for *_, name, value in found if name == key]
    choices = any(isinstance(v, str) and comment.startswith(f"{v},") and f"`{v}`" not in text for v in values)
    return f"{text.rstrip('.')} ({comment})" if choices else text


def accepted(kind: Any) -> str:
    """Return in words which values a type takes, such as `whole number, at least 1`; empty where that is not known."""
    from pydantic import TypeAdapter

    from libero_env.validation import is_plain

    if not is_plain(kind):
        return ""
    adapter = TypeAdapter(tuple[kind], config={"arbitrary_types_allowed": True})
    return _in_words(adapter.json_schema()["prefixItems"][0])


def _in_words(schema: Mapping[str, Any]) -> str:
    """Return a JSON schema in words."""
    if "anyOf" in schema:
        return " or ".join(dict.fromkeys(filter(None, map(_in_words, schema["anyOf"]))))
    if "enum" in schema or "const" in schema:
        return ", ".join(map(str, schema.get("enum", [schema.get("const")])))
    kind = str(schema.get("type", ""))
    if kind == "array":
        entries = _in_words(schema.get("items", {}))
        return f"list of {entries}" if entries else "list"
    words = {"integer": "whole number", "number": "number", "boolean": "true, false", "string": "text"}
    bounds = {
        "minimum": "at least",
        "exclusiveMinimum": "above",
        "maximum": "at most",
        "exclusiveMaximum": "below",
    }
    limits = []
    for key, text in bounds.items():
        if key in schema:
            bound = schema[key]
            limits.append(f"{text} {bound if isinstance(bound, int) else format(bound, 'g')}")
    return ", ".join(filter(None, [words.get(kind, kind), *limits]))


def _entry(target: str, key: str) -> str:
    """A docstring's entry; where it says "see `Name`", what that says of the key, whose name there may be shorter."""
    import lifelong.nn

    text = _documented(target).get(key, "")
    for name in re.findall(r"see `(\w+)`", text):
        for file in sorted(Path(lifelong.nn.__path__[0]).glob("*.py")):
            if f"class {name}(" not in file.read_text(encoding="utf-8"):
                continue
            other = f"lifelong.nn.{file.stem}.{name}"
            names = (key, key.rpartition("_")[0], key.partition("_")[2])
            found = next((_entry(other, n) for n in names if n != "proprio" and n in _documented(other)), "")
            if len(found) > 2:  # more than a letter of the legend
                return found
    return re.sub(r",? ?[Ss]ee `\w+`[^.;]*", "", text).strip(" .;,")


@cache
def _documented(target: str) -> dict[str, str]:
    """The entries under Args and Attributes in the docstrings of a class, by name."""
    from hydra.utils import get_object

    built = get_object(target)
    entries: dict[str, str] = {}
    for doc in (inspect.getdoc(built), inspect.getdoc(built.__init__)):
        for section in re.findall(r"^(?:Args|Attributes):\n((?:(?: {4}.*)?\n?)+)", doc or "", re.M):
            for entry in re.split(r"\n(?= {4}\S)", section):
                names, colon, text = entry.partition(":")
                if colon:
                    found = " ".join(text.split())
                    entries.update({n.strip(): found for n in names.split(",")})
    return entries


@cache
def _comments(file: Path) -> dict[str, str]:
    """The comment beside each key of a YAML file."""
    found = re.findall(r"^ *(\w+):[^#\n]*# *(.+)$", file.read_text(encoding="utf-8"), re.M)
    return dict(found)


def _about(file: Path) -> str:
    """The comment a file begins with."""
    lines = file.read_text(encoding="utf-8").splitlines()
    said = []
    for line in lines:
        if not line.startswith("#"):
            break
        said += [] if "@package" in line else [line.lstrip("# ")]
    return f": {as_cell(' '.join(said))}" if said else ""


def _value(value: Any) -> str:
    text = "null" if value is None else str(value).lower() if isinstance(value, bool) else str(value)
    return f"`{text}`"


def as_cell(text: str) -> str:
    """Return text for the cell of a table; outside of code, what stands in angle brackets is not HTML."""
    parts = " ".join(text.split()).replace("|", "\\|").split("`")
    return "`".join(part if i % 2 else part.replace("<", "&lt;") for i, part in enumerate(parts))
