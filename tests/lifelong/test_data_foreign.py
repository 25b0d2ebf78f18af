"""Training data from files of strangers: the same windows however they are read and held, or one line."""

from pathlib import Path

import h5py
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from libero_env.errors import DemoError
from lifelong.data import DemoSource, SequenceVLDataset, dataset, loading, open_windows
from lifelong.errors import DataError
from lifelong.types import Batch, PolicySpec
from tests.harness.fuzz import examples
from tests.harness.robomimic_windows import read_with_robomimic

SPEC = PolicySpec(
    views=("agentview_rgb",), image_size=(4, 6), proprio={"ee_pos": 3}, language_dim=2, seq_len=3
)
LANGUAGE = torch.zeros(2)


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("LIBERO_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def write_file(path: Path, lengths=(4, 3), pairing: object = "libero", labels: bool = False) -> Path:
    rng = np.random.default_rng(sum(lengths))
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        if pairing is not None:
            data.attrs["pairing"] = pairing
        for k, steps in enumerate(lengths):
            group = data.create_group(f"demo_{k}")
            group.attrs["num_samples"] = steps
            for key in ("actions", "expert_actions")[: 1 + labels]:
                group[key] = rng.uniform(-1, 1, (steps, 7))
            group["obs/agentview_rgb"] = rng.integers(0, 256, (steps, 4, 6, 3), dtype=np.uint8)
            group["obs/ee_pos"] = rng.normal(size=(steps, 3))
    return path


def everything(source: DemoSource, **how: str) -> list[torch.Tensor]:
    windows = open_windows(source, language=LANGUAGE, **how)
    return arrays(windows.batch(torch.arange(len(windows))))


def arrays(batch: Batch) -> list[torch.Tensor]:
    readings = batch.observation.proprio["ee_pos"]
    return [batch.observation.images, readings, batch.actions, batch.window_ids, batch.padding()]


@given(
    st.lists(st.integers(1, 6), min_size=1, max_size=4),
    st.sampled_from([None, "libero", b"libero", "aligned", b"aligned"]),
    st.sampled_from(["aligned", "stored"]),
    st.sampled_from(["expert", "executed"]),
    st.booleans(),
    st.none() | st.integers(1, 5),
)
@examples(short=25, long=400)
def test_windows_do_not_depend_on_how_they_are_read_and_held(
    tmp_path_factory, lengths, stated, pairing, read, labels, limit
):
    pytest.importorskip("robomimic.utils.dataset")
    path = write_file(tmp_path_factory.mktemp("x") / "x_demo.hdf5", lengths, stated, labels)
    shifted = pairing == "aligned" and stated in (None, "libero", b"libero")
    frames = sum(n - shifted for n in lengths[:limit])
    source = DemoSource(path, SPEC, limit, pairing, read)
    ways = [{"memory": memory} for memory in ("host", "disk", "device", "auto")]
    if not frames:
        for how in ways:
            with pytest.raises(DataError, match="demonstration"):
                everything(source, **how)
        return
    first, *others = (everything(source, **how) for how in ways)
    others.append(arrays(read_with_robomimic(source, LANGUAGE)))
    assert len(first[0]) == frames
    for other in others:
        assert all(torch.equal(a, b) for a, b in zip(first, other, strict=True))
    with h5py.File(path) as file:  # written out: observation t with action t + 1, or with action t
        key = "expert_actions" if labels and read == "expert" else "actions"
        expected = np.concatenate(
            [file[f"data/demo_{k}/{key}"][shifted:] for k in range(len(lengths))][:limit]
        )
    assert torch.equal(first[2][:, 0], torch.from_numpy(expected.astype(np.float32)))


@pytest.mark.parametrize("stated", ["bogus", b"bogus", 1])
@pytest.mark.parametrize("how", [{"memory": "host"}, {"memory": "disk"}])
def test_an_unknown_pairing_gives_no_windows(tmp_path, stated, how):
    path = write_file(tmp_path / "x_demo.hdf5", pairing=stated)
    with pytest.raises(DemoError, match=r"x_demo\.hdf5.*pairing"):
        open_windows(DemoSource(path, SPEC), language=LANGUAGE, **how)


@pytest.mark.parametrize("key", ["actions", "obs/ee_pos"])
@pytest.mark.parametrize("how", [{"memory": "host"}, {"memory": "disk"}])
def test_values_that_are_not_finite_name_the_file_instead_of_the_learning_rate(tmp_path, key, how):
    path = write_file(tmp_path / "x_demo.hdf5")
    with h5py.File(path, "a") as file:
        file[f"data/demo_1/{key}"][2, 0] = np.nan
    with pytest.raises(DemoError, match=rf"x_demo\.hdf5: demo_1/{key} .*nan at step 2"):
        open_windows(DemoSource(path, SPEC), language=LANGUAGE, **how)


def test_rows_that_were_never_filled_are_refused(tmp_path, monkeypatch):
    source = DemoSource(write_file(tmp_path / "x_demo.hdf5"), SPEC, pairing="stored")
    for wrong in ([4, 4], [4, 2], [4], [4, 3, 1]):
        monkeypatch.setattr(DemoSource, "lengths", wrong)
        with pytest.raises(DataError, match="changed meanwhile"):
            SequenceVLDataset.from_source(source, language=LANGUAGE)


def test_frames_that_do_not_fit_into_memory_are_refused_before_they_are_read(tmp_path, monkeypatch):
    path = write_file(tmp_path / "x_demo.hdf5")
    monkeypatch.setattr(loading, "host_memory", lambda: (100, 1000))
    monkeypatch.setattr(dataset.torch, "empty", None)
    with pytest.raises(
        DataError, match=r"needs 360 B of host memory and 100 B are free; set data\.memory=disk"
    ):
        open_windows(DemoSource(path, SPEC), language=LANGUAGE, memory="host")
