"""Files of certificates: a table, the results as JSON, and a figure of each suite."""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from libero_env.design.certify import Certificate, markdown_table, results

_COLOURS = ("#f4f6ec", "#8fcfc3", "#2379ab", "#14265e")  # from few steps to many; distinct in greyscale too
_FAILED = "#b03024"


def write_results(
    certificates: Sequence[Certificate], out: Path, *, assets: str | None = None, disturb: bool = False
) -> None:
    """Write `results.json`, `results.md` and, where matplotlib is installed, a figure of each suite; print their paths.

    Args:
        certificates: Results of the tasks.
        out: Folder to write to.
        assets: Models that were used, as for `select_pack`.
        disturb: Whether the actions had noise; the names of the files state it.
    """
    out.mkdir(parents=True, exist_ok=True)
    ending = "-disturbed" if disturb else ""
    written = [out / f"results{ending}.json", out / f"results{ending}.md"]
    written[0].write_text(json.dumps(results(certificates, assets=assets, disturb=disturb), indent=1) + "\n")
    written[1].write_text(markdown_table(certificates))
    suites: dict[str, list[Certificate]] = {}
    for certificate in certificates:
        suites.setdefault(certificate.task.partition("/")[0], []).append(certificate)
    for suite, own in suites.items():
        path = out / f"{suite}{ending}.png"
        try:
            draw_figure(own, path, f"{suite}: steps of the expert from each start")
        except ModuleNotFoundError as error:
            print(f"no figure of {suite}: {error.name} is not installed (it is in the extra `train`)")
        else:
            written.append(path)
    print("\n".join(map(str, written)))


def draw_figure(certificates: Sequence[Certificate], path: Path, title: str) -> None:
    """Draw the figure of a suite: a row per task, a column per initial state, coloured by length; failures red.

    Raises:
        ModuleNotFoundError: matplotlib is not installed.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.colors import LinearSegmentedColormap
    from matplotlib.figure import Figure

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
