"""The `libero` command. Each subcommand is a small function that imports what it needs when it runs."""

import argparse
import io
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NoReturn

from libero_env.cli import arguments, assets, demos, ending, objects, perturb, tasks, teleop
from libero_env.cli.arguments import Subparsers
from libero_env.errors import InvalidInputError
from libero_eval.cli import check, compare, evaluate, protocols, relearn, robustness, saliency, serve
from lifelong.cli import sweep, tune
from lifelong.errors import ConfigError

RECORDS = "results.jsonl"  # in the directory of each run
TRAIN_HELP = """\
Learn a sequence of tasks, evaluate after each, and write a report. Overrides choose a file of a configuration
group (algo=ewc, benchmark=libero_goal, preset=paper) or set a key (train.lr=3e-4). A killed run resumes when the same
command is given again.

examples:
  libero train algo=ewc benchmark=libero_object
  libero train -m algo=sequential,er,ewc seed=1,2     a sweep, with one report that compares the runs
  libero train --config-dir my_configs algo=my_algo   files of your own beside the package's
  libero train --cfg job                              print the configuration, run nothing
  libero train --info searchpath                      where configuration files are
  torchrun --nproc-per-node 2 --no-python libero train   several processes or GPUs"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one subcommand.

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
    if words[:1] == ["train"] and not {"-h", "--help"} & set(words):
        return run_train(words[1:])  # Hydra reads the rest: options in any place, overrides
    args = build_parser().parse_args(words)
    with ending.interruptible():
        try:
            return args.run(args) or 0
        except KeyboardInterrupt as error:
            if hint := getattr(args, "go_on", ""):
                error.add_note(hint)
            raise


class _Parser(argparse.ArgumentParser):
    """A parser that tells an error in one line, and prints its help where a command is missing."""

    def __init__(self, **options: Any):
        super().__init__(**options)
        # read before the words come here: it may stand anywhere
        self.add_argument(ending.DEBUG, action="store_true", help="show the traceback of every error")

    def error(self, message: str) -> NoReturn:
        """Print what is wrong, or the commands there are, and exit."""
        if message.endswith((": COMMAND", ": ACTION")):
            self.print_help(sys.stderr)
            self.exit(ending.MISTAKE)
        self.exit(ending.MISTAKE, f"error: {' '.join(message.split())}; see {self.prog} --help\n")


def build_parser() -> argparse.ArgumentParser:
    """Return the parser with every subcommand; each stores its function as `run`."""
    parser = _Parser(prog="libero", description="Lifelong robot learning on LIBERO.")
    subparsers = parser.add_subparsers(required=True, metavar="COMMAND")
    for register in COMMANDS:
        register(subparsers)
    return parser


def register_train(subparsers: Subparsers) -> None:
    """Add `libero train`."""
    parser = subparsers.add_parser(
        "train",
        help="learn a sequence of tasks and measure forgetting and transfer",
        description=TRAIN_HELP,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        usage="libero train [-m] [--config-dir DIR] [--cfg job] [OVERRIDE ...]",
    )
    parser.add_argument("overrides", nargs="*", metavar="OVERRIDE", help="GROUP=FILE or KEY=VALUE")
    parser.add_argument("-m", "--multirun", action="store_true", help="run every combination of values")
    parser.add_argument("--config-dir", metavar="DIR", help="a folder of configuration files to be added")
    parser.add_argument("--cfg", metavar="WHAT", help="print the configuration (job, hydra, all)")
    parser.set_defaults(run=lambda args: run_train(args.overrides))


def run_train(words: Sequence[str]) -> int:
    """Train as the overrides ask."""
    try:
        from lifelong.launch import main as launch
    except ModuleNotFoundError as error:
        if error.name not in ("hydra", "jinja2", "matplotlib", "omegaconf", "safetensors", "torch"):
            raise
        print(f"error: {error.name} is not installed: pip install 'libero-lifelong[train]'", file=sys.stderr)
        return ending.MISTAKE
    return launch(words)


def register_doctor(subparsers: Subparsers) -> None:
    """Add `libero doctor`."""
    parser = subparsers.add_parser("doctor", help="what this machine has and lacks, and how to fix it")
    parser.add_argument("--gl", action="store_true", help="only draw a frame")
    parser.add_argument("--json", action="store_true", help="print the findings as JSON")
    parser.set_defaults(run=run_doctor)


def run_doctor(args: argparse.Namespace) -> int:
    """Print the findings; return 1 where something essential is broken."""
    import libero_env.cli.doctor as environment
    import lifelong.cli.doctor as learning

    findings = environment.examine(gl_only=args.gl)
    if not args.gl:
        findings += learning.examine()
    print(environment.findings_json(findings) if args.json else environment.render_findings(findings))
    return int(environment.is_broken(findings))


def register_report(subparsers: Subparsers) -> None:
    """Add `libero report RUN_DIR...`."""
    parser = subparsers.add_parser("report", help="a page about one run, or about several side by side")
    parser.add_argument(
        "run_dirs",
        nargs="+",
        type=arguments.path,
        metavar="RUN_DIR",
        help="such as runs/libero_object/ewc/...",
    )
    parser.add_argument(
        "--out",
        type=arguments.path,
        help="the page, or a folder for it (default: report.html in the run directory; for several, comparison/ here)",
    )
    parser.set_defaults(run=run_report)


def run_report(args: argparse.Namespace) -> None:
    """Write the page; print its path and, of several runs, which differ significantly."""
    from lifelong.report.page import comparison_text, shift_text, write_report

    for folder in args.run_dirs:
        _check_run(folder)
    page = write_report(args.run_dirs, args.out)
    print(page)
    for line in comparison_text(page) if len(args.run_dirs) > 1 else shift_text(args.run_dirs[0]):
        print(line)


def _check_run(folder: Path) -> None:
    """Check that a folder is not one of runs, at some level below `runs`.

    Raises:
        ConfigError: It is; the message names its runs.
    """
    if (folder / RECORDS).is_file():
        return
    for levels in ("*", "*/*", "*/*/*"):
        if count := len(list(folder.glob(f"{levels}/{RECORDS}"))):
            shown = folder / levels
            raise ConfigError(
                f"{folder} is no run: it holds {count}, in {shown}; write libero report {shown}"
            )


COMMANDS: tuple[Callable[[Subparsers], None], ...] = (
    register_train,
    sweep.register,
    tune.register,
    register_doctor,
    tasks.register,
    perturb.register,
    robustness.register,
    demos.register,
    assets.register,
    objects.register,
    teleop.register,
    evaluate.register,
    saliency.register,
    relearn.register,
    protocols.register,
    serve.register,
    compare.register,
    register_report,
    check.register,
)
