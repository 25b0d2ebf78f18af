"""Reports of synthetic runs: self-contained pages, also of unfinished and damaged runs."""

import base64
import html
import itertools
import json
import os
import re
from collections.abc import Callable, Iterable
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.stats
import yaml
from matplotlib.backends.backend_agg import FigureCanvasAgg
from omegaconf import DictConfig
from PIL import Image

from experiments.comparisons.episodes import read_episodes
from libero_cli.main import main
from libero_env.sim.causes import Failure
from libero_env.tasks import get_suite
from libero_env.text import json_safe
from lifelong.errors import LifelongError
from lifelong.report import page as page_module
from lifelong.report.comparison import Plan, compare
from lifelong.report.export import export_runs, load_runs
from lifelong.report.figures import (
    LINE_MARKERS,
    Line,
    Panel,
    forgetting_figure,
    heatmap_figure,
    learning_figure,
    storage_figure,
)
from lifelong.report.page import comparison_text, write_report
from lifelong.report.runs import group_runs, load_run, short_labels
from lifelong.report.tables import triangle
from lifelong.report.unlike import unlike
from lifelong.results.log import ResultLog
from lifelong.results.records import (
    CostRecord,
    DemonstrationsRecord,
    EvalRecord,
    LossRecord,
    PhaseRecord,
    RunEndRecord,
    TaskEndRecord,
    signed_line,
)
from lifelong.results.summary import summarize
from lifelong.stats.intervals import Estimate
from lifelong.stats.methods import MethodRun, statistics
from lifelong.stats.metrics import METRIC_NAMES, Curve
from tests.harness.browser import PHONE
from tests.harness.configs import composed
from tests.harness.records import run_start

GROCERIES = [
    "alphabet soup", "cream cheese", "salad dressing", "bbq sauce", "ketchup", "tomato sauce", "butter", "milk",
    "chocolate pudding", "orange juice"
]  # fmt: skip
DROPPED, AWAY = (
    Failure("dropped", "thing_0", "floor"),
    Failure("never reached", "thing_0", handled=("thing_1",)),
)
# Algorithm -> success just after learning, and the share of it kept from one task to the next.
CHARACTERS = {"sequential": (0.82, 0.35), "er": (0.74, 0.86), "ewc": (0.5, 0.6), "packnet": (0.68, 1.0)}


def make_run(
    folder: Path,
    algo: str = "er",
    seed: int = 1,
    tasks: int = 10,
    done: int | None = None,
    epochs: tuple[int, ...] = (0, 2, 4, 6, 8, 10),
    order: int = 0,
    data_seed: int | None = None,
    **settings: object,
) -> Path:
    """Write a run directory as an experiment does, with synthetic numbers."""
    rng = np.random.default_rng([seed, data_seed or 0, *algo.encode()])
    names = GROCERIES[:tasks] if tasks <= 10 else [f"thing {i}" for i in range(tasks)]
    names = names[order:] + names[:order]
    sections = {
        "algo": {"name": algo, **settings},
        "train": {"epochs": epochs[-1]},
        "benchmark": {"order": order},
        "data": {"seed": data_seed},
    }
    config, log = {"seed": seed, **sections}, ResultLog(folder / "results.jsonl")
    told = [f"pick up the {name} and place it in the basket" for name in names]
    words = [f"algo={algo}", "+train.note=a b", "runs_dir=/home/me", "eval.sim_threads=2"]
    facts = {"algo": algo, "seed": seed, "data_seed": data_seed, "overrides": words, "config": config}
    log.append(run_start([text.replace(" ", "_") for text in told], instructions=told, **facts))
    (folder / "config.yaml").write_text(yaml.safe_dump(config))
    log.append(PhaseRecord(phase="demos", seconds=310.0))
    top, kept = CHARACTERS[algo]
    level = np.clip(rng.normal(top, 0.12, tasks), 0.1, 1.0)
    for i in range(tasks if done is None else done):
        best = _learn(log, rng, i, level[i], epochs)
        for j in range(i + 1):
            log.append(_evaluation(rng, "matrix", i, best, j, level[j] * kept ** (i - j)))
        log.append(CostRecord(task=i, costs={"parameters": 1.2e6, "flops_per_step": 3.4e10}))
        spent = {"stored_bytes": 2e6 * (i + 1), "kept_share": 100 / (i + 1), "updates": 640, "windows": 999}
        spent |= {"end_task_seconds": 0.7, "parameters_trained": 1.1e6, "flops_per_action": 5e7}
        log.append(CostRecord(task=i, costs=spent))
        log.append(TaskEndRecord(task=i, best_epoch=best, seconds=float(rng.uniform(200, 260))))
    if done is None:
        log.append(RunEndRecord(seconds=2600.0, finished="2026-01-01T12:00:00+00:00"))
    return folder


def make_runs(folder: Path, algos: Iterable[str], seeds: Iterable[int] = (1,), **settings: Any) -> list[Path]:
    """Write a run of each algorithm with each seed."""
    return [make_run(folder / f"{a}{s}", a, s, **settings) for a in algos for s in seeds]


def _learn(
    log: ResultLog, rng: np.random.Generator, task: int, level: float, epochs: tuple[int, ...]
) -> None:
    rates = {}
    for epoch in range(epochs[-1] + 1):
        if epoch:
            loss = -28 + 30 * np.exp(-0.35 * epoch) + rng.normal(0, 0.4)
            log.append(LossRecord(task=task, epoch=epoch, loss=float(loss), seconds=14.0))
        if epoch in epochs:
            record = _evaluation(rng, "curve", task, epoch, task, level * (1 - np.exp(-0.4 * epoch)))
            rates[epoch] = record.rate
            log.append(record)
    return max(rates, key=rates.__getitem__)


def _evaluation(
    rng: np.random.Generator, phase: str, learned: int, epoch: int, task: int, rate: float
) -> EvalRecord:
    wins = rng.random(20) < rate
    lifted = wins | (rng.random(20) < 0.5)
    return EvalRecord(
        phase=phase,
        learned=learned,
        epoch=epoch,
        task=task,
        successes=tuple(bool(w) for w in wins),
        lengths=tuple(int(x) for x in rng.integers(90, 280, 20)),
        init_states=tuple(range(20)),
        seconds=4.0,
        atoms=(f"(In thing_{task} basket_1_contain_region)", f"(Up thing_{task})", "(Close drawer_1)"),
        atoms_at_start=((False, False, True),) * 20,
        atoms_ever=tuple((bool(w), bool(u), True) for w, u in zip(wins, lifted, strict=True)),
        atoms_at_end=tuple((bool(w), bool(w), True) for w in wins),
        failures=tuple(None if w else DROPPED if u else AWAY for w, u in zip(wins, lifted, strict=True)),
    )


def configure(run: Path, **values: object) -> Path:
    """Set keys of a run's configuration, with two underscores for each dot, as if it had been run with them."""
    config = yaml.safe_load((run / "config.yaml").read_text())
    for key, value in values.items():
        *sections, name = key.split("__")
        node = config
        for section in sections:
            node = node.setdefault(section, {})
        node[name] = value
    (run / "config.yaml").write_text(yaml.safe_dump(config))
    return run


def rewrite(run: Path, change: Callable[[dict], dict | None], *kinds: str) -> None:
    """Change the values of a run's records of some kinds, or of all; None removes a record."""
    rows = [json.loads(line) for line in (run / "results.jsonl").read_text().splitlines()]
    rows = [{key: value for key, value in row.items() if key != "crc32"} for row in rows]
    rows = [change(row) if row["kind"] in (kinds or (row["kind"],)) else row for row in rows]
    (run / "results.jsonl").write_bytes(b"".join(map(signed_line, filter(None, rows))))


def add_video(folder: Path, name: str = "task_01_success") -> None:
    (folder / "videos").mkdir(exist_ok=True)
    frames = [Image.new("RGB", (16, 16), (40 * i, 90, 160)) for i in range(4)]
    path = folder / "videos" / f"{name}.gif"
    frames[0].save(path, save_all=True, append_images=frames[1:])


class Page(HTMLParser):
    """Parses a page: its text, the files it loads, and whether every element is closed."""

    VOID = ("meta", "img", "br", "link", "input", "line")

    def __init__(self, text: str):
        super().__init__()
        self.loads: list[str] = []
        self.words: list[str] = []
        self.titles: list[str] = []
        self.open: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = dict(attrs)
        self.loads += [v for k in ("src", "xlink:href", "data") if (v := values.get(k))]
        self.loads += [v] if tag == "link" and (v := values.get("href")) else []
        self.titles += [v] if (v := values.get("title")) else []
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        if tag not in self.VOID:
            self.open.pop()

    def handle_endtag(self, tag: str) -> None:
        assert self.open and self.open.pop() == tag, f"</{tag}> closes nothing"

    def handle_data(self, data: str) -> None:
        self.words.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).split())


@pytest.fixture
def no_papers(monkeypatch):
    """Write no figures beside a page, which a test does not look at."""
    monkeypatch.setattr(page_module, "save", lambda figure, stem: None)


undrawn = pytest.mark.usefixtures("no_papers")


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = make_run(tmp_path_factory.mktemp("er"), tasks=4)
    add_video(folder)
    write_report([folder])
    return folder


def test_the_page_loads_no_other_file(finished: Path):
    page = Page((finished / "report.html").read_text())
    assert page.open == []
    assert page.loads and all(v.startswith(("data:", "#")) for v in page.loads)
    assert "@import" not in (finished / "report.html").read_text()
    assert (finished / "heatmap.pdf").read_bytes().startswith(b"%PDF")


def test_a_run_reads_on_a_phone(finished: Path, tab):
    assert tab.faults_on_a_phone(finished / "report.html") == []
    rows = tab.evaluate(
        "[...document.querySelectorAll('table.metrics tbody tr')].map(row => [...row.cells].map(c => "
        "(({left, right, top, bottom}) => [left, right, top, bottom])(c.getBoundingClientRect())))"
    )
    assert len(rows) == len(METRIC_NAMES)
    for name, *_, meaning in rows:
        assert meaning[2] >= name[3], "the meaning stands below the name"
        assert 0 <= meaning[0] < meaning[1] <= PHONE
        assert meaning[3] - name[2] < 150, "a row is not much taller than its text"
    cells = tab.evaluate(
        "[...document.querySelectorAll('table.heat td')].map(c => c.getBoundingClientRect().right)"
    )
    assert cells and max(cells) <= PHONE, "the matrix is seen as a whole"


def test_the_page_describes_the_whole_run(finished: Path):
    raw = (finished / "report.html").read_text()
    text = Page(raw).text
    assert "python train.py algo=er &#39;+train.note=a b&#39;<" in raw, "without what changes no result"
    for message in ("er on libero_object", "FWT", "NBT", "AUC", "Just learned", "demos 5 min 10 s", "mujoco"):
        assert message in text
    assert "pick up the cream cheese and place it in the basket" in text
    assert "task 01 success" in text and "epochs: 10" in text
    assert "not finished" not in text
    assert "Why rollouts failed" in text and "Never reached" in text and "Interference" in text


def test_the_heatmap_shows_the_matrix(finished: Path):
    run = load_run(finished)
    page = Page((finished / "report.html").read_text())
    hints = [t for t in page.titles if t.startswith("after task")]
    assert len(hints) == 10  # the upper triangle is blank
    rates, _ = run.results.success_matrix()
    assert f"on task 2 (cream cheese): {100 * rates[3, 1]:.0f} %" in hints[7]
    assert f"{round(20 * rates[3, 1])} of 20 episodes" in hints[7]


@pytest.mark.parametrize(
    "suite, tasks", [("libero_goal", 10), ("libero_object", 10), ("libero_90", 12), ("libero_goal", 2)]
)
def test_a_heatmap_names_its_tasks_apart_and_inside_of_the_picture(suite: str, tasks: int):
    labels = [task.language for task in get_suite(suite).tasks[:tasks]]
    figure = heatmap_figure([Panel(suite, np.tril(np.ones((tasks, tasks))), labels)])
    FigureCanvasAgg(figure).draw()
    names = [label.get_text() for label in figure.axes[0].get_yticklabels()]
    assert all(name.count("\n") <= 1 and max(map(len, name.split("\n"))) <= 24 for name in names)
    assert len(set(names)) == len(set(labels))
    drawn, whole = figure.get_tightbbox(), figure.bbox_inches
    assert min(drawn.x0, drawn.y0, whole.x1 - drawn.x1, whole.y1 - drawn.y1) >= -0.02


def test_the_same_results_give_the_same_page(finished: Path, tmp_path: Path):
    out = write_report([finished], tmp_path / "again.html")
    assert out.read_bytes() == (finished / "report.html").read_bytes()


@pytest.mark.parametrize("done", [0, 2])
def test_an_unfinished_run_is_reported(tmp_path: Path, done: int):
    folder = make_run(tmp_path / "run", tasks=3, done=done)
    with open(folder / "results.jsonl", "ab") as file:
        file.write(b'{"kind": "eval", "pha')
    page = Page(write_report([folder]).read_text())
    assert f"not finished: {done} of 3 tasks are learned" in page.text and page.open == []
    assert ("None yet" in page.text) == (done == 0)


@undrawn
def test_invalid_lines_and_a_missing_config_are_noted_on_the_page(tmp_path: Path):
    folder = make_run(tmp_path / "run", tasks=2)
    lines = (folder / "results.jsonl").read_text().splitlines()
    (folder / "results.jsonl").write_text("\n".join([*lines[:4], "<b>oops</b>", *lines[4:]]) + "\n")
    (folder / "config.yaml").unlink()
    raw = write_report([folder]).read_text()
    assert "results.jsonl:5: not JSON" in Page(raw).text and "config.yaml is missing" in Page(raw).text


@undrawn
def test_the_page_of_several_runs_has_a_folder_that_git_ignores(tmp_path: Path, monkeypatch):
    runs = [make_run(tmp_path / "runs" / a, a, tasks=2) for a in ("er", "ewc")]
    monkeypatch.chdir(tmp_path)
    assert write_report(runs) == tmp_path / "comparison" / "report.html"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["comparison", "runs"]
    assert (tmp_path / "comparison" / ".gitignore").read_text() == "*\n"


@undrawn
def test_two_runs_of_one_seed_count_once(tmp_path: Path):
    first, again = (make_run(tmp_path / name, "er", 1, tasks=2) for name in ("first", "again"))
    partial = make_run(tmp_path / "partial", "er", 1, tasks=2, done=1)
    other = make_run(tmp_path / "other", "er", 2, tasks=2)
    (group,) = group_runs([load_run(p) for p in (first, again, partial, other)])
    assert len(group.runs) == 2 and {r.record.seed for r in group.runs} == {1, 2}
    assert partial in {r.path for r in group.repeats} and len(group.repeats) == 2
    page = Page(write_report([first, partial, other], tmp_path / "out").read_text())
    assert "../partial: a further run of seed 1 of er; it is not counted" in page.text


def test_runs_that_differ_in_any_setting_are_methods_of_their_own(tmp_path: Path):
    """In each top-level section of a configuration that decides results, and in keys like those of machines."""
    sections = {str(key) for key, value in composed().items() if isinstance(value, DictConfig)} - {"tracker"}
    keys = ["policy__temporal__drop_path", "stream__perturb_seed", "policy__path", "algo__dir"]
    for key in [*keys, *(f"{name}__strange" for name in sorted(sections))]:
        runs = [make_run(tmp_path / key / str(n), "er", 1, tasks=2) for n in (0, 1)]
        for number, run in enumerate(runs):
            configure(run, **{key: number / 10})
        assert len(group_runs([load_run(run) for run in runs])) == 2, key
    configure(runs[1], **{key: 0})
    assert len(group_runs([load_run(run) for run in runs])) == 1, "0.0 and 0 are one value"


@undrawn
def test_intervals_stay_where_the_metric_can_be(tmp_path: Path, monkeypatch):
    """Two episodes that both failed, with two seeds: the interval starts at 0 and has a width."""
    monkeypatch.setitem(CHARACTERS, "er", (0.0, 1.0))

    def failed(row: dict) -> dict:
        few = {k: v[:2] for k, v in row.items() if k.startswith("atoms_") or k == "failures"}
        return row | {**few, "successes": [False] * 2, "lengths": [9, 9], "init_states": [0, 1]}

    runs = [make_run(tmp_path / str(seed), "er", seed, tasks=2) for seed in (1, 2)]
    for run in runs:
        rewrite(run, failed, "eval")
    page = write_report(runs, tmp_path / "out")
    found = json.loads((page.parent / "comparison.json").read_text())
    metrics = found["groups"]["er"]["metrics"]
    assert (metrics["nbt"]["low"], metrics["nbt"]["high"]) == (0, 0)
    assert all(m["low"] == m["mean"] == 0 < m["high"] < 1 for name, m in metrics.items() if name != "nbt")


def test_long_names_do_not_squeeze_the_plot(tmp_path: Path):
    names = [f"er (policy bc_transformer_small, memory {i}00, epochs 50)" for i in range(3)]
    for labels in (names, ["a", "b"]):
        figure = forgetting_figure([Line(name, np.full((1, 4), 0.5)) for name in labels])
        FigureCanvasAgg(figure).draw()
        box = figure.axes[0].get_position()
        assert box.width > 0.85 and box.height * figure.get_size_inches()[1] > 1.9


def test_tasks_that_are_learned_together_leave_no_empty_rows():
    rates = np.full((10, 10), np.nan)
    for row in range(5, 10):
        rates[row, : row + 1] = 1.0
    panel = Panel("er", rates, [str(task) for task in range(10)])
    full = replace(panel, rates=np.tril(np.ones((10, 10))))
    heatmap, whole = (heatmap_figure([one] * 5) for one in (panel, full))
    for figure in (heatmap, whole):
        FigureCanvasAgg(figure).draw()
    axes = heatmap.axes[0]
    assert axes.get_ylim() == (9.5, 4.5)
    assert [t.get_text() for t in axes.get_yticklabels()] == ["6", "7", "8", "9", "10"]
    assert whole.axes[0].get_ylim() == (9.5, -0.5)
    assert heatmap.get_size_inches()[1] < 0.7 * whole.get_size_inches()[1]
    line = forgetting_figure([Line("er", rates[:, :1].T)])
    assert list(line.axes[0].get_xticks()) == [6, 7, 8, 9, 10]


def test_no_two_of_twenty_lines_look_the_same():
    figure = forgetting_figure([Line(str(n), np.full((1, 4), 0.5)) for n in range(20)])
    looks = {
        (line.get_color(), line.get_linestyle(), line.get_marker(), line.get_markerfacecolor())
        for line in figure.axes[0].lines
    }
    assert len(looks) == 20


@undrawn
def test_all_pairs_are_a_triangle_and_oracles_and_memory_have_columns(tmp_path: Path):
    runs = make_runs(tmp_path, ("ewc", "er", "packnet"), (1, 2, 3), tasks=3)
    out = write_report(runs, tmp_path / "compared", Plan(all_pairs=True))
    found = json.loads((out.parent / "comparison.json").read_text())
    rows, labels = triangle(found, "auc"), list(found["groups"])
    assert [row["label"] for row in rows] == labels[:2]
    shown = [[m and m["value"] for m in row["cells"]] for row in rows]
    mean = [found["groups"][label]["metrics"]["auc"]["mean"] for label in labels]
    assert shown[0] == pytest.approx([mean[0] - mean[1], mean[0] - mean[2]]) and min(shown[0]) >= 0
    assert shown[1][0] is None and shown[1][1] == pytest.approx(mean[1] - mean[2])
    assert {label for label, g in found["groups"].items() if g["told_task"]} == {"packnet"}
    text = Page(out.read_text()).text
    assert "Task told" in text and "AUC: all pairs" in text and "standard error" not in text
    assert triangle(found | {"differences": found["differences"][:2]}, "auc") == []  # not all pairs


@undrawn
def test_orders_and_demonstrations_are_factors_apart_from_the_seed(tmp_path: Path):
    runs = [
        make_run(tmp_path / f"{seed}{data}{order}", "er", seed, tasks=3, data_seed=data, order=order)
        for seed, data, order in itertools.product((1, 2), (3, 4), (0, 1))
    ]
    (group,) = group_runs([load_run(run) for run in runs])
    assert len(group.runs) == 8 and not group.repeats
    out = write_report(runs, tmp_path / "compared")
    found = json.loads((out.parent / "comparison.json").read_text())["groups"]["er"]
    auc = {(r.record.seed, r.record.data_seed, r.record.tasks): r.metrics.auc.value for r in group.runs}
    units = np.reshape(list(auc.values()), (2, 4)).mean(0)  # means over the seeds of each order and set
    assert found["metrics"]["auc"]["values"] == pytest.approx(units)
    seeds = np.reshape(list(auc.values()), (2, 4)).var(0, ddof=1).mean()
    assert found["spreads"]["seed"]["auc"] == pytest.approx(np.sqrt(seeds))
    data = np.reshape(list(auc.values()), (2, 2, 2)).var(1, ddof=1).mean()
    assert found["spreads"]["demonstrations"]["auc"] == pytest.approx(np.sqrt(data))
    assert "Order of tasks" in Page(out.read_text()).text
    again = [results.run for _, results in read_episodes(out.parent / "episodes.csv.gz")]
    assert {(run.seed, run.data_seed, run.tasks) for run in again} == set(auc)


@undrawn
def test_conventions_of_other_papers_are_compared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(CHARACTERS, "single_task", (0.8, 1.0))
    runs = make_runs(tmp_path, ("er", "single_task"), (1, 2, 3), tasks=3)
    out = write_report(runs, tmp_path / "compared")
    groups = json.loads((out.parent / "comparison.json").read_text())["groups"]
    er = [load_run(run).results for run in runs[:3]]
    found = groups["er"]["other_conventions"]
    of_others = ("bwt", "forgetting", "nbt_of_followed", "relative_nbt", "intransigence")
    assert set(found) == set(of_others), "none unseen"
    assert found["bwt"]["mean"] == pytest.approx(np.mean([r.other_conventions()["bwt"] for r in er]))
    alone = np.mean([np.diag(load_run(run).results.success_matrix()[0]) for run in runs[3:]], axis=0)
    learned = np.mean([np.diag(r.success_matrix()[0]) for r in er], axis=0)
    assert found["intransigence"]["mean"] == pytest.approx((alone - learned).mean())
    own = groups["single_task"]["other_conventions"]["intransigence"]
    assert own == {"mean": 0, "half_width": 0}  # by seed
    assert "relative nbt" in Page(out.read_text()).text


def test_intransigence_is_against_runs_of_the_same_settings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(CHARACTERS, "my_own", (0.8, 1.0))
    runs = [make_run(tmp_path / a, a, tasks=2) for a in ("er", "my_own")]
    target = "lifelong.algorithms.single_task.SingleTask"
    configure(runs[1], algo___target_=target, train__epochs=99)
    er = group_runs([load_run(run) for run in runs])
    assert "intransigence" not in compare(er)["groups"]["er"]["other_conventions"]
    assert {group.label: group.told_task for group in er} == {"er": False, "my_own": True}
    configure(runs[1], train__epochs=10)
    again = compare(group_runs([load_run(run) for run in runs]))["groups"]
    assert "intransigence" in again["er"]["other_conventions"]
    assert again["my_own"]["other_conventions"]["intransigence"]["mean"] == 0


def together(
    folder: Path, algo: str, rates: dict[tuple[int, int], float], sizes: tuple[int, ...] = ()
) -> Path:
    """Write a run of four tasks with the given success (row, task), and 60 s of training for each row."""
    log, rng = ResultLog(folder / "results.jsonl"), np.random.default_rng(0)
    names = [f"put_it_there_{n}" for n in range(4)]
    log.append(run_start(names, algo=algo, group_sizes=sizes, config={}))
    for (row, task), rate in rates.items():
        log.append(replace(_evaluation(rng, "matrix", row, 1, task, rate), seconds=0.0))
    for row in sorted({row for row, _ in rates}):
        log.append(LossRecord(task=row, epoch=1, loss=1.0, seconds=60.0))
        log.append(CostRecord(task=row, costs={"parameters": 10.0 * (row + 1)}))
        log.append(TaskEndRecord(task=row, best_epoch=1, seconds=60.0))
    return folder


@undrawn
def test_tasks_that_are_learned_together_share_their_costs_and_have_an_intransigence(tmp_path: Path):
    pairs = {(1, 0): 1.0, (1, 1): 0.0} | {(3, task): 1.0 for task in range(4)}
    joint = together(tmp_path / "multitask", "multitask", {(3, task): 1.0 for task in range(4)})
    runs = [together(tmp_path / "er", "er", pairs, (2, 2)), joint]
    found = compare(group_runs([load_run(run) for run in runs]))["groups"]
    assert found["er"]["other_conventions"]["intransigence"]["mean"] == 1 / 4
    assert found["er"]["costs"]["training_seconds"] == 30 and found["er"]["costs"]["parameters"] == 30
    assert found["multitask"]["costs"]["training_seconds"] == 15
    text = [Page(write_report([run]).read_text()).text for run in runs]
    assert "1 to 2, together 1 min 00 s" in text[0] and "1 to 4, together 1 min 00 s" in text[1]


def test_auc_stands_against_what_is_stored():
    points = {str(n): (1e3 * n, Estimate(0.5, 0.4, 0.6)) for n in range(20)}
    figure = storage_figure(points)
    drawn = [line for line in figure.axes[0].lines if line.get_marker() in LINE_MARKERS]
    assert [line.get_xdata()[0] for line in drawn] == [size for size, _ in points.values()]


@pytest.mark.parametrize("least", [1.0, 6.2e5, 1e6, 9.9e6])
def test_ticks_of_what_is_stored_do_not_touch(least):
    figure = storage_figure({"none": (0.0, Estimate(0.2, 0.1, 0.3)), "little": (least, Estimate(0.7, 0.6, 0.8)),
                             "much": (2.5e8, Estimate(0.8, 0.7, 0.9))})  # fmt: skip
    figure.draw_without_rendering()
    ends = [tick.label1.get_window_extent() for tick in figure.axes[0].xaxis.get_major_ticks()]
    assert all(left.x1 < right.x0 for left, right in itertools.pairwise(ends) if right.width)


@pytest.fixture(scope="module")
def compared(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict]:
    """Two methods with three seeds each."""
    folder = tmp_path_factory.mktemp("compared")
    runs = make_runs(folder, ("ewc", "er"), (1, 2, 3), tasks=3)
    page = write_report(runs, folder / "all")
    return page, json.loads((page.parent / "comparison.json").read_text())


def test_a_comparison_reads_on_a_phone(compared: tuple[Path, dict], tab):
    assert tab.faults_on_a_phone(compared[0]) == []


def test_a_comparison_is_a_page_with_files_beside_it(compared: tuple[Path, dict]):
    page, figures = Page(compared[0].read_text()), ("heatmap", "forgetting", "storage")
    assert page.open == [] and "2 methods on libero_object" in page.text
    assert len(re.findall(r"\[[−\d]+, \d+\]", page.text)) >= 2 * 5
    drawn = {f"{figure}.{kind}" for figure in figures for kind in ("png", "pdf")}
    files = {"report.html", "comparison.json", "episodes.csv.gz"}
    assert {p.name for p in compared[0].parent.iterdir()} == files | drawn


def test_means_and_intervals_of_the_comparison(compared: tuple[Path, dict]):
    _, found = compared
    assert [(len(g["runs"]), g["orders"]) for g in found["groups"].values()] == [(3, 1), (3, 1)]
    for group in found["groups"].values():
        for name in METRIC_NAMES:
            metric = group["metrics"][name]
            values = np.array(metric["values"])
            assert metric["mean"] == pytest.approx(values.mean())
            assert metric["standard_error"] == pytest.approx(values.std(ddof=1) / np.sqrt(len(values)))
            assert metric["low"] < metric["mean"] < metric["high"]
    (difference,) = found["differences"]
    assert (difference["of"], difference["less"]) == ("er", "ewc")  # best AUC first
    final = difference["metrics"]["final_success"]
    means = [found["groups"][n]["metrics"]["final_success"]["mean"] for n in ("er", "ewc")]
    assert final["value"] == pytest.approx(means[0] - means[1])
    assert 0 < final["low"] < final["value"] < final["high"]  # made so: er keeps more


def test_the_table_of_episodes_gives_the_same_numbers(compared: tuple[Path, dict]):
    page, found = compared
    methods: dict[str, list[MethodRun]] = {}
    for label, results in read_episodes(page.parent / "episodes.csv.gz"):
        member = MethodRun(results.scores(), results.run.seed, results.run.tasks, results.run.data_seed)
        methods.setdefault(label, []).append(member)
    again = json.loads(json.dumps(json_safe(statistics(methods))))
    assert again["differences"] == found["differences"]
    assert again["metrics"] == {label: g["metrics"] for label, g in found["groups"].items()}


def test_forgetting_by_task_and_by_subgoal(compared: tuple[Path, dict]):
    page, found = compared
    er = found["groups"]["er"]
    soup = "pick_up_the_alphabet_soup_and_place_it_in_the_basket"
    runs = [load_run(page.parent / p) for p in er["runs"]]
    places = [(r, r.record.tasks.index(soup)) for r in runs]
    drops = [r.metrics.nbt_by_task[k] for r, k in places if k < 2]
    assert er["forgetting_by_task"][soup]["mean"] == pytest.approx(np.mean(drops))
    assert set(er["subgoals"]) == {"In", "Up"}  # the drawer is closed from the start
    assert found["groups"]["ewc"]["subgoals"]["In"]["forgotten"]["mean"] > 0.1
    text = Page(page.read_text()).text
    assert "Forgetting by task" in text and "task 2" not in text
    by_seed = found["differences"][0]["metrics"]["final_success"]["by_seed"]
    assert ", ".join(f"{100 * d:.1f}" for d in by_seed).replace("-", "−") in text


def test_a_task_that_is_learned_twice_is_one_value_of_a_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(globals(), "GROCERIES", ["milk", "butter", "milk", "soup"])
    run = load_run(make_run(tmp_path, tasks=4))
    milk, *_ = compare(group_runs([run]))["groups"]["er"]["forgetting_by_task"].values()
    assert milk["mean"] == pytest.approx(run.metrics.nbt_by_task[[0, 2]].mean())
    assert np.isnan(milk["half_width"])


def test_costs_are_in_both_kinds_of_page(compared: tuple[Path, dict], finished: Path):
    page, found = compared
    assert found["groups"]["er"]["costs"]["stored_bytes"] == 6e6  # after the last of three tasks
    for text in (Page(page.read_text()).text, Page((finished / "report.html").read_text()).text):
        for message in ("Costs", "34.0 GFLOP", "50.0 MFLOP", "1.20 M", "6.00 MB", "0.7 s", "33.3 %", "640"):
            assert message in text, message
    shares = Page(page.read_text()).text.count("33.3 %")
    assert shares == 2 * len(found["groups"]), "beside success, and in the costs"


@undrawn
def test_subgoals_are_on_the_page_unless_records_are_old(finished: Path, tmp_path: Path):
    text = Page((finished / "report.html").read_text()).text
    assert "Subgoals" in text and "In thing_0 basket_1_contain_region" in text
    assert "held from the start" in text
    old = make_run(tmp_path / "old", tasks=2)
    rewrite(old, lambda _: None, "cost")
    rewrite(old, lambda row: {k: v for k, v in row.items() if not k.startswith("atoms")})
    assert load_run(old).results.problems == ()
    text = Page(write_report([old]).read_text()).text
    assert "Subgoals" not in text and "Costs" not in text and "FWT" in text


@undrawn
def test_saliency_is_on_the_page(tmp_path: Path):
    folder = make_run(tmp_path / "run", tasks=2)
    assert ">Saliency</h2>" not in write_report([folder]).read_text()
    (folder / "saliency").mkdir()
    Image.new("RGB", (8, 8)).save(folder / "saliency" / "task_01_after_01.png")
    (folder / "saliency" / "task_01_after_01.txt").write_text("at the cheese")
    text = Page(write_report([folder]).read_text()).text
    assert "Saliency" in text and "at the cheese" in text


def test_runs_that_differ_in_more_than_their_seed_are_not_averaged(tmp_path: Path):
    runs = make_runs(tmp_path / "few", ["ewc"], (1, 2), tasks=2, strength=10)
    runs += make_runs(tmp_path / "many", ["ewc"], tasks=2, strength=500)
    groups = group_runs([load_run(r) for r in runs])
    assert [(g.label, len(g.runs)) for g in groups] == [("ewc (strength 10)", 2), ("ewc (strength 500)", 1)]


@pytest.mark.parametrize("key", ["open_environments", "sim_threads", "record_every", "shift"])
def test_keys_that_change_no_result_make_no_method(key: str, tmp_path: Path):
    runs = [make_run(tmp_path / str(seed), "er", seed, tasks=1, epochs=(0, 1)) for seed in (1, 2)]
    value = {"camera": 1} if key == "shift" else 7
    configure(runs[0], **{f"eval__{key}": value}, data__folder="elsewhere", language__cache_dir="x")
    assert len(group_runs([load_run(run) for run in runs])) == 1


def test_runs_of_one_seed_that_learned_from_two_folders_are_two_methods(tmp_path: Path):
    runs = []
    for folder, digest in (("moved", "aa"), ("human", "bb"), (None, "aa")):
        for seed in (1, 2):
            run = make_run(tmp_path / f"{folder}{seed}", "er", seed, tasks=1, epochs=(0, 1))
            runs.append(configure(run, data__folder=folder))
            record = DemonstrationsRecord(counts=(50,), generators=("",), digests=(digest,))
            ResultLog(run / "results.jsonl").append(record)
    assert [group.label for group in group_runs([*map(load_run, runs[2:])])] == ["er (folder human)", "er"]
    assert [len(group.runs) for group in group_runs([*map(load_run, runs[2:])])] == [2, 2]
    (group,) = group_runs([*map(load_run, runs[:2]), *map(load_run, runs[4:])])
    assert (len(group.runs), len(group.repeats)) == (2, 2)


def test_a_setting_that_is_not_named_is_as_one_that_is_null(tmp_path: Path):
    """Older runs lack the keys of newer ones, and without a seed the expert records with seed 0."""
    runs = [make_run(tmp_path / str(seed), "er", seed, tasks=1, epochs=(0, 1)) for seed in (1, 2)]
    runs.append(make_run(tmp_path / "named", "er", 2, tasks=1, epochs=(0, 1), data_seed=0))
    configure(runs[2], data__statistics=None, algo__share=None)
    (group,) = group_runs([load_run(run) for run in runs])
    assert (len(group.runs), len(group.repeats)) == (2, 1)


@undrawn
def test_runs_of_one_seed_from_two_starts_are_two_in_the_table_of_episodes(tmp_path: Path):
    runs = [make_run(tmp_path / str(n), "er", 1, tasks=1, epochs=(0, 1)) for n in (1, 2)]
    for number, run in enumerate(runs):
        configure(run, init_from=f"runs/seed{number}")
    page = write_report(runs, tmp_path / "out")
    again = [results.success_matrix()[1] for _, results in read_episodes(page.parent / "episodes.csv.gz")]
    assert again == [[[20]], [[20]]]


@pytest.mark.parametrize("words, message", [
    (["--reference", "er", "--margin", "0.2"], "--reference, --margin: a single run"),
    (["--all-pairs", "--other-worlds"], "--all-pairs, --other-worlds: a single run"),
    (["OTHER", "--all-pairs", "--reference", "er"], "--all-pairs and --reference er name different pairs"),
])  # fmt: skip
def test_options_of_a_comparison_without_effect_are_refused(words, message, finished: Path, tmp_path, capsys):
    other = make_run(tmp_path / "ewc", "ewc", tasks=4)
    words = [str(other) if word == "OTHER" else word for word in words]
    assert main(["report", str(finished), *words, "--out", str(tmp_path / "out")]) == 2
    assert message in capsys.readouterr().err and not (tmp_path / "out" / "report.html").exists()


def test_no_two_methods_have_one_label(tmp_path: Path):
    """Or one would take the place of the other in every table."""
    runs = []
    for number in range(32):
        values = {key: number >> bit & 1 for bit, key in enumerate("abcd")} | {"e": (1, "1")[number >> 4]}
        runs.append(make_run(tmp_path / str(number), "er", 1, tasks=1, epochs=(0, 1), **values))
    labels = [group.label for group in group_runs([load_run(run) for run in runs])]
    assert len(set(labels)) == 32, labels


@undrawn
def test_runs_that_learned_from_other_demonstrations_are_told(tmp_path: Path):
    kinds = {"old": "ab", "older": "ab", "new": "ac", "fewer": "de", "seed": "fg"}  # digests of two tasks
    runs = []
    for number, (name, digests) in enumerate(kinds.items()):
        data_seed = 2 if name == "seed" else None  # which asks for others
        algo, counts = ("ewc", "er")[number % 2], (10, 10) if name == "fewer" else (50, 50)
        runs.append(make_run(tmp_path / name, algo, number, tasks=2, data_seed=data_seed))
        makers = ("expert-4", f"expert-{4 + (name == 'new')}")
        record = DemonstrationsRecord(counts=counts, generators=makers, digests=(*digests,))
        ResultLog(runs[-1] / "results.jsonl").append(record)
    runs.append(make_run(tmp_path / "unknown", "er", 9, tasks=2))
    page = write_report(runs, tmp_path / "report.html")
    told = [line for line in comparison_text(page) if "other demonstrations" in line]
    first, second = load_run(runs[0]).record.tasks
    than = "than er seed 1, ewc seed 0 (50 a task by expert-4): a difference between them may be due to that."
    assert told == [
        f"er seed 3 learned from other demonstrations of {first}, {second} (10 a task by expert-4) {than}",
        f"ewc seed 2 learned from other demonstrations of {second} (50 a task by expert-5) {than}",
    ]
    assert told[0] in page.read_text(), "an older record says nothing"
    assert "other demonstrations" not in "".join(comparison_text(write_report(runs[:2], tmp_path)))


@undrawn
def test_a_run_says_in_what_its_demonstrations_differ(tmp_path: Path):
    """From each other, and from what it was evaluated with."""
    run = make_run(tmp_path / "run", tasks=2)
    versions, tasks = load_run(run).record.versions, load_run(run).record.tasks
    here = f"{versions.get('models')} {versions.get('models_digest')}"
    known = {"counts": (5, 5), "digests": ("aa", "bb"), "models": (here, here), "labels": ("intended",) * 2}
    for changed, line in (
        ({"generators": ("expert-4", "expert-4")}, None),
        ({"generators": ("expert-4", "")}, f"in expert: expert-4 of {tasks[0]}, not stated of {tasks[1]}."),
        ({"labels": ("intended", "executed")}, f"labels: intended of {tasks[0]}, executed of {tasks[1]}."),
        ({"models": (here, "moon 00")}, f"show the models moon 00; it was evaluated on {here}."),
        ({"models": (), "labels": ()}, None),  # as before they were noted
    ):
        values = {"generators": ("expert-4",) * 2, **known, **changed}
        ResultLog(run / "results.jsonl").append(DemonstrationsRecord(**values))
        notes = [note for note in load_run(run).notes if "emonstrations" in note]
        assert (not notes) if line is None else any(line in note for note in notes), notes
        assert line is None or line in Page(write_report([run], tmp_path / "out.html").read_text()).text


def test_runs_of_different_progress_and_length_compare(tmp_path: Path):
    runs = [make_run(tmp_path / "a", "er", 1, tasks=3), make_run(tmp_path / "b", "er", 2, tasks=3, done=1)]
    runs.append(make_run(tmp_path / "c", "ewc", 1, tasks=3, done=0))
    page = Page(write_report(runs, tmp_path / "out.html").read_text())
    assert "1 of 3" in page.text and "0 of 3" in page.text
    runs = [make_run(tmp_path / "3", tasks=3), make_run(tmp_path / "4", seed=2, tasks=4, done=3)]
    for run in runs:  # nothing else tells that they are no runs of one method
        (run / "config.yaml").unlink()
    assert [group.label for group in group_runs([*map(load_run, runs)])] == ["er (tasks 3)", "er (tasks 4)"]


@undrawn
def test_a_run_behind_the_others_of_its_method_is_not_counted(tmp_path: Path):
    runs = [make_run(tmp_path / f"{a}{s}", a, s, tasks=2) for a, s in (("er", 1), ("ewc", 1), ("ewc", 2))]
    runs.append(make_run(tmp_path / "er2", "er", 2, tasks=2, done=1))
    page = write_report(runs, tmp_path / "out")
    line = "er seed 2 has learned 1 of 2 tasks; it is not counted."
    found = json.loads((page.parent / "comparison.json").read_text())
    assert line in comparison_text(page) and line in page.read_text() and line in found["conditions"]
    er = found["groups"]["er"]
    assert er["seeds"] == [1] and er["metrics"]["auc"]["values"] == [load_run(runs[0]).metrics.auc.value]
    assert len(read_episodes(page.parent / "episodes.csv.gz")) == 3
    latex = export_runs([tmp_path], "latex", tmp_path / "runs.tex").read_text()
    assert f"% left out, not finished: {runs[-1]}: 1 of 2 tasks learned\n" in latex and "er & 1 & " in latex
    table = load_runs(tmp_path)
    assert [Path(path).name for path in table.path[~table.counted]] == ["er2"]
    told = comparison_text(write_report(runs[1:], tmp_path / "apart"))
    assert "Runs differ in tasks learned (1 of 2: er seed 2; 2 of 2: ewc seed 1, ewc seed 2)." in told


@pytest.mark.parametrize(
    "key, value, told",
    [
        ("seed", 3, "The seeds differ between methods: er against ewc."),
        ("benchmark__order", 1, "The tasks or their orders differ between methods: er against ewc."),
        ("data__seed", 5, "The seeds of the demonstrations (data.seed) differ between methods: er against"),
        ("init_from", "runs/base", "init_from (None of er, runs/base of ewc)"),
        ("data__perturb", {"camera": 0.5}, "data.perturb.camera (None of er, 0.5 of ewc)"),
        ("eval__select", None, None),
    ],
)
def test_what_differs_between_all_runs_of_two_methods_is_told(
    key: str, value, told: str | None, tmp_path: Path
):
    facts = {key.split("__")[1]: value} if key == "benchmark__order" else {}
    facts |= {"data_seed": value} if key == "data__seed" else {}
    other = value if key == "seed" else 2
    runs = make_runs(tmp_path, ["er"], (1, 2), tasks=2)
    runs += [
        configure(run, **{key: value}) for run in make_runs(tmp_path, ["ewc"], (1, other), tasks=2, **facts)
    ]
    groups = group_runs([load_run(configure(run, data__memory=str(n))) for n, run in enumerate(runs)])
    lines = [line for line in unlike(groups) if not line.startswith("No record tells")]
    assert len(lines) == bool(told) and (told or "") in "".join(lines)


def test_a_sample_of_cells_that_all_seeds_share_is_told(tmp_path: Path):
    told = "The same cells are sampled in all runs of er: what NBT and AUC miss by that is in no interval"
    runs = [load_run(make_run(tmp_path / str(seed), "er", seed, tasks=2)) for seed in (1, 2)]
    for seeds, same in (((None, None), True), ((7, 7), True), ((1, 2), False)):
        facts = [{"cells": "sampled", "cells_share": 0.5, "cells_seed": seed} for seed in seeds]
        found = [replace(run, record=replace(run.record, **of)) for run, of in zip(runs, facts, strict=True)]
        assert any(line.startswith(told) for line in unlike(group_runs(found))) == same
    other = replace(found[0], record=replace(found[0].record, algo="ewc", cells_seed=9))
    against = "The seeds of the sampled cells (eval.cells_seed) differ between methods: er against ewc."
    assert against in unlike(group_runs([found[0], other]))


def test_runs_of_a_method_that_learn_different_tasks_are_told(tmp_path: Path):
    told = "The runs of er learn 2 different sets of tasks."
    first, second = (load_run(make_run(tmp_path / str(n), "er", n, tasks=2, order=n)) for n in (0, 1))
    assert told not in unlike(group_runs([first, second]))
    others = replace(second.record, tasks=(first.record.tasks[0], "another"))
    assert told in unlike(group_runs([first, replace(second, record=others)]))


def test_the_start_of_a_run_that_its_methods_name_tells_is_not_told_again(tmp_path: Path):
    runs = [make_run(tmp_path / name, "er", 1, tasks=2) for name in "ab"]
    groups = group_runs([load_run(runs[0]), load_run(configure(runs[1], init_from="base"))])
    assert [group.label for group in groups] == ["er", "er (init_from base)"]
    assert not any("Settings" in line for line in unlike(groups))


def test_long_sequences_fit(tmp_path: Path):
    text = write_report([make_run(tmp_path / "run", tasks=21, epochs=(0, 1))]).read_text()
    assert Page(text).open == []
    assert text.count("<summary>21 tasks</summary>") == 2 and "<summary>22 rows</summary>" in text  # folded
    assert re.findall(r'class="no">(\d*)<', text) == [str(n) if n % 10 == 0 else "" for n in range(1, 22)]


def test_paths_that_are_no_runs_are_named(tmp_path: Path):
    told = {"nowhere": "no such run", "empty": "results.jsonl is missing", "begun": "no 'run' record"}
    for name in ("empty", "begun"):
        (tmp_path / name).mkdir()
    (tmp_path / "begun" / "results.jsonl").write_text("")
    for name, words in told.items():
        with pytest.raises(LifelongError, match=f"{re.escape(str(tmp_path / name))}.*{words}"):
            write_report([tmp_path / name])
    with pytest.raises(LifelongError, match="no run directory given"):
        write_report([])


@undrawn
def test_media_above_the_limit_are_omitted_by_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    folder = make_run(tmp_path / "run", tasks=2)
    for name in ("a", "b"):
        add_video(folder, name)
    (folder / "videos" / "a.txt").write_text("the first one")
    monkeypatch.setattr("lifelong.report.media.MEDIA_LIMIT", (folder / "videos" / "a.gif").stat().st_size)
    raw = write_report([folder]).read_text()
    assert "the first one" in raw and "Omitted: b.gif (it is larger than" in raw
    assert base64.b64encode((folder / "videos" / "a.gif").read_bytes()).decode() in raw


def test_labels_omit_the_common_words_of_all_instructions():
    texts = [f"pick up the {n} and place it in the basket" for n in GROCERIES]
    assert short_labels(texts) == list(GROCERIES)
    assert short_labels(["open the door"]) == ["open the door"]
    assert short_labels(["push it", "push it"]) == ["push it", "push it"]
    assert short_labels(["open the door", "close the window"]) == ["open the door", "close the window"]


HOSTILE = [
    r"$\frac{$ a $ b $ c_1^{",
    "<script>alert(1)</script> \\ {{ 7 * 7 }}",
    "two\nlines\x00\x1b[2J \u202eright to left \u05d0\u05d1 漢字 🤖",
    "long " * 400,
]


@pytest.mark.parametrize("text", HOSTILE, ids=range(len(HOSTILE)))
def test_any_text_is_shown_as_it_is(text, tmp_path):
    run = make_run(tmp_path / "run", tasks=2, epochs=(0, 2))
    rewrite(run, lambda row: row | {"instructions": [text, "b"], "algo": text}, "run")
    html = write_report([run]).read_text(encoding="utf-8")
    assert "<script>alert" not in html and "} 49 {" not in html and "\\ 49" not in html


def test_nothing_is_forgotten_in_a_sequence_of_one_task(tmp_path: Path):
    """NBT is undefined, not 0 with an interval of no width."""
    runs = [make_run(tmp_path / f"{seed}", tasks=1, seed=seed) for seed in (1, 2)]
    run = load_run(runs[0])
    assert run.metrics is not None and np.isnan(run.metrics.nbt.value) and np.isnan(run.metrics.nbt.high)
    summary = json.loads(json.dumps(json_safe(summarize(run.results))))
    assert summary["metrics"]["nbt"] == {"value": None, "low": None, "high": None}
    assert summary["metrics"]["by_task"]["nbt"] == [None]
    assert "nan" not in Page(write_report([runs[0]]).read_text()).text.lower()
    page = write_report(runs, tmp_path / "out")
    assert "nan" not in Page(page.read_text()).text.lower()
    (group,) = json.loads((page.parent / "comparison.json").read_text())["groups"].values()
    assert group["metrics"]["nbt"]["mean"] is None and group["metrics"]["final_success"]["mean"] is not None


# --- runs of somebody else


def test_a_report_follows_no_link_out_of_a_run_and_waits_for_no_pipe(tmp_path: Path):
    run, secret, victim = make_run(tmp_path / "run", tasks=2), tmp_path / "secret", tmp_path / "victim"
    secret.write_text("c2VjcmV0 private")
    victim.write_text("precious")
    for name in ("heatmap.png", "heatmap.pdf"):
        (run / name).symlink_to(victim)
    (run / "videos").mkdir(exist_ok=True)
    (run / "videos" / "a.webp").symlink_to(secret)
    os.mkfifo(run / "videos" / "b.webp")
    (run / "videos" / "c.webp").symlink_to("c.webp")
    (tmp_path / "albums").mkdir()
    (tmp_path / "albums" / "holiday.png").write_bytes(b"private")
    (run / "saliency").symlink_to(tmp_path / "albums")
    (run / "config.yaml").unlink(missing_ok=True)
    (run / "config.yaml").symlink_to(secret)
    html = write_report([run]).read_text()
    assert victim.read_text() == "precious" and not (run / "heatmap.png").is_symlink()
    assert "private" not in html and base64.b64encode(secret.read_bytes()).decode() not in html
    assert "a.webp (it is a link that leads out of" in html and "b.webp (it is a folder, a pipe" in html
    assert "c.webp (it is a link" in html and "holiday" not in html
    assert "saliency is not a folder, or is a link" in html
    (run / "config.yaml").unlink()
    os.mkfifo(run / "config.yaml")
    assert "config.yaml is not read" in write_report([run]).read_text()
    (run / "config.yaml").unlink()
    (run / "config.yaml").write_text("[" * 100_000)
    assert "config.yaml: lists within lists" in write_report([run]).read_text()


@undrawn
def test_the_ring_is_the_kept_epoch_and_a_sent_page_names_no_folder_of_the_machine(tmp_path: Path):
    curve = Curve(np.array([4, 8]), np.array([0.8, 0.2]), np.array([5, 5]))
    axes = learning_figure({0: curve}, {}, ["a"], {0: 8}).axes[0]
    (ring,) = [line for line in axes.lines if line.get_markerfacecolor() == "none"]
    assert ring.get_xydata().tolist() == [[8, 20]]
    runs = [make_run(tmp_path / str(seed), tasks=2, seed=seed) for seed in (1, 2)]
    page = write_report(runs, tmp_path / "page")
    for file in ("report.html", "comparison.json"):
        assert str(tmp_path) not in (page.parent / file).read_text()


@undrawn
def test_what_differs_besides_the_method_is_said_and_other_worlds_are_refused(tmp_path: Path):
    runs = make_runs(tmp_path, ("ewc", "er"), (1, 2), tasks=2)

    def change(run: Path, horizon: int, **facts: str) -> None:
        rewrite(run, lambda row: row | {"versions": row["versions"] | facts}, "run")
        (run / "config.yaml").write_text(yaml.safe_dump({"eval": {"horizon": horizon}}))

    for run, horizon in zip(runs, (130, 130, 600, 600), strict=True):
        change(run, horizon, mujoco="3.3.2")
    demonstrations = DemonstrationsRecord(counts=(9, 9), generators=("", ""), digests=("a", "b"))
    ResultLog(runs[0] / "results.jsonl").append(demonstrations)
    told = comparison_text(write_report(runs, tmp_path / "alike"))
    assert told[:2] == [
        "No record tells which demonstrations these learned from: er seed 1, er seed 2, ewc seed 2.",
        "Settings differ that no method's name tells: eval.horizon (600 of er, 130 of ewc).",
    ]
    for name, value in {"mujoco": "4.0.0", "models_digest": "another"}.items():
        change(runs[1], 130, **{name: value})
        told = f"other-worlds: .*{name.replace('_', ' ')} .*{value}: ewc seed 2"
        with pytest.raises(LifelongError, match=told):
            write_report(runs, tmp_path / "page")
    text = write_report(runs, tmp_path / "page", Plan(other_worlds=True)).read_text()
    assert "Runs differ in mujoco (3.3.2: er seed 1, er seed 2, ewc seed 1; 4.0.0: ewc seed 2)." in text


@undrawn
def test_a_page_says_what_forward_transfer_is_the_mean_of_and_which_weights_were_never_trained(
    tmp_path: Path,
):
    run = make_run(tmp_path / "run", tasks=2)
    text = Page(write_report([run]).read_text()).text
    assert "the epochs of learning a task: epochs 0, 2, 4, 6, 8, 10, from 20 starts" in text
    assert "are kept" not in "".join(load_run(run).notes)
    ResultLog(run / "results.jsonl").append(TaskEndRecord(task=1, best_epoch=0, seconds=1.0))
    ResultLog(run / "results.jsonl").append(CostRecord(task=1, costs={"parameters_trained": 0}))
    notes = load_run(run).notes
    assert any("weights from before" in note and "task 2" in note for note in notes)
    assert any("nothing was trained" in note and "task 2" in note for note in notes)
    with pytest.raises(LifelongError, match=f"it holds 1, in {re.escape(str(tmp_path))}/\\*;"):
        load_run(tmp_path)


@undrawn
def test_a_page_has_one_estimate_of_forward_transfer(tmp_path: Path):
    runs = [make_run(tmp_path / algo, algo, tasks=2) for algo in ("er", "ewc")]
    rewrite(runs[0], lambda row: row | {"transfer": "published"}, "run")
    page = write_report(runs, tmp_path / "out")
    fwt = json.loads((page.parent / "comparison.json").read_text())["groups"]["er"]["metrics"]["fwt"]["mean"]
    text = Page(page.read_text()).text
    assert f"er 1 {100 * fwt:.1f} " in text and abs(fwt - load_run(runs[0]).metrics.fwt.value) > 1e-3
    assert "as measured" not in text and "chosen without the start that measures it" in text


def under_shift(run: Path, rate: float, tasks: int) -> tuple[float, float]:
    """Append what a run does under a shift; return its final success, and what of it is lost."""
    log, rng = ResultLog(run / "results.jsonl"), np.random.default_rng(0)
    records = [_evaluation(rng, "matrix", tasks - 1, 10, task, rate) for task in range(tasks)]
    for record in records:
        log.append(replace(record, phase="shift", shift="light=0.5"))
    final = np.mean([log.read().evaluation("matrix", tasks - 1, task).rate for task in range(tasks)])
    return final, final - np.mean([record.rate for record in records])


def test_what_is_lost_in_several_orders_is_their_mean(tmp_path: Path) -> None:
    runs = [make_run(tmp_path / f"er{order}", "er", 1, tasks=3, order=order) for order in range(3)]
    found = [under_shift(run, rate, 3) for run, rate in zip(runs, (0.9, 0.5, 0.1), strict=True)]
    final, lost = zip(*found, strict=True)
    page = write_report(runs, tmp_path / "page" / "report.html", Plan())
    (group,) = json.loads((page.parent / "comparison.json").read_text())["groups"].values()
    found = group["shifts"]["light=0.5"]
    assert found["runs"] == 3 and found["final"] == pytest.approx(np.mean(final))
    assert found["final"] == pytest.approx(group["metrics"]["final_success"]["mean"])
    assert found["lost"]["value"] == pytest.approx(np.mean(lost))


def test_what_methods_lose_under_a_held_out_shift_is_compared(tmp_path: Path) -> None:
    """Student's interval of what is lost, and of what is lost less the reference's, over the seeds of both."""
    runs, lost = [], {"er": {}, "ewc": {}}
    for algo, under in (("er", (0.6, 0.5, 0.1)), ("ewc", (0.2, 0.3))):
        for seed, rate in enumerate(under, 1):
            runs.append(make_run(tmp_path / f"{algo}{seed}", algo, seed, tasks=2))
            lost[algo][seed] = under_shift(runs[-1], rate, 2)[1]
    page = write_report(runs, tmp_path / "page" / "report.html", Plan(("er",)))
    found = json.loads((page.parent / "comparison.json").read_text())["groups"]
    own, other = (next(g["shifts"]["light=0.5"] for k, g in found.items() if k.startswith(a)) for a in lost)
    values, gaps = list(lost["er"].values()), [lost["ewc"][s] - lost["er"][s] for s in (1, 2)]
    assert (own["runs"], own["lost_less"], other["runs"]) == (3, {}, 2)
    for estimate, sample in ((own["lost"], values), (other["lost_less"]["er"], gaps)):
        ends = scipy.stats.t.interval(0.95, len(sample) - 1, np.mean(sample), scipy.stats.sem(sample))
        shown = [estimate[name] for name in ("value", "low", "high")]
        assert shown == pytest.approx([np.mean(sample), *ends])
    text = html.unescape(page.read_text())
    assert ">Under light=0.5</h2>" in text and "Less er's" in text
