"""Tools for demonstration files: their task, their statistics, filtering, and reading with robomimic."""

from dataclasses import replace

import h5py
import numpy as np
import pytest

from libero_cli.main import main
from libero_env.curating.curate import examine, filter_demos
from libero_env.demos.contents import read_header
from libero_env.demos.observe import recorded_task
from libero_env.demos.read import noop_steps, read_demos, read_episodes
from libero_env.errors import DemoError
from libero_env.tasks import get_task, write_task
from libero_env.tasks.problem import same_meaning
from libero_integrations.exports.lerobot import QUANTILES, colour_counts, colour_statistics
from tests.harness.demos import episode, write


def with_noops(seed):
    """Return an episode with no-ops in steps 3 and 4; in step 7 the gripper begins to close without motion."""
    one = episode(seed)
    one.expert_actions[:, 6] = -1.0
    one.expert_actions[7:, 6] = 1.0
    one.expert_actions[[3, 4, 7], :6] = 0.0
    return one


@pytest.fixture
def path(tmp_path):
    return write(tmp_path / "a_demo.hdf5", [with_noops(0), replace(episode(1), success=False), with_noops(2)])


def test_a_no_op_neither_moves_nor_changes_the_gripper():
    actions = with_noops(0).expert_actions
    assert np.flatnonzero(noop_steps(actions)).tolist() == [3, 4]
    assert (
        noop_steps(actions, threshold=2.0).sum() == len(actions) - 1
    )  # the step with the gripper command remains


def test_statistics_of_a_file(path):
    stats = examine(path)
    assert stats.lengths == (11, 11, 11) and stats.successes == 2 and stats.noops == 4 and not stats.faults
    assert "2 of 3 successful" in str(stats) and f"{100 * 4 / 33:.1f} % no-ops" in str(stats)


def test_faults_are_named(path):
    with h5py.File(path, "r+") as handle:
        handle["data/demo_1/actions"][0, 0] = 3.0
        handle["data/demo_2/obs/ee_pos"][4] = np.nan
        del handle["data/demo_2/obs/joint_states"]
        handle["data"].attrs["total"] = 7
    faults = "\n".join(examine(path).faults)
    for words in (
        "demo_1/actions reach 3.00",
        "demo_2/obs/ee_pos has values that are not finite",
        "demo_2 has no obs/joint_states",
        "total is 7; expected 33",
    ):
        assert words in faults, faults


def test_filtering_keeps_the_chosen_steps_unchanged(path, tmp_path):
    stats = filter_demos(path, tmp_path / "b.hdf5", success_only=True, without_noops=True)
    assert stats.lengths == (9, 9) and stats.successes == 2 and stats.noops == 0
    kept, whole = read_demos(tmp_path / "b.hdf5"), read_demos(path)
    steps = np.setdiff1d(np.arange(11), [3, 4])
    for demo, source in zip(kept, (whole[0], whole[2]), strict=True):
        np.testing.assert_array_equal(demo.actions, source.actions[steps])
        np.testing.assert_array_equal(demo.states, source.states[steps])
        for key, values in source.obs.items():
            np.testing.assert_array_equal(demo.obs[key], values[steps])
    with h5py.File(tmp_path / "b.hdf5") as handle:
        assert [handle[f"data/demo_{i}"].attrs["source_demo"] for i in range(2)] == ["demo_0", "demo_2"]


def test_filters_of_filtered_files_are_all_stated(path, tmp_path):
    filter_demos(path, tmp_path / "b.hdf5", without_noops=True)
    filter_demos(tmp_path / "b.hdf5", tmp_path / "c.hdf5", success_only=True)
    assert read_header(tmp_path / "c.hdf5")["filter"] == "without no-ops, then without failures"


def test_rewards_decide_success_where_it_is_not_stated(tmp_path):
    file = write(tmp_path / "foreign.hdf5", [replace(episode(1), success=False)])
    with h5py.File(file, "r+") as handle:
        demo = handle["data/demo_0"]
        del demo.attrs["success"]
        demo["dones"][-1] = 1  # of an episode that ended in failure, too
    assert examine(file).successes == 0
    with h5py.File(file, "r+") as handle:
        del handle["data/demo_0/rewards"]
    assert examine(file).successes == 1


def test_no_ops_of_a_copy_are_those_of_the_given_threshold(path, tmp_path):
    stats = filter_demos(path, tmp_path / "b.hdf5", threshold=1.0)
    assert stats.noops == examine(path, threshold=1.0).noops > examine(path).noops


def test_filtering_nothing_changes_nothing(path, tmp_path):
    filter_demos(path, tmp_path / "b.hdf5")
    for a, b in zip(read_episodes(path), read_episodes(tmp_path / "b.hdf5"), strict=True):
        for key in ("actions", "states", "robot_states", "expert_actions"):
            np.testing.assert_array_equal(getattr(a, key), getattr(b, key), err_msg=a.name)
        assert a.obs.keys() == b.obs.keys() and a.success == b.success
        assert all(np.array_equal(a.obs[key], b.obs[key]) for key in a.obs)


def test_existing_files_are_not_overwritten_and_empty_ones_not_written(path, tmp_path):
    with pytest.raises(DemoError, match="exists"):
        filter_demos(path, path)
    failed = write(tmp_path / "failures.hdf5", [replace(episode(1), success=False)])
    with pytest.raises(DemoError, match="no demonstration is successful"):
        filter_demos(failed, tmp_path / "c.hdf5", success_only=True)
    assert not (tmp_path / "c.hdf5").exists()


def test_the_task_is_found_by_name_and_by_text(tmp_path):
    task = get_task("libero_goal/3")
    names = {"bddl_file_name": f"somewhere/bddl_files/libero_goal/{task.name}.bddl"}
    known = write(tmp_path / "known.hdf5", [episode(0)], **names, bddl_file_content=task.bddl_text)
    assert recorded_task(known) is task
    bare = write(tmp_path / "bare.hdf5", [episode(0)], **names, bddl_file_content="")
    assert recorded_task(bare) is task
    other = task.bddl_text.replace("(:language ", "(:language Please ")
    own = recorded_task(write(tmp_path / "own.hdf5", [episode(0)], **names, bddl_file_content=other))
    assert own.id == "file/0" and own.name == task.name and own.problem.objects == task.problem.objects
    nameless = write(tmp_path / "no.hdf5", [episode(0)], bddl_file_name="x.bddl", bddl_file_content="")
    with pytest.raises(DemoError, match="bddl_file_name"):
        recorded_task(nameless)


@pytest.mark.parametrize(
    "name", ["/home/me/LIBERO/libero/bddl_files/libero_object/{}.bddl", "x/my_task.bddl"]
)
def test_the_name_of_an_open_file_is_no_task_text(name, tmp_path, capsys):
    """The original's collector stores `str(open(file))`: the name decides, and else the user."""
    task = get_task("libero_object/3")
    raw = {
        "bddl_file_name": name.format(task.name),
        "bddl_file_content": "<_io.TextIOWrapper name='x' mode='r'>",
    }
    path, known = write(tmp_path / "raw.hdf5", [episode(0)], **raw), "{}" in name
    assert main(["demos", "check", str(path)]) == 0
    assert ("name its task file with --bddl" in capsys.readouterr().out) != known
    if known:
        assert recorded_task(path) is task
    else:
        with pytest.raises(DemoError, match="_io.TextIOWrapper.*--bddl"):
            recorded_task(path)
    bddl = write_task(task, tmp_path / "own.bddl")
    for out, words in (("kept.hdf5", ["--bddl", str(bddl)]), ("same.hdf5", [])):
        assert main(["demos", "filter", str(path), str(tmp_path / out), *words]) == 0
    stated = recorded_task(tmp_path / "kept.hdf5")
    assert same_meaning(stated.problem, task.problem), "the new file states the task that was named"
    assert read_header(tmp_path / "kept.hdf5")["bddl_file_content"].startswith("(define")


def test_views_that_are_missing_are_told(tmp_path, capsys):
    blind = episode(0)
    del blind.obs["agentview_rgb"]
    path = write(tmp_path / "blind.hdf5", [blind])
    assert main(["demos", "check", str(path)]) == 0
    out = capsys.readouterr().out
    assert "note" in out and "has no agentview_rgb: no policy" in out and "eye_in_hand_rgb:" not in out


def test_statistics_of_histograms_are_those_of_the_pixels():
    rng = np.random.default_rng(0)
    frames = np.clip(rng.normal(100, 60, (20, 8, 8, 3)), 0, 255).astype(np.uint8)
    found = colour_statistics(colour_counts(frames[:7]) + colour_counts(frames[7:]), len(frames))
    pixels = frames.reshape(-1, 3) / 255.0
    quantiles = np.quantile(pixels, QUANTILES, axis=0, method="inverted_cdf")
    for name, expected in {
        "min": pixels.min(0),
        "max": pixels.max(0),
        "mean": pixels.mean(0),
        "std": pixels.std(0),
        "q01": quantiles[0],
        "q50": quantiles[2],
        "q99": quantiles[4],
    }.items():
        np.testing.assert_allclose(np.ravel(found[name]), expected, atol=1e-9, err_msg=name)
        assert np.shape(found[name]) == (3, 1, 1)
    assert found["count"] == [20]


def test_robomimic_reads_the_files(path):
    dataset = pytest.importorskip("robomimic.utils.dataset")
    obs_utils = pytest.importorskip("robomimic.utils.obs_utils")
    obs_utils.initialize_obs_utils_with_obs_specs(
        {"obs": {"low_dim": ["joint_states"], "rgb": ["agentview_rgb"]}}
    )
    windows = dataset.SequenceDataset(
        str(path),
        obs_keys=("joint_states", "agentview_rgb"),
        dataset_keys=("actions", "rewards", "dones"),
        load_next_obs=False,
        frame_stack=1,
        seq_length=4,
        hdf5_cache_mode=None,
    )
    assert windows.n_demos == 3 and len(windows) == 33
    np.testing.assert_array_equal(windows[0]["actions"], episode(0).actions[:4])
