"""Protocols: their files, what is wrong with a file, and what a policy may announce."""

import json
import math
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from libero_cli import main as cli
from libero_env.tasks import get_task
from libero_eval.protocols.adapter import ProtocolAdapter, axis_angle, axis_angle_float32, axis_angle_positive
from libero_eval.protocols.clock import ClockedActor
from libero_eval.protocols.environment import ProtocolEnv
from libero_eval.protocols.files import load_protocol, protocol_names
from libero_eval.protocols.protocol import EvalProtocol
from libero_eval.protocols.sections import SUITES
from libero_eval.user_policy import CallableActor, ProtocolActor
from lifelong.errors import MissingObservationError, PolicyError, ProtocolError, ProtocolMismatchError

TASK = get_task("libero_goal/3")
RUNNABLE = [name for name in protocol_names() if name not in ("groot", "rlinf")]


def write(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "mine.yaml"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize("name", protocol_names())
def test_each_value_of_the_packages_protocols_has_a_source(name):
    protocol = load_protocol(name)
    fields = list(protocol.flat())
    assert len(fields) > 40
    without = [key for key in fields if not {key, key.partition(".")[0]} & set(protocol.sources)]
    assert not without


@pytest.mark.parametrize("name", RUNNABLE)
def test_protocols_that_state_enough_can_be_run(name):
    protocol = load_protocol(name)
    protocol.require()
    for suite in SUITES:
        assert protocol.steps(get_task(f"{suite}/0")) > 200


def test_what_a_source_does_not_state_is_not_guessed(tmp_path):
    with pytest.raises(ProtocolError, match=r"groot cannot be run.*world\.env_seed.*extends: groot"):
        load_protocol("groot").require()
    with pytest.raises(ProtocolError, match=r"rlinf.*episode\.horizon"):
        load_protocol("rlinf").require()
    mine = load_protocol(
        write(tmp_path, "extends: rlinf\nepisode: {horizon: 480}\naction: {gripper: as_predicted}")
    )
    mine.require()
    assert mine.steps(TASK) == 480 and mine.world == load_protocol("rlinf").world


def test_a_resolved_protocol_is_read_back():
    for name in protocol_names():
        protocol = load_protocol(name)
        again = EvalProtocol.read(json.loads(json.dumps(protocol.resolved())), "result")
        assert again == protocol and again.digest == protocol.digest


def test_the_digest_depends_on_values_not_on_names_and_sources(tmp_path):
    openpi = load_protocol("openpi")
    same = load_protocol(
        write(tmp_path, "extends: openpi\ntitle: another title\nsources: {world: elsewhere}")
    )
    assert same.digest == openpi.digest and same.name == "mine"
    assert openpi.changed({"world.env_seed": 8}).digest != openpi.digest


BAD = {
    "a field is missing": ("world: {env_seed: 7}", r"world\.models is missing"),
    "unknown field": ("extends: openpi\nworld: {env_sed: 7}",
     r"world\.env_sed is an unknown key.*Did you mean 'env_seed'"),
    "crop without resize": ("extends: openpi\npixels: {resize: none, resize_size: null, crop: 0.9}",
     r"pixels\.crop is 0\.9, but pixels\.resize is none"),
    "size without resize": ("extends: openpi\npixels: {resize: none}", r"pixels\.resize_size is \[224, 224\], but"),
    "action without settling": ("extends: openpi\nepisode: {settle_steps: 0}",
     r"settle_action is .*settle_steps is 0"),
    "horizon of a suite": ("extends: openpi\nepisode: {horizon: {libero_goal: 300}}",
     r"episode\.horizon has no value for libero_spatial, libero_object, libero_10, libero_90"),
    "replan": ("extends: openpi\naction: {chunk: 4}", r"action\.replan is 5, but action\.chunk is 4"),
    "stored and seeded": ("extends: libero\nworld: {env_seed: 7}", r"world\.env_seed is 7, but .* stored"),
    "success at the end": ("extends: openpi\nepisode: {success: final}", r"episode\.success is 'final'"),
    "changes": ("extends: openpi\nchanges: {episode.horizon: 6}", "changes is a key of results"),
    "order": ("extends: openpi\nepisode: {reset_order: [set_init_state, reset]}",
     r"reset_order is \['set_init_state', 'reset'\]; .* in the order of seed, reset, set_init_state, settle"),
    "not settled": ("extends: openpi\nepisode: {reset_order: [reset, set_init_state]}",
     r"settle_steps is 10, but episode\.reset_order has no settle"),
    "no fixtures": ("extends: openpi\nworld: {fixture_poses: stored, env_seed: null}",
     r"fixture_poses are stored, but world\.init_states are original"),
    "seeded once": ("extends: openpi\nworld: {environments: rebuilt}", r"world\.environments are rebuilt, but"),
    "loads": ("extends: openpi\nworld: {loads: 0}", r"world\.loads"),
    "template": ("extends: openpi\nlanguage: {template: do}", r"language\.template is 'do'; it must have {instr"),
    "state without source": ("extends: openpi\nproprioception: {source: none}", r"proprioception\.order is "),
    "source of nothing": ("extends: openpi\nsources: {worlds: x}", r"sources\.worlds is not a key"),
    "no mapping": ("- 1", "is not a protocol"),
    "no YAML": ("a: [", "not valid YAML"),
    "frequency": ("extends: openpi\nworld: {control_freq: 30}", "control_freq.*30 Hz does not divide the 500 Hz"),
    "perturbations": ("extends: libero\nworld: {perturb: 'noise=0.1,camera=0.3'}", r"world\.perturb"),
    "circle": ("extends: mine.yaml", "extend each other in a circle"),
    "unknown base": ("extends: opennpi", "extends: unknown protocol 'opennpi'. Did you mean 'openpi'"),
}  # fmt: skip


@pytest.mark.parametrize("text, message", BAD.values(), ids=BAD)
def test_what_is_wrong_with_a_protocol_is_named_with_file_and_key(tmp_path, text, message):
    path = write(tmp_path, text)
    with pytest.raises(ProtocolError, match=message) as caught:
        load_protocol(path)
    assert str(path) in str(caught.value)


def test_all_contradictions_are_named_at_once(tmp_path):
    pixels = "pixels: {crop: 0.5, resize: null, resize_size: null}"
    path = write(tmp_path, f"extends: openpi\naction: {{chunk: 4}}\nepisode: {{settle_steps: 0}}\n{pixels}")
    with pytest.raises(ProtocolError, match=r"settle_action.*pixels\.crop is 0\.5.*replan"):
        load_protocol(path)


def test_a_policy_that_announces_another_protocol_is_refused_with_both_values():
    protocol = load_protocol("openpi")
    protocol.check(
        {"action": {"replan": 5}, "pixels.resize_size": [224, 224], "name": "pi05", "weights": "x"}
    )
    protocol.check({"action.chunk": 50})  # not stated by the protocol
    with pytest.raises(ProtocolMismatchError) as caught:
        protocol.check({"action": {"replan": 10, "gripper": "sign"}, "proprioception.rotation": "quat_xyzw"})
    message = str(caught.value)
    assert "action.replan: protocol openpi has 5, the policy 10" in message
    assert "'as_predicted', the policy 'sign'" in message
    assert "'axis_angle', the policy 'quat_xyzw'" in message


def test_waiting_steps_that_count_shorten_the_episode():
    protocol = load_protocol("openpi")
    assert protocol.steps(TASK) == 300
    assert protocol.changed({"episode.settle_counted": True}).steps(TASK) == 290


@pytest.mark.parametrize(
    "name, starts", [("openpi", [7, 7]), ("lerobot", [1000, 1003]), ("simplevla-rl", [0, 0])]
)
def test_seeds_of_the_environment(name, starts):
    protocol = load_protocol(name)
    assert [protocol.env_seed(TASK, 0), protocol.env_seed(TASK, 3)] == starts
    assert load_protocol("libero").env_seed(TASK, 3) is None
    with pytest.raises(ProtocolError, match="in initial state 1001 the seed -1; valid: 0 to"):
        load_protocol("lerobot").changed({"world.seed_per_start": -1}).env_seed(TASK, 1001)


@pytest.mark.sim
def test_the_robot_waits_where_it_is_under_absolute_actions():
    """As in vla-eval, which changes to absolute actions after the waiting steps: the action of these is no pose."""
    wait, ends = np.array([load_protocol("openpi").episode.settle_action]), []
    for delta in (True, False):
        protocol = load_protocol("libero").changed(
            {"world.delta": delta, "episode.settle_action": wait[0], "pixels.render_size": (16, 16)}
        )
        with closing(ProtocolEnv(protocol, TASK, 1, cameras=(), assets="builtin")) as env:
            env.reset(options={"init_state": np.zeros(1, int)})
            obs = [env.step(wait)[0]["ee_pos"][0] for _ in range(protocol.settle_steps + 1)]
        ends.append(obs)
    np.testing.assert_array_equal(ends[0][:-1], ends[1][:-1])
    assert np.linalg.norm(ends[1][-1] - ends[1][-2]) > 0.01, "then actions are absolute"


def observations() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(5)
    return {
        "agentview_rgb": rng.integers(0, 256, (2, 256, 256, 3), np.uint8),
        "eye_in_hand_rgb": rng.integers(0, 256, (2, 256, 256, 3), np.uint8),
        "ee_pos": rng.normal(size=(2, 3)),
        "ee_quat": np.array([[-0.1, 0.9, 0.3, 0.3], [0.5, 0.5, -0.5, 0.5]]),
        "gripper_states": rng.normal(size=(2, 2)),
    }


def test_images_are_turned_as_the_original_returns_them():
    obs = observations()
    image = obs["agentview_rgb"][0]
    for orientation, expected in (
        ("upright", image),
        ("bottom_up", image[::-1]),
        ("rotated", image[::-1][::-1, ::-1]),  # the original's rows, then [::-1, ::-1]
    ):
        protocol = load_protocol("vla-eval").changed({"pixels.orientation": orientation})
        given = ProtocolAdapter(protocol, TASK).inputs(obs, [0])[0]
        np.testing.assert_array_equal(given.images["agentview"], expected)
        assert set(given.images) == {"agentview", "robot0_eye_in_hand"}


def test_the_state_has_the_order_and_the_type_of_the_protocol():
    obs = observations()
    state = ProtocolAdapter(load_protocol("openpi"), TASK).inputs(obs)[1].state
    assert state.shape == (8,) and state.dtype == np.float64
    np.testing.assert_array_equal(state[:3], obs["ee_pos"][1])
    np.testing.assert_array_equal(state[6:], obs["gripper_states"][1])
    assert ProtocolAdapter(load_protocol("lerobot"), TASK).inputs(obs)[0].state.dtype == np.float32
    assert ProtocolAdapter(load_protocol("starvla"), TASK).inputs(obs)[0].state.size == 0


def test_the_controllers_state_turns_the_hand_to_the_grip_site():
    (given, _) = ProtocolAdapter(load_protocol("vla-eval"), TASK).inputs(
        observations() | {"ee_quat": np.array([[np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)], [1.0, 0.0, 0.0, 0.0]])}
    )
    sent = given.extra["controller_states"]
    assert sent.dtype == np.float32 and sent.shape == (8,)
    np.testing.assert_allclose(sent[3:6], 0, atol=1e-6)  # a quarter turn and back
    np.testing.assert_allclose(sent[[0, 1, 2, 6, 7]], given.state[[0, 1, 2, 6, 7]], rtol=1e-6)
    none = load_protocol("vla-eval").changed({"proprioception.source": "none", "proprioception.order": None})
    assert not ProtocolAdapter(none, TASK).inputs(observations())[0].extra


def test_a_quaternion_and_its_negative_are_one_rotation_or_two():
    quat = np.array([0.9, 0.3, 0.3, -0.1])
    assert not np.allclose(axis_angle(quat), axis_angle(-quat))
    np.testing.assert_array_equal(axis_angle_positive(quat), axis_angle_positive(-quat))
    assert np.linalg.norm(axis_angle(quat)) > math.pi > np.linalg.norm(axis_angle_positive(quat))
    np.testing.assert_allclose(axis_angle_float32(quat), axis_angle(quat), rtol=1e-6)
    assert axis_angle_float32(quat).dtype == np.float32
    identity = np.array([0.0, 0.0, 0.0, 1.0])
    for convert in (axis_angle, axis_angle_float32, axis_angle_positive):
        assert not convert(identity).any()


@pytest.mark.parametrize("gripper, expected", [
    ("as_predicted", [-1.0, 0.2, 0.5, 1.0]), ("sign", [-1.0, 1.0, 1.0, 1.0]), ("open_sign", [1.0, 1.0, 0.0, -1.0]),
    ("open_cut", [1.0, 1.0, 1.0, -1.0])
])  # fmt: skip
def test_gripper_maps(gripper, expected):
    predicted = np.zeros((4, 7))
    predicted[:, -1], predicted[:, 0] = [-1.0, 0.2, 0.5, 1.0], 0.3
    protocol = load_protocol("openpi").changed({"action.gripper": gripper})
    actions = ProtocolAdapter(protocol, TASK).actions(predicted)
    np.testing.assert_array_equal(actions[:, -1], expected)
    np.testing.assert_array_equal(actions[:, :-1], predicted[:, :-1])


class Chunks:
    """Predicts chunks that count up, and notes what it is given."""

    def __init__(self, length: int):
        self.length, self.given, self.resets = length, [], []

    def reset(self, instruction, num_envs):
        self.resets.append((instruction, num_envs))

    def predict(self, observations):
        self.given.append({k: np.shape(v) for k, v in observations.items()})
        steps = np.arange(self.length, dtype=float)[None, :, None]
        return np.broadcast_to(steps, (len(observations["state"]), self.length, 7))


def test_a_policy_of_the_protocols_inputs_is_asked_again_after_replan_actions():
    policy = Chunks(6)
    actor = ClockedActor(ProtocolActor(policy, (), ProtocolAdapter(load_protocol("openpi"), TASK), 5))
    actor.reset(2)
    taken = [actor.act(observations())[0, 0] for _ in range(7)]
    assert taken == [0, 1, 2, 3, 4, 0, 1] and len(policy.given) == 2
    assert policy.given[0] == {
        "agentview": (2, 224, 224, 3), "robot0_eye_in_hand": (2, 224, 224, 3), "state": (2, 8), "instruction": ()
    }  # fmt: skip
    assert policy.resets == [(TASK.language, 2)]
    short = ProtocolActor(Chunks(4), (), ProtocolAdapter(load_protocol("openpi"), TASK), 5)
    short.reset(2)
    with pytest.raises(PolicyError, match="returned 4 actions; the protocol executes 5"):
        short.plan(observations(), [0, 1])


def test_an_observation_of_the_other_names_is_named():
    class Native:
        def predict(self, observations):
            return np.zeros((len(observations["agentview_rgb"]), 7))

    with pytest.raises(MissingObservationError, match="'agentview_rgb', but agentview_image.*--names native"):
        CallableActor(Native(), (), "go", original=True).plan(observations(), [0])


def test_protocols_from_the_command_line(tmp_path, capsys):
    assert cli.main(["protocols", "list"]) == 0
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == list(protocol_names())
    assert cli.main(["protocols", "show", "rlinf"]) == 0
    shown = capsys.readouterr().out
    assert "horizon            not stated  # not stated for the" in shown
    replaced = load_protocol(write(tmp_path, "extends: openpi\nworld: {loads: 3}"))
    assert replaced.sources["world.loads"] == "mine.yaml's own" and replaced.title.endswith(", changed")
    assert "requirements.txt" in replaced.sources["world.robot"]
    mine = write(tmp_path, "extends: openpi\naction: {replan: 10}")
    assert cli.main(["protocols", "diff", "openpi", str(mine)]) == 1
    assert capsys.readouterr().out.splitlines()[1].split() == ["action.replan", "5", "10"]
    assert cli.main(["protocols", "diff", "openpi", "openpi"]) == 0
    assert cli.main(["eval", "expert", "--suite", "libero_goal/3", "--control-freq", "10"]) == 2
    assert "--control-freq 10: the expert acts at 20 Hz only" in capsys.readouterr().err
    assert cli.main(["protocols", "show", "opennpi"]) == 2
    assert "Did you mean 'openpi'" in capsys.readouterr().err
