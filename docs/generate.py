"""What the documentation takes from elsewhere while it is built: the first page, the references, and three tables.

MkDocs calls the functions `on_...` (`hooks` in mkdocs.yml). The references have a page for each group of commands and
of keys. A page asks for a part with a line such as `<!-- generated: commands -->`. Links to files outside this folder
become their paths, as the site has none of these.
"""

import contextlib
import inspect
import io
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any

import yaml
from markdown.extensions.toc import slugify
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

from libero_env.cli.main import COMMANDS, bind
from libero_env.objects import object_names
from libero_env.tasks import get_suite, suite_names

ROOT = Path(__file__).parents[1]
CONFIGS = ROOT / "configs"
OUTSIDE = re.compile(r"(?<!!)\[([^\]]+)\]\(\.\./([^)#]+)(?:#[^)]*)?\)")


def on_page_markdown(markdown: str, **kwargs: Any) -> str:
    """The text of a page with what is generated in its place."""
    for name, part in PARTS.items():
        marker = f"<!-- generated: {name} -->"
        if marker in markdown:
            markdown = markdown.replace(marker, part())
    return OUTSIDE.sub(_outside, markdown)


def _outside(link: re.Match[str]) -> str:
    text, path = link[1], link[2]
    if repository := os.environ.get("GITHUB_REPOSITORY"):
        notebook = path.endswith(".ipynb")
        server = "https://colab.research.google.com/github" if notebook else "https://github.com"
        text += " (in Colab)" if notebook else ""
        return f"[{text}]({server}/{repository}/blob/{os.environ['GITHUB_REF_NAME']}/{path})"
    return f"`{path}`" if text in path else f"{text} (`{path}`)"


def on_config(config: MkDocsConfig) -> None:
    """Put the pages of the references into the navigation, each below the page that lists them."""
    for section in (entry for entry in config.nav if "Reference" in entry):
        section["Reference"] = [
            {title: [page, *pages(page)]} if (title := REFERENCES.get(page)) else page
            for page in section["Reference"]
        ]


def on_files(files: Files, config: MkDocsConfig) -> None:
    """Add the pages that no file in this folder holds: the first one, which is README.md, and the references."""
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    first = re.sub(r"\]\((?!https?:|#)(docs/)?", lambda link: "](" if link[1] else "](../", readme)
    files.append(File.generated(config, "index.md", content=first))
    for reference in REFERENCES:
        for name, content in pages(reference).items():
            files.append(File.generated(config, name, content=content))


@cache
def pages(reference: str) -> dict[str, str]:
    """The pages of a reference: the name of each, and its text."""
    parts = command_reference() if reference == "commands.md" else configuration_reference()
    stem = reference.removesuffix(".md")
    return {
        f"{stem}-{title.lower().replace(' ', '-')}.md": f"# {title}\n\n{text}"
        for title, text in parts.items()
    }


def listed(reference: str) -> str:
    """A list of a reference's pages, each with links to its sections."""
    lines = []
    for name, text in pages(reference).items():
        title = text.splitlines()[0].lstrip("# ")
        sections = [f"[`{s}`]({name}#{slugify(s, '-')})" for s in re.findall("^## (.*)$", text, re.M)]
        lines.append(f"- [{title}]({name}): {', '.join(sections)}")
    return "\n".join(lines)


def command_reference() -> dict[str, str]:
    """A page for each heading of the list of commands, with a section for each command: what its help prints."""
    return {
        heading: "\n".join(f"## libero {name}\n\n```text\n{command_help(name)}```\n" for name in names)
        for heading, names in COMMANDS.items()
    }


def command_help(name: str) -> str:
    """What `libero NAME --help` prints, without the boxes round groups of options."""
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.suppress(SystemExit):
        bind(name, ["--help"])()
    lines = [line for line in printed.getvalue().splitlines() if not line.startswith("╰")]
    lines = [re.sub(r"^╭─ (.*?) ─*╮$", r"\1:", line) for line in lines]
    return "".join(line.removeprefix("│").removesuffix("│").rstrip() + "\n" for line in lines)


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
        f"| `{k}` | {_value(v)} | {_valid('lifelong.settings.RunSettings', k)} | {_cell(comments.get(k, ''))} |"
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
        f"| {_valid(built, key)} | {_cell(meaning(built, key, files))} |"
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
    return _cell(re.sub(r", (at most 1000000(000)?|below 9223372036854775808)\b", "", words))


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
    return f": {_cell(' '.join(said))}" if said else ""


def _value(value: Any) -> str:
    text = "null" if value is None else str(value).lower() if isinstance(value, bool) else str(value)
    return f"`{text}`"


def _cell(text: str) -> str:
    """Return text for the cell of a table; outside of code, what stands in angle brackets is not HTML."""
    parts = " ".join(text.split()).replace("|", "\\|").split("`")
    return "`".join(part if i % 2 else part.replace("<", "&lt;") for i, part in enumerate(parts))


PROTOCOL_ROWS = {
    "fixtures": ("world.fixture_poses", "world.env_seed", "world.seeding"),
    "waiting": ("episode.settle_steps",),
    "horizon": ("episode.horizon",),
    "success": ("episode.success",),
    "errors": ("episode.errors",),
    "images drawn": ("pixels.render_size", "pixels.orientation"),
    "resized": ("pixels.resize", "pixels.resize_size", "pixels.crop"),
    "state": ("proprioception.rotation", "proprioception.dtype"),
    "gripper": ("action.gripper",),
    "replan": ("action.replan",),
    "episodes of a task": ("counting.trials",),
    "arm": ("world.robot",),
}


def protocol_table() -> str:
    """A row for each protocol, with the values in which they differ most."""
    from libero_eval.cli.protocols import shown_values
    from libero_eval.protocols.files import load_protocol, protocol_names

    lines = [
        "| protocol |" + "".join(f" {title} |" for title in PROTOCOL_ROWS),
        "|---" * (len(PROTOCOL_ROWS) + 1) + "|",
    ]
    for name in protocol_names():
        values = shown_values(load_protocol(name))
        cells = []
        for keys in PROTOCOL_ROWS.values():
            told = dict.fromkeys(values[key] for key in keys)
            cells.append(
                ", ".join(t for t in told if t not in ("-", "1.0", "not stated")) or next(iter(told))
            )
        lines.append(f"| `{name}` |" + "".join(f" {cell} |" for cell in cells))
    return "\n".join(lines)


def perturbation_table() -> str:
    """A row for each kind of perturbation, in the order in which they are applied."""
    from libero_env.perturbations import KINDS

    rows = [f"| `{k.name}` | {k.layer} | {k.at_one:g} {k.unit} | {_cell(k.what)} |" for k in KINDS.values()]
    return "\n".join(["| kind | layer | severity 1 | what changes |", "|---|---|---|---|", *rows])


FAMILIES = {
    "groceries": "Groceries",
    "kitchenware": "Kitchenware",
    "articulated": "Objects with doors, drawers and knobs",
    "furniture": "Books, trays and shelves",
    "": "Others",
}


def gallery() -> str:
    """Pictures: objects by family, and tasks by suite. experiments/objects/gallery.py draws them."""
    parts = ["## Objects"]
    for family, names in families().items():
        found = [_picture(f"objects/{name}", name, f"<code>{name}</code>") for name in names]
        parts += [f"### {FAMILIES[family]}", _pictures(found)]
    parts += [
        "## Tasks",
        "The first initial state of each task as the camera `agentview` sees it, and the instruction. "
        "A task's id is its suite and number, such as `libero_goal/3`.",
    ]
    for suite in suite_names():
        found = [
            _picture(f"tasks/{suite}-{task.index}", task.id, f"{task.index}: {task.language}")
            for task in get_suite(suite).tasks
            if task.suite == suite
        ]
        parts += [f"### {suite}", _pictures(found)] if found else []
    return "\n\n".join(parts)


def families() -> dict[str, list[str]]:
    """Family -> its categories, sorted; those without parameters are of the family ''."""
    folder = ROOT / "libero_env" / "objects" / "builtin" / "parameters"
    owner = {
        name: family
        for family in filter(None, FAMILIES)
        for name in yaml.safe_load((folder / f"{family}.yaml").read_text(encoding="utf-8"))
    }
    names = object_names()
    return {family: [n for n in names if owner.get(n, "") == family] for family in FAMILIES}


def _picture(file: str, name: str, caption: str) -> str:
    path = f"images/gallery/{file}.jpg"
    return (
        f'<figure><img src="{path}" alt="{name}" loading="lazy"><figcaption>{caption}</figcaption></figure>'
    )


def _pictures(found: Sequence[str]) -> str:
    """As many beside each other as the page is wide; Markdown has nothing of that kind."""
    return "\n".join(['<div class="pictures">', *found, "</div>"])


REFERENCES = {"commands.md": "Commands", "configuration.md": "Configuration"}
PARTS = {
    "commands": partial(listed, "commands.md"),
    "configuration": partial(listed, "configuration.md"),
    "gallery": gallery,
    "keys": top_keys,
    "perturbations": perturbation_table,
    "protocols": protocol_table,
}
