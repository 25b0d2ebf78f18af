"""Checkpoint files after damage of any kind: the same tree, or an error that names the file; never another tree."""

import json
import tempfile
from pathlib import Path

import torch
from hypothesis import given
from hypothesis import strategies as st
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from lifelong import checkpoints
from lifelong.results.run_directory import CheckpointFolder
from tests.harness.checkpoints import write_forged
from tests.harness.fuzz import examples, survive
from tests.harness.mutations import damaged
from tests.harness.sequences import assert_same

TREE = {
    "run": None,
    "task": 1,
    "policy": {"w": torch.arange(600.0).reshape(20, 30), "b": torch.ones(4, dtype=torch.int64)},
    "algorithm": {"memory": {"budget": 3, "indices": {"0": torch.arange(5)}}, "list": [1, None, (True, "x")]},
}


def written(tree=TREE) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        checkpoints.save(Path(folder, "x.safetensors"), tree)
        return Path(folder, "x.safetensors").read_bytes()


WHOLE, OTHER = written(), written(TREE | {"task": 2})
VALUES = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats()
    | st.text(max_size=5)
    | st.sampled_from(["/policy/w", ""]),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(
            st.sampled_from(["dict", "list", "tuple", "tensor", "value", "format", "tree"]), inner, max_size=2
        )
    ),
    max_leaves=12,
)


def load(content: bytes):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "task_1.safetensors")
        path.write_bytes(content)
        return CheckpointFolder(Path(folder)).load_task(path)


@given(damaged(WHOLE, OTHER))
@examples(short=250, long=4000)
def test_damage_is_found_or_does_no_harm(content):
    found = survive("checkpoints", lambda: load(content))
    if found is not None:
        assert_same(found, TREE)


@given(VALUES, st.integers(0, 2))
@examples(short=100, long=2000)
def test_a_tree_from_others_is_refused_or_a_tree(tree, place):
    """Files whose checksum is missing or was computed by whoever made them."""

    def attempt():
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, "x.safetensors")
            tensors = {"": torch.zeros(0), "/policy/w": torch.ones(2)}
            if place == 2:
                write_forged(path, tensors, tree)
            else:
                head = {"format": checkpoints.FORMAT, "sha256": "0" * 64, "tree": tree} if place else tree
                save_file(tensors, path, {"lifelong": json.dumps(head)})
            checkpoints.check(checkpoints.load(path), {"w": (int, {str: torch.Tensor}, [str])}, path)

    survive("checkpoints", attempt)


@given(
    st.recursive(
        st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
        lambda inner: (
            st.lists(inner, max_size=4)
            | st.dictionaries(st.integers() | st.text(max_size=6), inner, max_size=4)
        ),
        max_leaves=30,
    ),
    st.sampled_from([torch.float32, torch.bfloat16, torch.int64, torch.bool, torch.uint8]),
    st.lists(st.integers(0, 4), max_size=3),
)
@examples(short=60, long=1000)
def test_every_tree_that_is_saved_is_loaded_again(plain, dtype, shape):
    tree = {"plain": plain, "tensor": torch.ones(shape).to(dtype)}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "x.safetensors")
        if survive("checkpoints", lambda: [checkpoints.save(path, tree)]) is not None:
            back = checkpoints.load(path)
            assert repr(back["plain"]) == repr(plain)
            assert torch.equal(back["tensor"], tree["tensor"]) and back["tensor"].dtype == dtype
            with safe_open(path, framework="pt") as file:
                assert set(load_file(path)) == set(file.keys())
