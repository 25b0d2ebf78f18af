"""`libero eval` of policies on servers, also when connections break."""

import hashlib
import json

import numpy as np
import pytest

from libero_cli import main as cli
from libero_eval.protocols.clock import ClockedActor
from libero_eval.servers.openpi import OPENPI
from libero_eval.servers.serving import ServedPolicy
from lifelong.evaluation.restore import restore
from tests.harness import policy_servers
from tests.harness.runs import make_run

pytestmark = pytest.mark.sim
EPISODES = ("--episodes", "3", "--unit-starts", "2", "--horizon", "8", "--threads", "1")


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    path = tmp_path_factory.mktemp("runs") / "run"
    make_run(path, "algo=er")
    return path


def test_a_served_run_is_evaluated_in_process(run, tmp_path, capsys):
    with policy_servers.served(ServedPolicy(restore(run, device="cpu"))) as address:
        assert cli.main(["eval", address, "--out", str(tmp_path / "out"), *EPISODES]) == 2
    assert "serves a run of this package: libero eval RUN" in capsys.readouterr().err


OPENPI_CARD = """
title: openpi's, small and short
extends: openpi
world: {drawing: fast}
episode: {settle_steps: 1, horizon: 7}
pixels: {render_size: [64, 64], resize_size: [56, 56]}
action: {replan: 3}
"""
GROOT_CARD = """
title: GR00T's, with the seed that its source does not state
extends: groot
world: {drawing: fast, robot: libero, env_seed: 0, seeding: once, loads: 1}
episode: {horizon: 7}
pixels: {render_size: [64, 64]}
action: {replan: 4}
"""
PROBES = 3  # of a unit: twice when it is planned, once when it begins
VLA_CARD = """
title: vla-eval's, small and short
extends: vla-eval
world: {drawing: fast}
episode: {settle_steps: 1, horizon: 3}
pixels: {render_size: [64, 64]}
"""


@pytest.fixture
def card(tmp_path):
    def write(text: str):
        path = tmp_path / "card.yaml"
        path.write_text(text)
        return str(path)

    return write


def on_server(address: str, out, card: str, *more: str) -> int:
    words = ["--suite", "libero_goal/0", "--episodes", "2", "--threads", "1", "--protocol", card]
    return cli.main(["eval", address, "--out", str(out), *words, *(more or ("--name", "lift"))])


def lift(count: int) -> np.ndarray:
    return np.tile([0.1, 0.0, 0.5, 0.0, 0.0, 0.1, -1.0], (count, 1))


def test_an_openpi_server_under_a_protocol(card, tmp_path, capsys):
    seen = []

    def answer(observation):
        seen.append(observation)
        return {"actions": lift(4)}

    with policy_servers.openpi(answer, {"action": {"replan": 3}, "model": "lift"}) as address:
        assert on_server(address, tmp_path / "out", card(OPENPI_CARD)) == 0
    found = json.loads((tmp_path / "out" / "eval.json").read_text())
    assert found["tasks"][0]["lengths"] == [7, 7] and found["protocol"]["action"]["replan"] == 3
    announced = {"action": {"replan": 3}, "model": "lift"}
    assert found["evaluated"]["server"] == address and found["evaluated"]["announced"] == announced
    assert len(seen) == PROBES + 2 * 3, "seven steps are three chunks"
    seen = seen[PROBES:]
    first = seen[0]
    assert first["observation/image"].shape == first["observation/wrist_image"].shape == (56, 56, 3)
    assert first["observation/image"].std() > 5 and first["observation/state"].dtype == np.float64
    assert first["observation/state"].shape == (8,) and first["prompt"] == found["tasks"][0]["instruction"]
    heights = sorted(o["observation/state"][2] for o in seen)
    assert heights[-1] > heights[0] + 0.01, "the arm has moved"


def test_leaving_out_images_changes_none_that_are_sent(card, tmp_path, capsys, monkeypatch):
    def answer(observation):  # actions that depend on every pixel
        draws = np.random.default_rng(
            list(hashlib.sha256(observation["observation/image"].tobytes()).digest())
        )
        return {"actions": draws.uniform(-0.5, 0.5, (3, 7))}

    found = []
    for name in ("seen", "all"):
        if name == "all":
            monkeypatch.setattr(ClockedActor, "sees_next", True)
        with policy_servers.openpi(answer) as address:
            assert on_server(address, tmp_path / name, card(OPENPI_CARD)) == 0
        found.append(json.loads((tmp_path / name / "eval.json").read_text())["tasks"])
    assert found[0] == found[1] and len(set(found[0][0]["actions"])) == 2


def test_another_policy_behind_the_same_address_gets_nothing_of_the_first(card, tmp_path, capsys):
    """Also where the server says nothing about itself, and where the evaluation is finished."""
    out, path, asked, height = tmp_path / "out", card(OPENPI_CARD), [], [1.0]

    def answer(_):
        asked.append(1)
        return {"actions": lift(3) * height[0]}

    with policy_servers.openpi(answer) as address:
        assert on_server(address, out, path, "--timeout", "20") == 2
        assert "does not say which policy it serves" in capsys.readouterr().err and not asked
        assert on_server(address, out, path) == 0
        whole, asked[:] = (out / "eval.json").read_text(), []
        assert on_server(address, out, path) == 0
        assert "nothing was run; --again repeats it" in capsys.readouterr().err and len(asked) == 2
        height[0] = 0.5
        assert on_server(address, out, path) == 2
        assert "answers a fixed observation otherwise" in capsys.readouterr().err
        height[0] = 1.0
        assert on_server(address, out, path, "--name", "other") == 2
        assert 'evaluated.name is "lift" there and "other" here' in capsys.readouterr().err
    assert (out / "eval.json").read_text() == whole


def test_a_result_connects_to_no_server_that_was_not_allowed(card, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("LIBERO_API_KEY", "secret")
    with policy_servers.openpi(lambda _: {"actions": lift(3)}) as address:
        assert on_server(address, tmp_path / "out", card(OPENPI_CARD)) == 0
    capsys.readouterr()
    monkeypatch.setattr("libero_eval.servers.openpi.OpenpiClient", None)
    assert cli.main(["eval", str(tmp_path / "out" / "eval.json"), "--out", str(tmp_path / "again")]) == 2
    error = capsys.readouterr().err
    assert "which would be connected to" in error and f"--allow {address}" in error


def test_an_openpi_connection_that_breaks_is_no_episode(card, tmp_path, capsys):
    counts = []

    async def handler(socket):
        await socket.send(OPENPI.pack({}))
        async for _ in socket:
            counts.append(1)
            if len(counts) == PROBES + 4:
                socket.transport.abort()
                return
            await socket.send(OPENPI.pack({"actions": lift(3)}))

    with policy_servers.web_socket(handler) as address:
        assert on_server(address, tmp_path / "out", card(OPENPI_CARD)) == 0
    result = json.loads((tmp_path / "out" / "eval.json").read_text())["tasks"][0]
    assert result["init_states"] == [0, 1] and result["lengths"] == [7, 7] and len(counts) > PROBES + 6
    assert not result.get("errors") and result["actions"][0] == result["actions"][1]


def test_a_protocol_that_counts_errors_does_not_count_those_of_servers(card, tmp_path, capsys):
    with policy_servers.openpi(lambda _: {"actions": lift(2)}) as address:
        assert on_server(address, tmp_path, card(OPENPI_CARD)) == 2
    assert "2 actions; the protocol executes 3" in capsys.readouterr().err
    assert not (tmp_path / "eval.json").exists()


def test_what_a_server_announces_is_compared_with_the_protocol(card, tmp_path, capsys):
    with policy_servers.openpi(lambda _: {}, {"action.replan": 10, "pixels.crop": 1.0}) as address:
        assert on_server(address, tmp_path / "out", card(OPENPI_CARD)) == 2
        error = capsys.readouterr().err
        assert "action.replan: protocol card has 3, the policy 10" in error and "pixels" not in error
    with policy_servers.openpi(lambda _: {}) as address:
        none = OPENPI_CARD.replace("replan: 3", "replan: null")
        assert on_server(address, tmp_path / "out", card(none)) == 2
        assert "does not state action.replan" in capsys.readouterr().err
    spec = {"gripper": {"name": "gripper", "dims": 1, "format": "continuous_01"}}
    with policy_servers.vla_eval(lambda _: {}, {"action_spec": spec}, []) as address:
        assert on_server(address.replace("ws:", "vla-eval:"), tmp_path / "out", card(VLA_CARD)) == 2
    told = "gripper: LIBERO takes binary_close_positive, the server sends continuous_01"
    assert told in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_vla_eval_server_under_a_protocol(card, tmp_path, capsys):
    heard, params = [], {"send_wrist_image": True, "send_state": True}
    answer = lambda _: {"actions": lift(1)[0]}  # noqa: E731
    with policy_servers.vla_eval(answer, {"observation_params": params}, heard) as address:
        assert on_server(address.replace("ws:", "vla-eval:"), tmp_path / "out", card(VLA_CARD)) == 0
    kinds = [m["type"] for m in heard]
    assert kinds.count("observation") == PROBES + 6
    assert kinds.count("episode_start") == kinds.count("episode_end") == PROBES + 2
    sent = next(m["payload"] for m in heard if m["type"] == "observation")
    assert sent["images"]["wrist"].shape == (64, 64, 3) and sent["states"].shape == (8,)
    assert json.loads((tmp_path / "out" / "eval.json").read_text())["tasks"][0]["lengths"] == [3, 3]


def test_a_groot_server_under_a_protocol(card, tmp_path, capsys):
    seen = []

    def get_action(observation, options):
        seen.append(observation)
        return policy_servers.flat(np.stack([lift(16)] * len(observation["state.x"])))

    with policy_servers.groot(policy_servers.groot_endpoints(get_action)) as address:
        assert on_server(address.replace("tcp:", "gr00t:"), tmp_path / "out", card(GROOT_CARD)) == 0
    assert [len(o["state.gripper"]) for o in seen] == [1] * PROBES + [2, 2]
    assert seen[0]["video.image"].shape[1:3] == (1, 64)
    found = json.loads((tmp_path / "out" / "eval.json").read_text())
    assert found["tasks"][0]["lengths"] == [7, 7]
    assert found["evaluated"]["announced"]["action"]["modality_keys"][-1] == "gripper"


@pytest.mark.parametrize(
    ("address", "message"),
    [
        ("http://localhost:1", "no kind of server has http; write ws://localhost:1"),
        ("localhost:8000", "an address without the kind of its server: write ws://localhost:8000"),
        ("ftp://localhost:1", "unknown kind of server 'ftp'. Valid: gr00t, vla-eval, ws, wss"),
    ],
)
def test_addresses_of_no_kind_of_server_are_refused(address, message, capsys):
    assert cli.main(["eval", address, *EPISODES]) == 2
    assert message in capsys.readouterr().err
