"""Environments with other people's packages, which tests run ours against."""

import hashlib
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest
from filelock import FileLock


def counterpart(
    *requirements: str, no_deps: Sequence[str] = (), python: str = sys.executable, build: bool = True
) -> Path:
    """Return the Python of an environment with these distributions; it is made once and kept.

    Environments lie in `LIBERO_COUNTERPARTS`, by default `~/.cache/libero-lifelong/counterparts`. Where the packages
    cannot be had, or are not there and `build` is false, the test is skipped.
    """
    default = Path.home() / ".cache" / "libero-lifelong" / "counterparts"
    base = Path(os.environ.get("LIBERO_COUNTERPARTS", default))
    base.mkdir(parents=True, exist_ok=True)
    asked = subprocess.run([python, "--version"], capture_output=True, text=True)
    if asked.returncode:  # such as a shim of pyenv without a version behind it
        pytest.skip(f"{python} does not run: {asked.stderr.strip().splitlines()[-1:]}")
    wanted = "\n".join([asked.stdout.strip(), *requirements, "--no-deps", *no_deps])
    folder = base / hashlib.sha256(wanted.encode()).hexdigest()[:16]
    with FileLock(f"{folder}.lock"):
        if not (folder / "complete").is_file():
            if not build:
                pytest.skip(f"there is no environment with {requirements[0]}, and it is made on demand only")
            _run(python, "-m", "venv", "--clear", str(folder))
            pip = [str(folder / "bin" / "python"), "-m", "pip", "install", "--quiet"]
            if requirements:
                _run(*pip, *requirements)
            if no_deps:
                _run(*pip, "--no-deps", *no_deps)
            (folder / "complete").write_text(wanted + "\n")
    return folder / "bin" / "python"


def _run(*command: str) -> None:
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        last = (done.stderr or done.stdout).strip().splitlines()[-1:] or ["no output"]
        pytest.skip(f"{' '.join(command[:6])} ... failed: {last[0]}")
