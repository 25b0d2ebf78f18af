"""Clients of policy servers: formats, chunks, and servers that fail, are late or send what is not valid."""

import asyncio
import io
import socket
import sys
import threading
import time
from contextlib import closing, contextmanager
from dataclasses import replace
from typing import Any

import msgpack
import numpy as np
import pytest
from PIL import Image
from websockets.server import ServerProtocol

from libero_env.errors import MissingPackageError
from libero_env.tasks import get_suite
from libero_eval.plan import plan_evaluation
from libero_eval.protocols.adapter import PolicyInput
from libero_eval.protocols.clock import ClockedActor
from libero_eval.protocols.files import load_protocol
from libero_eval.requests import EvalRequest
from libero_eval.servers.actors import RemoteActor, checked_actions
from libero_eval.servers.openpi import OPENPI, OpenpiClient
from libero_eval.servers.policy import ServerPolicy
from libero_eval.servers.transport import EpisodeStart, Limits, connect
from libero_integrations.servers.groot import ACTION, GROOT, GrootClient
from libero_integrations.servers.vla_eval import VLA_EVAL, VlaEvalClient
from lifelong.errors import CodecError, ConfigError, ConnectionLost, ProtocolMismatchError, ServerError
from lifelong.evaluation.rollout import run_episodes
from tests.harness import policy_servers

TASK = get_suite("libero_goal").tasks[0]
SHORT = Limits(connect=5, answer=5)


class Plain:
    """An adapter that sends the simulation's number and step, and doubles actions."""

    def __init__(self):
        self.asked = []

    def inputs(self, obs, rows=None):
        self.asked.append(list(rows))
        image = np.arange(48, dtype=np.uint8).reshape(4, 4, 3)
        images = {"agentview": image, "robot0_eye_in_hand": image[::-1]}
        extra = {"controller_states": np.ones(8, np.float32)}
        return [PolicyInput(images, obs["x"][i], TASK.language, extra) for i in rows]

    def actions(self, predicted):
        return 2 * predicted


def observations(count: int, step: int) -> dict[str, np.ndarray]:
    x = np.zeros((count, 8))
    x[:, 0], x[:, 1] = np.arange(count), step
    return {"x": x, "image": np.zeros((count, 1, 1, 3), np.uint8)}


def chunk(state: np.ndarray, length: int) -> np.ndarray:
    """Actions that tell simulation, step of the observation and position in the chunk."""
    actions = np.zeros((length, 7))
    actions[:, 0], actions[:, 1], actions[:, 2] = state[0], state[1], np.arange(length)
    return actions


@contextmanager
def remote(client, episodes: int = 1, replan: int | None = None):
    """Yield the actor of new episodes on a server."""
    with closing(client):
        planner = RemoteActor(
            client, Plain(), [EpisodeStart(TASK, 4 + i) for i in range(episodes)], replan=replan
        )
        actor = ClockedActor(planner)
        actor.reset(episodes)
        yield actor


def ask(address: str, limits: Limits = SHORT) -> np.ndarray:
    with remote(OpenpiClient(address, limits), replan=2) as actor:
        return actor.act(observations(1, 0))


def test_arrays_keep_their_bits_in_every_encoding():
    arrays = [np.arange(6, dtype=kind).reshape(2, 3) for kind in ("<f4", ">f8", "u1", "i8")]
    arrays += [np.zeros((0, 7)), np.array(2.5), np.arange(48, dtype=np.uint8).reshape(4, 4, 3)]
    for codec in (OPENPI, VLA_EVAL, GROOT):
        found = codec.unpack(codec.pack({"a": arrays, "text": "ä", "none": None, "number": np.float32(0.1)}))
        for value, array in zip(found["a"], arrays, strict=True):
            assert value.dtype == array.dtype and value.flags.writeable
            np.testing.assert_array_equal(value, array)
        assert found["text"] == "ä" and found["none"] is None and found["number"] == np.float32(0.1)


def test_the_maps_that_stand_for_arrays():
    array = np.zeros((1, 2), np.float32)
    wanted = {b"__ndarray__": True, b"data": bytes(8), b"dtype": "<f4", b"shape": [1, 2]}
    assert msgpack.unpackb(OPENPI.pack(array)) == wanted
    assert msgpack.unpackb(OPENPI.pack(np.int16(3))) == {b"__npgeneric__": True, b"data": 3, b"dtype": "<i2"}
    image = msgpack.unpackb(VLA_EVAL.pack(np.zeros((2, 2, 3), np.uint8)))
    assert image["__image__"] and image["format"] == "png" and image["data"].startswith(b"\x89PNG")
    assert msgpack.unpackb(VLA_EVAL.pack(array))["__ndarray__"]
    assert msgpack.unpackb(GROOT.pack(array))["as_npy"].startswith(b"\x93NUMPY")


@pytest.mark.parametrize("codec", [OPENPI, VLA_EVAL, GROOT], ids=lambda c: c.name)
def test_values_and_bytes_that_are_refused(codec):
    for value in (np.array([object()]), np.zeros(1, "f4,f4"), object()):
        with pytest.raises(CodecError, match=codec.name):
            codec.pack({"a": value})
    if codec is not GROOT:
        with pytest.raises(CodecError, match="refused"):
            codec.pack(np.zeros(1, complex))
    for data in (b"", b"\xc1garbage", codec.pack(1) + b"more"):
        with pytest.raises(CodecError, match=f"not a message of {codec.name}"):
            codec.unpack(data)


def test_an_array_that_does_not_fit_its_bytes_is_refused():
    for changes in ({b"shape": [3]}, {b"dtype": "O"}, {b"shape": [-1, -2]}, {b"data": b""}):
        lie = {b"__ndarray__": True, b"data": bytes(8), b"dtype": "<f4", b"shape": [2]} | changes
        with pytest.raises(CodecError, match="not a message of openpi"):
            OPENPI.unpack(msgpack.packb(lie))


def test_openpi_observations_and_chunks():
    seen = []

    def answer(observation):
        seen.append(observation)
        return {"actions": chunk(observation["observation/state"], 5), "server_timing": {"infer_ms": 1.0}}

    with policy_servers.openpi(answer, {"name": "mine", "size": 224}) as address:
        client = OpenpiClient(address, SHORT)
        assert client.announced == {"name": "mine", "size": 224}
        adapter = Plain()
        actor = ClockedActor(
            RemoteActor(client, adapter, [EpisodeStart(TASK, i) for i in range(3)], replan=3)
        )
        actor.reset(3)
        over = np.zeros(3, bool)
        for step in range(7):
            over[1] = step >= 2
            actor.note(over, over)
            actions = actor.act(observations(3, step))
            for i in np.flatnonzero(~over):
                np.testing.assert_array_equal(actions[i, :3], [2 * i, 2 * (step // 3 * 3), 2 * (step % 3)])
            assert not actions[over].any()
        client.close()
    assert adapter.asked == [[0, 1, 2], [0, 2], [0, 2]], "only running simulations without actions"
    assert set(seen[0]) == {"observation/image", "observation/wrist_image", "observation/state", "prompt"}
    assert seen[0]["observation/image"].dtype == np.uint8 and seen[0]["prompt"] == TASK.language


class Drawing:
    """An environment that notes when it draws; its episodes end after nine steps."""

    num_envs = 1

    def reset(self, *, seed=None, options=None):
        self.drawn, self.step_ = [self.render_images], 0
        return observations(1, 0), {"success": np.zeros(1, bool)}

    def step(self, actions):
        self.drawn.append(self.render_images)
        self.step_ += 1
        over = np.array([self.step_ == 9])
        return observations(1, self.step_), np.zeros(1), over, over, {"success": over}


@pytest.mark.parametrize(
    ("settle", "record", "drawn"), [(0, 0, {0, 3, 6}), (2, 0, {2, 5, 8}), (0, 4, {0, 3, 4, 6, 8})]
)
def test_only_images_that_are_seen_are_drawn(settle, record, drawn):
    answer = lambda observation: {"actions": chunk(observation["observation/state"], 3)}  # noqa: E731
    env = Drawing()
    env.render_images = True
    with policy_servers.openpi(answer) as address:
        client = OpenpiClient(address, SHORT)
        planner = RemoteActor(client, Plain(), [EpisodeStart(TASK, 0)], replan=3, views=("image",))
        actor = ClockedActor(planner)
        rollouts = run_episodes(actor, env, [0], horizon=20, settle_steps=settle, record_every=record)
        client.close()
    assert {i for i, seen in enumerate(env.drawn) if seen} - {9} == drawn, "9: it was not known to be over"
    assert rollouts.episodes[0].success and env.render_images


@pytest.mark.parametrize("in_flight", [2, None])
def test_requests_in_flight(in_flight):
    waiting, most = 0, 0

    async def handler(socket):
        nonlocal waiting, most
        await socket.send(OPENPI.pack({}))
        async for data in socket:
            waiting += 1
            most = max(most, waiting)
            await asyncio.sleep(0.05)
            waiting -= 1
            await socket.send(OPENPI.pack({"actions": chunk(OPENPI.unpack(data)["observation/state"], 1)}))

    with (
        policy_servers.web_socket(handler) as address,
        remote(OpenpiClient(address, Limits(5, 5, in_flight)), 5, replan=1) as actor,
    ):
        actor.act(observations(5, 0))
    assert most == (in_flight or 5)


@pytest.mark.parametrize(("answer", "message"), [
    ({"actions": np.full((4, 7), np.nan)}, "must be finite; entry .* is nan"),
    ({"actions": np.zeros((4, 8))}, r"shape \(4, 8\); expected \(H, 7\) with H >= 2"),
    ({"actions": np.zeros((1, 7))}, "1 actions; the protocol executes 2"),
    ({"actions": [[1.0], [2.0, 3.0]]}, r"expected finite numbers of shape \(H, 7\).*inhomogeneous"),
    ({"action": np.zeros((4, 7))}, r"\['action'\] and without `actions`"),
    ([1, 2], "sent a list as actions; expected a map"),
    (b"\xc1\x00garbage", "9 bytes that are not a message of openpi"),
    ("Traceback ...\nValueError: no such key", "(?s)its traceback:.*no such key"),
    (b"\x81\xa1a" * 31 + b"\x01", "within each other, more than 30 deep"),
    (b"\x81\xa7actions\xdd\x00\x10\x00\x00" + b"\x80" * (1 << 20), "more than 10000 lists and maps"),
    ("X" * (1 << 20), r"its traceback:\n\.\.\. X{2000}$"),
    ({"k" * 100_000: 1}, "without `actions`"),
    ({"actions": [["x" * 100_000] * 7] * 2}, "is not a real number"),
], ids=range(13))  # fmt: skip
def test_answers_that_are_not_valid_are_named(answer, message):
    with (
        policy_servers.openpi(lambda _: answer) as address,
        pytest.raises(ServerError, match=message) as caught,
    ):
        ask(address)
    assert address in str(caught.value) and not isinstance(caught.value, ConnectionLost)
    assert len(str(caught.value)) < 2500


def test_single_actions():
    assert checked_actions(list(range(7)), None, "it").shape == (1, 7)
    assert checked_actions(np.arange(7, dtype=np.int64), 1, "it").dtype == np.float64
    with pytest.raises(ServerError, match="chunk_size"):
        checked_actions(np.zeros((4, 7)), None, "it")


def test_a_server_that_is_silent():
    with (
        policy_servers.openpi(lambda _: time.sleep(1) or {}) as address,
        pytest.raises(ServerError, match=r"nothing within 0\.2 s \(actions\); --timeout"),
    ):
        ask(address, Limits(5, 0.2))


@pytest.mark.parametrize("code", [1001, 1011])
def test_a_connection_that_breaks(code):
    async def handler(socket):
        await socket.send(OPENPI.pack({}))
        await socket.recv()
        await socket.close(code, "going away")

    with (
        policy_servers.web_socket(handler) as address,
        pytest.raises(ConnectionLost, match=f"{address} was closed with {code} going away"),
    ):
        ask(address)


def deaf(listening):
    """Open a connection, and read nothing of it until it ends."""
    taken, _ = listening.accept()
    with taken:
        protocol = ServerProtocol()
        protocol.receive_data(taken.recv(1 << 16))
        (request,) = protocol.events_received()
        protocol.send_response(protocol.accept(request))
        taken.sendall(b"".join(protocol.data_to_send()))
        time.sleep(1)


def test_a_server_that_takes_no_request_and_one_that_sends_too_much(monkeypatch):
    with socket.create_server(("127.0.0.1", 0)) as listening:
        accepting = threading.Thread(target=deaf, args=(listening,))
        accepting.start()
        address = f"ws://127.0.0.1:{listening.getsockname()[1]}"
        connection = connect(address, OPENPI, Limits(5, 0.3))
        with pytest.raises(ServerError, match=rf"{address} took no request within 0\.3 s; --timeout"):
            connection.send({"image": bytes(64 << 20)})
        accepting.join(10)
    monkeypatch.setattr("libero_eval.servers.transport.MAX_MESSAGE_BYTES", 1000)
    with (
        policy_servers.openpi(lambda _: {"actions": np.zeros((100, 7))}) as address,
        pytest.raises(ConnectionLost, match="closed with 1009"),
    ):
        ask(address)


def test_a_server_that_comes_later_is_waited_for():
    with policy_servers.openpi(lambda _: {}) as address:
        port = int(address.rpartition(":")[2])
    with pytest.raises(ServerError, match=r"no policy server at .* within 0\.3 s"):
        ask(address, Limits(0.3, 1))
    found = []
    client = threading.Thread(target=lambda: found.append(OpenpiClient(address, SHORT)))
    client.start()
    time.sleep(0.3)

    async def handler(socket):
        await socket.send(OPENPI.pack({"late": True}))
        await socket.wait_closed()

    async def main(on_ready):
        async with policy_servers.serve(handler, "127.0.0.1", port) as server:
            on_ready(port)
            await server.serve_forever()

    with policy_servers.running(main):
        client.join(10)
        assert found[0].announced == {"late": True}
        found[0].close()


def test_a_server_that_changes_its_policy_is_refused():
    versions = iter(range(9))

    async def handler(socket):
        await socket.send(OPENPI.pack({"version": next(versions)}))
        await socket.wait_closed()

    with (
        policy_servers.web_socket(handler) as address,
        pytest.raises(ServerError, match="'version': 1.*at first.*'version': 0"),
    ):
        ask(address)


def test_what_openpi_announces_identifies_the_policy_and_is_compared_with_the_protocol():
    base = load_protocol("openpi")
    replan = base.action.replan

    def policy(metadata: Any, **changes: Any) -> ServerPolicy:
        with policy_servers.openpi(lambda seen: {}, metadata) as address:
            return ServerPolicy(EvalRequest(policy=address, suite=("libero_goal/1",), **changes))

    about = {"checkpoint": "pi0_1", "action.replan": replan}
    found = policy(about)
    assert found.identity == {"server": found.given, "announced": about}
    assert found.protocol(base) is base
    with pytest.raises(ProtocolMismatchError, match=rf"action.replan.*{replan + 1}"):
        policy({**about, "action.replan": replan + 1}).protocol(base)
    with pytest.raises(ConfigError, match=r"--seed 3: ws://.* is sent no seed; leave it out.*--out"):
        policy(about, seed=3).protocol(base)
    assert policy(about, seed=3, clock="latency=uniform:50/150ms").protocol(base) is base
    assert policy({"action.replan": replan}, name="pi0_1").protocol(base) is base
    with pytest.raises(ServerError, match="metadata"):
        policy([1])
    changed = policy({}, name="pi0_1", event=("goal=1@touched",))
    with pytest.raises(ConfigError, match="^goal=1@touched: ws://.* cannot be told another instruction"):
        plan_evaluation(changed.request, changed)


@pytest.mark.parametrize("when", ["before the first request", "twice", "at the end"])
def test_answers_that_nobody_has_asked_for_are_refused(when):
    """They would be taken for the answers to later requests, and every action come late."""

    async def handler(socket):
        answer, count = OPENPI.pack({"actions": np.zeros((1, 7))}), 0
        await socket.send(OPENPI.pack({}))
        if when == "before the first request":
            await socket.send(answer)
        async for _ in socket:
            count += 1
            await socket.send(answer)
            if when == "twice" or (when == "at the end" and count == 2):
                await socket.send(answer)

    with (
        policy_servers.web_socket(handler) as address,
        remote(OpenpiClient(address, SHORT), replan=1) as actor,
        pytest.raises(ServerError, match="sent a message before it was asked"),
    ):
        for step in range(2):
            actor.act(observations(1, step))
            time.sleep(0.1)  # of the simulation
        actor.note(np.array([True]), np.array([True]))


@pytest.mark.parametrize(("hello", "message"), [
    ({"action_spec": [1]}, r"action_spec is \[1\]; expected an object"),
    ({"action_spec": {"position": 5}}, "action_spec.position"),
    ({"observation_params": {"seed": "abc"}}, "observation_params.seed"),
    ({"observation_params": {"max_steps": np.zeros(3)}}, "observation_params.max_steps"),
])  # fmt: skip
def test_hellos_of_vla_eval_that_are_not_valid(hello, message):
    with (
        policy_servers.vla_eval(lambda _: {}, hello, []) as address,
        pytest.raises(ServerError, match=message) as caught,
    ):
        VlaEvalClient(address, SHORT)
    assert address in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("modality", "config", "message"),
    [
        ("video", 5, "video"),
        ("video", {"modality_keys": [["x"]]}, "video"),
        ("action", {"modality_keys": policy_servers.MODALITIES["action"], "delta_indices": 5}, "action"),
        ("state", {"modality_keys": ["left_arm"]}, r"state keys \['left_arm'\]; LIBERO's are x, y"),
    ],
)
def test_modalities_of_groot_that_are_not_valid(modality, config, message):
    endpoints = policy_servers.groot_endpoints(None)
    whole = endpoints["get_modality_config"]()
    endpoints["get_modality_config"] = lambda: whole | {modality: config}
    with policy_servers.groot(endpoints) as address, pytest.raises(ServerError, match=message) as caught:
        GrootClient(address, SHORT)
    assert address in str(caught.value) and "\n" not in str(caught.value)


def test_images_of_servers_are_pngs_of_the_size_that_they_state():
    """Other formats would start other programs."""
    image = Image.fromarray(np.zeros((4, 6, 3), np.uint8))
    for kind, shape in (("EPS", [4, 6, 3]), ("GIF", [4, 6, 3]), ("PNG", [6, 4, 3]), ("PNG", None)):
        file = io.BytesIO()
        image.save(file, kind)
        message = {"__image__": True, "format": kind.lower(), "data": file.getvalue(), "shape": shape}
        with pytest.raises(CodecError, match="not a message of vla-eval"):
            VLA_EVAL.unpack(msgpack.packb(message))
    file = io.BytesIO()
    Image.new("1", (3000, 3000)).save(file, "PNG")
    message = {"__image__": True, "format": "png", "data": file.getvalue(), "shape": [3000, 3000]}
    with pytest.raises(CodecError, match="an image of 3000 x 3000"):
        VLA_EVAL.unpack(msgpack.packb(message))


def test_a_missing_package_is_named_before_anything_is_connected(monkeypatch):
    asked = []

    async def handler(socket):
        asked.append(1)
        await socket.wait_closed()

    with policy_servers.web_socket(handler) as address:
        for client, module in ((OpenpiClient, "msgpack"), (GrootClient, "msgpack"), (GrootClient, "zmq")):
            with monkeypatch.context() as patch, pytest.raises(MissingPackageError, match=module):
                patch.setitem(sys.modules, module, None)
                client(address, SHORT)
    assert not asked


def test_vla_eval_episodes():
    heard, hello = [], {"harness_version": "0.8.0", "observation_params": {"send_wrist_image": True}}
    hello["observation_params"]["send_state"] = True
    answer = lambda payload: {"actions": chunk(payload["states"], 1)[0]}  # noqa: E731
    with policy_servers.vla_eval(answer, hello, heard) as address:
        client = VlaEvalClient(address, SHORT)
        assert client.announced == hello
        with remote(client) as actor:
            for step in range(2):
                np.testing.assert_array_equal(actor.act(observations(1, step))[0, :2], [0, 2 * step])
            actor.note(np.array([True]), np.array([True]))
    kinds = ["hello", "hello", "episode_start", "observation", "observation", "episode_end"]
    assert [m["type"] for m in heard] == kinds
    assert [m["seq"] for m in heard] == [1, 1, 2, 3, 4, 5]
    assert heard[2]["payload"]["task"] == {
        "name": TASK.language, "suite": "libero_goal", "task_id": 0, "episode_idx": 4
    }  # fmt: skip
    sent = heard[3]["payload"]
    assert sent["images"]["wrist"].shape == (4, 4, 3) and sent["task_description"] == TASK.language
    assert sent["controller_states"].dtype == np.float32
    assert heard[5]["payload"]["metrics"] == {"success": True}


def test_vla_eval_errors_and_messages_out_of_order():
    heard = []
    with (
        policy_servers.vla_eval(
            lambda _: {"error": "observation_failed: KeyError"}, {"x": 1}, heard
        ) as address,
        remote(VlaEvalClient(address, SHORT)) as actor,
        pytest.raises(ServerError, match="failed: observation_failed: KeyError"),
    ):
        actor.act(observations(1, 0))

    async def handler(socket):
        async for data in socket:
            message = VLA_EVAL.unpack(data)
            if message["type"] == "episode_start":
                continue
            kind = "hello" if message["type"] == "hello" else "action"
            reply = {"type": kind, "payload": {}, "seq": 1, "timestamp": 0.0}
            await socket.send(VLA_EVAL.pack(reply))

    with (
        policy_servers.web_socket(handler) as address,
        remote(VlaEvalClient(address, SHORT)) as actor,
        pytest.raises(ServerError, match="sent 'action' with seq 1; expected action with 3"),
    ):
        actor.act(observations(1, 0))


def test_groot_observations_of_many_simulations():
    seen = []

    def get_action(observation, options):
        seen.append(observation)
        states = np.concatenate([observation["state.x"], observation["state.y"]], -1)[:, 0]
        return policy_servers.flat(np.stack([chunk(state, 8) for state in states]))

    with policy_servers.groot(policy_servers.groot_endpoints(get_action)) as address:
        client = GrootClient(address, Limits(5, 5, 2))
        assert client.announced["video"]["modality_keys"] == ["image", "wrist_image"]
        with remote(client, 3, replan=8) as actor:
            for step in range(9):
                actions = actor.act(observations(3, step))
                np.testing.assert_array_equal(actions[:, 0], [0, 2, 4])
                assert (actions[:, 1:3] == [2 * (step // 8 * 8), 2 * (step % 8)]).all()
    assert [len(o["state.x"]) for o in seen] == [2, 1, 2, 1], "two simulations in a request"
    assert seen[0]["video.image"].shape == (2, 1, 4, 4, 3) and seen[0]["video.image"].dtype == np.uint8
    assert seen[0]["state.gripper"].shape == (2, 1, 2) and seen[0]["state.x"].dtype == np.float32
    assert seen[0]["annotation.human.action.task_description"] == [TASK.language] * 2


@pytest.mark.parametrize(("get_action", "message"), [
    (lambda **_: policy_servers.flat(np.full((1, 8, 7), np.inf)), "must be finite; entry .* is inf"),
    (lambda **_: policy_servers.flat(np.zeros((2, 8, 7))), r"shapes \[\(2, 8, 1\)\]; expected \(1, H, 1\)"),
    (lambda **_: [{"x": np.zeros((1, 8, 1))}, {}], r"answered \['x'\].*--use-sim-policy-wrapper"),
    (lambda **_: {"error": "x" * 1_000_000}, r"failed \(get_action\): \.\.\. x{2000}$"),
    (lambda **_: [{f"action.{k}": [[1], [2, 3]] for k in ACTION}, {}], "not arrays"),
    (lambda **_: b"\xc1", "1 bytes that are not a message of GR00T"),
    (lambda **_: time.sleep(1), r"nothing within 0\.3 s \(get_action\)"),
])  # fmt: skip
def test_groot_answers_that_are_not_valid_are_named(get_action, message):
    with (
        policy_servers.groot(policy_servers.groot_endpoints(get_action)) as address,
        remote(GrootClient(address, Limits(5, 0.3)), replan=2) as actor,
        pytest.raises(ServerError, match=message),
    ):
        actor.act(observations(1, 0))


def test_groot_and_vla_eval_take_no_other_state():
    """A protocol of one's own may have another; its numbers would be taken for those of LIBERO's."""
    given = PolicyInput(
        dict.fromkeys(("agentview", "robot0_eye_in_hand"), np.zeros((4, 4, 3), np.uint8)), np.ones(9), ""
    )
    own = load_protocol("groot").changed({"proprioception.order": ["gripper_qpos", "ee_pos", "ee_rotation"]})
    with (
        policy_servers.groot(policy_servers.groot_endpoints(None)) as address,
        closing(GrootClient(address, SHORT)) as client,
    ):
        load_protocol("groot").check(client.stated(client.announced))
        with pytest.raises(
            ProtocolMismatchError, match=r"proprioception\.order: protocol groot has \('gripper"
        ):
            own.check(client.stated(client.announced))
        with pytest.raises(ServerError, match=r"the state has 9 numbers; proprioception\.rotation"):
            client.ask({0: given})
    hello = {"observation_params": {"send_state": True}}
    with (
        policy_servers.vla_eval(None, hello, []) as address,
        closing(VlaEvalClient(address, SHORT)) as client,
    ):
        client.open([EpisodeStart(TASK, 0)])
        with pytest.raises(ServerError, match=r"needs the state; .*proprioception\.source"):
            client.ask({0: replace(given, state=np.zeros(0))})


def test_no_groot_server_at_all():
    with pytest.raises(ServerError, match="no GR00T server at .* within 0.3 s"):
        GrootClient("tcp://127.0.0.1:9", Limits(0.3, 1))
