"""The scene in the browser: frames, predicates, perturbations and a policy that acts; the page and its socket."""

import contextlib
import socket
import threading
import time
import urllib.error
import urllib.request
from contextlib import closing
from dataclasses import replace

import h5py
import msgpack
import numpy as np
import pytest
import viser
import zstandard
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from libero_cli.main import main
from libero_env.envs.env import LiberoEnv
from libero_env.errors import InvalidInputError, LiberoError
from libero_env.perturbations import Perturbation
from libero_env.tasks import Atom, Not, Then, bddl, get_task
from libero_eval.requests import ViewRequest
from libero_integrations.stage import POLICY, Stage
from libero_integrations.viewer import Viewer
from libero_integrations.viewer_gate import Gate
from tests.harness.demos import STEPS, record_wander

pytestmark = pytest.mark.sim
TASK = "libero_goal/7"  # turn on the stove
ON_FROM = 5  # frame of the recording from which the stove is on
ATOM = "(Turnon flat_stove_1)"


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    path = record_wander(tmp_path_factory.mktemp("demos") / "stove.hdf5", TASK, (16, 16))
    with LiberoEnv(TASK, cameras=()) as env:
        (knob,) = env.scene.joints["flat_stove_1"]
        column = 1 + env.scene.model.jnt_qposadr[knob]
        on = np.mean(env.scene.entities["flat_stove_1"].articulation["turnon"])
    with h5py.File(path, "r+") as file:
        file["data/demo_1/states"][ON_FROM:, column] = on
    return path


@pytest.fixture
def stage(closing):
    return lambda what, **more: closing(Stage(ViewRequest(what=str(what), **more)))


@pytest.fixture(scope="module")
def open_view():
    with closing(Stage(ViewRequest(what=TASK))) as shown, closing(Viewer(shown, "127.0.0.1", 0)) as view:
        view.open(shown.initial)
        yield view


@pytest.fixture
def viewer(stage):
    opened = []

    def make(what, **more):
        opened.append(Viewer(stage(what, **more), "127.0.0.1", 0))
        opened[-1].open(opened[-1].stage.initial)
        return opened[-1]

    yield make
    for one in opened:
        one.close()


def messages(frame: bytes) -> bytes:
    """Return the messages of a frame: [size, compressed size, messages, arrays]."""
    return zstandard.decompress(frame[16 : 16 + int.from_bytes(frame[8:16], "little")])


def until(viewer: Viewer, condition, seconds: float = 60.0) -> None:
    """Let the viewer look at its controls until a condition holds."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        viewer.update()


def test_predicates_turn_true_in_the_frames_of_a_recording(stage, recording):
    shown = stage(recording)
    assert shown.sources == ("demo_0", "demo_1", POLICY)
    shown.open(replace(shown.initial, source="demo_1"))
    assert len(shown.frames) == STEPS
    assert [truth[ATOM] for truth in shown.truths] == [False] * ON_FROM + [True] * (STEPS - ON_FROM)
    assert f"`{ATOM}` false" in shown.describe(ON_FROM - 1)
    text = shown.describe(STEPS - 1)
    assert f"`{ATOM}` true, since frame {ON_FROM}" in text and "the goal is reached" in text
    with h5py.File(recording) as file:
        states, fixtures = file["data/demo_1/states"][:], file["data/demo_1"].attrs["fixtures"]
    shown.show(7)
    np.testing.assert_array_equal(shown.env.simulations.physics_state(0), states[7])
    np.testing.assert_array_equal(shown.env.simulations.fixtures[0].ravel(), np.ravel(fixtures))


def test_goals_over_time_remember_the_frames_of_a_recording(stage, recording, tmp_path):
    on = Atom("Turnon", ("flat_stove_1",))
    goal = Then((Not(on), on))
    (tmp_path / "then.bddl").write_text(bddl.write(replace(get_task(TASK).problem, goal=goal)))
    shown = stage(recording, bddl=tmp_path / "then.bddl")
    shown.open(replace(shown.initial, source="demo_1"))
    assert shown.is_reached == [False] * ON_FROM + [True] * (STEPS - ON_FROM)


def test_perturbations_change_pictures_and_those_of_physics_are_refused_in_recordings(stage, recording):
    shown = stage(recording)
    shown.open(shown.initial)
    shown.show(3)
    before = shown.picture("agentview")
    shown.open(replace(shown.initial, perturbations=(Perturbation("camera", 1.0),)))
    shown.show(3)
    assert np.abs(shown.picture("agentview").astype(int) - before).mean() > 5
    with pytest.raises(LiberoError, match="layout"):
        shown.open(replace(shown.initial, perturbations=(Perturbation("layout", 1.0),)))


def test_a_policy_acts_in_frames_that_stay(stage):
    shown, steps = stage(TASK, perturb="noise=0.5"), []
    shown.open(shown.initial)
    assert len(shown.frames) == 1

    def look():
        steps.append(len(shown.frames))
        if len(steps) == 6:
            raise StopIteration

    with pytest.raises(StopIteration):
        shown.act(look)
    assert steps == [1, 2, 3, 4, 5, 6]
    arm = []
    for index in (0, 5):
        shown.show(index)
        arm.append(shown.env.simulations.fields["qpos"][0, :7].copy())
        assert shown.env.simulations.data(0).ncon > 0  # contacts can be drawn
    assert np.abs(arm[1] - arm[0]).max() > 1e-3


def test_controls_choose_frames_sources_and_perturbations(viewer, recording):
    view = viewer(recording)
    view.camera.value = "agentview"  # of seven
    view.frame.value = 4
    view.update()
    assert view.shown == 4 and "frame 4" in view.text.content
    view.source.value = "demo_1"
    until(view, lambda: view.stage.choice.source == "demo_1")
    view.play.value = True
    until(view, lambda: not view.play.value)
    assert view.shown == STEPS - 1 and "the goal is reached" in view.text.content
    view.severities["layout"].value = 0.5
    until(view, lambda: "not possible" in view.text.content)
    view.severities["layout"].value = 0.0
    until(view, lambda: "not possible" not in view.text.content)
    view.source.value = POLICY
    until(view, lambda: view.stage.choice.source == POLICY)

    def restart():
        while len(view.stage.frames) < 4:
            time.sleep(0.01)
        view._on_restart(None)

    threading.Thread(target=restart, daemon=True).start()
    view.play.value = True
    view.update()  # until it is started again
    until(view, lambda: len(view.stage.frames) == 1)


def test_a_policy_acts_a_step_at_a_time_and_its_episodes_are_counted(viewer, monkeypatch):
    view = viewer(TASK)
    until(view, lambda: view.stage.frames)
    assert not any(frustum.visible for frustum in view._frustums.values())
    seen = []

    def press():
        for wanted in (2, 3):
            view._on_step(None)
            while len(view.stage.frames) < wanted:
                time.sleep(0.01)
            time.sleep(0.2)
            seen.append(len(view.stage.frames))
        view._on_restart(None)

    view._on_step(None)
    threading.Thread(target=press, daemon=True).start()
    view.update()  # until it is started again
    assert seen == [2, 3]
    until(view, lambda: len(view.stage.frames) == 1)
    monkeypatch.setattr(view.stage, "act", lambda look: None)
    for reached in (True, False):
        view.stage.is_reached[-1] = reached
        view.play.value = True
        view.update()
    assert "1 of 2 episodes of the policy reached the goal" in view.text.content
    view.cameras.value = True
    view._on_change()
    view.update()
    assert all(frustum.visible for frustum in view._frustums.values())


def test_values_that_are_not_offered_do_not_end_it(viewer):
    """Only the page keeps to what is offered; whoever reaches the socket need not."""
    view = viewer(TASK)
    dropdowns = [(control, "nothing") for control in (view.task, view.source, view.camera)]
    for control, value in [*dropdowns, (view.severities["camera"], 5.0)]:
        offered, control._impl.value = control.value, value  # as viser does with a message
        view._is_stale = True
        view.update()
        assert "not possible" in view.text.content
        control._impl.value = offered
        view.update()
        assert "not possible" not in view.text.content


def test_the_page_and_its_socket_are_served_and_a_client_may_come_back(viewer, capsys):
    view = viewer(TASK)
    with urllib.request.urlopen(f"http://127.0.0.1:{view.port}/") as page:
        assert page.status == 200 and b"<html" in page.read(1000)
    for _ in range(2):
        with join(view) as client:
            text = b""
            while b"/bodies/flat_stove_1_main" not in text or b"**turn on the stove**" not in text:
                text += messages(client.recv(timeout=30))
    assert main(["view", TASK, "--port", str(view.port)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"--port {view.port} cannot be listened on: Address already in use" in line


def join(view, **more):
    """Return a client of the page, and the page's own messages so far."""
    own = f"viser-v{viser.__version__}"
    return connect(f"ws://127.0.0.1:{view.port}", subprotocols=[own], max_size=None, **more)


ORIGINS = ("http://evil.example", "null", "", "http://localhost:1", "file://")
HOSTS = ("127.0.0.1.evil.example:80", "192.168.0.7", "", "[", "a@b")
OTHERS = [*({"Origin": origin} for origin in ORIGINS), *({"Host": host} for host in HOSTS)]


@pytest.mark.parametrize("headers", OTHERS, ids=str)
def test_pages_of_others_are_not_let_in(open_view, headers):
    request = urllib.request.Request(f"http://127.0.0.1:{open_view.port}/", headers=headers)
    with pytest.raises(urllib.error.HTTPError, match="403"):
        urllib.request.urlopen(request)
    origin = {"origin": headers["Origin"]} if "Origin" in headers else {}
    host = {"additional_headers": headers} if "Host" in headers else {}
    with pytest.raises(InvalidStatus, match="403|400"), join(open_view, **origin, **host):
        pass


BAD = (
    *(float("nan"), float("inf"), "7", None, True, [], [1], {}, {"a": 1}, b"7", "x" * 5000, 2**63, -(2**63)),
    *(1e300, -1.0, 49.7, 10_000),
)
BROKEN = (
    *(b"", b"\xc1", b"\x93" * 9, "text", msgpack.packb(7), msgpack.packb({}), msgpack.packb({"type": []})),
    *(
        msgpack.packb({"type": "GuiUpdateMessage", **more})
        for more in ({}, {"uuid": 1}, {"uuid": [], "updates": {}})
    ),
    *(
        msgpack.packb({"type": name, "share_url": 1})
        for name in ("ShareUrlRequest", "ResetGuiMessage", "X" * 999)
    ),
    msgpack.packb({"type": "ViewerCameraMessage", "wxyz": [1e400] * 4, "position": "here"}),
)


def test_values_are_within_what_a_control_offers_before_anybody_hears_of_them(open_view):
    gate, controls = Gate("127.0.0.1"), open_view.server.gui._gui_input_handle_from_uuid
    gate.controls = controls.get
    told = {"type": "GuiUpdateMessage"}
    for uuid, control in controls.items():
        low, high, options = (getattr(control, name, None) for name in ("min", "max", "options"))
        for value in BAD:
            message = msgpack.packb({**told, "uuid": uuid, "updates": {"value": value}})
            with contextlib.suppress(ValueError):
                found = msgpack.unpackb(gate.checked(message))["updates"]["value"]
                assert type(found) is type(control.value) or isinstance(control.value, tuple)
                assert (low is None or low <= found) and (high is None or found <= high)
                assert found in options if options else abs(found) <= 1e6 or isinstance(found, str)
            for updates in ({"label": value}, {"value": 0, "removed": value}, {}):
                with pytest.raises(ValueError, match="is not a message"):
                    gate.checked(msgpack.packb({**told, "uuid": uuid, "updates": updates}))
    for content in BROKEN:
        with contextlib.suppress(ValueError):
            assert gate.checked(content) is None, content


@pytest.mark.parametrize("value", [1e300, float("nan"), "7", None])
def test_what_one_client_says_ends_no_other(open_view, value, capfd, caplog):
    message = {"type": "GuiUpdateMessage", "uuid": open_view.start._impl.uuid, "updates": {"value": value}}
    with join(open_view, origin=f"http://127.0.0.1:{open_view.port}") as other:
        with join(open_view) as client, pytest.raises(ConnectionClosed, match="1008"):
            for content in (msgpack.packb(message), b"the end"):
                client.send(content)
            while True:
                client.recv(timeout=20)
        assert open_view.start.value in (0, 49)
        open_view.start.value = 0
        for one in (other, stack := join(open_view)):
            with one, contextlib.suppress(TimeoutError):
                while one.recv(timeout=2):
                    pass
        stack.close()
    assert "Traceback" not in capfd.readouterr().err + caplog.text


def test_perturbations_of_the_protocol_are_shown_unless_others_are_named(stage, tmp_path):
    own = tmp_path / "dim.yaml"
    own.write_text("{extends: libero, world: {perturb: light=0.5@2}}")
    assert stage(TASK, protocol=str(own)).initial.perturbations == (Perturbation("light", 0.5, 2),)
    named = stage(TASK, protocol=str(own), perturb="camera=0.3")
    assert named.initial.perturbations == (Perturbation("camera", 0.3),)


def test_options_that_mean_nothing_are_refused(tmp_path):
    with pytest.raises(InvalidInputError, match="--bddl is of demonstration files"):
        Stage(ViewRequest(what=TASK, bddl=tmp_path / "mine.bddl"))
    with pytest.raises(InvalidInputError, match="leave out --policy expert"):
        Stage(ViewRequest(what=str(tmp_path), policy="expert"))
    with closing(socket.create_server(("127.0.0.1", 0))) as taken:
        port = taken.getsockname()[1]
        assert main(["view", "libero_goal/99", "--port", str(port)]) == 2
