"""Draw the figure of a suite from its certificates: a row per task, a column per initial state; failures are red.

libero tasks certify libero_object --states 50 --out experiments/expert/builtin
python experiments/expert/figures.py experiments/expert/builtin/tasks/libero_object libero_object.png
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure

from libero_env.design.certify import Certificate
from libero_env.storage import read_json
from libero_env.validation import validate

_COLOURS = ("#f4f6ec", "#8fcfc3", "#2379ab", "#14265e")  # from few steps to many; distinct in greyscale too
_FAILED = "#b03024"


def draw_figure(certificates: Sequence[Certificate], path: Path, title: str) -> None:
    """Draw the figure, coloured by the number of steps."""
    states = max(len(c.outcomes) for c in certificates)
    steps = np.full((len(certificates), states), np.nan)
    for row, certificate in zip(steps, certificates, strict=True):
        row[: len(certificate.outcomes)] = [o.steps if o.success else np.nan for o in certificate.outcomes]
    figure = Figure(figsize=(8.5, 1.2 + 0.2 * len(certificates)), dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    colours = LinearSegmentedColormap.from_list("steps", _COLOURS).with_extremes(bad=_FAILED)
    image = axes.imshow(
        np.ma.masked_invalid(steps), cmap=colours, aspect="auto", interpolation="nearest", vmin=0
    )
    labels = [f"{_label(c)}  {100 * c.rate:.0f} %" for c in certificates]
    axes.set_yticks(range(len(labels)), labels, fontsize=6, parse_math=False)  # names are texts of users
    axes.set_xlabel("initial state; red where the goal was not reached", fontsize=7)
    axes.tick_params(axis="x", labelsize=6)
    axes.set_title(title, fontsize=8, parse_math=False)
    figure.colorbar(image, ax=axes, shrink=min(1.0, 20 / len(certificates))).ax.tick_params(labelsize=6)
    figure.savefig(path)


def _label(certificate: Certificate) -> str:
    words = certificate.name.replace("_", " ")
    return f"{certificate.task.rpartition('/')[2]}  {words if len(words) <= 64 else words[:63] + '…'}"


def main() -> None:
    """Draw the certificates of a folder."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("out", type=Path)
    args = parser.parse_args()
    found = [validate(Certificate, read_json(path)) for path in args.folder.glob("*.json")]
    found.sort(key=lambda one: int(one.task.rpartition("/")[2]))
    draw_figure(found, args.out, f"{args.folder.name}: steps of the expert from each start")


if __name__ == "__main__":
    main()
