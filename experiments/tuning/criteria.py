"""Does success from ten starts order strengths as success from other starts does, or does the error on demonstrations?

    python experiments/tuning/criteria.py run --out runs/criteria --seeds 1,2     # goes on where it was stopped
    python experiments/tuning/criteria.py table runs/criteria/*.json              # or criteria.json beside this file

Four tasks of LIBERO-Object, 20 demonstrations to learn from and 7 to measure on, 600 steps a task, preset=laptop. Each
of four strengths of three algorithms learns them in order. At the end three things are measured: the mean absolute
error on the held-out demonstrations of each task, success from the stored states 0 to 9 of each task, and, as the
truth, from 10 to 29 of them (30 to 39 too where time allows).

What decides, written before the run. Of the pairs of strengths of one algorithm and seed whose true success over all
four tasks differs by ten points or more, a criterion orders some as the truth does. The better criterion has the larger
share of them; it decides if it has at least 15 points more, its choices lose no more true success, and it has no
smaller share in any of the algorithms. If neither has that, nothing is decided, and what is cheaper stays. Rank
correlations (Kendall's tau-b) and seconds of one core are printed beside it.
"""

import argparse
import itertools
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from held_out import errors, open_both
from scipy.stats import kendalltau

from libero_env.storage import read_record, write_record
from lifelong import checkpoints
from lifelong.composition import compose_run
from lifelong.evaluation.environments import run_environment
from lifelong.evaluation.rollout import rollout
from lifelong.settings import BenchmarkSettings, Configuration, plain_data
from lifelong.tuning.trials import StreamData, Trial, learn
from lifelong.types import Batch

STRENGTHS = {  # key, values
    "ewc": ("algo.strength", (1.5, 15, 150, 1500)),
    "lwf": ("algo.strength", (0.1, 1, 3, 10)),
    "er": ("algo.ratio", (0.02, 0.1, 0.3, 1)),
}
WORDS = ("preset=laptop", "benchmark=libero_object", "data.demos=20", "threads=1", "eval.sim_threads=1")
STEPS, MORE, TASKS = 600, 7, 4
STARTS = tuple(range(first, first + 10) for first in (0, 10, 20, 30))
CLEAR = 0.1  # difference of true success from which a pair counts


def trained(trial: Trial, data: StreamData, batches: list[Batch], out: Path, stem: Path) -> dict[str, Any]:
    """Learn the stream; keep the last weights, and return the errors at the end and what both took."""
    began = time.process_time()
    *_, (algorithm, policy) = learn(trial, data, out)
    learned = time.process_time()
    found = errors(algorithm, policy, batches)
    checkpoints.save(Path(f"{stem}.safetensors"), {"policy": policy.state_dict()})
    return {"errors": found, "seconds": [learned - began, time.process_time() - learned], "success": {}}


def successes(trial: Trial, data: StreamData, starts: range, stem: Path) -> dict[str, Any]:
    """Roll the last weights out on each task; keep the actions from the first starts."""
    config, path = Configuration(trial.config), Path(f"{stem}.safetensors")
    policy, settings = config.build("policy", spec=data.spec), config.build("eval")
    checkpoints.load_weights(policy, checkpoints.load(path)["policy"], path)
    began, found = time.process_time(), []
    for k, task in enumerate(trial.stream):
        env, acted = run_environment(task, len(starts), data.spec, settings, config.build("data")), []
        step = env.step
        env.step = lambda actions, step=step, acted=acted: (acted.append(actions.copy()), step(actions))[1]
        done = rollout(
            policy,
            env,
            starts,
            language=data.training[k].language,  # type: ignore[attr-defined] # of a task alone
            horizon=settings.horizon,
            settle_steps=settings.settle_steps,
            seed=(trial.seed, 3, k),
            precision=settings.precision,
        )
        env.close()
        found.append([int(one.success) for one in done.episodes])
        if starts == STARTS[0]:
            actions = np.array(acted).astype(np.float32)
            assert (actions == np.array(acted)).all()
            np.savez_compressed(f"{stem}-{k}.npz", actions=actions, lengths=[e.length for e in done.episodes])
    return {"won": found, "seconds": time.process_time() - began}


def run(out: Path, seeds: list[int], algos: list[str]) -> None:
    """Learn and measure whatever is not recorded in `out`."""
    out.mkdir(parents=True, exist_ok=True)
    tasks = BenchmarkSettings("libero_object").sequence()[:TASKS]
    opened: tuple[StreamData, list[Batch]] | None = None
    parts = [(seed, starts) for some in (STARTS[:3], STARTS[3:]) for seed in seeds for starts in some]
    values = [
        (algo, key, value) for algo, (key, values) in STRENGTHS.items() if algo in algos for value in values
    ]
    for (seed, starts), (algo, key, value) in itertools.product(parts, values):
        stem = out / f"{algo}-{value:g}-{seed}"
        path = out / f"{stem.name}.json"
        record = read_record(path)
        if record is not None and str(starts.start) in record["success"]:
            continue
        config = plain_data(compose_run([*WORDS, f"algo={algo}", f"{key}={value}"])[0])
        trial = Trial(config, tasks, seed, STEPS)
        data, batches = opened = opened or open_both(config, tasks, MORE)
        if record is None:
            record = {"algo": algo, "value": value, "seed": seed, **trained(trial, data, batches, out, stem)}
            write_record(path, record)
        record["success"][str(starts.start)] = found = successes(trial, data, starts, stem)
        write_record(path, record)
        shown = " ".join(f"{one:.3f}" for one in record["errors"])
        print(f"{stem.name} starts {starts.start}: {shown}; {[sum(won) for won in found['won']]}", flush=True)


def criteria(record: dict[str, Any]) -> dict[str, float]:
    """Return what each criterion says of a trial (larger is better), and its true success."""
    first, *others = (
        np.array(record["success"][start]["won"]) for start in sorted(record["success"], key=int)
    )
    logs, truth = np.log(record["errors"]), np.concatenate(others, axis=1).mean(1)
    return {
        "truth": truth.mean(),
        "success, all tasks": first.mean(),
        "success, earlier tasks": first[:-1].mean(),
        "error, all tasks": -logs.mean(),
        "error, earlier tasks": -logs[:-1].mean(),
    }


def table(paths: list[Path]) -> None:
    """Print what was measured, and how the criteria order it where four strengths have a true success."""
    read = [json.loads(path.read_text()) for path in paths]
    records = [one for part in read for one in (part if isinstance(part, list) else [part])]
    records = sorted(
        (one for one in records if one["success"]),
        key=lambda one: (one["seed"], list(STRENGTHS).index(one["algo"]), one["value"]),
    )
    print(
        "| | seed | errors at the end | all | won from starts 0 to 9 | other starts | s: learning, ten starts |"
    )
    print("|---|---:|---|---:|---|---|---|")
    for one in records:
        first, *others = one["success"].values()
        error = np.exp(np.mean(np.log(one["errors"])))
        won = [" ".join(str(sum(task)) for task in part["won"]) for part in (first, *others)]
        print(
            f"| {one['algo']} {one['value']:g} | {one['seed']} | {' '.join(f'{e:.3f}' for e in one['errors'])} | "
            f"{error:.3f} | {won[0]} | {', '.join(won[1:])} | {one['seconds'][0]:.0f}, {first['seconds']:.0f} |"
        )
    groups = itertools.groupby(records, key=lambda one: (one["seed"], one["algo"]))
    whole = {key: [criteria(one) for one in group if len(one["success"]) > 1] for key, group in groups}
    whole = {key: values for key, values in whole.items() if len(values) == 4}
    if not whole:
        print("\nno algorithm has four strengths with a true success")
        return
    print(
        "\n| criterion | clear pairs ordered as the truth | tau-b | points of true success lost by its choice |"
    )
    print("|---|---|---:|---:|")
    for name in [*next(iter(whole.values()))[0]][1:]:
        shares, taus, lost = [], [], []
        for (seed, algo), values in whole.items():
            pairs = [
                (a[name] - b[name], a["truth"] - b["truth"]) for a, b in itertools.combinations(values, 2)
            ]
            signs = [np.sign(told * true) for told, true in pairs if abs(true) >= CLEAR]
            shares.append(f"{algo} {seed}: {sum(0.5 + 0.5 * sign for sign in signs):g} of {len(signs)}")
            truth, told = ([v[key] for v in values] for key in ("truth", name))
            taus.append(kendalltau(told, truth).statistic)
            lost.append(
                100 * (max(truth) - np.mean([t for t, c in zip(truth, told, strict=True) if c == max(told)]))
            )
        print(f"| {name} | {', '.join(shares)} | {np.nanmean(taus):.2f} | {np.mean(lost):.1f} |")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=("run", "table"))
    parser.add_argument("records", nargs="*", type=Path)
    parser.add_argument("--seeds", default="1,2")
    parser.add_argument(
        "--algos", nargs="+", default=[*STRENGTHS], help="of several processes, those of each"
    )
    parser.add_argument("--out", type=Path, default=Path("runs/criteria"))
    args = parser.parse_args()
    torch.set_num_threads(1)
    if args.what == "run":
        run(args.out, [int(seed) for seed in args.seeds.split(",")], args.algos)
    else:
        table(args.records)


if __name__ == "__main__":
    main()
