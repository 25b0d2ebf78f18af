"""Tools for demonstration files: their task, their statistics, and filtering."""

from dataclasses import replace

import h5py
import numpy as np
import pytest

from libero_cli.main import main
from libero_env.curating.curate import examine, filter_demos
from libero_env.demos.contents import read_header
from libero_env.demos.observe import recorded_task
from libero_env.demos.read import noop_steps, read_episodes
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
    assert noop_steps(actions, threshold=2.0).sum() == len(actions) - 1  # that of the gripper remains


def test_statistics_of_a_file(path):
    stats = examine(path)
    assert stats.lengths == (11, 11, 11) and stats.successes == 2 and stats.noops == 4 and not stats.faults
    assert "2 of 3 successful" in str(stats) and f"{100 * 4 / 33:.1f} % no-ops" in str(stats)


def test_faults_are_named(path):
    with h5py.File(path, "r+") as handle:
        handle["data/demo_1/actions"][0, 0] = 3.0
        del handle["data/demo_2/obs/joint_states"]
        handle["data"].attrs["total"] = 7
    faults = "\n".join(examine(path).faults)
    for words in ("demo_1/actions reach 3.00", "demo_2 has no obs/joint_states", "total is 7; expected 33"):
        assert words in faults, faults


@pytest.mark.parametrize("chosen", [{}, {"success_only": True, "without_noops": True}], ids=str)
def test_filtering_keeps_the_chosen_steps_unchanged(path, tmp_path, chosen):
    stats = filter_demos(path, tmp_path / "b.hdf5", **chosen)
    steps = np.setdiff1d(np.arange(11), [3, 4]) if chosen else np.arange(11)
    kept, whole = list(read_episodes(tmp_path / "b.hdf5")), list(read_episodes(path))
    numbers = [0, 2] if chosen else [0, 1, 2]
    assert stats.lengths == (len(steps),) * len(numbers) and stats.successes == 2
    assert stats.noops == (0 if chosen else 4)
    for demo, number in zip(kept, numbers, strict=True):
        source = whole[number]
        for key in ("actions", "states", "robot_states", "expert_actions"):
            np.testing.assert_array_equal(getattr(demo, key), getattr(source, key)[steps], err_msg=key)
        assert demo.obs.keys() == source.obs.keys() and demo.success == source.success
        assert all(np.array_equal(demo.obs[key], source.obs[key][steps]) for key in demo.obs)
        assert not chosen or demo.attrs["source_demo"] == f"demo_{number}"


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


@pytest.mark.parametrize("name", ["/home/me/LIBERO/bddl_files/libero_object/{}.bddl", "x/my_task.bddl"])
def test_the_name_of_an_open_file_is_no_task_text(name, tmp_path, capsys):
    """The original's collector stores `str(open(file))`: the name decides, and else the user."""
    task = get_task("libero_object/3")
    raw, known = {"bddl_file_content": "<_io.TextIOWrapper name='x' mode='r'>"}, "{}" in name
    path = write(tmp_path / "raw.hdf5", [episode(0)], bddl_file_name=name.format(task.name), **raw)
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
    q01, _, q50, _, q99 = np.quantile(pixels, QUANTILES, axis=0, method="inverted_cdf")
    expected = {"min": pixels.min(0), "max": pixels.max(0), "mean": pixels.mean(0), "std": pixels.std(0)}
    for name, values in {**expected, "q01": q01, "q50": q50, "q99": q99}.items():
        np.testing.assert_allclose(np.ravel(found[name]), values, atol=1e-9, err_msg=name)
        assert np.shape(found[name]) == (3, 1, 1)
    assert found["count"] == [20]
