"""The facade's learning side: datasets and helpers."""

import json
import random

import h5py
import numpy as np
import pytest
import torch
from torch import nn
from torch.utils.data import DataLoader

from libero._adapters.config import Config, load_config
from libero.lifelong import utils
from libero.lifelong.datasets import (
    GroupedTaskDataset,
    SequenceVLDataset,
    TruncatedSequenceDataset,
    get_dataset,
)
from libero_env.errors import LiberoError
from tests.harness.facade_learning import LANGUAGE, SIZE, tiny, write_demos

VIEWS, LOW_DIM = ["agentview_rgb", "eye_in_hand_rgb"], ["gripper_states", "joint_states"]
MODALITY = {"rgb": VIEWS, "depth": [], "low_dim": LOW_DIM}


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    return write_demos(tmp_path_factory.mktemp("demos") / "task_demo.hdf5")


def test_windows_hold_the_frames_of_the_file(file):
    dataset, shape_meta = get_dataset(file, MODALITY, seq_len=3)
    window = dataset[3]  # the last but one of five: one step is repeated
    assert (len(dataset), dataset.n_demos, dataset.total_num_sequences) == (9, 2, 9)
    assert shape_meta["ac_dim"] == 7 and shape_meta["use_images"]
    assert shape_meta["all_shapes"]["agentview_rgb"] == (3, SIZE, SIZE)
    assert shape_meta["all_obs_keys"] == [*VIEWS, *LOW_DIM] == list(window["obs"])
    with h5py.File(file) as stored:
        demo = stored["data/demo_0"]
        image, joints, actions = (demo[k][()] for k in ("obs/agentview_rgb", "obs/joint_states", "actions"))
    frames = [3, 4, 4]
    seen = (window["obs"]["agentview_rgb"] * 255).round().to(torch.uint8)
    assert window["obs"]["agentview_rgb"].dtype == torch.float32
    assert (seen.permute(0, 2, 3, 1).numpy() == image[frames]).all(), "as stored, bottom row first"
    assert np.allclose(window["obs"]["joint_states"], joints[frames], atol=1e-6)
    assert np.allclose(window["actions"], actions[frames], atol=1e-6)


def test_frame_stack_adds_earlier_frames(file):
    dataset, _ = get_dataset(file, ["rgb", "low_dim"], seq_len=2, frame_stack=3)
    window, plain = dataset[6], get_dataset(file, ["rgb", "low_dim"], seq_len=2)[0]
    joints = window["obs"]["joint_states"]
    assert (joints.shape, window["actions"].shape) == ((4, 7), (2, 7))
    first = plain[5]["obs"]["joint_states"][0]
    assert (joints[0] == first).all() and (joints[1] == first).all(), "the past begins with the demonstration"
    assert (joints[2:] == plain[6]["obs"]["joint_states"]).all()


def test_filter_key_selects_demonstrations(file, tmp_path):
    path = tmp_path / "masked.hdf5"
    path.write_bytes(file.read_bytes())
    with h5py.File(path, "a") as stored:
        stored["mask/valid"] = np.array([b"demo_1"])
    dataset, _ = get_dataset(path, MODALITY, seq_len=2, filter_key="valid")
    assert (dataset.n_demos, len(dataset)) == (1, 4)
    with pytest.raises(LiberoError, match="valid: valid"):
        get_dataset(path, MODALITY, filter_key="train")


def test_datasets_with_instructions_grouped_and_truncated(file):
    dataset, _ = get_dataset(file, MODALITY, seq_len=2)
    embs = torch.randn(2, LANGUAGE)
    instructed = SequenceVLDataset(dataset, embs[0])
    assert (instructed.n_demos, instructed.total_num_sequences, len(instructed)) == (2, 9, 9)
    assert (instructed[1]["task_emb"] == embs[0]).all()
    assert (instructed[1]["actions"] == dataset[1]["actions"]).all()
    assert "task_emb" not in dataset[1]
    group = GroupedTaskDataset([dataset, dataset], embs)
    assert (len(group), group.n_demos, group.total_num_sequences) == (18, 4, 18)
    uneven = GroupedTaskDataset([instructed, TruncatedSequenceDataset(instructed, 2)], embs)
    order = [0, 9, 1, 10, *range(2, 9)]  # the tasks take turns, as in the original
    assert all((uneven[k]["actions"] == dataset[i % 9]["actions"]).all() for k, i in enumerate(order))
    assert [int((uneven[k]["task_emb"] == embs[1]).all()) for k in range(5)] == [0, 1, 0, 1, 0]
    few = TruncatedSequenceDataset(instructed, 3)
    assert [tuple(b["actions"].shape) for b in DataLoader(few, batch_size=2)] == [(2, 2, 7), (1, 2, 7)]
    with pytest.raises(IndexError):
        few[3]


def test_seeds_and_devices(monkeypatch):
    monkeypatch.setattr(torch.backends.cudnn, "deterministic", False)
    draws = []
    for _ in range(2):
        utils.control_seed(3)
        draws.append((random.random(), np.random.rand(), torch.rand(()).item()))  # noqa: NPY002
    assert draws[0] == draws[1] and torch.backends.cudnn.deterministic
    assert utils.safe_device(torch.zeros(2), "cuda:0").device.type in ("cpu", "cuda")
    assert utils.safe_device(nn.Linear(1, 1)).weight.device.type == "cpu"


def test_checkpoints_hold_data_only(tmp_path):
    model, path = nn.Linear(2, 3), tmp_path / "sub" / "model.pth"
    cfg = load_config("seed=5")
    masks = {"weight": torch.ones(3, 2, dtype=torch.uint8)}
    utils.torch_save_model(model, path, cfg=cfg, previous_masks=masks)
    weights, loaded, masks = utils.torch_load_model(path, map_location="cuda")
    assert torch.equal(weights["weight"], model.weight) and masks["weight"].sum() == 6
    assert isinstance(loaded, Config) and loaded == cfg
    torch.save({"state_dict": {}, "cfg": None, "evil": nn.Linear}, tmp_path / "evil.pth")
    for broken in (tmp_path / "evil.pth", tmp_path / "absent.pth"):
        with pytest.raises(LiberoError, match=broken.name):
            utils.torch_load_model(broken)


def test_json_encoder_of_arrays():
    value = {"a": np.arange(2), "b": np.float32(0.5), "c": torch.ones(1), "d": np.bool_(True)}
    assert json.loads(json.dumps(value, cls=utils.NpEncoder)) == {
        "a": [0, 1], "b": 0.5, "c": [1.0], "d": True
    }  # fmt: skip
    with pytest.raises(TypeError):
        json.dumps(object(), cls=utils.NpEncoder)


def test_confidence_intervals_are_the_originals():
    assert utils.confidence_interval(0.5, 100) == pytest.approx(1.96 * 0.05)
    assert utils.confidence_interval(0.1, 20) == pytest.approx(1.96 * 0.3 / 20**0.5)
    assert utils.confidence_interval(1.0, 20) == 0.0


def test_task_embeddings():
    cfg = load_config()
    embs = utils.get_task_embs(cfg, ["pick up the milk and place it in the basket"] * 2)
    assert embs.shape == (2, 384) and cfg.policy.language_encoder.network_kwargs.input_size == 384
    cfg = load_config("task_embedding_format=one-hot", "task_embedding_one_hot_offset=2")
    assert utils.get_task_embs(cfg, ["a", "b", "c"]).argmax(1).tolist() == [2, 3, 4]
    assert cfg.policy.language_encoder.network_kwargs.input_size == 5
    cfg.task_embedding_format = "elmo"
    with pytest.raises(LiberoError, match="roberta"):
        utils.get_task_embs(cfg, ["a"])


def test_experiment_folders_are_numbered(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    cfg = tiny("lifelong=er", "seed=7")
    first = "experiments/LIBERO_SPATIAL/ER/BCTransformerPolicy_seed7/run_001"
    assert utils.create_experiment_dir(cfg) == first
    assert cfg.experiment_name == "LIBERO_SPATIAL_ER_BCTransformerPolicy_seed7_run_001"
    utils.create_experiment_dir(cfg)
    assert cfg.experiment_dir.endswith("run_002")
    cfg.pretrain_model_path, cfg.data.task_order_index, cfg.task_embedding_format = "a.pth", 3, "one-hot"
    assert utils.create_experiment_dir(cfg).startswith("experiments_finetune_permute3_onehot/LIBERO_SPATIAL/")
