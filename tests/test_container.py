"""What the Dockerfile names is there; `make lint` runs its linter, and experiments/container its steps."""

import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]
TEXT = re.sub(r"\\\n", " ", (ROOT / "Dockerfile").read_text())


def test_extras_of_the_image_are_extras_of_the_package() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    (extras,) = re.findall(r"^ARG EXTRAS=(\S+)", TEXT, re.MULTILINE)
    assert set(extras.split(",")) <= set(project["optional-dependencies"])
    (command,) = re.findall(r'^ENTRYPOINT \["(\w+)"\]', TEXT, re.MULTILINE)
    assert command in project["scripts"]


def test_files_that_the_image_copies_are_in_the_checkout() -> None:
    sources = [word for words in re.findall(r"^COPY (.+)", TEXT, re.MULTILINE) for word in words.split()[:-1]]
    assert len(sources) > 5 and not [source for source in sources if not (ROOT / source).exists()]
    ignored = (ROOT / ".dockerignore").read_text().split()
    assert not {Path(source).parts[0] for source in sources if source != "."} & set(ignored)


def test_the_image_does_not_run_as_root() -> None:
    users = re.findall(r"^USER (\d+)", TEXT, re.MULTILINE)
    assert users and int(users[-1]) > 0
