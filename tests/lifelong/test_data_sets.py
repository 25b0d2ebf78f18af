"""Data sets of LeRobot and of TensorFlow Datasets are learned from as the files that they were made of."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch

from libero_env.assets.pack import select_pack
from libero_env.demos.agreement import stated_facts
from libero_env.demos.read import read_demos
from libero_env.errors import DemoError, LiberoError
from libero_env.tasks import get_suite
from libero_integrations.exports import demonstrations as exports
from libero_integrations.exports.layouts import GRIPPER, ORIGIN, PUBLISHED, RECORDED
from libero_integrations.exports.lerobot import EpisodeDatasetWriter
from lifelong.data import DemoSource, demonstrations, open_windows
from lifelong.data.settings import DataSettings
from lifelong.errors import DataError
from tests.harness.demos import episode, write

pytest.importorskip("av")
parquet = pytest.importorskip("pyarrow.parquet")
TASKS = get_suite("libero_object").tasks[:2]
PNG = replace(PUBLISHED["physical-intelligence/libero"], mirrored=False)  # lossless
SIZE, LENGTHS = 32, (9, 14)


@pytest.fixture(autouse=True)
def home(tmp_path, monkeypatch):
    monkeypatch.setenv("LIBERO_CACHE", str(tmp_path / "cache"))
    forms = {**RECORDED, "png": PNG, "mirrored": replace(PNG, mirrored=True)}
    forms["open"] = replace(PNG, open_gripper=True)
    monkeypatch.setattr(exports, "RECORDED", forms)


def smooth(seed, steps):
    """Return an episode whose images change slowly, so that videos and JPEG preserve them, with a binary gripper."""
    one = episode(seed, steps, SIZE)
    one.actions[:, 6] = np.where(np.arange(steps) < steps // 2, -1.0, 1.0)
    one.expert_actions[:, 6] = one.actions[:, 6]
    row = np.linspace(0, 180, SIZE)
    for k, key in enumerate(("agentview_rgb", "eye_in_hand_rgb")):
        frames = [row[:, None] * 0.6 + row[None] * 0.4 + 2 * t + 10 * seed + 9 * k for t in range(steps)]
        one.obs[key] = np.repeat(np.array(frames).astype(np.uint8)[..., None], 3, axis=3)
    return one


def record(path, task, **more):
    pack = select_pack()
    stated = {"bddl_file_name": f"x/{task.name}.bddl", "bddl_file_content": task.bddl_text}
    stated |= {"generator": "scripted-expert-3", "disturbed": True, "robot": "libero"}
    stated["problem_info"] = json.dumps({"language_instruction": task.language})
    stated["models"] = json.dumps({"pack": pack.name, "digest": pack.digest})
    return write(path, [smooth(k, steps) for k, steps in enumerate(LENGTHS)], **(stated | more))


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("recorded")
    return [record(folder / f"{task.name}.hdf5", task) for task in TASKS]


def exported(files, root, form, **options):
    exports.export_demos(files, root, form, progress=False, **options)
    return root


@pytest.fixture
def a_set(files, tmp_path, tmp_path_factory):
    """Return a function that exports the files in a form, once, and returns a copy of the set."""

    def copy(form):
        kept = tmp_path_factory.getbasetemp() / f"set_{form}"
        if not kept.exists():
            exported(files, kept, form)
        return shutil.copytree(kept, tmp_path / "set")

    return copy


def settings(*names, **more):
    what = {"demos": 2, "image_size": SIZE, "seq_len": 3, "views": ["agentview_rgb", "eye_in_hand_rgb"]}
    what |= {"proprio": ["ee_pos", "ee_ori", "gripper_states"], "files": list(map(str, names))}
    return DataSettings(**(what | more))


def find(data, tasks=TASKS, others=()):
    return demonstrations.find_demos(tasks, [data.demos] * len(tasks), data, False, others)


def everything(path, data):
    source = DemoSource(path, data.spec(2), data.demos, data.pairing, data.labels)
    windows = open_windows(source, language=torch.zeros(2))
    batch = windows.batch(torch.arange(len(windows)))
    return {"images": batch.observation.images, "actions": batch.actions} | dict(batch.observation.proprio)


FORMS = dict.fromkeys(("png", "mirrored", "open", "lerobot", "gr00t"), "lerobot") | {"rlds": "rlds"}


@pytest.mark.parametrize(("form", "labels"), [*((form, "expert") for form in FORMS), ("png", "executed")])
def test_windows_are_those_of_the_recording(form, labels, files, tmp_path):
    """To the bit; images of H.264 and JPEG within 6 of 255 levels, 1.5 on average."""
    folder = exported(files, tmp_path / "set", form, labels=labels)
    there, here = settings(f"{FORMS[form]}:{folder}", labels=labels), settings(*files, labels=labels)
    found = find(there)
    assert found == find(there) != find(here)
    for mine, theirs in zip(find(here), found, strict=True):
        expected, read = everything(mine, here), everything(theirs, there)
        images = expected.pop("images")  # which this writer does not turn, whatever the layout says
        images = images.flip(-2) if form == "mirrored" else images
        apart = (images.int() - read.pop("images").int()).abs()
        if form in ("png", "mirrored", "open"):
            assert not apart.any()
        else:
            assert apart.max() <= 6 and apart.float().mean() < 1.5
        assert all(torch.equal(values, read[name]) for name, values in expected.items())
    assert {stated_facts(path)["labels"] for path in found} == {
        stated_facts(path, labels)["labels"] for path in files
    }


def test_a_part_of_a_set_is_converted_and_continued(a_set):
    folder = a_set("rlds")
    few = find(settings(f"rlds:{folder}", demos=1), TASKS[1:], others=TASKS[:1])
    assert [len(read_demos(path)) for path in few] == [1]
    both = find(settings(f"rlds:{folder}"))
    assert both[1:] == few and [len(read_demos(path)) for path in both] == [2, 2]
    with pytest.raises(DataError, match="rlds:.* has 2 demonstrations and 3 are required; use data.demos=2"):
        find(settings(f"rlds:{folder}", demos=3))


def edit(file, **changes):
    values = json.loads(file.read_text())
    for name, value in changes.items():
        *path, last = name.split("__")
        part = values
        for key in path:
            part = part[key]
        part[last] = value
    file.write_text(json.dumps(values))


def change(**changes):
    return lambda folder: edit(folder / ORIGIN, **changes)


def info(**changes):
    return lambda folder: edit(folder / "meta/info.json", **changes)


def cut(folder):
    for file in sorted(folder.glob("data/*/*.parquet"))[:1]:
        table = parquet.read_table(file)
        parquet.write_table(table.slice(1), file)


def flip_a_bit(folder):
    (file,) = folder.glob("1.0.0/*.tfrecord-*")
    content = bytearray(file.read_bytes())
    content[len(content) // 5] ^= 1
    file.write_bytes(content)


STATE = "features__state__names"


@pytest.mark.parametrize(("form", "spoil", "words"), [
    ("png", change(control_hz=10), "was recorded at 10 Hz; runs act at 20 Hz"),
    ("png", change(control_delta=False), "control_delta False of the controller.*relative actions of OSC_POSE"),
    ("png", change(controller="joint_position"), "type 'joint_position' of the controller"),
    ("png", change(robot="robosuite-1.4.1"), "has the robot robosuite-1.4.1"),
    ("png", change(perturb="light=0.5"), "was rendered under light=0.5"),
    ("png", change(models=[{"pack": "moon", "digest": "0"}]), "shows the models moon 0"),
    ("png", change(actions_are="executed"), "has no expert_actions, and noise.*data.labels=executed"),
    ("png", change(gripper=GRIPPER[True]), r"episode 0 has .*-1.* for the gripper, and 1 opens, 0 closes"),
    ("open", change(gripper=GRIPPER[False]), r"has \[0.0, 1.0\] for the gripper, and -1 opens"),
    ("png", change(gripper="closes"), "libero.json: gripper is 'closes'; expected '-1 opens"),
    ("png", change(images__first_row="left"), "images.first_row is 'left'"),
    ("png", change(images="upright"), "libero.json cannot be read"),
    ("png", info(**{STATE: ["x", "y", "z", "qx", "qy", "qz", "qw", "finger"]}), "state is x, y, z, qx.*rotation"),
    ("png", info(codebase_version="v1.6"), "has version 'v1.6'.*expected v2 or v3.0"),
    ("png", info(data_path="../{episode_index}.parquet"), "data in '../{episode_index}.parquet'"),
    ("png", info(fps="ten"), "info.json: fps is 'ten'"),
    ("png", lambda folder: (folder / ORIGIN).write_text("["), "libero.json.*not JSON"),
    ("png", lambda folder: shutil.rmtree(folder / "data"), "episode 0 cannot be read"),
    ("png", cut, "has 8 frames.*damaged"),
    ("lerobot", info(fps=7), "has no 9 frames from 0 s on at 7 per second"),
    ("rlds", flip_a_bit, "record [01] .*(damaged|not whole|cannot be read)"),
    ("rlds", lambda folder: (folder / "1.0.0/features.json").unlink(), "has 0 files features.json"),
    ("png", shutil.rmtree, "no such folder"),
])  # fmt: skip
def test_sets_that_do_not_fit_are_refused_by_name(form, spoil, words, a_set):
    folder = a_set(form)
    spoil(folder)
    with pytest.raises(LiberoError, match=words) as caught:
        find(settings(f"{FORMS[form]}:{folder}"))
    assert str(folder) in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(("more", "words"), [
    ({"labels": "executed"}, "has the intended actions only"),
    ({"image_size": 16}, "images of 32x32 pixels.*use data.image_size=32"),
    ({"proprio": ["joint_states"]}, "has no joint_states, which data.proprio has; use of gripper_states"),
])  # fmt: skip
def test_settings_that_a_set_does_not_fit_are_named_before_it_is_converted(more, words, a_set, tmp_path):
    folder = a_set("png")
    with pytest.raises(LiberoError, match=f"lerobot:{folder}.*{words}"):
        find(settings(f"lerobot:{folder}", **more))
    made = list((tmp_path / "cache").rglob("*.hdf5"))
    assert all(len(read_demos(path)) == 1 for path in made)


def test_goals_are_not_taken_for_relative_actions(tmp_path):
    for shape, words in (
        (8, "has actions .9, 8.; expected"),
        (7, "has a motion of 3; expected relative ones"),
    ):
        one = smooth(0, LENGTHS[0])
        one.expert_actions[:, 5] = 3.0
        layout = replace(PNG, action_dim=8)
        writer = EpisodeDatasetWriter(tmp_path / str(shape), PNG if shape == 7 else layout)
        actions = np.tile(one.actions, 2)[:, :shape]
        actions[:, 5] = 3.0
        writer.add(replace(one, actions=actions), TASKS[0].language, "x")
        writer.finish()
        with pytest.raises(DemoError, match=words):
            find(settings(f"lerobot:{tmp_path / str(shape)}"), TASKS[:1])


@pytest.mark.parametrize("name", PUBLISHED)
def test_a_published_set_is_known_by_its_features(name, files, tmp_path, monkeypatch, capsys):
    """Which do not say that its images are mirrored; our own without their file say too little."""
    layout = PUBLISHED[name]
    monkeypatch.setitem(exports.RECORDED, "theirs", layout)
    folder = exported(files[:1], tmp_path / "set", "theirs", labels="executed")
    (folder / ORIGIN).unlink()
    form = "rlds" if layout.version == "rlds" else "lerobot"
    (path,) = find(settings(f"{form}:{folder}", labels="executed"), TASKS[:1])
    assert (
        f"read as {name}, with mirrored images, at 20 Hz, {GRIPPER[layout.open_gripper]}"
        in capsys.readouterr().err
    )
    read, recorded = read_demos(path)[0], read_demos(files[0], labels="executed")[0]
    np.testing.assert_array_equal(read.actions, recorded.actions.astype(np.float32))
    apart = read.obs["agentview_rgb"].astype(int) - recorded.obs["agentview_rgb"][:, :, ::-1]
    assert np.abs(apart).mean() < 4.0


def test_a_set_that_says_nothing_is_refused(a_set):
    folder = a_set("lerobot")
    (folder / ORIGIN).unlink()
    with pytest.raises(DemoError, match="does not say how it was made.*images.mirrored"):
        find(settings(f"lerobot:{folder}"))


def test_an_instruction_of_several_tasks_is_refused(tmp_path):
    two = [t for t in get_suite("libero_90").tasks if t.language == "turn on the stove"]
    folder = exported([record(tmp_path / "a.hdf5", two[0])], tmp_path / "set", "png")
    names = ", ".join(sorted(task.id for task in two))
    with pytest.raises(DemoError, match=f"'turn on the stove' is the instruction of {names}"):
        find(settings(f"lerobot:{folder}"), two[:1])


def test_a_set_of_other_tasks_is_refused(files, tmp_path):
    folder = exported(files[:1], tmp_path / "set", "png")
    with pytest.raises(DemoError, match=f"no episode of a task of this run; .* are '{TASKS[0].language}'"):
        find(settings(f"lerobot:{folder}"), TASKS[1:])
