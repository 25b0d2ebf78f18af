"""Runs the published protocol and prints what comes out beside Table 8 of Liu et al. (NeurIPS 2023).

    python experiments/paper/table8.py --demos human_demos [--algo sequential er] [--seeds 100] [--runs runs/table8]

Needs a GPU, BERT's weights, and for a comparison the original's models and human demonstrations:

    libero assets install && export LIBERO_ASSETS=original
    libero demos download libero_object --dest human_demos

Runs that were interrupted go on, finished ones are read: the command may be repeated, and with `--only-read` it trains
nothing.
"""

import argparse
import json
import statistics
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
METRICS = ("fwt", "nbt", "auc")
# ResNet-T: mean and standard error of three seeds, of FWT, NBT and AUC.
PUBLISHED = {
    "libero_object": {
        "sequential": ((0.78, 0.04), (0.76, 0.04), (0.26, 0.02)),
        "er": ((0.67, 0.07), (0.43, 0.04), (0.44, 0.06)),
        "ewc": ((0.56, 0.03), (0.69, 0.02), (0.16, 0.02)),
        "packnet": ((0.60, 0.07), (0.17, 0.05), (0.60, 0.05)),
    },
    "libero_spatial": {
        "sequential": ((0.72, 0.01), (0.81, 0.01), (0.20, 0.01)),
        "er": ((0.65, 0.03), (0.27, 0.03), (0.56, 0.01)),
        "ewc": ((0.23, 0.01), (0.33, 0.01), (0.06, 0.01)),
        "packnet": ((0.55, 0.01), (0.07, 0.02), (0.63, 0.00)),
    },
    "libero_goal": {
        "sequential": ((0.77, 0.01), (0.82, 0.01), (0.22, 0.00)),
        "er": ((0.64, 0.01), (0.34, 0.02), (0.49, 0.02)),
        "ewc": ((0.32, 0.02), (0.48, 0.03), (0.06, 0.00)),
        "packnet": ((0.63, 0.02), (0.06, 0.01), (0.75, 0.01)),
    },
    "libero_10": {
        "sequential": ((0.54, 0.01), (0.63, 0.01), (0.15, 0.00)),
        "er": ((0.48, 0.02), (0.32, 0.04), (0.32, 0.01)),
        "ewc": ((0.13, 0.02), (0.22, 0.03), (0.02, 0.00)),
        "packnet": ((0.22, 0.01), (0.08, 0.01), (0.25, 0.00)),
    },
}


def command(args: argparse.Namespace, algo: str, seed: int) -> list[str]:
    """Return the command of one run."""
    words = ["preset=paper", "compat=libero", f"benchmark={args.benchmark}", f"algo={algo}", f"seed={seed}"]
    folder = [f"data.folder={args.demos}"] if args.demos else []
    return [sys.executable, str(ROOT / "train.py"), *words, *folder, f"runs_dir={args.runs}", *args.overrides]


def results_file(args: argparse.Namespace, algo: str, seed: int) -> Path:
    """Return the file in which a finished run has its metrics."""
    return Path(args.runs) / args.benchmark / algo / f"bc_transformer_seed{seed}" / "results.json"


def row(args: argparse.Namespace, algo: str) -> str:
    """Return a line of the table; of several seeds the mean and its standard error."""
    files = [file for seed in args.seeds if (file := results_file(args, algo, seed)).is_file()]
    found = [json.loads(file.read_text()) for file in files]
    hours = sum(sum(f["seconds_by_phase"].values()) for f in found) / 3600
    cells = []
    for number, metric in enumerate(METRICS):
        values = [f["metrics"][metric]["value"] for f in found]
        mean = f"{statistics.fmean(values):.2f}" if values else "-"
        if len(values) > 1:
            mean += f" ± {statistics.stdev(values) / len(values) ** 0.5:.2f}"
        there, error = PUBLISHED[args.benchmark][algo][number]
        cells.append(f"{mean} / {there:.2f} ± {error:.2f}")
    return f"| {algo} | {len(found)} | {' | '.join(cells)} | {hours:.1f} |"


def main() -> None:
    """Run what is not finished, and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--benchmark", choices=PUBLISHED, default="libero_object")
    parser.add_argument("--algo", nargs="+", choices=PUBLISHED["libero_object"], default=["sequential", "er"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[100])
    parser.add_argument(
        "--demos", help="folder of the human demonstrations; without it they are recorded here"
    )
    parser.add_argument("--runs", default="runs/table8")
    parser.add_argument("--only-read", action="store_true")
    parser.add_argument(
        "overrides", nargs="*", help="further settings of train.py, such as data.memory=device"
    )
    args = parser.parse_args()
    import torch

    if not (args.only_read or torch.cuda.is_available() or "device=cpu" in args.overrides):
        sys.exit("error: there is no GPU, and a run takes weeks without one; add device=cpu if that is meant")
    for algo in args.algo:
        for seed in args.seeds:
            if not args.only_read:
                subprocess.run(command(args, algo, seed), check=True)
    print(f"\n{args.benchmark}, ResNet-T: here / published\n")
    print("| algorithm | seeds here | FWT | NBT | AUC | hours |\n|---|---:|---|---|---|---:|")
    for algo in args.algo:
        print(row(args, algo))


if __name__ == "__main__":
    main()
