"""Count the files between a question and its answer: those on the call stack when a function is first reached.

    python experiments/structure/walks.py [NAME ...]

Each walk runs a real command in a process of its own and looks at the stack when its last function is first called.
"""

import argparse
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
PACKAGES = ("libero_cli", "libero_env", "lifelong", "libero_eval", "libero")

# argv of the command; then file (its end) and name of the function at which the stack is read
_RUN = """
import runpy, sys, threading
ends, names, through = {ends!r}, {names!r}, {through!r}
def look(frame, event, argument):
    code = frame.f_code
    if event == "call" and code.co_name in names and code.co_filename.endswith(tuple(ends)):
        above, files = frame, ""
        while above is not None:
            above, files = above.f_back, files + above.f_code.co_filename + " "
        if through not in files:
            return
        sys.setprofile(None)
        while frame is not None:
            print("STACK", frame.f_code.co_filename, frame.f_code.co_qualname, flush=True)
            frame = frame.f_back
        import os
        os._exit(0)
sys.setprofile(look)
threading.setprofile(look)
sys.argv = {argv!r}
runpy.run_path({script!r}, run_name="__main__")
"""


@dataclass(frozen=True)
class Walk:
    """A way through the code.

    Attributes:
        what: From where to where.
        words: Words of the command line.
        ends: Ends of the paths of files in which the last function may be.
        names: Names that it may have.
        script: What is run; "" for the `libero` command.
        through: A file that must be on the stack.
    """

    what: str
    words: tuple[str, ...]
    ends: tuple[str, ...]
    names: tuple[str, ...]
    script: str = ""
    through: str = ""


SMOKE = ("preset=smoke", "benchmark.tasks=[0,1]", "device=cpu")
WALKS = {
    "ewc": Walk(
        "`algo=ewc` -> its penalty",
        ("algo=ewc", *SMOKE, "algo.strength=1"),
        ("algorithms/ewc.py", "algorithms/anchor.py"),
        ("penalty",),
        "train.py",
    ),
    "ctrl": Walk(
        "an action -> the control law, which numba compiles",
        ("eval", "expert", "--suite", "libero_object/0", "--episodes", "1", "--horizon", "3"),
        ("sim/simulation.py", "sim/back_ends.py"),
        ("_substeps",),
        through="envs/batch.py",
    ),
    "state": Walk(
        "an initial state -> qpos",
        ("eval", "expert", "--suite", "libero_object/0", "--episodes", "1", "--horizon", "3"),
        ("sim/simulation.py", "sim/state.py", "sim/engine.py"),
        ("_reset", "reset"),
        through="envs/batch.py",
    ),
    "eval": Walk(
        "`libero eval` -> the record of an episode",
        ("eval", "expert", "--suite", "libero_object/0", "--episodes", "1", "--horizon", "3"),
        ("evaluation_file.py", "work/store.py", "work/work_folder.py"),
        ("write_unit", "publish", "add", "save"),
    ),
}


def stack(walk: Walk, checkout: Path) -> list[str]:
    """Return the frames of the packages, from the command to the function, as `file name`."""
    entry = "libero_cli/__main__.py"
    script = str(checkout / (walk.script or entry))
    code = _RUN.format(
        ends=walk.ends, names=walk.names, through=walk.through, argv=[script, *walk.words], script=script
    )
    with tempfile.TemporaryDirectory() as folder:
        done = subprocess.run(
            [sys.executable, "-c", code],
            cwd=folder,
            env={**os.environ, "PYTHONPATH": str(checkout)},
            capture_output=True,
            text=True,
            check=False,
        )
    frames = [line.split()[1:3] for line in done.stdout.splitlines() if line.startswith("STACK ")]
    if not frames:
        raise SystemExit(f"{walk.what}: the function was not reached\n{done.stderr[-2000:]}")
    own = [(file, name) for file, name in frames if any(f"/{p}/" in file for p in PACKAGES)]
    return [f"{Path(file).relative_to(checkout)} {name}" for file, name in reversed(own)]


def main() -> None:
    """Print the stack of each walk, and its number of files."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", help=", ".join(WALKS))
    parser.add_argument("--checkout", type=Path, default=ROOT)
    options = parser.parse_args()
    for name in options.names or WALKS:
        frames = stack(WALKS[name], options.checkout.resolve())
        files = dict.fromkeys(frame.split()[0] for frame in frames)
        print(f"{WALKS[name].what}: {len(files)} files, {len(frames)} calls")
        print("".join(f"  {frame}\n" for frame in frames))


if __name__ == "__main__":
    main()
