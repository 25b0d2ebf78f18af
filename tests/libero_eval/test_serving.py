"""Serving of a run's policy: the same actions as in process, episodes of clients, requests that are refused."""

import asyncio
import re
import socket
import urllib.error
import urllib.request
from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest
from websockets.exceptions import ConnectionClosedError
from websockets.sync.client import connect

from libero_env.errors import LiberoError
from libero_env.tasks import get_suite, get_task
from libero_eval.servers.openpi import OPENPI, OpenpiClient
from libero_eval.servers.serving import PolicyServer, ServedPolicy
from libero_eval.servers.transport import Limits
from lifelong.errors import PolicyError, ServerError
from lifelong.evaluation.actors import PolicyActor
from lifelong.evaluation.restore import restore
from lifelong.seeding import generator
from tests.harness import policy_servers
from tests.harness.runs import make_run

SAMPLING = ("policy/head=gmm_small", "policy.stochastic=true")
OPENPI_NAMES = ("data.proprio=[ee_pos,gripper_states]",)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("runs")


def run_of(folder, *overrides: str) -> ServedPolicy:
    path = folder / "_".join(re.sub(r"\W", "_", o) for o in overrides)
    if not path.is_dir():
        make_run(path, *overrides)
    return ServedPolicy(restore(path, device="cpu"))


def frames(spec, rows: int, seed: int = 0, steps: int = 4) -> list[dict[str, np.ndarray]]:
    rng = np.random.default_rng(seed)
    return [
        {v: rng.integers(0, 256, (rows, *spec.image_size, 3), np.uint8) for v in spec.views}
        | {n: rng.normal(size=(rows, size)) for n, size in spec.proprio.items()}
        for _ in range(steps)
    ]


def in_process(served: ServedPolicy, task, seen, seeds) -> list[np.ndarray]:
    run = served.run
    with run.acting(task) as policy:
        draws = [generator(*words) for words in seeds]
        actor = PolicyActor(policy, run.embed(task), run.device, run.eval.precision, draws)
        actor.reset(len(seeds))
        return [actor.act(obs) for obs in seen]


def request(obs, row: int = 0, **more) -> dict:
    return {f"observation/{name}": value[row] for name, value in obs.items()} | more


@pytest.mark.parametrize("algo", ["er", "packnet", "dmpel", "iscil", "clare", "lora", "single_task"])
def test_served_actions_are_those_in_process(folder, algo):
    quick = {"clare": ["algo.discriminator_steps=2"], "dmpel": ["algo.recall_steps=2"]}.get(algo, [])
    served = run_of(folder, f"algo={algo}", *quick, *SAMPLING)
    seen = frames(served.run.policy.spec, rows=1)
    reworded = replace(served.run.tasks[1], language="the same in other words")  # as perturbations do
    session = served.session()
    for task in (*served.run.tasks, get_task("libero_goal/1"), reworded):
        wanted = in_process(served, task, seen, [(0, 4, task.index, 3)])
        for _ in range(2):  # the second time from the start
            begin = {"reset": True, "task": task.id, "prompt": get_task(task.id).language}
            begin["seed"] = [0, 4, task.index, 3]
            asked = [request(obs, **(begin if obs is seen[0] else {})) for obs in seen]
            asked[0] |= {"instruction": task.language} if task is reworded else {}
            found = [session.infer(one)["actions"] for one in asked]
            np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-5)  # alignment may round otherwise


def test_clients_do_not_touch_each_other(folder):
    served = run_of(folder, "algo=packnet", *SAMPLING)
    first, second = served.run.tasks
    seen = frames(served.run.policy.spec, rows=2)
    alone = []
    for row, task in enumerate((first, second)):
        session = served.session()
        asked = [request(obs, row, prompt=task.language, seed=[1, row]) for obs in seen]
        alone.append([session.infer(r)["actions"] for r in asked])
        session.close()
    sessions = served.session(), served.session()
    together: list[list] = [[], []]
    for obs in seen:
        for row, (session, task) in enumerate(zip(sessions, (first, second), strict=True)):
            asked = request(obs, row, prompt=task.language, seed=[1, row])
            together[row].append(session.infer(asked)["actions"])
    np.testing.assert_array_equal(together, alone)
    for session in sessions:
        session.close()


def test_what_begins_an_episode(folder):
    served = run_of(folder, "algo=er", *SAMPLING)
    first, second = served.run.tasks
    (obs,) = frames(served.run.policy.spec, rows=1, steps=1)
    session = served.session()
    ask = lambda **more: session.infer(request(obs, **more))["actions"].tobytes()  # noqa: E731
    started = ask(prompt=first.language, seed=[3])
    went_on = ask(seed=[3])
    assert went_on != started, "no prompt: the episode goes on"
    assert ask(reset=True, seed=[3]) == started and ask(seed=[3]) == went_on
    assert ask(prompt=first.language, task=first.id, seed=[3]) not in (started, went_on)
    ask(prompt=second.language)
    assert ask(prompt=first.language, seed=[3]) == started, "another prompt began an episode"
    reworded = ask(instruction="move it", seed=[3])
    assert reworded not in (started, went_on), "other words alone, for the same task"
    assert ask(reset=True, task=first.id, instruction="move it", seed=[3]) == reworded
    assert ask(instruction="move it", seed=[3]) != reworded, "the same words: the episode goes on"
    other = served.session().infer(request(obs, prompt=first.language))["actions"]
    again = served.session().infer(request(obs, prompt=first.language))["actions"]
    assert not np.array_equal(other, again), "without a seed each client draws by itself"


def test_requests_that_are_refused(folder):
    served = run_of(folder, "algo=er")
    spec, task = served.run.policy.spec, served.run.tasks[0]
    obs = frames(spec, rows=1, steps=1)[0]
    good = request(obs, prompt=task.language)
    bad = {
        "not a list": ([1], "not a list"),
        "lacks": ({k: v for k, v in good.items() if "joint" not in k}, "lacks observation/joint_states; it"),
        "dtype": (good | {"observation/agentview_rgb": np.zeros((32, 32, 3))}, "dtype float64; valid: uint8"),
        "shape": (good | {"observation/agentview_rgb": np.zeros((8, 8, 3), np.uint8)}, r"\(8, 8, 3\).*\(32, 32, 3\)"),
        "nan": (good | {"observation/ee_pos": np.full(3, np.nan)}, "not finite"),
        "prompt": (good | {"prompt": "dance"}, f"no task with prompt 'dance'.*{task.language}"),
        "words": (good | {"instruction": "x" * 10_000_000}, "instruction is not a text of at most 1000"),
        "reset": (good | {"reset": "no"}, "reset is neither true nor false"),
        "ragged": (good | {"observation/agentview_rgb": [[1], [2, 3]]}, "agentview_rgb is not an array"),
        "task": (good | {"task": "../../secrets.bddl"}, "no task with prompt"),
        "unknown": (good | {"rest": True}, "unknown key of a request 'rest'. Did you mean 'reset'"),
        "far": (good | {"observation/joint_states": np.full(7, 1e30)}, "actions that are not finite"),
        "seed": (good | {"seed": ["a"]}, r"seed is \['a'\]; valid: a list of integers"),
        "openpi": ({"observation/image": obs["agentview_rgb"][0], "prompt": task.language},
         "needs joint_states, which observation/image.*do not hold"),
    }  # fmt: skip
    for name, (message, error) in bad.items():
        with pytest.raises(LiberoError, match=error):
            served.session().infer(message)
            raise AssertionError(name)


def test_an_address_that_cannot_be_listened_on_is_named(folder):
    served = run_of(folder, "algo=er")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        server = PolicyServer(served.metadata, served.session, port=taken.getsockname()[1])
        with pytest.raises(ServerError, match=r"--port \d+ cannot be listened on: .*; --port 0"):
            asyncio.run(server.run())


def test_instructions_of_several_tasks(folder):
    served = run_of(folder, "algo=er")
    obs = frames(served.run.policy.spec, rows=1, steps=1)[0]
    names: dict[str, list[str]] = {}
    for task in get_suite("libero_90").tasks:
        names.setdefault(task.language, []).append(task.id)
    text, ids = next((t, i) for t, i in names.items() if len(i) > 1)
    with pytest.raises(PolicyError, match=f"several tasks.*{ids[0]}.*{ids[1]}"):
        served.session().infer(request(obs, prompt=text))


def test_openpi_names(folder):
    served = run_of(folder, "algo=er", *OPENPI_NAMES)
    assert served.metadata["openpi_names"]
    task = served.run.tasks[0]
    obs = frames(served.run.policy.spec, rows=1, steps=1)[0]
    wanted = served.session().infer(request(obs, prompt=task.language))["actions"]
    raw = {name: obs[f"{name}_rgb"][0, ::-1] for name in ("agentview", "eye_in_hand")}  # the simulator's rows
    state = np.concatenate([obs["ee_pos"][0], np.full(3, 9.0), obs["gripper_states"][0]])
    sent = {"observation/image": raw["agentview"][::-1, ::-1], "observation/state": state}
    sent |= {"observation/wrist_image": raw["eye_in_hand"][::-1, ::-1], "prompt": task.language}
    found = served.session().infer(sent)["actions"]
    np.testing.assert_array_equal(found, wanted)


def test_health_errors_and_keys_over_the_wire(folder, monkeypatch):
    served = run_of(folder, "algo=er")
    obs = frames(served.run.policy.spec, rows=1, steps=1)[0]
    good = OPENPI.pack(request(obs, prompt=served.run.tasks[0].language))
    with policy_servers.served(served) as address:
        with urllib.request.urlopen(address.replace("ws", "http") + "/healthz") as response:
            assert (response.status, response.read()) == (200, b"OK\n")
        for data in (b"\xc1garbage", OPENPI.pack({"prompt": "dance"})):
            with connect(address, compression=None, max_size=None) as socket:
                assert OPENPI.unpack(socket.recv())["server"] == "libero-lifelong"
                socket.send(good)
                answer = OPENPI.unpack(socket.recv())
                assert answer["actions"].shape == (1, 7) and answer["server_timing"]["infer_ms"] > 0
                socket.send(good)
                assert OPENPI.unpack(socket.recv())["server_timing"]["prev_total_ms"] > 0
                socket.send(data)
                text = socket.recv()
                assert re.match(r"(Codec|Policy)Error: ", text) and "\n" not in text
                assert ".py" not in text and str(folder) not in text
                with pytest.raises(ConnectionClosedError) as closed:
                    socket.recv()
                assert closed.value.rcvd.code == 1011
    monkeypatch.setenv("LIBERO_API_KEY", "secret")
    with policy_servers.served(served) as address:
        with closing(OpenpiClient(address, Limits(10, 60))) as client:
            assert client.announced["weights"] == served.run.weights_digest
        monkeypatch.delenv("LIBERO_API_KEY")
        with pytest.raises(ServerError, match="HTTP 401"):
            OpenpiClient(address, Limits(10, 60))
        with pytest.raises(urllib.error.HTTPError, match="401"):
            urllib.request.urlopen(address.replace("ws", "http"))
