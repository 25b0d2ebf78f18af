"""The command `libero tune`: choose a setting by what it keeps and what it lets learn."""

import argparse
import itertools
import shlex
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from libero_env.cli import arguments
from libero_env.cli.arguments import Subparsers
from lifelong.errors import ConfigError

if TYPE_CHECKING:
    from libero_env.tasks import Task
    from lifelong.tuning.sweep import Candidate

DESCRIPTION = """\
Choose a setting without rollouts: short streams of tasks outside of the evaluated suites are learned with each value,
and errors on held-out demonstrations take the place of success. Prints the frontier of retention and plasticity, keeps
a picture and a JSON file, and names the value with the least error on all tasks at the end. A sweep that was stopped
goes on with the same command.

examples:
  libero tune algo=ewc                                     the values that the algorithm suggests
  libero tune algo=lwf algo.strength=0.1,0.3,1,3           these values
  libero tune algo=ewc policy/head=gmm_small               with another head
  libero tune algo=er train.lr=5e-4,1e-3,2e-3              any key of the configuration
  libero tune algo=ewc --write my_configs                  write the chosen value, for libero train
                                                           --config-dir my_configs algo=ewc tuned@algo=HEAD/ewc"""
SUITE, STEPS, HELD_OUT, BESIDE = "libero_90", 160, 0.25, ["er"]  # the defaults
MEASUREMENT = (
    "for each value, the geometric mean over the streams of the factor on the error that fine-tuning leaves on a task "
    "it has just learned"
)


def register(subparsers: Subparsers) -> None:
    """Add the command `libero tune`."""
    parser = subparsers.add_parser(
        "tune",
        help="choose a setting by what it keeps and what it lets learn",
        description=DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("overrides", nargs="+", metavar="OVERRIDE", help="as of `libero train`; KEY=V1,V2,... is swept")
    add("--suite", default=SUITE, help="suite of the streams' tasks (default: libero_90)")
    add(
        "--stream",
        action="append",
        metavar="TASKS",
        help="tasks of a stream in learning order, numbers or names, such as 61,62; give it once for each stream "
        "(default: five of libero_90, in one scene)",
    )
    add("--seeds", type=_numbers, default=(1,), help="seeds with which each stream is learned (default: 1)")
    add(
        "--steps",
        type=arguments.whole(1, 1_000_000),
        default=STEPS,
        help="optimiser steps a task (default: 160)",
    )
    add(
        "--held-out",
        type=arguments.number(0, 1, open_ends=True),
        default=HELD_OUT,
        help="share of the demonstrations that is measured on (default: 0.25)",
    )
    add(
        "--beside", nargs="*", default=BESIDE, metavar="ALGO", help="algorithms to compare with (default: er)"
    )
    add(
        "--out",
        type=arguments.path,
        default=Path("runs/tuning"),
        metavar="DIR",
        help="folder of table, picture and measurements (default: runs/tuning)",
    )
    add(
        "--config-dir", type=arguments.path, metavar="DIR", help="a folder of configuration files to be added"
    )
    add(
        "--write",
        type=arguments.path,
        metavar="DIR",
        help="folder of configuration files in which tuned/HEAD/ALGO.yaml gets the chosen value",
    )
    parser.set_defaults(run=run_tune, go_on="the same command goes on from there")


def _numbers(text: str) -> tuple[int, ...]:
    read = arguments.whole(0, arguments.MAX_SEED)
    return tuple(read(part) for part in text.split(","))


def run_tune(args: argparse.Namespace) -> None:
    """Measure all values and write table, picture, JSON file and the chosen value."""
    import torch

    from lifelong.composition import compose_run
    from lifelong.settings import Configuration, plain_data
    from lifelong.tuning.figure import draw_frontier
    from lifelong.tuning.frontier import render
    from lifelong.tuning.proxy import ProxySettings
    from lifelong.tuning.sweep import measure_frontier, write_frontier, write_tuned

    candidates, plain_words, default = _candidates(args.overrides, args.config_dir)
    without = [word for word in plain_words if not word.startswith(("algo", "tuned@algo"))]

    def other(algo: str) -> "Candidate":
        return _candidate(algo, {}, [*without, f"algo={algo}"], args.config_dir)

    config, choices = compose_run(plain_words, args.config_dir)
    plain = plain_data(config)
    checked = Configuration(plain)
    checked.check()
    if threads := checked.settings().threads:
        torch.set_num_threads(threads)
    beside = [other(algo) for algo in args.beside if algo != choices["algo"]]
    proxy = ProxySettings(_streams(args), args.seeds, args.steps, args.held_out)
    frontier = measure_frontier(candidates, beside, other("sequential"), proxy, args.out)

    algo, head = choices["algo"], choices.get("policy/head", choices["policy"])
    keys = ", ".join(candidates[0].settings)
    print(f"\n{keys} of {algo}: {MEASUREMENT}\n\n{render(frontier, default)}\n")
    best = frontier.chosen
    print("chosen: " + " ".join(f"{key}={value}" for key, value in best.settings.items()))
    if frontier.at_edge():
        print("the chosen value is the first or the last one: try values beyond it", file=sys.stderr)
    about = _about(args, proxy.streams, choices, plain)
    stem = args.out / f"{algo}-{head}-{'-'.join(key.rpartition('.')[2] for key in best.settings)}"
    write_frontier(frontier, stem.with_suffix(".json"), about)
    draw_frontier(frontier, f"{algo}: {keys}", stem)
    print(f"picture: {stem}.png")
    if args.write:
        path = args.write / "tuned" / head / f"{algo}.yaml"
        write_tuned(best, path, _comment(about, best.score.value))
        print(f"written: {path}")


def _candidates(
    words: Sequence[str], config_dir: Path | None
) -> tuple[list["Candidate"], list[str], str | None]:
    """Return a candidate for each combination of values, the words that are not swept, and the default's label."""
    from lifelong.composition import compose_run, swept
    from lifelong.settings import Configuration, plain_data

    lists = swept(words)
    rest = [word for word in words if word.partition("=")[0] not in lists]
    plain = plain_data(compose_run(rest, config_dir)[0])
    if not lists:
        tuned = Configuration(plain).build("algo").tuned
        if not tuned:
            raise ConfigError(
                "this algorithm suggests no values; name a key with several, such as algo.KEY=V1,V2 or "
                "train.lr=1e-3,2e-3"
            )
        key = next(iter(tuned))
        lists = {f"algo.{key}": [f"{value:g}" for value in tuned[key]]}
    values = [dict(zip(lists, chosen, strict=True)) for chosen in itertools.product(*lists.values())]
    candidates = [
        _candidate(
            _label(value.values()), value, [*rest, *(f"{k}={v}" for k, v in value.items())], config_dir
        )
        for value in values
    ]
    return candidates, rest, _label(str(_value_at(plain, key)) for key in lists)


def _candidate(
    label: str, values: dict[str, str], words: Sequence[str], config_dir: Path | None
) -> "Candidate":
    from lifelong.composition import compose_run
    from lifelong.settings import Configuration, plain_data
    from lifelong.tuning.sweep import Candidate

    config = plain_data(compose_run(words, config_dir)[0])
    Configuration(config).check()
    return Candidate(label, {key: _value_at(config, key.lstrip("+")) for key in values}, config)


def _label(values: Iterable[str]) -> str:
    """Return values as one label, numbers in their shortest form."""

    def shown(text: str) -> str:
        try:
            return f"{float(text):g}"
        except ValueError:
            return text

    return " ".join(map(shown, values))


def _value_at(config: Any, key: str) -> Any:
    """Return the value of a dotted key; None where there is none, as for the name of a group's file."""
    for name in key.split("."):
        config = config.get(name) if isinstance(config, dict) else None
    return config


def _streams(args: argparse.Namespace) -> "tuple[tuple[Task, ...], ...]":
    """Return the tasks of the streams.

    Raises:
        UnknownNameError: A suite or task does not exist.
    """
    from lifelong.settings import BenchmarkSettings
    from lifelong.tuning.proxy import STREAMS

    chosen = [text.split(",") for text in args.stream] if args.stream else STREAMS
    return tuple(
        BenchmarkSettings(args.suite, tasks=[int(t) if str(t).isdigit() else t for t in tasks]).sequence()
        for tasks in chosen
    )


def _about(
    args: argparse.Namespace,
    streams: "Sequence[Sequence[Task]]",
    choices: dict[str, str],
    plain: dict[str, Any],
) -> dict[str, Any]:
    """Return what a reader of the results needs to repeat them."""
    import importlib.metadata

    import torch

    from libero_env.demos.config import GENERATOR

    return {
        "command": shlex.join(["libero", "tune", *args.overrides, *_options(args)]),
        "preset": choices.get("preset"),
        "policy": choices["policy"],
        "head": choices.get("policy/head"),
        "streams": [[task.id for task in stream] for stream in streams],
        "seeds": list(args.seeds),
        "steps": args.steps,
        "batch_size": plain["train"].get("batch_size"),
        "held_out": args.held_out,
        "versions": {
            "libero-lifelong": importlib.metadata.version("libero-lifelong"),
            "torch": torch.__version__,
            "demonstrations": GENERATOR,
        },
    }


def _options(args: argparse.Namespace) -> list[str]:
    """Return the options that results depend on and that are not the default ones."""
    seeds = ",".join(map(str, args.seeds))
    options = {"--suite": args.suite, "--seeds": seeds, "--steps": str(args.steps)}
    options |= {"--held-out": f"{args.held_out:g}"}
    defaults = {"--suite": SUITE, "--seeds": "1", "--steps": str(STEPS), "--held-out": f"{HELD_OUT:g}"}
    chosen = [(name, value) for name, value in options.items() if value != defaults[name]]
    chosen += [("--stream", tasks) for tasks in args.stream or ()]
    beside = [] if args.beside == BESIDE else ["--beside", *args.beside]
    return [*(word for pair in chosen for word in pair), *beside]


def _comment(about: dict[str, Any], score: float) -> str:
    versions = ", ".join(f"{name} {version}" for name, version in about["versions"].items())
    return (
        f"Chosen by: {about['command']}\nWith preset {about['preset']}, {about['steps']} steps of "
        f"{about['batch_size']} windows a task; {versions}\nError on all tasks at the end {score:.2f} times that of "
        "tasks just learned by fine-tuning"
    )
