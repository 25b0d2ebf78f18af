"""What the documentation takes from elsewhere while it is built: pages at the root, the references, and tables.

MkDocs calls the functions `on_...` (`hooks` in mkdocs.yml). The references have a page for each package, and each group
of commands and of keys. A page asks for a part with a line such as `<!-- generated: commands -->`. Links to files
outside this folder become their paths, as the site has none of these.
"""

import argparse
import base64
import contextlib
import hashlib
import importlib
import inspect
import io
import json
import os
import re
from collections.abc import Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any

import configuration_keys
import yaml
from configuration_keys import as_cell
from markdown.extensions.toc import slugify
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

from libero_cli.main import COMMANDS, bind
from libero_env import __version__
from libero_env.objects.builtin import builtin_names
from libero_env.tasks import get_suite, suite_names

ROOT = Path(__file__).parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
OUTSIDE = re.compile(r"(?<!!)\[([^\]]+)\]\(\.\./([^)#]+)(?:#[^)]*)?\)")


def on_page_markdown(markdown: str, **kwargs: Any) -> str:
    """The text of a page with what is generated in its place."""
    for name, part in PARTS.items():
        marker = f"<!-- generated: {name} -->"
        if marker in markdown:
            markdown = markdown.replace(marker, part())
    for name, page in ROOT_PAGES.items():
        markdown = markdown.replace(f"](../{name}", f"]({page}")
    return OUTSIDE.sub(_outside, markdown)


def _outside(link: re.Match[str]) -> str:
    text, path = link[1], link[2]
    if repository := os.environ.get("GITHUB_REPOSITORY"):
        notebook = path.endswith(".ipynb")
        server = "https://colab.research.google.com/github" if notebook else "https://github.com"
        text += " (in Colab)" if notebook else ""
        return f"[{text}]({server}/{repository}/blob/{os.environ['GITHUB_REF_NAME']}/{path})"
    path = path.removesuffix("/README.md")
    return f"`{path}`" if text in path else f"{text} (`{path}`)"


def on_config(config: MkDocsConfig) -> None:
    """Put the pages of the references into the navigation, the version into the head, and a link to the source."""
    below = {page: {title: [page, *pages(page)]} for page, title in REFERENCES.items()}
    below["walkthroughs.md"] = {"Walk-throughs": ["walkthroughs.md", *map(notebook_name, NOTEBOOKS)]}
    for section in config.nav:
        for title, entries in section.items() if isinstance(section, dict) else ():
            if isinstance(entries, list):
                section[title] = [below.get(entry, entry) for entry in entries]
    config.site_name += f" {__version__}"
    if repository := os.environ.get("GITHUB_REPOSITORY"):
        config.repo_url = f"https://github.com/{repository}"


def on_files(files: Files, config: MkDocsConfig) -> None:
    """Add the pages that no file in this folder holds: those of the files at the root, and the references."""
    for source, name in ROOT_PAGES.items():
        text = (ROOT / source).read_text(encoding="utf-8")
        own = re.sub(r"\]\((?!https?:|#)(docs/)?", lambda link: "](" if link[1] else "](../", text)
        files.append(File.generated(config, name, content=own))
    for reference in REFERENCES:
        for name, content in pages(reference).items():
            files.append(File.generated(config, name, content=content))
    for path in NOTEBOOKS:
        content, pictures = notebook_page(path)
        files.append(File.generated(config, notebook_name(path), content=content))
        for name, picture in pictures.items():
            files.append(File.generated(config, name, content=picture))


def notebook_name(path: Path) -> str:
    """Name of a notebook's page."""
    return f"notebook-{path.stem}.md"


def executed(path: Path) -> Path:
    """Where the copy of a notebook with its outputs is, until its text changes."""
    return (
        ROOT
        / "build"
        / "notebooks"
        / f"{path.stem}-{hashlib.sha256(path.read_bytes()).hexdigest()[:12]}.ipynb"
    )


def execute_notebooks() -> None:
    """Execute each notebook of which there is no copy with outputs; `make docs` does so before it builds the site."""
    import nbformat
    from nbclient import NotebookClient

    for path in NOTEBOOKS:
        if not (out := executed(path)).exists():
            print(f"executing {path.name}", flush=True)
            notebook = nbformat.read(path, as_version=4)
            folder = {"metadata": {"path": str(path.parent)}}
            NotebookClient(notebook, timeout=3600, kernel_name="python3", resources=folder).execute()
            out.parent.mkdir(parents=True, exist_ok=True)
            nbformat.write(notebook, out)


def notebook_page(path: Path) -> tuple[str, dict[str, bytes]]:
    """A notebook as Markdown, with outputs where it was executed, and its pictures by name."""
    done = executed(path)
    cells = json.loads((done if done.exists() else path).read_text(encoding="utf-8"))["cells"]
    parts, pictures = list[str](), dict[str, bytes]()
    for cell in cells:
        text = "".join(cell["source"]).replace("](../docs/", "](")
        parts.append(text if cell["cell_type"] == "markdown" else f"```python\n{text}\n```")
        for output in cell.get("outputs", ()):
            found = output.get("data", {})
            if "image/png" in found:
                name = f"images/notebooks/{path.stem}-{len(pictures)}.png"
                pictures[name] = base64.b64decode("".join(found["image/png"]))
                parts.append(f"![output]({name})")
            elif output.get("name") != "stderr":
                told = "".join(output.get("text") or found.get("text/plain", ()))
                parts.append(f"```text\n{told.rstrip()}\n```")
    title, _, rest = parts[0].partition("\n")
    link = f"[Open it](../notebooks/{path.name})" + ("" if done.exists() else "; not executed in this build")
    return "\n\n".join([title, f"{link}.", rest, *parts[1:]]), pictures


def notebook_list() -> str:
    """A list of the notebooks: the title of each, and its first paragraph."""
    lines = []
    for path in NOTEBOOKS:
        title, about, *_ = notebook_page(path)[0].split("\n\n")[0::2]
        lines.append(f"- [{title.lstrip('# ')}]({notebook_name(path)}): {' '.join(about.split())}")
    return "\n".join(lines)


@cache
def pages(reference: str) -> dict[str, str]:
    """The pages of a reference: the name of each, and its text."""
    stem = reference.removesuffix(".md")
    parts = {
        "commands": command_reference,
        "configuration": configuration_keys.configuration_reference,
        "python": python_reference,
    }[stem]()
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


def python_reference() -> dict[str, str]:
    """A page for each package, with a section for each public name: what its docstring says."""
    found = {}
    for package in ("libero_env", "lifelong", "libero_eval"):
        module, sections = importlib.import_module(package), []
        for name in module.__all__:
            one = getattr(module, name)
            file = one.__module__.replace(".", "/") + ".py"
            head = f"`from {package} import {name}`, defined in [{file}](../{file})"
            sections.append(f"## {name}\n\n{head}\n\n::: {one.__module__}.{one.__qualname__}\n")
        found[package] = f"{inspect.getdoc(module)}\n\n" + "\n".join(sections)
    return found


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
    from libero_eval.protocols.files import load_protocol, protocol_names
    from libero_eval.protocols.naming import shown_values

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

    rows = [f"| `{k.name}` | {k.layer} | {k.at_one:g} {k.unit} | {as_cell(k.what)} |" for k in KINDS.values()]
    return "\n".join(["| kind | layer | severity 1 | what changes |", "|---|---|---|---|", *rows])


def known_answers() -> str:
    """A table of published success with what agrees with it, and a section for each policy."""
    from libero_eval.judging.published import PLANNED, protocol_file, published

    known = published()
    suites = list(next(iter(known.values())).successes)
    heads = [suite.removeprefix("libero_") for suite in suites]
    lines = [f"| name | {' | '.join(heads)} | of | run here |", "|---" * (len(suites) + 3) + "|"]
    parts = []
    for name, one in known.items():
        cells = []
        for suite in suites:
            low, high = (100 * count / PLANNED for count in one.agreeing(suite))
            cells.append(f"{100 * one.successes[suite] / one.episodes:.1f}<br>[{low:.1f}, {high:.1f}]")
        run = f"[yes]({one.run_here})" if one.run_here else "no"
        lines.append(f"| [`{name}`](#{name}) | {' | '.join(cells)} | {one.episodes} | {run} |")
        there = f"MuJoCo {one.mujoco or 'not stated'}"
        sources = ", ".join(f"[{as_cell(what)}]({address})" for what, address in one.sources.items())
        project, _, serve = one.server.partition(": ")
        parts += [
            f"## {one.title} {{ #{name} }}",
            f"Weights: `{one.checkpoint}`. Served by {project}: `{serve}`. Published under "
            f"`{one.conditions}`, {there}. Sources: {sources}.",
        ]
        if text := protocol_file(one):
            parts.append(f"`{name}.yaml`:\n\n```yaml\n{text}```")
        parts.append(f"```sh\n{one.command(name)}\nlibero compare eval/{name} --published {name}\n```")
    return "\n\n".join(["\n".join(lines), *parts])


def not_offered() -> str:
    """A table of the original's names that are missing."""
    rows = yaml.safe_load((ROOT / "docs" / "not_offered.yaml").read_text(encoding="utf-8"))
    lines = [f"| {row['names']} | {row['instead']} |" for row in rows]
    return "\n".join(["| names | instead, or why |", "|---|---|", *lines])


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
    names = sorted(builtin_names())
    return {family: [n for n in names if owner.get(n, "") == family] for family in FAMILIES}


def _picture(file: str, name: str, caption: str) -> str:
    path = f"images/gallery/{file}.jpg"
    return (
        f'<figure><img src="{path}" alt="{name}" loading="lazy"><figcaption>{caption}</figcaption></figure>'
    )


def _pictures(found: Sequence[str]) -> str:
    """As many beside each other as the page is wide; Markdown has nothing of that kind."""
    return "\n".join(['<div class="pictures">', *found, "</div>"])


REFERENCES = {"python.md": "Python", "commands.md": "Commands", "configuration.md": "Configuration"}
ROOT_PAGES = {"README.md": "index.md", "CONTRIBUTING.md": "contributing.md", "CHANGELOG.md": "changes.md"}
PARTS = {
    "commands": partial(listed, "commands.md"),
    "configuration": partial(listed, "configuration.md"),
    "gallery": gallery,
    "keys": configuration_keys.top_keys,
    "known answers": known_answers,
    "not offered": not_offered,
    "notebooks": notebook_list,
    "perturbations": perturbation_table,
    "python": partial(listed, "python.md"),
    "protocols": protocol_table,
}

if __name__ == "__main__":
    argparse.ArgumentParser(description="Execute the notebooks that have changed.").parse_args()
    execute_notebooks()
