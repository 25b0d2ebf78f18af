"""Figures of a report, through matplotlib's object interface only, sized for a paper's column or page."""

import io
import math
import re
import textwrap
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import Colormap, LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from libero_env.storage import atomic_path
from libero_env.text import quantity
from lifelong.results.records import CollectionRecord
from lifelong.stats.intervals import Estimate, mean_and_half_width, wilson_interval
from lifelong.stats.metrics import Curve

# Okabe and Ito's colours, distinguishable for colour-blind readers, without yellow, which is too light on white
LINE_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#7F7F7F")
LINE_MARKERS = ("o", "s", "^", "D", "v", "P", "X")
LINE_DASHES = ("-", "--", ":", "-.")  # of the first lines, one for each colour, of as many after them, ...
LARGEST_WITH_EVERY_TASK = 12  # number of tasks up to which a success matrix has every number
NAME_WIDTH = 24  # characters of a line of a task's name beside it
INK = "#010203"  # placeholder of the page's text colour, light or dark, in SVG
STYLE = matplotlib.rc_params_from_file(Path(__file__).with_name("style.mplstyle"), use_default_template=False)


@dataclass(frozen=True)
class Panel:
    """One success matrix.

    Attributes:
        rates: (K, K) success rates, NaN where not evaluated.
        labels: K short task names.
    """

    title: str
    rates: NDArray[np.float64]
    labels: Sequence[str]


@dataclass(frozen=True)
class Line:
    """One curve over the tasks learned.

    Attributes:
        label: Label in the legend; empty for none.
        values: (runs, K) values of each run, NaN beyond the tasks it learned.
    """

    label: str
    values: NDArray[np.float64]


def success_colours() -> Colormap:
    """Return the colour map of success: light to dark with evenly falling lightness, so it also prints in grey."""
    stops = ("#f4f6ec", "#cfe8d2", "#8fcfc3", "#45aabf", "#2379ab", "#1d4a8c", "#14265e")
    return LinearSegmentedColormap.from_list("success", stops)


def cell_colours(rate: float) -> tuple[str, str]:
    """Return the background and text colour of a cell with this success rate, as #rrggbb."""
    channels = np.array(success_colours()(rate)[:3])
    linear = np.where(channels <= 0.04045, channels / 12.92, ((channels + 0.055) / 1.055) ** 2.4)
    luminance = float(linear @ (0.2126, 0.7152, 0.0722))
    back = "#{:02x}{:02x}{:02x}".format(*(round(255 * c) for c in channels))
    return back, "#ffffff" if luminance < 0.24 else "#0d1820"


@matplotlib.rc_context(STYLE)
def heatmap_figure(panels: Sequence[Panel]) -> Figure:
    """Draw success matrices side by side, up to four in a row, in percent, with one colour bar.

    Several matrices begin with the first row that one of them has: tasks that are learned together have one row.
    """
    columns = min(len(panels), 4)
    rows = math.ceil(len(panels) / columns)
    single = len(panels) == 1
    first = 0 if single else _first_known([panel.rates.T for panel in panels])
    shares = [1 - first / len(panel.rates) for panel in panels]
    width, height = (4.5, 3.4) if single else (2.45 * columns + 0.5, (0.6 + 2 * max(shares)) * rows)
    figure = Figure(figsize=(width, height), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False)
    for axes in grid.flat[len(panels) :]:
        axes.set_axis_off()
    for place, (axes, panel) in enumerate(zip(grid.flat, panels, strict=False)):
        image = _draw_matrix(axes, panel, first, font=7.5 if single else 6)
        if single and len(panel.rates) <= LARGEST_WITH_EVERY_TASK:
            _name_rows(axes, panel.labels)
        if place % columns == 0:
            axes.set_ylabel("after learning task")
        if place + columns >= len(panels):
            axes.set_xlabel("success on task")
    if single and len(panels[0].rates) > 5:  # in the empty triangle
        place = grid[0, 0].inset_axes((0.56, 0.93, 0.42, 0.035))
        bar = figure.colorbar(image, cax=place, orientation="horizontal", ticks=(0, 50, 100))
        bar.set_label("success (%)", labelpad=1)
    else:
        bar = figure.colorbar(image, ax=grid, shrink=0.85, pad=0.02, aspect=28, label="success (%)")
    bar.outline.set_visible(False)
    return figure


@matplotlib.rc_context(STYLE)
def learning_figure(
    curves: Mapping[int, Curve],
    losses: Mapping[int, tuple[NDArray[np.int64], NDArray[np.float64]]],
    labels: Sequence[str],
    kept: Mapping[int, int],
    drawn: Mapping[int, Sequence[CollectionRecord]] = MappingProxyType({}),
) -> Figure:
    """Draw for each task its success (with Wilson's 95 % band, the kept epoch circled) above its training loss.

    Args:
        curves: Learning curve of each task.
        losses: Epochs and mean training losses of each task.
        labels: K short task names.
        kept: Epoch whose weights are kept, of each task that is learned.
        drawn: Iterations of each task that is learned from reward, whose success is dashed.
    """
    tasks = sorted(curves.keys() | losses.keys())
    columns = min(5, len(tasks))
    # Inches. Placed by hand: automatic layout of a hundred panels takes a minute.
    left, panel, gap, upper, lower, between, row_height = 0.7, 1.93, 0.24, 1.1, 0.68, 0.13, 2.5
    width, height = left + columns * (panel + gap), math.ceil(len(tasks) / columns) * row_height + 0.2
    limits = _loss_limits(losses)
    epochs = [c.epochs for c in curves.values()] + [e for e, _ in losses.values()]
    last = max(1, *(int(e.max(initial=1)) for e in epochs))
    figure = Figure(figsize=(width, height))
    for place, task in enumerate(tasks):
        row, column = divmod(place, columns)
        x, top = left + column * (panel + gap), height - 0.25 - row * row_height
        bottoms = ((top - upper, upper), (top - upper - between - lower, lower))
        boxes = [(x / width, y / height, panel / width, h / height) for y, h in bottoms]
        above, below = (figure.add_axes(box) for box in boxes)
        above.set_title(f"{task + 1}  {shorten(labels[task], 24)}", loc="left", fontsize=8.5)
        _draw_curve(above, curves.get(task), kept.get(task))
        if found := drawn.get(task):
            rates = [100 * r.successes / max(1, r.episodes) for r in found]
            above.plot([r.epoch for r in found], rates, "--", color=LINE_COLOURS[2], lw=1)
        if task in losses:
            marker = "o" if len(losses[task][0]) < 4 else None
            below.plot(*losses[task], color=LINE_COLOURS[1], lw=1.2, marker=marker, ms=2.6)
        below.set_ylim(*limits)
        below.yaxis.set_major_locator(MaxNLocator(3))
        for axes, name in ((above, "success (%)"), (below, "loss")):
            _set_epoch_axis(axes, last, labelbottom=axes is below)
            axes.tick_params(labelleft=column == 0)
            if column == 0:
                axes.set_ylabel(name)
                axes.yaxis.set_label_coords(-0.5 / panel, 0.5)
        if place + columns >= len(tasks):
            below.set_xlabel("epoch")
    return figure


@matplotlib.rc_context(STYLE)
def forgetting_figure(lines: Sequence[Line]) -> Figure:
    """Draw average success over the tasks learned so far against their number, with Student's 95 % band over runs.

    Lines of the same colour differ in dashes and markers.
    """
    named = any(line.label for line in lines)
    labels = [line.label for line in lines]
    room = 0.18 * math.ceil(len(labels) / _legend_columns(labels))
    figure = Figure(figsize=(5.6, 2.8 + room) if named else (3.5, 2.7), layout="constrained")
    axes = figure.subplots()
    for number, line in enumerate(lines):
        columns = [mean_and_half_width(c[~np.isnan(c)]) for c in line.values.T]
        mean, half = 100 * np.array(columns).T
        x, look = np.arange(1, len(mean) + 1), _look(number)
        axes.plot(x, mean, **look, lw=1.4, label=shorten(line.label), clip_on=False)
        band = 0.18 if len(lines) <= len(LINE_COLOURS) else 0.06
        low, high = np.clip(mean - half, 0, 100), np.clip(mean + half, 0, 100)
        axes.fill_between(x, low, high, color=look["color"], alpha=band, lw=0)
    longest = max(line.values.shape[1] for line in lines)
    first = 1 + _first_known([line.values for line in lines])
    axes.set_xticks(range(first, longest + 1, max(1, longest // 10)))
    axes.set(
        xlim=(first - 0.2, longest + 0.2), ylim=(0, 100), xlabel="tasks learned", ylabel="average success (%)"
    )
    axes.grid(axis="y")
    if named:
        legend_below(figure)
    return figure


@matplotlib.rc_context(STYLE)
def storage_figure(points: Mapping[str, tuple[float, Estimate]]) -> Figure:
    """Draw AUC with its 95 % interval against the bytes that a method keeps from task to task.

    Args:
        points: Bytes and AUC of each method.
    """
    least = min([size for size, _ in points.values() if size > 0], default=1.0)
    most = max(least, *(size for size, _ in points.values()))
    decades = 10.0 ** np.arange(math.floor(math.log10(least)), math.log10(2 * most))
    room = 0.18 * math.ceil(len(points) / _legend_columns(list(points)))
    figure = Figure(figsize=(5.6, 2.8 + room), layout="constrained")
    axes = figure.subplots()
    axes.set_xscale("symlog", linthresh=decades[0])  # methods that keep nothing stand at 0
    axes.set_xticks([0.0, *decades])
    for number, (label, (size, auc)) in enumerate(points.items()):
        ends = np.nan_to_num([[auc.value - auc.low], [auc.high - auc.value]])
        look = _look(number) | {"ls": "none"}
        axes.errorbar([size], [100 * auc.value], 100 * ends, **look, elinewidth=0.8, label=shorten(label))
    axes.xaxis.set_major_formatter(lambda size, _: quantity(size, "B"))
    axes.set(xlim=(-0.3 * decades[0], 2 * most), xlabel="kept from one task to the next", ylabel="AUC (%)")
    axes.grid()
    legend_below(figure)
    return figure


def _look(number: int) -> dict[str, Any]:
    """Return colour, dashes and marker of a method, which no other of up to 49 has."""
    turn, place = divmod(number, len(LINE_COLOURS))
    colour, marker = LINE_COLOURS[place], LINE_MARKERS[(place + turn) % len(LINE_MARKERS)]
    dashes, filling = LINE_DASHES[turn % len(LINE_DASHES)], "white" if turn % 2 else colour
    return {"color": colour, "ls": dashes, "marker": marker, "mfc": filling, "ms": 3.8}


def as_svg(figure: Figure) -> str:
    """Return the figure as an inline SVG with transparent background, in the page's font and text colour."""
    buffer = io.StringIO()
    with matplotlib.rc_context(STYLE), _any_script():
        figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None})
    text = buffer.getvalue()
    text = text[text.index("<svg") :].replace(INK, "currentColor")
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r"(font(?:-family)?: [^;\"]*?)'DejaVu Sans'[^;\"]*", r"\1inherit", text)
    # "font: 8px inherit" is not valid CSS: name the page's family through a variable instead.
    return re.sub(r"(font: [^;\"]*?)inherit", r"\1var(--font)", text)


def save(figure: Figure, stem: Path) -> None:
    """Write `stem`.png (300 dpi) and `stem`.pdf, black on white."""
    with matplotlib.rc_context(STYLE), _any_script():
        FigureCanvasAgg(figure)
        own: dict[str, dict[str, Any]] = {"png": {"dpi": 300}, "pdf": {"metadata": {"CreationDate": None}}}
        look: dict[str, Any] = {"facecolor": "white", "bbox_inches": "tight", "pad_inches": 0.05}
        for kind, options in own.items():
            with atomic_path(stem.with_suffix(f".{kind}")) as part:
                figure.savefig(part, format=kind, **look, **options)


@contextmanager
def _any_script() -> Iterator[None]:
    """Draw characters that the font lacks as boxes, without a warning for each."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph .* missing from", UserWarning)
        warnings.filterwarnings("ignore", "Matplotlib currently does not support", UserWarning)
        yield


def shorten(text: str, length: int = 120) -> str:
    """Return the text in one line of printable characters, shortened at a word with an ellipsis if it is longer.

    Args:
        text: Any text, such as an instruction.
        length: Maximum number of characters.
    """
    text = "".join(c if c.isprintable() else " " for c in text)
    if len(text) <= length:
        return text
    cut = text[: length - 1].rsplit(" ", 1)[0] if " " in text[: length - 1] else text[: length - 1]
    return cut.rstrip(" ,") + "…"


def _first_known(values: Sequence[NDArray[np.float64]]) -> int:
    """Return the first column in which an array has a number; 0 if none has one."""
    known = [~np.isnan(array).all(axis=0) for array in values]
    return min((int(np.argmax(columns)) for columns in known if columns.any()), default=0)


def _draw_matrix(axes: Axes, panel: Panel, first: int, font: float) -> matplotlib.image.AxesImage:
    """Draw a success matrix from its row `first` on."""
    size = len(panel.rates)
    image = axes.imshow(100 * panel.rates, cmap=success_colours(), vmin=0, vmax=100)
    axes.set_title(shorten(panel.title))
    ticks = range(0, size, 1 if size <= LARGEST_WITH_EVERY_TASK else math.ceil(size / 6))
    axes.set_yticks([t for t in ticks if t >= first], [str(t + 1) for t in ticks if t >= first])
    axes.set_xticks(ticks, [str(t + 1) for t in ticks])
    axes.tick_params(length=0)
    for side in axes.spines.values():
        side.set_visible(False)
    if size <= LARGEST_WITH_EVERY_TASK:
        axes.set_xticks(np.arange(size + 1) - 0.5, minor=True)
        axes.set_yticks(np.arange(first, size + 1) - 0.5, minor=True)
        axes.grid(which="minor", color="white", alpha=1, lw=1.2)
        axes.tick_params(which="minor", length=0)
        for i, j in zip(*np.nonzero(~np.isnan(panel.rates)), strict=True):
            colour = cell_colours(float(panel.rates[i, j]))[1]
            text = f"{100 * panel.rates[i, j]:.0f}"
            axes.text(j, i, text, ha="center", va="center", color=colour, fontsize=font)
    axes.set_ylim(size - 0.5, first - 0.5)
    return image


def _name_rows(axes: Axes, labels: Sequence[str]) -> None:
    """Put the names of tasks beside the numbers of a matrix's rows, in up to two lines each."""
    names = [
        "\n".join(textwrap.wrap(shorten(label), NAME_WIDTH, max_lines=2, placeholder="…")) for label in labels
    ]
    axes.set_yticks(range(len(names)), names, fontsize=6.5, linespacing=0.95)
    axes.tick_params(axis="y", pad=18)
    axes.set_anchor("W")  # a square in the middle of its room is laid out as if its names had that room, too
    rows = axes.get_yaxis_transform()
    for task in range(len(names)):
        axes.annotate(str(task + 1), (0, task), (-4, 0), rows, "offset points", ha="right", va="center")


def _draw_curve(axes: Axes, curve: Curve | None, kept: int | None) -> None:
    axes.set_ylim(0, 100)
    axes.grid(axis="y")
    if curve is None or len(curve.rates) == 0:
        return
    low, high = wilson_interval(curve.rates * curve.episodes, curve.episodes)
    colour = LINE_COLOURS[0]
    axes.fill_between(curve.epochs, 100 * low, 100 * high, color=colour, alpha=0.16, lw=0)
    axes.plot(curve.epochs, 100 * curve.rates, color=colour, lw=1.4, marker="o", ms=2.6, clip_on=False)
    ring = curve.epochs == kept
    axes.plot(
        curve.epochs[ring], 100 * curve.rates[ring], "o", ms=6.5, mfc="none", mec=INK, mew=0.9, clip_on=False
    )


def _set_epoch_axis(axes: Axes, last: int, labelbottom: bool) -> None:
    axes.set_xlim(-0.03 * last, 1.03 * last)
    axes.xaxis.set_major_locator(MaxNLocator(4, integer=True))
    axes.tick_params(labelbottom=labelbottom)


def _loss_limits(losses: Mapping[int, tuple[NDArray[np.int64], NDArray[np.float64]]]) -> tuple[float, float]:
    values = np.concatenate([v for _, v in losses.values()]) if losses else np.zeros(0)
    values = values[np.isfinite(values)]
    if len(values) == 0:
        return 0.0, 1.0
    margin = 0.06 * max(float(np.ptp(values)), 1e-6)
    return float(values.min()) - margin, float(values.max()) + margin


def legend_below(figure: Figure) -> None:
    """Put the legend of a figure's labelled lines under it, so that long names take no room from the plot."""
    found = [axes.get_legend_handles_labels() for axes in figure.axes]
    handles = [h for hs, _ in found for h in hs]
    labels = [name for _, names in found for name in names]
    if handles:
        figure.legend(handles, labels, loc="outside lower left", ncols=_legend_columns(labels))


def _legend_columns(labels: Sequence[str]) -> int:
    longest = max((len(name) for name in labels), default=0)
    return max(1, min(4, 88 // (longest + 8)))
