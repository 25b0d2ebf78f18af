"""How often "so many seeds needed" is right: the power at the seeds that a first comparison asks for.

python experiments/comparisons/power.py --simulations 400          # prints the table of the README
"""

import argparse
from dataclasses import replace

import numpy as np
from interval_coverage import table
from model import Design, Method, samples_of, simulate, truths

from lifelong.results.contrasts import Contrast, contrasts
from lifelong.results.seeds import MOST_SEEDS, outlook

BASE = Method(0.75, 0.95)
OTHERS = {"a little": Method(0.75, 0.93), "more": Method(0.75, 0.9), "much": Method(0.75, 0.85)}
METRIC = "auc"


def compare(other: Method, design: Design, rng: np.random.Generator) -> Contrast:
    """One experiment with two methods."""
    outcomes = simulate([BASE, other], design, rng)
    found = {str(i): samples_of(o, design)[METRIC] for i, o in enumerate(outcomes)}
    return contrasts(found)[0]


def power(other: Method, design: Design, simulations: int, rng: np.random.Generator) -> float:
    """Share of experiments that tell the two methods apart."""
    return float(np.mean([compare(other, design, rng).p_value < 0.05 for _ in range(simulations)]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--simulations", type=int, default=400)
    parser.add_argument("--seed", type=int, default=2026)
    args = parser.parse_args()
    rng, rows = np.random.default_rng(args.seed), []
    for first in (2, 3, 5):
        design = Design(seeds=first)
        for other in OTHERS.values():
            difference = truths(BASE, design)[METRIC] - truths(other, design)[METRIC]
            pilots = [compare(other, design, rng) for _ in range(args.simulations)]
            significant = np.mean([p.p_value < 0.05 for p in pilots])
            detectable = np.array([outlook(p, 1).detectable for p in pilots])
            # what the first seeds ask for, given that the difference is not significant
            asked = [outlook(p, 1).seeds or MOST_SEEDS for p in pilots if p.p_value >= 0.05]
            low, middle, high = np.percentile(asked or [np.nan], [25, 50, 75])
            known = [replace(p, estimate=replace(p.estimate, value=difference)) for p in pilots]
            needed = round(float(np.median([outlook(p, 1).seeds or MOST_SEEDS for p in known])))
            cells = [f"{difference:.3f}", f"{100 * significant:.0f} %", f"{np.median(detectable):.3f}"]
            cells += [f"{middle:.0f} ({low:.0f} to {high:.0f})", f"{needed}"]
            cells.append(f"{100 * power(other, replace(design, seeds=needed), args.simulations, rng):.0f} %")
            rows.append([f"{first} seeds", *cells])
            print("|", " | ".join(rows[-1]), "|", flush=True)
    heads = [
        "first comparison",
        "difference",
        "significant",
        "detectable",
        "asks for, if not",
        "of the true one",
    ]
    print(*table([*heads, "power with these"], rows), sep="\n")


if __name__ == "__main__":
    main()
