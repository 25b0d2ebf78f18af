"""Checkpoints: complete or absent, exact, and nothing is executed on load."""

import hashlib
import json
import os
import pickle

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

from lifelong import checkpoints
from lifelong.errors import CheckpointError, DamagedCheckpointError
from lifelong.results.run_directory import CheckpointFolder
from tests.harness import sequences
from tests.harness.checkpoints import write_forged


def test_a_tree_is_loaded_as_it_was_saved(tmp_path):
    net = torch.nn.Linear(3, 2)
    optimizer = torch.optim.AdamW(net.parameters(), lr=0.1)
    net(torch.ones(1, 3)).sum().backward()
    optimizer.step()
    view = torch.arange(6.0).reshape(2, 3).t()
    tree = {
        "opt": optimizer.state_dict(),
        "view": view,
        "same": view,
        "list": [1, 2.5, None, "x", (True, {3: view})],
    }
    checkpoints.save(tmp_path / "a" / "state.safetensors", tree)
    back = checkpoints.load(tmp_path / "a" / "state.safetensors")
    assert back["list"][:4] == [1, 2.5, None, "x"]
    assert back["list"][4][0] is True and torch.equal(back["list"][4][1][3], view)
    assert torch.equal(back["view"], view)
    for key, value in tree["opt"]["state"][0].items():
        assert torch.equal(back["opt"]["state"][0][key], value)
    assert back["opt"]["param_groups"] == tree["opt"]["param_groups"]
    assert [p.name for p in (tmp_path / "a").iterdir()] == ["state.safetensors"]


TREE = {
    "task": 3,
    "policy": {"a": torch.arange(12.0).reshape(3, 4), "b": torch.ones(5, dtype=torch.uint8)},
    "odd": {1: torch.zeros(2), "1": torch.ones(2), "nan": float("nan")},
    "half": torch.ones(3, dtype=torch.bfloat16),
    "scalar": torch.tensor(2),
}


def test_equal_trees_give_equal_files_that_others_may_read(tmp_path):
    names = [tmp_path / f"{i}.safetensors" for i in range(8)]
    for name in names:
        checkpoints.save(name, TREE)
    assert len({hashlib.sha256(name.read_bytes()).digest() for name in names}) == 1
    os.umask(mask := os.umask(0))
    assert names[0].stat().st_mode & 0o777 == 0o666 & ~mask, "as every other file"
    with safe_open(names[0], framework="pt") as file:
        assert torch.equal(file.get_tensor("/policy/a"), TREE["policy"]["a"])
    back = checkpoints.load(names[0])
    assert back["odd"][1].tolist() == [0, 0] and back["odd"]["1"].tolist() == [1, 1]
    assert back["half"].dtype == torch.bfloat16 and back["scalar"].shape == ()


def test_any_flipped_byte_is_found(tmp_path):
    path = tmp_path / "x.safetensors"
    checkpoints.save(path, TREE)
    whole, silent = path.read_bytes(), []
    for i in range(len(whole)):
        path.write_bytes(whole[:i] + bytes([whole[i] ^ 0x10]) + whole[i + 1 :])
        try:
            checkpoints.load(path)
            silent.append(i)
        except CheckpointError:
            pass
    assert not silent


@pytest.mark.parametrize("tree", [
    "[]",
    '{"value": []}',
    '{"tensor": "/gone"}',
    '{"dict": [["a"]]}',
    '{"dict": [[null, {"value": 1}]]}',
    '{"dict": [["a", {"value": 1}], ["a", {"value": 2}]]}',
    '{"list": {"value": 1}}',
    '{"dict": [], "list": []}',
    '{"list": [' * 200 + '{"value": 1}' + "]}" * 200,
])  # fmt: skip
def test_a_tree_that_was_not_written_here_is_refused(tmp_path, tree):
    path = tmp_path / "x.safetensors"
    write_forged(path, {"": torch.zeros(0)}, json.loads(tree))
    with pytest.raises(CheckpointError, match=r"x\.safetensors is broken, or is no checkpoint"):
        checkpoints.load(path)


def test_what_cannot_be_read_again_is_not_written_and_leaves_the_old_file(tmp_path):
    path, deep = tmp_path / "x.safetensors", {}
    checkpoints.save(path, {"n": 1})
    for _ in range(100):
        deep = {"a": deep}
    for tree, message in [
        (deep, "nested deeper"),
        ({"a": torch.ones(1, dtype=torch.complex128)}, "complex128"),
        ({"a": torch.ones(2, 2).to_sparse()}, "sparse"),
        ({(1, 2): 3}, "not all str or int"),
        ({"n": object()}, "cannot store a object at /n"),
    ]:
        with pytest.raises(CheckpointError, match=message):
            checkpoints.save(path, tree)
    assert list(tmp_path.iterdir()) == [path] and checkpoints.load(path) == {"n": 1}


def test_files_of_other_programs_are_refused_and_never_to_be_deleted(tmp_path):
    save_file({"w": torch.ones(2)}, tmp_path / "other.safetensors", {"format": "pt"})
    sparse = tmp_path / "sparse.safetensors"
    with open(sparse, "wb") as file:
        file.truncate(1 << 42)
    pickled, missing = tmp_path / "pickled.safetensors", tmp_path / "missing.safetensors"
    pickled.write_bytes(pickle.dumps({"w": 1}))
    for path in (tmp_path / "other.safetensors", "/etc/passwd", sparse, pickled, missing):
        with pytest.raises(CheckpointError, match="no checkpoint") as caught:
            checkpoints.load(checkpoints.Path(path))
        assert "elete" not in str(caught.value)


def test_weights_that_are_not_finite_or_of_another_kind_are_refused(tmp_path):
    net = torch.nn.Linear(3, 2)
    net.register_buffer("mask", torch.tensor([0.0, -torch.inf]))
    state = {k: v.clone() for k, v in net.state_dict().items()}
    checkpoints.load_weights(net, state, tmp_path)
    with pytest.raises(CheckpointError, match="weight has values that are not finite"):
        checkpoints.load_weights(net, state | {"weight": state["weight"] * torch.nan}, tmp_path)
    with pytest.raises(CheckpointError, match="int64"):
        checkpoints.load_weights(net, state | {"bias": torch.ones(2, dtype=torch.int64)}, tmp_path)
    for odd in (None, [], {"weight": 1}, {1: torch.ones(2)}, {"weight": state["weight"]}):
        with pytest.raises(CheckpointError):
            checkpoints.load_weights(net, odd, tmp_path)
    sequences.assert_same(dict(net.state_dict()), state)


def test_a_form_names_the_first_difference():
    net = torch.nn.Linear(3, 2)
    form = {"n": int, "w": (None, checkpoints.Weights()), "by_task": {int: {"a": torch.Tensor}}}
    good = {"n": 1, "w": {"bias": torch.ones(2)}, "by_task": {0: {"a": torch.ones(1)}}}
    checkpoints.check(good, form, "x", net)
    checkpoints.check(good | {"w": None, "by_task": {}}, form, "x", net)
    for changed, message in [
        ({"n": True}, "/n is of type bool; expected int"),
        ({"n": "1"}, "/n is of type str"),
        ({"z": 1}, "missing or unknown: 'z'"),
        ({"w": {"bias": torch.ones(3)}}, r"/w/bias has shape \(3,\)"),
        ({"w": {"other": torch.ones(2)}}, "/w/other is no weight of the policy"),
        ({"w": {"bias": torch.ones(2) * torch.inf}}, "/w/bias has values that are not finite"),
        ({"by_task": {"0": {"a": torch.ones(1)}}}, "has the key '0'; expected int"),
        ({"by_task": {0: {"a": 1.0}}}, "/by_task/0/a is of type float; expected Tensor"),
        ({"by_task": [1]}, "/by_task is of type list; expected dict"),
    ]:
        with pytest.raises(CheckpointError, match=message):
            checkpoints.check(good | changed, form, "x", net)
    with pytest.raises(CheckpointError, match="lacks weight"):
        checkpoints.check({"bias": torch.ones(2)}, checkpoints.Weights(complete=True), "x", net)


def stored(folder, name, tree, beside=None):
    """Save a tree and return its file."""
    path = folder / f"{name}.safetensors"
    checkpoints.save(path, tree, beside=beside)
    return path


def test_what_a_file_beside_it_holds_is_stored_once(tmp_path):
    old, nan = torch.randn(1000), torch.full((300,), torch.nan)
    first = stored(tmp_path, "task_0", {"kept": {0: old, "nan": nan}, "w": torch.zeros(1000)})
    second = stored(tmp_path, "task_1", {"kept": {0: old, "nan": nan}, "w": torch.ones(1000)}, first)
    tree = {"kept": {0: old, "nan": nan, 1: torch.ones(10)}, "w": torch.ones(1000), "moved": old}
    third = stored(tmp_path, "task_2", tree, second)
    assert [p.stat().st_size // 1000 for p in (first, second, third)] == [9, 4, 4]
    back = checkpoints.load(third)
    assert torch.equal(back["kept"][0], old) and torch.equal(back["w"], torch.ones(1000))
    assert back["kept"]["nan"].isnan().all() and torch.equal(back["moved"], old)
    assert torch.equal(checkpoints.load(second)["kept"][0], old)

    stored(tmp_path, "task_0", {"kept": {0: old + 1, "nan": nan}, "w": torch.zeros(1000)})
    with pytest.raises(DamagedCheckpointError, match="does not have the checksum"):
        checkpoints.load(third)
    first.unlink()
    with pytest.raises(DamagedCheckpointError, match=r"task_2.*it needs task_0\.safetensors beside it"):
        checkpoints.load(third)
    whole = stored(tmp_path, "task_3", {"kept": {0: old}}, third)  # what cannot be read is not referred to
    assert torch.equal(checkpoints.load(whole)["kept"][0], old)


@pytest.mark.parametrize("place", ["../task_0.safetensors", "config.yaml", "link.safetensors", 3])
def test_only_checkpoints_of_the_folder_are_read_besides(tmp_path, place, monkeypatch):
    (tmp_path / "run").mkdir()
    weights = torch.randn(1000)
    stored(tmp_path, "task_0", {"w": weights})
    (tmp_path / "run" / "link.safetensors").symlink_to(tmp_path / "task_0.safetensors")
    monkeypatch.setattr(checkpoints, "_stored_beside", lambda beside, tensors: {"/w": place})
    forged = stored(tmp_path / "run", "task_1", {"w": weights})
    with pytest.raises(DamagedCheckpointError, match="not a checkpoint of its folder|is not valid"):
        checkpoints.load(forged)


def test_checkpoints_of_a_run_hold_what_is_new(tmp_path):
    folder, learned, sizes = CheckpointFolder(tmp_path), {}, []
    for task in range(6):
        learned[task] = {"w": torch.randn(10_000)}
        folder.save_task(task, learned[task], {"learned": dict(learned)})
        sizes.append(folder.task_path(task).stat().st_size)
    assert max(sizes) < 1.02 * sizes[0]
    for task in range(6):
        state = folder.load_task(folder.task_path(task))
        assert all(
            torch.equal(state["algorithm"]["learned"][k]["w"], learned[k]["w"]) for k in range(task + 1)
        )
