"""Configurations of any kind: overrides on the command line; saved ones that were damaged or are of a stranger."""

import contextlib
import copy
import io
import os
from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from omegaconf import OmegaConf

import lifelong.experiment
import lifelong.training.memory
from libero_env.errors import LiberoError
from lifelong.evaluation.restore import restore
from lifelong.launch import main
from lifelong.results.run_directory import RunDirectory
from tests.harness.configs import composed
from tests.harness.fuzz import examples, survive
from tests.harness.runs import make_run

BEGINS = "a run begins"
CHOICES = [
    *("algo=er", "algo=agem", "algo=ewc", "algo=packnet", "algo=lora", "algo=dmpel", "algo=iscil", "algo=clare"),
    *("algo=derpp", "algo=si"),
    *("policy=bc_rnn_small", "policy=bc_vilt_small", "policy=bc_transformer", "policy/head=flow_small"),
    *("compat=libero", "stream=blurry", "language=onehot", "augmentation=shift_jitter", "benchmark=libero_10"),
]  # fmt: skip
TEXTS = [
    *("-1", "0", "1", "1.5", "-0.0", "nan", "inf", "-inf", "1e400", "1e-400", "9" * 30, "9" * 400, "9" * 5000),
    *("null", "true", "no", "''", "abc", "[]", "[1,2]", "[null]", "{}", "{a:1}", "[[[]]]", "1000000", "4096", "17"),
    *("../../x", "/", "/dev/null", "~", "é", "\u202e", "日本", "x" * 300, "a/b", "a\\b", "'a b'", "\x7f", "\ud800"),
    *("${nothing}", "${seed}", "${oc.env:HOME}", "${oc.env:NO_SUCH}", "???", "${train}", "${.}", "${", "%s", "{0}"),
    *("os.system", "lifelong.nn.GMMHead", "lifelong.algorithms.er.ER", "torch.nn.Linear", "builtins.print"),
]  # fmt: skip
VALUES = [
    *(-1, 0, 1, 2**31, 2**63, 2**70, 10**400, 1.5, 1e308, float("nan"), float("inf"), None, True, False, "", "abc"),
    *([], [1], {}, {"a": 1}, [[]], "../x", "/etc/passwd", "\0", "é", "x" * 300, "${oc.env:HOME}", "${", "???"),
    {"_target_": "posix.mkdir", "path": "made"},
    {"_target_": "lifelong.nn.GMMHead", "_partial_": True},
    {"_target_": "lifelong.nn.TemporalLSTM", "in_dim": 10**6, "hidden": 10**6},
    {"_target_": "lifelong.nn.augmentation.os.system", "_args_": ["true"]},
]  # fmt: skip


def paths_in(node, path=()):
    """All paths of a configuration."""
    if path:
        yield path
    items = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    for key, value in items:
        yield from paths_in(value, (*path, key))


KEYS = sorted(
    {
        ".".join(map(str, path))
        for choice in ("algo=er", "algo=ewc", "algo=dmpel", "policy=bc_vilt_small", "policy=bc_rnn_small")
        for path in paths_in(OmegaConf.to_container(composed("preset=smoke", choice)))
        if all(isinstance(key, str) for key in path)
    }
    | {"foo", "train.foo", "policy.head_hidden", "algo._args_", "policy._partial_", "a.b.c", "hydra"}
)
OVERRIDES = st.one_of(
    st.builds(
        "{}{}={}".format,
        st.sampled_from(["", "", "", "+", "++"]),
        st.sampled_from(KEYS),
        st.sampled_from(TEXTS),
    ),
    st.builds("~{}".format, st.sampled_from(KEYS)),
    st.sampled_from(CHOICES),
)


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    """A folder in which nothing is made; a machine of little memory; runs that end before they begin."""

    def opened(*args, **kwargs):
        raise LiberoError(BEGINS)

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(RunDirectory, "opened", opened)
    for module in (lifelong.experiment, lifelong.training.memory):
        monkeypatch.setattr(module, "memory_limit", lambda: 1 << 30)
    monkeypatch.setattr("sys.argv", ["libero"])


def launched(words):
    """Compose, check and build; the error of a clean refusal."""
    said = io.StringIO()
    with contextlib.redirect_stderr(said), contextlib.redirect_stdout(io.StringIO()):
        status = main(["preset=smoke", "device=cpu", *words])
    lines = said.getvalue().splitlines()
    assert status == 2 and len(lines) == 1, f"status {status}: {said.getvalue()}"
    assert not os.listdir("."), f"left behind: {os.listdir('.')}"
    if BEGINS not in lines[0]:
        raise LiberoError(lines[0])


@given(st.lists(OVERRIDES, min_size=1, max_size=4))
@examples(short=14, long=400)
def test_any_overrides_begin_a_run_or_are_refused(words):
    survive("configuration overrides", lambda: launched(words))


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("saved") / "run"
    make_run(folder, "algo=er")
    return folder


SAVED = OmegaConf.to_container(composed("preset=smoke", "algo=er"), resolve=True)
SAVED_PATHS = sorted(paths_in(SAVED), key=str)


@st.composite
def mutated(draw):
    """The mutations of a saved configuration: paths, what is done there, and a value."""
    kinds = st.sampled_from(["replace", "replace", "replace", "delete", "rename", "add"])
    one = st.tuples(st.sampled_from(SAVED_PATHS), kinds, st.sampled_from(VALUES))
    return draw(st.lists(one, min_size=1, max_size=3))


def apply(config, changes):
    for path, kind, value in changes:
        node = config
        try:
            for key in path[:-1]:
                node = node[key]
            old = node[path[-1]]
        except (KeyError, IndexError, TypeError):
            continue
        if kind == "delete":
            del node[path[-1]]
        elif kind == "rename" and isinstance(node, dict):
            node[f"{path[-1]}x"] = node.pop(path[-1])
        elif kind == "add" and isinstance(old, dict):
            old["_target_"] = copy.deepcopy(value)
        else:
            node[path[-1]] = copy.deepcopy(value)
    return config


@given(mutated())
@examples(short=40, long=2000)
def test_a_changed_saved_configuration_is_restored_or_refused(run, changes):
    config = apply(yaml.safe_load((run / "config.yaml").read_text()) if changes else {}, changes)
    survive(
        "saved configurations", lambda: restored(run, yaml.safe_dump(config, allow_unicode=True).encode())
    )


@given(
    st.lists(
        st.tuples(
            st.floats(0, 1), st.sampled_from([b"", b"\0", b"\xff", b"{", b"- ", b"&a ", b"*a", b"!!x "])
        )
    )
)
@examples(short=15, long=1000)
def test_a_damaged_saved_configuration_is_restored_or_refused(run, cuts):
    content = (run / "config.yaml").read_bytes()
    for place, put in cuts:
        at = int(place * len(content))
        content = content[:at] + put + content[at + 3 :]
    survive("saved configurations", lambda: restored(run, content))


def restored(run: Path, content: bytes):
    """Restore the run with another config.yaml."""
    file = run / "config.yaml"
    before = file.read_bytes()
    file.write_bytes(content)
    try:
        restore(run, device="cpu")
    finally:
        file.write_bytes(before)
        assert not os.listdir("."), "something was executed"
