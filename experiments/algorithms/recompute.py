"""The numbers of frontier.md once more, from the records alone: NumPy and SciPy, none of this project's code.

python experiments/algorithms/recompute.py      # 1, and what differs, where the page has other digits
"""

import argparse
import json
import lzma
import re
import sys
from collections import defaultdict
from pathlib import Path

import numpy as np
from scipy import stats

HERE = Path(__file__).parent
PAIR = "final_success", "auc"


def read(path: Path) -> dict[str, float]:
    """Return a run's metrics and what it keeps, from its file."""
    lines = [
        json.loads(line) for line in json.loads(lzma.decompress(path.read_bytes()))["records"].splitlines()
    ]
    tasks = len(next(x for x in lines if x["kind"] == "run")["tasks"])
    c, curve, cost = np.full((tasks, tasks), np.nan), np.zeros(tasks), {}
    for x in lines:
        if x["kind"] == "eval":
            rate = sum(x["successes"]) / len(x["successes"])
            if x["phase"] == "matrix":
                c[x["learned"], x["task"]] = rate
            elif x["phase"] == "curve":
                curve[x["learned"]] = rate
        elif x["kind"] == "cost":
            cost.update(x["costs"] if x["task"] == tasks - 1 else {})
    learned, end = np.diag(c).copy(), c[-1].copy()
    for i in range(1, tasks - 1):  # what was not drawn is guessed, and the guess corrected by what was
        drawn, guess = ~np.isnan(c[i, :i]), (learned[:i] + end[:i]) / 2
        error = np.where(drawn, c[i, :i] - guess, 0) * i / drawn.sum()
        c[i, :i] = guess + error
    lost = [np.mean(learned[k] - c[k + 1 :, k]) for k in range(tasks - 1)] + [0.0]
    area = [(curve[k] + c[k + 1 :, k].sum()) / (tasks - k) for k in range(tasks)]
    found = {
        "just_learned": learned.mean(),
        "final_success": end.mean(),
        "nbt": np.mean(lost),
        "auc": np.mean(area),
    }
    return {**found, "stored": cost["stored_bytes"], "share": cost["kept_share"]}


def interval(name: str, values: np.ndarray, episodes: int = 100) -> str:
    """Return the mean over seeds with Student's interval, not narrower than Wilson's of a success rate."""
    mean, n = values.mean(), len(values)
    if n == 1:
        low, high = np.nan, np.nan
    else:
        half = stats.t.ppf(0.975, n - 1) * values.std(ddof=1) / np.sqrt(n)
        low, high = max(mean - half, -1.0 if name == "nbt" else 0.0), min(mean + half, 1.0)
    if name == "nbt":
        known = n > 1 and (half > 1e-9 or mean == 0)
    elif known := n > 1:
        z, size = stats.norm.ppf(0.975), n * episodes
        middle = (mean + z * z / (2 * size)) / (1 + z * z / size)
        side = z * np.sqrt(mean * (1 - mean) / size + z * z / (4 * size**2)) / (1 + z * z / size)
        low, high = min(low, max(0.0, middle - side)), max(high, min(1.0, middle + side))
    return f"{mean:z.2f}" + (f" [{low:z.2f}, {high:z.2f}]" if known else "")


def difference(values: np.ndarray) -> tuple[str, float]:
    """Return a paired difference in points with Student's interval, and its p-value."""
    mean, n = 100 * values.mean(), len(values)
    if n < 2 or values.std() < 1e-12:
        return f"{mean:+z.1f}", np.nan
    error = 100 * values.std(ddof=1) / np.sqrt(n)
    half = stats.t.ppf(0.975, n - 1) * error
    p = 2 * stats.t.sf(abs(mean / error), n - 1) if n > 2 else np.nan
    return f"{mean:+z.1f} [{mean - half:z.1f}, {mean + half:z.1f}]", p


def holm(p: list[float]) -> list[float]:
    """Return p-values after Holm's correction; NaN is no test."""
    known = sorted((value, i) for i, value in enumerate(p) if value == value)
    out, least = [np.nan] * len(p), 0.0
    for rank, (value, i) in enumerate(known):
        least = max(least, min(1.0, value * (len(known) - rank)))
        out[i] = least
    return out


def page(mark: str) -> dict[str, list[str]]:
    """Return the rows of a table of frontier.md by their first cell."""
    text = (HERE / "frontier.md").read_text(encoding="utf-8")
    lines = text.split(f"<!-- {mark} -->\n")[1].split("<!-- end")[0].splitlines()[2:]
    return {
        row[0]: row[1:] for row in ([cell.strip() for cell in line.strip("|").split("|")] for line in lines)
    }


def main() -> int:
    argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    ).parse_args()
    runs: dict[str, dict[int, dict[str, float]]] = defaultdict(dict)
    for path in sorted((HERE / "records" / "frontier").glob("*/seed?.json.xz")):
        runs[path.parent.name][int(re.findall(r"\d+", path.name)[0])] = read(path)
    wrong = []
    for name, cells in page("frontier").items():
        own = runs[re.sub("[ ,]+", "_", name)]
        metrics = ("just_learned", "final_success", "nbt", "auc")
        expected = [interval(m, np.array([own[s][m] for s in sorted(own)])) for m in metrics]
        expected.insert(0, f"{np.mean([own[s]['share'] for s in own]):.2g} %")
        wrong += [(name, a, b) for a, b in zip([cells[3], *cells[5:]], expected, strict=True) if a != b]
    tested = page("pairs")
    by_metric = {}
    for metric in PAIR:
        found = []
        for pair in tested:
            a, b = (runs[part.replace(" ", "_")] for part in pair.split(" − "))
            found.append(
                difference(np.array([a[s][metric] - b[s][metric] for s in sorted(a.keys() & b.keys())]))
            )
        by_metric[metric] = [
            (text, p) for (text, _), p in zip(found, holm([p for _, p in found]), strict=True)
        ]
    for i, (pair, cells) in enumerate(tested.items()):
        expected = [cell for m in PAIR for cell in (by_metric[m][i][0], _p(by_metric[m][i][1]))]
        wrong += [(pair, a, b) for a, b in zip(cells[:4], expected, strict=True) if a != b]
    for name, printed, found in wrong:
        print(f"{name}: the page has {printed}, the records {found}")
    print(
        f"{len(runs)} methods, {sum(map(len, runs.values()))} runs, {len(tested)} pairs: {len(wrong)} cells differ"
    )
    return int(bool(wrong))


def _p(value: float) -> str:
    return "–" if value != value else f"{value:.2g}"


if __name__ == "__main__":
    sys.exit(main())
