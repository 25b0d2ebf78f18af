"""Draws the pictures of the first pages, in docs/images.

PYTHONPATH=. python docs/pictures.py film OUT.jpg RECORDING ...         a row of moments for each recording
PYTHONPATH=. python docs/pictures.py matrices OUT.png ALGORITHM ...     mean success in experiments/algorithms
PYTHONPATH=. python docs/pictures.py page OUT.png PAGE.html TOP HEIGHT  a part of a page, in pixels

film.jpg: `libero eval expert --suite libero_goal/3 libero_10/2 --episodes 1 --videos 1 --size 256`,
then `film` of eval/expert/videos/*. forgetting.png: `matrices` of sequential, packnet and er. first-run-*: what the
commands of docs/first-run.md write.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image, ImageSequence

MOMENTS, SIDE, GAP = 5, 190, 4  # of a recording; pixels
COLOURS = 96  # of a page, so that its file is small
STUDY = Path(__file__).parents[1] / "experiments" / "algorithms"


def film(out: Path, *recordings: str) -> None:
    """Draw moments of each recording, from its first picture to its last, as the first camera saw them."""
    sheet = Image.new("RGB", (MOMENTS * (SIDE + GAP) - GAP, len(recordings) * (SIDE + GAP) - GAP), "white")
    for row, path in enumerate(recordings):
        with Image.open(path) as recording:
            frames = [frame.convert("RGB") for frame in ImageSequence.Iterator(recording)]
        for column, moment in enumerate(np.linspace(0, len(frames) - 1, MOMENTS).astype(int)):
            frame = frames[moment].crop((0, 0, frames[moment].height, frames[moment].height))
            sheet.paste(frame.resize((SIDE, SIDE)), (column * (SIDE + GAP), row * (SIDE + GAP)))
    sheet.save(out, quality=85)


def matrices(out: Path, *algorithms: str) -> None:
    """Draw the success matrices of algorithms on LIBERO-Goal, means over the seeds, side by side."""
    sys.path.append(str(STUDY))
    from study import EARLIER, planned

    from lifelong.report.figures import Panel, heatmap_figure
    from lifelong.results import ResultLog

    panels = []
    for algorithm in algorithms:
        with tempfile.TemporaryDirectory() as folder:
            runs = [
                run
                for run in planned(EARLIER)
                if f"{run.name}/".startswith(f"goal/{algorithm}/") and run.is_done()
            ]
            logs = [ResultLog(run.unpack(Path(folder)) / "results.jsonl").read() for run in runs]
        measured = np.ma.masked_invalid([log.success_matrix()[0] for log in logs])
        rates = measured.mean(0).filled(np.nan)
        panels.append(Panel(algorithm, rates, [str(i) for i in range(len(rates))]))
    heatmap_figure(panels).savefig(out, dpi=130, bbox_inches="tight", facecolor="white")
    _shrink(out)


def page(out: Path, source: str, top: str, height: str) -> None:
    """Draw a part of a page, as wide as a screen."""
    from tests.harness.browser import browser

    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile, browser(Path(profile)) as tab:
        tab.open(Path(source), 1000)
        tab.screenshot(out)
    with Image.open(out) as whole:
        whole.crop((0, int(top), 1000, int(top) + int(height))).save(out)
    _shrink(out)


def _shrink(path: Path) -> None:
    with Image.open(path) as picture:
        picture.convert("RGB").quantize(COLOURS).save(path, optimize=True)


if __name__ == "__main__":
    what, out, *rest = sys.argv[1:]
    {"film": film, "matrices": matrices, "page": page}[what](Path(out), *rest)
