"""Serving of a run's policy: the same actions as in process, episodes of clients, requests that are refused."""

import asyncio
import json
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
from libero_eval.protocols.clock import Clock, ClockedActor
from libero_eval.servers.actors import ServedActor
from libero_eval.servers.openpi import OPENPI, OpenpiClient
from libero_eval.servers.serving import PREFIX, PolicyServer, ServedPolicy, announced_run
from libero_eval.servers.transport import EpisodeStart, Limits
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
    seen = frames(served.run.policy.spec, rows=3)
    with policy_servers.served(served) as address:
        reworded = replace(served.run.tasks[1], language="the same in other words")  # as perturbations do
        for task in (*served.run.tasks, get_task("libero_goal/1"), reworded):
            seeds = [(0, 4, task.index, state) for state in range(3)]
            wanted = in_process(served, task, seen, seeds)
            episodes = [EpisodeStart(task, state) for state in range(3)]
            with closing(OpenpiClient(address, Limits(10, 60))) as client:
                actor = ClockedActor(ServedActor(client, served.metadata, episodes, seeds))
                for _ in range(2):  # the second time from the start
                    actor.reset(3)
                    np.testing.assert_array_equal([actor.act(obs) for obs in seen], wanted)


def test_served_chunks_are_those_in_process(folder):
    """On a clock, rows ask at different times, and the server has the history of all."""
    flow = [
        "policy/head=flow_small",
        "policy.head.chunk=2",
        "policy.head.execute=1",
        "policy.stochastic=true",
    ]
    served = run_of(folder, "algo=dmpel", "algo.recall_steps=2", *flow)
    task, seeds = served.run.tasks[0], [(0, 4, 0, state) for state in range(3)]
    seen = frames(served.run.policy.spec, rows=3, steps=8)
    clock = Clock.read("latency=uniform:0/150ms")
    run = served.run
    with run.acting(task) as policy:
        draws = [generator(*words) for words in seeds]
        actor = ClockedActor(
            PolicyActor(policy, run.embed(task), run.device, run.eval.precision, draws), clock, seeds
        )
        actor.reset(3)
        wanted = [actor.act(obs) for obs in seen]
    assert len({tuple(row) for row in actor.timing}) > 1
    with policy_servers.served(served) as address, closing(OpenpiClient(address, Limits(10, 60))) as client:
        episodes = [EpisodeStart(task, state) for state in range(3)]
        actor = ClockedActor(ServedActor(client, served.metadata, episodes, seeds), clock, seeds)
        actor.reset(3)
        np.testing.assert_array_equal([actor.act(obs) for obs in seen], wanted)
    session = served.session()
    for plan in ([3], ["0"], [True], 0):
        with pytest.raises(PolicyError, match="plan is .*a list of rows, from 0 to 0"):
            session.infer(request(seen[0], prompt=task.language, plan=plan))


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
    obs, both = frames(spec, rows=1, steps=1)[0], frames(spec, rows=2, steps=1)[0]
    good = request(obs, prompt=task.language)
    bad = {
        "not a list": ([1], "not a list"),
        "lacks": ({k: v for k, v in good.items() if "joint" not in k}, "lacks observation/joint_states; it"),
        "dtype": (good | {"observation/agentview_rgb": np.zeros((32, 32, 3))}, "dtype float64; valid: uint8"),
        "text": (good | {"observation/ee_pos": ["a", "b", "c"]}, "dtype <U1; valid: floats"),
        "shape": (good | {"observation/agentview_rgb": np.zeros((8, 8, 3), np.uint8)}, r"\(8, 8, 3\).*\(32, 32, 3\)"),
        "nan": (good | {"observation/ee_pos": np.full(3, np.nan)}, "not finite"),
        "prompt": (good | {"prompt": "dance"}, f"no task with prompt 'dance'.*{task.language}"),
        "words": (good | {"instruction": "x" * 10_000_000}, "instruction is not a text of at most 1000"),
        "no text": (good | {"prompt": np.zeros(3)}, "prompt is not a text"),
        "reset": (good | {"reset": "no"}, "reset is neither true nor false"),
        "ragged": (good | {"observation/agentview_rgb": [[1], [2, 3]]}, "agentview_rgb is not an array"),
        "many": (
            {k: np.repeat(v[None], 101, 0) for k, v in request(obs).items()} | {"prompt": task.language},
            r"shape \(101,",
        ),
        "task": (good | {"task": "../../secrets.bddl"}, "no task with prompt"),
        "other": (good | {"task": served.run.tasks[1].id}, "no task with prompt"),
        "unknown": (good | {"rest": True}, "unknown key of a request 'rest'. Did you mean 'reset'"),
        "far": (good | {"observation/joint_states": np.full(7, 1e30)}, "actions that are not finite"),
        "seed": (good | {"seed": ["a"]}, r"seed is \['a'\]; valid: integers"),
        "openpi": ({"observation/image": obs["agentview_rgb"][0], "prompt": task.language},
         "needs joint_states, which observation/image.*do not hold"),
    }  # fmt: skip
    for name, (message, error) in bad.items():
        with pytest.raises(LiberoError, match=error):
            served.session().infer(message)
            raise AssertionError(name)
    session = served.session()
    session.infer(good)
    with pytest.raises(PolicyError, match="2 rows in an episode that began with 1"):
        session.infer({f"observation/{k}": v for k, v in both.items()} | {"prompt": task.language})


@pytest.mark.parametrize("host", ["nowhere.invalid", "127.0.0.1"])
def test_an_address_that_cannot_be_listened_on_is_named(folder, host):
    served = run_of(folder, "algo=er")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        server = PolicyServer(served.metadata, served.session, host=host, port=taken.getsockname()[1])
        with pytest.raises(
            ServerError, match=rf"--host {host} --port \d+ cannot be listened on: .*; --port 0"
        ):
            asyncio.run(server.run())


def test_metadata_of_other_kinds_are_refused_in_one_line(folder):
    """Whatever is missing, of another type, out of range, nested or huge."""
    about = json.loads(json.dumps(run_of(folder, "algo=er").metadata))
    assert announced_run(about, "ws://it")["weights"] == about["weights"]
    odd = [5.5, [[1]], {"x": {"y": []}}, None, ["a"]]
    odd_parts = {
        "format": [2, "x" * 100_000, None, {}],
        "selection": [[50], [-1], [1.5], ["1"], "x" * 100_000],
        "actions": [
            about["actions"] | one
            for one in ({"chunk": 5}, {"replan": -1}, {"shape": [0]}, {"shape": [1] * 4})
        ],
        "images": ["upside down"],
        "gripper": ["opens at +1, closes at -1"],
        "tasks": [["libero_goal/0"], {"libero_goal/0": 5}],
        "observation": [
            {},
            {PREFIX + "ee_pos": {"dtype": "float64", "shape": [3]}},
            about["observation"] | {PREFIX + "depth": {"dtype": "uint8", "shape": [4, 4, 3]}},
            {PREFIX + "agentview_rgb": {"dtype": "uint8", "shape": [64, 64]}},
            {PREFIX + "agentview_rgb": {"dtype": "uint8", "shape": [10**9, 64, 3]}},
            {PREFIX + "agentview_rgb": {"dtype": "uint8"}},
        ],
    }
    cases = [(key, {k: v for k, v in about.items() if k != key}) for key in about if key != "server"]
    cases += [(key, about | {key: one}) for key, parts in odd_parts.items() for one in parts]
    cases += [(key, about | {key: one}) for key in about.keys() - {"server", "drawing"} for one in odd]
    for key, values in cases:
        with pytest.raises(ServerError, match=key) as caught:
            announced_run(values, "ws://it")
        assert (
            "ws://it" in str(caught.value) and "\n" not in str(caught.value) and len(str(caught.value)) < 1000
        )


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
    found = served.session().infer(
        {
            "observation/image": raw["agentview"][::-1, ::-1],
            "observation/wrist_image": raw["eye_in_hand"][::-1, ::-1],
            "observation/state": state,
            "prompt": task.language,
        }
    )["actions"]
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
    task = served.run.tasks[0]
    with policy_servers.served(served) as address:
        with closing(OpenpiClient(address, Limits(10, 60))) as client:
            actor = ServedActor(client, served.metadata, [EpisodeStart(task, 0)], [(0,)])
            actor.reset(1)
            assert actor.plan(obs, [0]).shape == (1, 1, 7)
        monkeypatch.delenv("LIBERO_API_KEY")
        with pytest.raises(ServerError, match="HTTP 401"):
            OpenpiClient(address, Limits(10, 60))
        with pytest.raises(urllib.error.HTTPError, match="401"):
            urllib.request.urlopen(address.replace("ws", "http"))
