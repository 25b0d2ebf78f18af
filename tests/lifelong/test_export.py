"""Runs as tables: values are those of results.json and of the reports."""

import shutil
from pathlib import Path

import pandas
import pytest

import lifelong
from libero_cli.main import main
from libero_env.text import json_safe
from lifelong.report.export import _escaped
from lifelong.report.runs import load_run
from lifelong.results.summary import summarize

RUNS = Path(__file__).parent / "data/saved_runs"


def test_a_row_has_what_the_summary_of_the_run_has():
    table = lifelong.load_runs(RUNS)
    assert sorted(table.algo) == sorted(path.name for path in RUNS.iterdir())
    for row in table.to_dict("records"):
        run = load_run(Path(row["path"]))
        summary = json_safe(summarize(run.results))
        assert (row["seed"], row["finished"]) == (summary["run"]["seed"], summary["finished"])
        assert row["transfer"] == summary["statistics"]["transfer"]
        for name in ("fwt", "nbt", "auc"):
            assert row[name] == pytest.approx(summary["metrics"][name]["value"])
        assert row["config.train.lr"] == run.config["train"]["lr"]


@pytest.mark.parametrize("form", ["csv", "parquet"])
def test_files_hold_the_same_table(form, tmp_path, capsys):
    assert main(["results", "export", f"{RUNS}/e*", "--as", form, "--out", str(tmp_path)]) == 0
    file = tmp_path / f"runs.{form}"
    assert capsys.readouterr().out == f"{file}\n"
    table = pandas.read_csv(file) if form == "csv" else pandas.read_parquet(file)
    assert list(table.columns) == list(lifelong.load_runs(f"{RUNS}/e*").columns) and sorted(table.algo) == [
        "er",
        "ewc",
    ]


def test_latex_has_a_row_for_each_method(tmp_path, capsys):
    assert main(["results", "export", str(RUNS), "--as", "latex", "--out", str(tmp_path)]) == 0
    lines = (tmp_path / "runs.tex").read_text().splitlines()
    (row,) = [line for line in lines if line.startswith("packnet")]
    assert row.endswith(r"& $0.0$ & $0.0$ & $0.0$ & $0.0$ & $0.0$ \\"), "four episodes have no interval"
    assert len({line.count(" & ") for line in lines if " & " in line}) == 1


def test_papers_tables_have_finished_runs_only(tmp_path, capsys):
    for name in ("er", "ewc"):
        shutil.copytree(RUNS / name, tmp_path / name)
    log = tmp_path / "ewc" / "results.jsonl"
    lines = log.read_text().splitlines(keepends=True)
    first = next(
        i for i, line in enumerate(lines) if '"kind": "task_end"' in line or '"kind":"task_end"' in line
    )
    log.write_text("".join(lines[: first + 1]))
    export = ["results", "export", "--as", "latex", "--out", str(tmp_path)]
    assert main([*export, str(tmp_path)]) == 0
    table = (tmp_path / "runs.tex").read_text()
    assert (
        "left out, as it is not finished" in capsys.readouterr().err and "% left out, not finished: " in table
    )
    assert "\ner" in table and "\newc" not in table
    assert main([*export, str(tmp_path / "ewc")]) == 2
    assert "no run is finished" in capsys.readouterr().err


def test_runs_moved_aside_and_pretrainings_are_left_out(tmp_path):
    for name in ("seed1", "seed1.old1", "pretrain/libero_90/0123"):
        shutil.copytree(RUNS / "er", tmp_path / name)
    for pattern in (tmp_path, f"{tmp_path}/*", tmp_path / "seed1"):
        assert list(lifelong.load_runs(pattern).path) == [str(tmp_path / "seed1")]
    for name in ("seed1.old1", "pretrain/libero_90/0123"):
        assert list(lifelong.load_runs(tmp_path / name).path) == [str(tmp_path / name)]


def test_text_of_a_label_is_never_markup():
    assert _escaped(r"50% a_b \x{}") == r"50\% a\_b \textbackslash{}x\{\}"
