"""`libero eval` of policies on servers: the episodes of an evaluation in process, also when connections break."""

import json
from contextlib import contextmanager

import pytest

from lifelong.cli import main as cli
from lifelong.evaluation.restore import restore
from lifelong.evaluation.servers.codecs import OPENPI
from lifelong.evaluation.servers.sessions import ServedPolicy
from tests.harness import policy_servers
from tests.harness.runs import make_run

pytestmark = pytest.mark.sim
EPISODES = ("--episodes", "3", "--unit-starts", "2", "--horizon", "8", "--threads", "1")


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    path = tmp_path_factory.mktemp("runs") / "run"
    make_run(path, "algo=packnet", "policy/head=gmm_small", "policy.stochastic=true")
    return path


def evaluate(policy, out, *more: str) -> dict:
    assert cli.main(["eval", str(policy), "--out", str(out), *EPISODES, *more]) == 0
    return json.loads((out / "eval.json").read_text())


@contextmanager
def breaking(policy: ServedPolicy, after: int):
    """Serve a policy; the first connection that has had some requests breaks without a word."""
    broken = []

    async def handler(socket):
        session = policy.session()
        await socket.send(OPENPI.pack(policy.metadata))
        requests = 0
        async for data in socket:
            requests += 1
            if requests > after and not broken:
                broken.append(requests)
                socket.transport.abort()
                return
            await socket.send(OPENPI.pack(session.infer(OPENPI.unpack(data))))

    with policy_servers.web_socket(handler) as address:
        yield address, broken


def test_the_episodes_of_a_served_run_are_those_in_process(run, tmp_path, capsys):
    local = evaluate(run, tmp_path / "local")
    policy = ServedPolicy(restore(run, device="cpu"))
    with policy_servers.served(policy) as address:
        served = evaluate(address, tmp_path / "served")
    assert served["tasks"] == local["tasks"], "actions to the bit"
    assert all(any(digests) for digests in (task["actions"] for task in served["tasks"]))
    assert served["protocol"] == local["protocol"] and served["init_states"] == local["init_states"]
    assert served["evaluated"]["server"] == address
    assert served["evaluated"]["announced"]["weights"] == local["evaluated"]["weights"]


def test_episodes_are_repeated_after_a_broken_connection(run, tmp_path, capsys):
    policy = ServedPolicy(restore(run, device="cpu"))
    with policy_servers.served(policy) as address:
        whole = evaluate(address, tmp_path / "whole")
    with breaking(policy, after=5) as (address, broken):
        found = evaluate(address, tmp_path / "broken")
    assert broken and found["tasks"] == whole["tasks"], "none is lost or counted twice"
    assert f"ConnectionLost: the connection to {address} was broken off" in capsys.readouterr().err


def test_what_a_server_does_wrong_ends_the_evaluation(tmp_path, capsys):
    with policy_servers.openpi(lambda _: {}, {"server": "libero-lifelong", "format": 2}) as address:
        assert cli.main(["eval", address, *EPISODES, "--out", str(tmp_path / "out")]) == 2
    assert "is of format 2; this version knows 1" in capsys.readouterr().err
    assert cli.main(["eval", "http://localhost:1", *EPISODES]) == 2
    assert "unknown kind of server 'http'. Valid: gr00t, vla-eval, ws, wss" in capsys.readouterr().err
    assert cli.main(["eval", address, "--in-flight", "0"]) == 2
    assert "--in-flight is 0" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
