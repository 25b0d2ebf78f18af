"""The command `libero tune`: choose a setting by what it keeps and what it lets learn."""

import itertools
import shlex
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from libero_env.cli.options import MAX_SEED, Field, FilePath, Positional
from libero_env.errors import InvalidInputError
from lifelong.errors import ConfigError

if TYPE_CHECKING:
    from libero_env.tasks import Task
    from lifelong.settings import Configuration
    from lifelong.tuning.trials import Candidate


@dataclass(frozen=True, kw_only=True)
class TuneRequest:
    """Choose a setting by success on short streams of tasks.

    Tasks outside of the evaluated suites are learned one after the other with each value, and rolled out at the end.
    Prints the frontier of retention and plasticity with the seconds that it took, keeps a picture and a JSON file, and
    names the value with the largest success over all tasks. A sweep that was stopped goes on with the same command.
    Examples:

    libero tune algo=ewc: the values that the algorithm suggests

    libero tune algo=lwf algo.strength=0.1,0.3,1,3: these values

    libero tune algo=ewc policy/head=gmm_small: with another head

    libero tune algo=er train.lr=5e-4,1e-3,2e-3: any key that learning depends on

    libero tune algo=ewc --write my_configs: write the chosen value, for
    libero train --config-dir my_configs algo=ewc tuned@algo=HEAD/ewc

    Attributes:
        overrides: As of `libero train`; KEY=V1,V2,... is swept.
        suite: Suite of the streams' tasks.
        stream: Tasks of a stream in learning order, numbers or names, such as 61,62; give it once for each stream
            (default: five of libero_90, in one scene).
        seeds: Seeds with which each stream is learned, such as 1,2.
        steps: Optimiser steps a task.
        starts: Initial states, the first ones, from which each task is rolled out at the end.
        beside: Algorithms to compare with.
        out: Folder of numbers, picture and measurements.
        config_dir: A folder of configuration files to be added.
        write: Folder of configuration files in which tuned/HEAD/ALGO.yaml gets the chosen value (ALGO_own.yaml where
            the package has such a file).
    """

    overrides: Positional[Annotated[tuple[str, ...], Field(min_length=1)]]
    suite: str = "libero_90"
    stream: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    seeds: str = "1"
    steps: Annotated[int, Field(ge=1, le=1_000_000)] = 600
    starts: Annotated[int, Field(ge=1, le=50)] = 10
    beside: tuple[str, ...] = ("sequential", "er")
    out: FilePath = Path("runs/tuning")
    config_dir: FilePath | None = None
    write: FilePath | None = None

    @property
    def seed_numbers(self) -> tuple[int, ...]:
        """The seeds as numbers.

        Raises:
            InvalidInputError: One is not a seed.
        """
        parts = self.seeds.split(",")
        if not all(part.isdecimal() and int(part) <= MAX_SEED for part in parts):
            raise InvalidInputError(
                f"--seeds {self.seeds}: expected whole numbers of at least 0, such as 1,2"
            )
        return tuple(map(int, parts))


def tune(request: TuneRequest) -> None:
    """Measure all values and write table, picture, JSON file and the chosen value."""
    from lifelong.composition import compose_run, config_folder, config_folders, swept

    lists = swept(request.overrides, config_folders(request.config_dir))
    if empty := [key for key, found in lists.items() if not found]:
        raise ConfigError(f"{empty[0]} lists no values to try; write them out, such as {empty[0]}=V1,V2")
    words = [word for word in request.overrides if word.partition("=")[0] not in lists]
    for key in (word.lstrip("+~").partition("=")[0] for word in words):
        # a preset may set them for the runs
        if (
            key.partition(".")[0] in ("seed", "benchmark", "eval", "learner")
            or key == "train.steps_per_epoch"
        ):
            raise ConfigError(
                f"{key} has no effect in libero tune; leave it out: see --seeds, --suite, --stream and --steps"
            )
    words.append(f"benchmark={request.suite}")  # whose horizon presets take
    config, choices = compose_run(words, request.config_dir)
    import torch

    from lifelong.settings import Configuration, plain_data
    from lifelong.tuning.frontier import draw_frontier, render, write_frontier, write_tuned
    from lifelong.tuning.trials import TrialSettings, check_obeyed, measure_frontier

    plain = plain_data(config)
    check_obeyed(plain, lists)
    checked = Configuration(plain)
    lists = lists or _suggested(checked)
    if request.write and (others := [key for key in lists if not key.startswith("algo.")]):
        raise ConfigError(
            f"--write keeps settings of the algorithm, and {others[0]} is none; leave out --write, and set {others[0]} "
            "in a preset of your own"
        )
    values = [dict(zip(lists, chosen, strict=True)) for chosen in itertools.product(*lists.values())]
    candidates = [
        _candidate(
            _label(value.values()),
            value,
            [*words, *(f"{k}={v}" for k, v in value.items())],
            request.config_dir,
        )
        for value in values
    ]
    without = [word for word in words if not word.startswith(("algo", "tuned@algo"))]

    def other(algo: str) -> "Candidate":
        return _candidate(algo, {}, [*without, f"algo={algo}"], request.config_dir)

    if threads := checked.settings().threads:
        torch.set_num_threads(threads)
    beside = [other(algo) for algo in request.beside if algo != choices["algo"]]
    trials = TrialSettings(_streams(request), request.seed_numbers, request.steps, request.starts)
    frontier = measure_frontier(candidates, beside, trials, request.out)

    algo, head = choices["algo"], choices.get("policy/head", choices["policy"])
    keys = ", ".join(candidates[0].settings)
    default = _label(str(_value_at(plain, key)) for key in lists)
    print(
        f"\n{keys} of {algo}: for each value, success at the end, from {request.starts} starts of each task, "
        f"and what a stream took\n\n{render(frontier, default)}\n"
    )
    best = frontier.chosen
    print("chosen: " + " ".join(f"{key}={value}" for key, value in best.settings.items()))
    weights = {tuple(trial.weights for trial in one.trials) for one in frontier.outcomes}
    if len(values) > 1 == len(weights):
        print(f"all values leave the same weights: {keys} has no effect on what is measured", file=sys.stderr)
    elif len(equal := frontier.equals()) > 1:
        named, rate = ", ".join(one.label for one in equal), best.score.value
        more = "--starts or --seeds" if rate else f"--steps than {request.steps} a task"
        print(f"{named} succeed equally ({rate:.0%}): give more {more}", file=sys.stderr)
    elif frontier.at_edge():
        print("the chosen value is the first or the last one: try values beyond it", file=sys.stderr)
    about = _about(request, trials.streams, choices, plain)
    names = "-".join(key.rpartition(".")[2].replace("/", "-") for key in best.settings)
    stem = request.out / f"{algo}-{head}-{names}"
    write_frontier(frontier, stem.with_suffix(".json"), about)
    draw_frontier(frontier, f"{algo}: {keys}", stem)
    print(f"picture: {stem}.png")
    if request.write:
        name, package = f"{head}/{algo}", config_folder()
        if (package / f"tuned/{name}.yaml").is_file() and package.resolve() != request.write.resolve():
            name += "_own"  # the package's goes before a file of the same name
        path = request.write / "tuned" / f"{name}.yaml"
        write_tuned(best, path, _comment(about, best.score.value))
        print(f"written: {path}, for libero train --config-dir {request.write} algo={algo} tuned@algo={name}")


def _suggested(config: "Configuration") -> dict[str, list[str]]:
    """Return the values that the algorithm suggests for its first key to be tuned."""
    tuned = config.build("algo").tuned
    if not tuned:
        raise ConfigError(
            "this algorithm suggests no values; name a key with several, such as algo.KEY=V1,V2 or "
            "train.lr=1e-3,2e-3"
        )
    key = next(iter(tuned))
    return {f"algo.{key}": [f"{value:g}" for value in tuned[key]]}


def _candidate(
    label: str, values: dict[str, str], words: Sequence[str], config_dir: Path | None
) -> "Candidate":
    from lifelong.composition import compose_run
    from lifelong.settings import Configuration, plain_data
    from lifelong.tuning.trials import Candidate

    config = plain_data(compose_run(words, config_dir)[0])
    for group in ("algo", "data", "train", "stream", "pretrain"):  # before anything is recorded or learned
        Configuration(config).build(group)
    # of a group, the name of its file
    settings = {k: _value_at(config, k.lstrip("+")) if "." in k else name for k, name in values.items()}
    return Candidate(label, settings, config)


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


def _streams(request: TuneRequest) -> "tuple[tuple[Task, ...], ...]":
    """Return the tasks of the streams.

    Raises:
        UnknownNameError: A suite or task does not exist.
    """
    from libero_env.tasks import get_suite
    from lifelong.settings import BenchmarkSettings
    from lifelong.tuning.trials import STREAMS

    get_suite(request.suite)  # not `own`, whose files no option names
    chosen = [text.split(",") for text in request.stream] if request.stream else STREAMS
    return tuple(
        BenchmarkSettings(request.suite, tasks=[int(t) if str(t).isdigit() else t for t in tasks]).sequence()
        for tasks in chosen
    )


def _about(
    request: TuneRequest, streams: "Sequence[Sequence[Task]]", choices: dict[str, str], plain: dict[str, Any]
) -> dict[str, Any]:
    """Return what a reader of the results needs to repeat them."""
    import importlib.metadata

    import torch

    from libero_env.demos.config import GENERATOR

    return {
        "command": shlex.join(["libero", "tune", *request.overrides, *_options(request)]),
        "preset": choices.get("preset"),
        "policy": choices["policy"],
        "head": choices.get("policy/head"),
        "streams": [[task.id for task in stream] for stream in streams],
        "seeds": list(request.seed_numbers),
        "steps": request.steps,
        "batch_size": plain["train"].get("batch_size"),
        "starts": request.starts,
        "versions": {
            "libero-lifelong": importlib.metadata.version("libero-lifelong"),
            "torch": torch.__version__,
            "demonstrations": GENERATOR,
        },
    }


def _options(request: TuneRequest) -> list[str]:
    """Return the options that results depend on and that are not the default ones."""
    defaults = TuneRequest(overrides=("algo=er",))
    names = ("suite", "seeds", "steps", "starts")
    differing = [name for name in names if getattr(request, name) != getattr(defaults, name)]
    chosen = [(f"--{name.replace('_', '-')}", f"{getattr(request, name)}") for name in differing]
    chosen += [("--stream", tasks) for tasks in request.stream]
    beside = [] if request.beside == defaults.beside else ["--beside", *request.beside]
    return [*(word for pair in chosen for word in pair), *beside]


def _comment(about: dict[str, Any], score: float) -> str:
    versions = ", ".join(f"{name} {version}" for name, version in about["versions"].items())
    return (
        f"Chosen by: {about['command']}\nWith preset {about['preset']}, {about['steps']} steps of "
        f"{about['batch_size']} windows a task; {versions}\nSuccess on all tasks at the end {score:.0%}, from "
        f"{about['starts']} starts of each"
    )
