"""Words of the command line, and texts of others in figures and pages."""

import contextlib
import io
import re
from typing import get_type_hints

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from libero_cli.main import ALL, load, main
from libero_env.cli.options import options_of
from lifelong.errors import ConfigError
from lifelong.report.figures import Line, Panel, as_svg, forgetting_figure, heatmap_figure
from lifelong.report.tables import page_template
from tests.harness.fuzz import examples, survive

# commands that only read what they are given: none of the files exists
VALID = [
    ["tasks", "list", "libero_object", "--order", "3"],
    ["tasks", "show", "libero_goal/3"],
    ["demos", "info", "nowhere.hdf5"],
    ["demos", "check", "nowhere.hdf5"],
    ["demos", "filter", "nowhere.hdf5", "out.hdf5", "--threshold", "0.01"],
    ["demos", "replay", "nowhere.hdf5", "--demo", "1", "--size", "32x48"],
    ["demos", "export", "nowhere.hdf5", "--out", "set", "--settle", "3"],
    ["objects", "show", "plate"],
    ["protocols", "show", "openpi"],
    ["protocols", "diff", "openpi", "libero"],
    ["power", "--base", "0.9", "--difference", "0.05", "--alpha", "0.05", "--power", "0.8", "--tests", "3"],
    ["compare", "nowhere", "nothing", "--alpha", "0.1", "--allow", "tasks"],
    ["results", "export", "nowhere", "--as", "lerobot"],
    ["report", "nowhere"],
    ["saliency", "nowhere", "--moments", "4", "--stride", "8"],
    ["eval", "nowhere:make", "--suite", "libero_goal/0", "--episodes", "3", "--size", "64", "--timeout", "3"],
    ["eval", "nowhere", "--starts", "reporting", "--horizon", "7", "--workers", "2", "--seed", "5"],
    ["eval", "--status", "nowhere"],
]
HOSTILE = [
    *("", " ", "-1", "0", "1e400", "nan", "-inf", "1" + 400 * "0", "1.5", "0x10", "١٢", "None", "[]", "{}", "null"),
    *("--", "-", "---", "--debug", "--out", "--size=", "=", "@x", "..", "../../etc/passwd", "/dev/null", "."),
    *("a\0b", "\ud800", "\u202eab", "\x1b[2J", "x" * 300, "a/b/c", "C:\\x", "~", "$HOME", "%s %d", "{0}",
     "libero_goal/-1"),
    *("libero_goal/99", "ws://", "ws://[::1", "gr00t://:1", "os:getcwd", "a.yaml", "b.bddl", ":", "$\\frac{$"),
]  # fmt: skip


@st.composite
def command_lines(draw: st.DrawFn) -> list[str]:
    """A valid command line with a few words replaced, dropped, doubled, swapped or added."""
    words = list(draw(st.sampled_from(VALID)))
    word = st.sampled_from(HOSTILE) | st.text(max_size=6)
    for _ in range(draw(st.integers(1, 3))):
        place = draw(st.integers(1, max(1, len(words) - 1)))
        match draw(st.sampled_from(["replace", "drop", "double", "swap", "add"])):
            case "drop" if len(words) > 2:
                del words[place % len(words)]
            case "double":
                words.insert(place, words[place % len(words)])
            case "swap":
                other = draw(st.integers(0, len(words) - 1))
                words[place % len(words)], words[other] = words[other], words[place % len(words)]
            case "add":
                words.insert(place, draw(word))
            case _:
                words[place % len(words)] = draw(word)
    return words


@given(words=command_lines())
@examples(short=60, long=4000)
def test_any_words_are_run_or_refused_in_a_line(words, tmp_path_factory, monkeypatch):
    folder = tmp_path_factory.getbasetemp() / "words"
    folder.mkdir(exist_ok=True)
    with monkeypatch.context() as patch:
        patch.chdir(folder)
        patch.setattr("sys.argv", ["libero"])
        patch.setenv("LIBERO_DEMOS", str(folder / "none"))
        patch.setenv("HYDRA_FULL_ERROR", "1")
        patch.delenv("LIBERO_DEBUG", raising=False)

        def attempt() -> None:
            told = io.StringIO()
            with contextlib.redirect_stderr(told), contextlib.redirect_stdout(io.StringIO()):
                try:
                    status = main(words)
                except SystemExit as ended:  # argparse, and Hydra
                    status = ended.code
            text = told.getvalue()
            assert status in (0, 1, 2), f"{words}: status {status}: {text[-2000:]}"
            if "--debug" not in words:
                assert "Traceback" not in text, f"{words}: {text[-2000:]}"
            if status == 2:
                raise ConfigError(text or "nothing is said")

        survive("command line", attempt)


@given(st.lists(st.sampled_from(HOSTILE) | st.text(max_size=30), min_size=2, max_size=2))
@examples(short=15, long=600)
def test_any_text_is_drawn_and_written(texts):
    def attempt() -> None:
        matrix = heatmap_figure([Panel(texts[0], np.eye(2), texts)])
        for figure in (matrix, forgetting_figure([Line(text, np.ones((1, 2))) for text in texts])):
            as_svg(figure)
        page = page_template("page.html").environment.from_string("<p>{{ t }}</p>").render(t=texts[0])
        assert page.count("<") == 2

    survive("texts in reports", attempt)


@pytest.mark.parametrize("name", [name for name, command in ALL.items() if not command.reads_words])
def test_every_number_of_an_option_has_a_range(name):
    """No option takes any number: `int` and `float` alone have no ends."""
    hints = get_type_hints(options_of(load(ALL[name])))  # without the bounds in Annotated
    bounded = get_type_hints(options_of(load(ALL[name])), include_extras=True)
    for option, hint in hints.items():
        if re.search(r"\b(int|float)\b", str(hint)) and option != "return":
            assert re.search("FieldInfo|AfterValidator", str(bounded[option])), option
