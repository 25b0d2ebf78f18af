"""Run the steps of the Dockerfile where there is no Docker: in a clean Debian, with chroot. Run it as root.

    apt-get install debootstrap
    python experiments/container/build.py --root /tmp/image
    python experiments/container/build.py --root /tmp/image --run train preset=smoke    # docker run IMAGE train ...

debootstrap's bookworm with its Python 3.11 stands in for the image that the Dockerfile begins with. The build context
is what git knows. `--share` shows a folder of this machine in the image while it is built, and `--env` adds variables,
such as those that tell pip where packages are.
"""

import argparse
import os
import re
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

ROOT = Path(__file__).parents[2]
SUITE = "bookworm"
BASE_PACKAGES = "python3,python3-venv,ca-certificates"


def instructions(dockerfile: Path) -> Iterator[tuple[str, str]]:
    """Yield the instructions of a Dockerfile, continued lines joined, without comments."""
    lines = [line for line in dockerfile.read_text().splitlines() if not line.lstrip().startswith("#")]
    for line in re.sub(r"\\\n", " ", "\n".join(lines)).splitlines():
        if line.strip():
            name, _, rest = line.strip().partition(" ")
            yield name.upper(), rest.strip()


class Image:
    """A folder with a Debian in which steps are run.

    Args:
        root: The folder.
        extra: Variables that all steps have, and the image has not.
    """

    def __init__(self, root: Path, extra: dict[str, str]):
        self.root, self.extra = root, extra
        self.arguments: dict[str, str] = {}
        self.environment = {"PATH": "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"}
        self.user, self.folder = "0", "/"
        self.words: dict[str, list[str]] = {}

    def step(self, name: str, rest: str) -> None:
        """Run an instruction.

        Raises:
            SystemExit: It is none that is known here, or it failed.
        """
        if name == "FROM":
            return
        if name == "ARG":
            key, _, default = rest.partition("=")
            self.arguments.setdefault(key, default)
        elif name == "ENV":
            for word in shlex.split(rest):
                key, _, value = word.partition("=")
                self.environment[key] = re.sub(r"\$(\w+)", lambda m: self.environment.get(m[1], ""), value)
        elif name == "WORKDIR":
            self.folder = rest
            inside(self.root, rest).mkdir(parents=True, exist_ok=True)
        elif name == "USER":
            self.user = rest
        elif name == "COPY":
            *sources, target = rest.split()
            self.copy(sources, os.path.join(self.folder, target))
        elif name in ("ENTRYPOINT", "CMD"):
            self.words[name] = [str(word) for word in re.findall(r'"([^"]*)"', rest)]
        elif name == "RUN":
            if status := self.run(["sh", "-c", rest], self.arguments | self.extra):
                sys.exit(f"RUN {rest}\nended with status {status}")
        else:
            sys.exit(f"{name}: this script does not know the instruction")

    def copy(self, sources: Sequence[str], target: str) -> None:
        """Copy tracked files and folders of the checkout."""
        for source in sources:
            listed = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard", source]
            files = subprocess.run(listed, cwd=ROOT, check=True, capture_output=True, text=True).stdout
            base = ROOT / source if (ROOT / source).is_dir() else (ROOT / source).parent
            for file in filter(None, files.split("\0")):
                there = inside(self.root, target) / (ROOT / file).relative_to(base)
                there.parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(ROOT / file, there)

    def run(self, command: Sequence[str], extra: dict[str, str]) -> int:
        """Run a command in the image as its user, and return its exit status."""
        variables = [f"{key}={value}" for key, value in (self.environment | extra).items()]
        script = f"cd {shlex.quote(self.folder)} && exec {shlex.join(command)}"
        chroot = ["chroot", f"--userspec={self.user}:{self.user}", str(self.root)]
        return subprocess.run([*chroot, "env", "-i", *variables, "sh", "-c", script], check=False).returncode


def inside(root: Path, path: str) -> Path:
    """Return where a path of the image lies here."""
    return root / path.lstrip("/")


@contextmanager
def mounted(source: str, target: Path, *options: str) -> Iterator[None]:
    """Mount within the context."""
    target.mkdir(parents=True, exist_ok=True)
    subprocess.run(["mount", *options, source, str(target)], check=True)
    try:
        yield
    finally:
        subprocess.run(["umount", str(target)], check=True)


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--root", type=Path, required=True, help="folder of the image; it must not exist yet")
    parser.add_argument("--mirror", default="http://deb.debian.org/debian")
    parser.add_argument("--share", nargs="+", default=[], metavar="DIR")
    parser.add_argument("--env", nargs="+", default=[], metavar="KEY=VALUE")
    parser.add_argument("--arg", nargs="+", default=[], metavar="KEY=VALUE", help="as docker's --build-arg")
    parser.add_argument("--run", nargs=argparse.REMAINDER, help="run the image instead of building it")
    args = parser.parse_args()
    image = Image(args.root.resolve(), dict(word.split("=", 1) for word in args.env))
    image.arguments = dict(word.split("=", 1) for word in args.arg)
    steps = list(instructions(ROOT / "Dockerfile"))
    if args.run is None:
        base = ["debootstrap", "--variant=minbase", f"--include={BASE_PACKAGES}", SUITE]
        subprocess.run([*base, str(image.root), args.mirror], check=True)
    with ExitStack() as stack:
        stack.enter_context(mounted("proc", image.root / "proc", "-t", "proc"))
        stack.enter_context(mounted("/dev", image.root / "dev", "--bind"))
        stack.enter_context(mounted("/dev/shm", image.root / "dev" / "shm", "--bind"))
        if args.run is not None:
            for name, rest in steps:
                if name not in ("RUN", "COPY"):
                    image.step(name, rest)
            return image.run([*image.words["ENTRYPOINT"], *(args.run or image.words["CMD"])], {})
        for folder in args.share:
            stack.enter_context(mounted(folder, inside(image.root, folder), "--bind"))
        for name, rest in steps:
            began = time.monotonic()
            print(f"=== {name} {rest[:100]}", flush=True)
            image.step(name, rest)
            if name in ("RUN", "COPY"):
                print(f"--- {time.monotonic() - began:.0f} s", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
