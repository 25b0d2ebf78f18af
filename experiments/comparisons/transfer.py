"""Bias and spread of estimates of forward transfer where the best epoch is chosen by the rollouts that measure it.

python experiments/comparisons/transfer.py --simulations 20000          # prints the table of the README
"""

import argparse
from typing import get_args

import numpy as np
from scipy.special import ndtri

from lifelong.stats.metrics import Curve, Transfer

CURVES = {
    "rises to 80 %": (0.0, 0.3, 0.5, 0.65, 0.75, 0.8),
    "flat at 70 %": (0.0, 0.6, 0.7, 0.7, 0.7, 0.7),
    "rises, then falls": (0.0, 0.4, 0.7, 0.8, 0.7, 0.6),
    "never learned": (0.02, 0.05, 0.05, 0.05, 0.05, 0.05),
    "three points": (0.0, 0.5, 0.75),
}


def simulate(
    truth: tuple[float, ...], episodes: int, simulations: int, rng: np.random.Generator
) -> dict[str, np.ndarray]:
    """Every estimate, and the true value of the weights that are kept; starts differ in difficulty."""
    rates, found = np.array(truth), {name: np.zeros(simulations) for name in (*get_args(Transfer), "kept")}
    level = ndtri(np.clip(rates, 1e-4, 1))[:, None] * np.sqrt(2)
    epochs, count = np.arange(len(truth)), np.full(len(truth), episodes)
    for i in range(simulations):
        won = level + rng.standard_normal(episodes) + rng.standard_normal((len(truth), episodes)) > 0
        won = won.astype(float)
        curve = Curve(epochs, won.mean(1), count, won[..., None])
        for name in get_args(Transfer):
            found[name][i] = curve.transfer(name)
        kept = rates.copy()
        kept[curve.best :] = rates[curve.best]
        found["kept"][i] = kept.mean()
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--simulations", type=int, default=20_000)
    args = parser.parse_args()
    rng = np.random.default_rng(2023)
    print("| curve | episodes a point | FWT of the weights kept | published | cross-fitted | no hold |")
    print("|---|---:|---:|---:|---:|---:|")
    for name, truth in CURVES.items():
        for episodes in (5, 10, 20):
            found = simulate(truth, episodes, args.simulations, rng)
            kept = found["kept"].mean()
            cells = [
                f"{found[kind].mean() - kept:+.3f} (sd {found[kind].std():.3f})"
                for kind in ("published", "cross_fitted", "plain")
            ]
            print(f"| {name} | {episodes} | {kept:.3f} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
