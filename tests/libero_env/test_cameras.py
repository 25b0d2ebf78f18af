"""Added cameras: they show what a pinhole camera shows, change nothing else, and go wherever cameras go."""

import numpy as np
import pytest
import yaml

from libero_cli.main import main
from libero_env import BatchEnv, Camera, LiberoEnv, make_task, read_demos, read_task
from libero_env.curating.rendering import rerender
from libero_env.demos.config import RenderConfig
from libero_env.demos.contents import read_header
from libero_env.demos.observe import recorded_rendering
from libero_env.errors import InvalidInputError, LiberoError, RenderError, UnknownNameError
from libero_env.sim.render import largest_image
from libero_env.tasks import bddl
from tests.harness.demos import record_wander

pytestmark = pytest.mark.sim
TASK = "libero_goal/3"
TOP = Camera("top", pos=(0.1, -0.3, 1.9), lookat=(0.0, 0.0, 0.9), fovy=60)
PLATE = {"scene": "kitchen", "objects": ["plate"], "goal": "Up plate_1", "language": "lift the plate"}
PLATE |= {"place": {"plate_1": {"at": [0.05, 0.1], "half": 0.0}}}


def start(env):
    return env.reset(options={"init_state": 0})[0]


def copy_of(env, name, **more):
    """Return a camera where one of the scene is."""
    camera = env.scene.model.camera(name)
    body = env.scene.model.body(int(camera.bodyid[0])).name
    return Camera("copy", camera.pos, quat=camera.quat, fovy=camera.fovy[0], body=body, **more)


@pytest.mark.parametrize("drawing", ["fast", "faithful"])
@pytest.mark.parametrize("name", ["agentview", "robot0_eye_in_hand"])
def test_a_camera_where_another_is_has_its_pictures_and_changes_none(closing, name, drawing):
    plain = closing(LiberoEnv(TASK, drawing=drawing))
    seen = start(plain)
    more = closing(LiberoEnv(TASK, drawing=drawing, cameras=(copy_of(plain, name), *plain.config.cameras)))
    both = start(more)
    for key, value in seen.items():
        np.testing.assert_array_equal(both[key], value)
    np.testing.assert_array_equal(both["copy_rgb"], both[f"{name.removeprefix('robot0_')}_rgb"])
    assert more.observation_space.contains(both)


@pytest.mark.parametrize("drawing", ["fast", "faithful"])
def test_a_picture_does_not_depend_on_which_others_are_drawn_with_it(closing, drawing):
    both = ("agentview", "robot0_eye_in_hand")
    sets = (both, both[::-1], both[:1], both[1:], (TOP, *both))
    envs = [closing(LiberoEnv(TASK, cameras=cameras, camera_size=32, drawing=drawing)) for cameras in sets]
    expected = start(envs[0])
    for env in envs:
        seen = start(env)
        for name in {*seen} & {"agentview_rgb", "eye_in_hand_rgb"}:
            np.testing.assert_array_equal(seen[name], expected[name])
        np.testing.assert_array_equal(env.observer.render(0, both[1]), expected["eye_in_hand_rgb"])


@pytest.mark.parametrize(("fovy", "height"), [(60, 120), (30, 200)])
def test_a_point_is_where_a_pinhole_camera_has_it(closing, fovy, height):
    """A plate beside the optical axis, seen straight from above, and another camera that looks at it."""
    task = make_task(**PLATE)
    plate = start(closing(LiberoEnv(task, cameras=(), observations=("objects",))))["plate_1_pos"]
    above = Camera("above", plate + (-0.1, 0.05, 0.8), lookat=plate + (-0.1, 0.05, 0.0), fovy=fovy)
    aside = Camera("aside", plate + (0.9, -0.4, 0.7), lookat=plate, fovy=fovy)
    options = {"camera_size": (height, 160), "observations": ("segmentation_instance",)}
    env = closing(LiberoEnv(task, cameras=[above, aside], **options))
    seen = start(env)
    number = next(n for n, name in env.observer.labels().items() if name == "plate_1")
    focal = 0.5 * height / np.tan(np.deg2rad(fovy) / 2)
    beside = height / 2 - focal * 0.1 / 0.8, 80 + focal * 0.05 / 0.8  # up is +x, right is -y
    expected = {"above": (beside, 0.005 * focal / 0.8), "aside": ((height / 2, 80), 0.015 * focal / 1.2)}
    for name, (place, height_of_the_plate) in expected.items():
        middle = np.argwhere(seen[f"{name}_segmentation"] == number).mean(axis=0) + 0.5
        np.testing.assert_allclose(middle, place, atol=height_of_the_plate)
    np.testing.assert_allclose(env.observer.camera_to_world(0, "aside")[:3, 3], aside.pos)


def test_batches_have_added_cameras_and_fixed_ones_move_with_their_body(closing):
    on_plate = Camera("on_plate", (0, 0, 0.5), lookat=(0, 0, 0), body="plate_1")
    env = closing(BatchEnv(TASK, 2, cameras=("agentview", TOP, str(on_plate)), camera_size=32))
    seen, _ = env.reset(options={"init_state": [0, 1]})
    assert seen["top_rgb"].shape == seen["on_plate_rgb"].shape == (2, 32, 32, 3)
    for i in range(2):
        plate = env.simulations.fields["xpos"][i][env.scene.model.body("plate_1_main").id]
        seen_from = env.observer.camera_to_world(i, "on_plate")[:3, 3]
        np.testing.assert_allclose(np.linalg.norm(seen_from - plate), 0.5)
    assert env.config.cameras == ("agentview", str(TOP), str(on_plate))


def test_pictures_are_as_large_as_opengl_draws_them(closing):
    large, small = (closing(LiberoEnv(TASK, cameras=[TOP], camera_size=n)) for n in (2048, 512))
    mean = start(large)["top_rgb"].reshape(512, 4, 512, 4, 3).mean(axis=(1, 3))
    assert np.abs(mean - start(small)["top_rgb"]).mean() < 2  # grey levels: edges only
    limit = largest_image()
    with pytest.raises(RenderError, match=rf"{limit + 1}x8 pixels is not valid; .* from 1 to {limit} here"):
        LiberoEnv(TASK, cameras=[TOP], camera_size=(limit + 1, 8))


def test_a_task_file_has_cameras(tmp_path, closing, capsys):
    views = {"top": {"pos": [0.1, -0.3, 1.9], "lookat": [0, 0, 0.9], "fovy": 60}}
    path = tmp_path / "plate.yaml"
    path.write_text(yaml.safe_dump(PLATE))
    plain = read_task(path)
    path.write_text(yaml.safe_dump(PLATE | {"cameras": views}))
    task = read_task(path)
    assert task.problem.cameras == (TOP,)
    assert bddl.parse(task.bddl_text) == task.problem
    own, given = (closing(LiberoEnv(t, cameras=[c])) for t, c in ((task, "top"), (plain, TOP)))
    np.testing.assert_array_equal(start(own)["top_rgb"], start(given)["top_rgb"])
    with pytest.raises(InvalidInputError, match="camera top: the scene has a camera of this name"):
        LiberoEnv(task, cameras=[TOP])
    text = "far,pos=2 0 2,lookat=0 0 1"
    command = ["tasks", "preview", str(path), "--starts", "1", "--cameras", "top", text, "--size", "64"]
    assert main([*command, "--out", str(tmp_path / "sheet.png")]) == 0
    assert main([*command[:-4], "nope", "--out", str(tmp_path / "none.png")]) == 2
    assert "unknown camera 'nope'. Valid: agentview, birdview" in capsys.readouterr().err


@pytest.mark.parametrize(("view", "message"), [
    ("{pos: [0, 0], lookat: [0, 0, 1]}", "cameras.top.pos is [0, 0]; list should have at least 3 items"),
    ("{pos: [0, 0, 1], quat: [0, 0, 0, 0]}", "camera top: its quat is zero"),
    ("{pos: [0, 0, 1], lookat: [0, 0, 0], fovy: 0}", "Camera: fovy is 0"),
])  # fmt: skip
def test_wrong_cameras_of_a_task_file_are_one_line(tmp_path, view, message):
    path = tmp_path / "plate.yaml"
    path.write_text(yaml.safe_dump(PLATE, sort_keys=False) + f"cameras:\n  top: {view}\n")
    with pytest.raises(InvalidInputError) as caught:
        read_task(path)
    line = path.read_text().splitlines().index(f"  top: {view}") + 1
    assert str(caught.value).startswith(f"{path}:{line}: {message}") and "\n" not in str(caught.value)


TEXT = "pos=0 0 1,lookat=0 0 0"


@pytest.mark.parametrize(("cameras", "message"), [
    (["agentview", TOP, TOP], "2 cameras have images top_"),
    ([f"eye_in_hand,{TEXT}"], "camera eye_in_hand: the scene has a camera of this name"),
    ([f"agentview,{TEXT}"], "camera agentview: the scene has a camera of this name"),
    (["agentveiw"], "unknown camera 'agentveiw'. Did you mean 'agentview'"),
    (["top,pos=0 0 1e-300,lookat=0 0 0"], "camera top looks at the point where it is"),
    ([f"top,{TEXT},quat=1 0 0 0"], "camera top: give one of quat and lookat"),
    ([f"top,{TEXT},body=plate_2"], "unknown body of camera top 'plate_2'"),
    (["top,lookat=0 0 0"], "it has no pos; expected NAME,pos=X Y Z"),
    ([f"top,{TEXT},fov=3"], "'fov=3' is not valid; expected NAME,pos=X Y Z"),
    (["top,pos=0 0 nan,lookat=0 0 0"], "pos.2 is nan; expected a finite number"),
    ([f"robot0_x,{TEXT}"], "is one of the robot"),
    (TOP, "cameras is Camera"),
])  # fmt: skip
def test_wrong_cameras_of_an_environment_are_one_line(cameras, message):
    with pytest.raises(LiberoError) as caught:
        LiberoEnv(TASK, cameras=cameras)
    assert message in str(caught.value) and "\n" not in str(caught.value)


def test_recordings_have_added_cameras_and_say_where_they_are(tmp_path, closing):
    path = record_wander(tmp_path / "goal.hdf5", TASK, (24, 32))
    out = rerender(path, tmp_path / "seen.hdf5", RenderConfig(cameras=["agentview", TOP], size=(24, 32)))
    assert list(read_header(out)["cameras"]) == ["agentview", str(TOP)]
    assert recorded_rendering(out).cameras == ("agentview", str(TOP))
    plain, seen = (next(iter(read_demos(p))) for p in (path, out))
    np.testing.assert_array_equal(seen.obs["agentview_rgb"], plain.obs["agentview_rgb"])
    assert seen.obs["top_rgb"].shape == plain.obs["agentview_rgb"].shape
    again = rerender(out, tmp_path / "again.hdf5", recorded_rendering(out))
    np.testing.assert_array_equal(next(iter(read_demos(again))).obs["top_rgb"], seen.obs["top_rgb"])
    video = tmp_path / "top.gif"
    main(["demos", "replay", str(path), "--by", "state", "--video", str(video), "--cameras", str(TOP)])
    assert video.is_file()


def test_the_text_of_a_camera_is_the_camera():
    turned = Camera("a.b", (0.1, 2, 1 / 3), quat=(0.5, -0.5, 0.5, 0.5), fovy=12.5, body="plate_1")
    assert [Camera.read(str(camera)) for camera in (TOP, turned)] == [TOP, turned]
    with pytest.raises(UnknownNameError, match="environment option"):
        LiberoEnv(TASK, camera=[TOP])
