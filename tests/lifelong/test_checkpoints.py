"""Checkpoints: complete or absent, exact, and nothing is executed on load."""

import pickle

import pytest
import torch

from lifelong import checkpoints
from lifelong.errors import CheckpointError


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


@pytest.mark.parametrize("keep", [0, 5, 200])
def test_a_truncated_file_is_named(tmp_path, keep):
    path = tmp_path / "x.safetensors"
    checkpoints.save(path, {"w": torch.ones(100)})
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(CheckpointError, match=r"x\.safetensors is broken"):
        checkpoints.load(path)


def test_a_pickle_is_refused(tmp_path):
    path = tmp_path / "x.safetensors"
    path.write_bytes(pickle.dumps({"w": 1}))
    with pytest.raises(CheckpointError, match="broken"):
        checkpoints.load(path)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(CheckpointError, match="no checkpoint at"):
        checkpoints.load(tmp_path / "x.safetensors")


def test_a_failed_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "x.safetensors"
    checkpoints.save(path, {"n": 1})
    with pytest.raises(CheckpointError, match="cannot store a object at /n"):
        checkpoints.save(path, {"n": object()})
    assert checkpoints.load(path) == {"n": 1}


def test_weights_of_another_shape_are_refused(tmp_path):
    net = torch.nn.Linear(3, 2)
    before = net.weight.clone()
    for state, message in [
        ({"weight": torch.ones(2, 3)}, "has no bias"),
        ({"weight": torch.ones(2, 4), "bias": torch.ones(2)}, r"weight has shape \(2, 4\)"),
        ({"weight": torch.ones(2, 3), "bias": torch.ones(2), "z": torch.ones(1)}, "has z"),
    ]:
        with pytest.raises(CheckpointError, match=message):
            checkpoints.load_weights(net, state, tmp_path)
    assert torch.equal(net.weight, before)
