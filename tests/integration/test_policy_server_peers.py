"""Policy servers with their real counterparts from PyPI: openpi's client, and vla-eval's server."""

import json
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import msgpack
import numpy as np
import pytest

from libero_env.tasks import get_suite
from libero_eval.protocols.adapter import PolicyInput
from libero_eval.protocols.clock import ClockedActor
from libero_eval.servers.actors import RemoteActor
from libero_eval.servers.openpi import OPENPI
from libero_eval.servers.transport import EpisodeStart, Limits
from libero_integrations.servers.vla_eval import VLA_EVAL, VlaEvalClient
from lifelong.errors import ServerError
from lifelong.evaluation.actors import PolicyActor
from lifelong.evaluation.restore import restore
from lifelong.seeding import generator
from tests.harness.counterparts import counterpart
from tests.harness.runs import make_run

pytestmark = pytest.mark.slow

NEEDED = ("anyio", "dm-tree", "msgpack", "numpy", "pillow", "typing_extensions", "websockets")
CLIENT = """
import json, sys
import numpy as np
from openpi_client.websocket_client_policy import WebsocketClientPolicy

port, frames, out = int(sys.argv[1]), np.load(sys.argv[2]), {}
policy = WebsocketClientPolicy("127.0.0.1", port)
about = policy.get_server_metadata()
task, instruction = next(iter(about["tasks"].items()))
names = list(about["observation"])
actions = []
for step in range(len(frames[names[0].replace("/", "__")])):
    observation = {name: frames[name.replace("/", "__")][step] for name in names}
    answer = policy.infer({**observation, "prompt": instruction, "task": task})
    actions.append(answer["actions"].tolist())
try:
    policy.infer({"prompt": instruction})
except RuntimeError as error:
    out["error"] = str(error)
print(json.dumps({**out, "actions": actions, "timing": sorted(answer["server_timing"]), "server": about["server"]}))
"""
MODEL = """
import sys
from functools import partial
import anyio
import numpy as np
from vla_eval.model_servers.predict import PredictModelServer
from vla_eval.model_servers.serve import serve_async
from vla_eval.specs import GRIPPER_CLOSE_POS, IMAGE_RGB, LANGUAGE, POSITION_DELTA, ROTATION_AA

class Counting(PredictModelServer):
    def get_observation_params(self):
        return {"send_wrist_image": True, "send_state": True}

    def get_action_spec(self):
        return {"position": POSITION_DELTA, "rotation": ROTATION_AA, "gripper": GRIPPER_CLOSE_POS}

    def get_observation_spec(self):
        return {"agentview": IMAGE_RGB, "language": LANGUAGE}

    def predict_batch(self, observations, contexts):
        self.sizes = getattr(self, "sizes", []) + [len(observations)]
        found = []
        for obs, ctx in zip(observations, contexts):
            if obs["states"][0] == 13:
                raise ValueError("thirteen")
            chunk = np.zeros((2, 7))
            chunk[:, 0] = obs["states"][0]
            chunk[:, 1] = ctx.step
            chunk[:, 2] = obs["images"]["agentview"].sum() - obs["images"]["wrist"].sum()
            chunk[:, 3] = len(obs["task_description"])
            chunk[:, 4] = max(self.sizes)
            found.append({"actions": chunk})
        return found

server = Counting(chunk_size=2, max_batch_size=4, max_wait_time=0.2)
anyio.run(partial(serve_async, server, "127.0.0.1", int(sys.argv[1])))
"""
CODEC = """
import sys
import numpy as np
from openpi_client import msgpack_numpy
from vla_eval.protocol import numpy_codec
import msgpack
value = {"a": np.arange(6, dtype="<f4").reshape(2, 3), "n": np.int16(3), "t": "x", "i": np.zeros((4, 5, 3), np.uint8)}
both = [msgpack_numpy.packb(value), msgpack.packb(value, default=numpy_codec.encode_ndarray)]
sys.stdout.buffer.write(msgpack.packb(both))
"""


@pytest.fixture(scope="module")
def python() -> Path:
    return counterpart(*NEEDED, no_deps=("openpi-client==0.1.2", "vla-eval==0.8.0"))


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("runs") / "run"
    make_run(path, "algo=packnet")
    return path


def free_port() -> int:
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return found.getsockname()[1]


@contextmanager
def process(*command: str) -> Iterator[subprocess.Popen]:
    started = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        yield started
    finally:
        started.kill()
        started.communicate()


def test_openpi_client_and_libero_serve(python, run, tmp_path):
    restored = restore(run, device="cpu")
    spec, task = restored.policy.spec, restored.tasks[0]
    rng = np.random.default_rng(0)
    frames = {v: rng.integers(0, 256, (5, *spec.image_size, 3), np.uint8) for v in spec.views}
    frames |= {n: rng.normal(size=(5, size)) for n, size in spec.proprio.items()}
    np.savez(tmp_path / "frames.npz", **{f"observation__{name}": value for name, value in frames.items()})
    with restored.acting(task) as policy:
        actor = PolicyActor(policy, restored.embed(task), restored.device, "fp32", [generator(0)])
        actor.reset(1)
        wanted = [actor.act({k: v[i : i + 1] for k, v in frames.items()}) for i in range(5)]
    command = [sys.executable, "-m", "libero_cli", "serve", str(run), "--port", "0", "--device", "cpu"]
    with process(*command) as server:
        line = server.stdout.readline()
        assert "serving" in line and "after task 1 at ws://127.0.0.1:" in line
        port = line.rpartition(":")[2].strip()
        client = [str(python), "-c", CLIENT, port, str(tmp_path / "frames.npz")]
        done = subprocess.run(client, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    np.testing.assert_allclose(found["actions"], wanted, atol=1e-6)
    assert found["timing"] == ["infer_ms", "prev_total_ms"] and found["server"] == "libero-lifelong"
    assert "PolicyError: the request lacks observation/agentview_rgb" in found["error"]


def test_their_bytes_are_ours(python):
    done = subprocess.run([str(python), "-c", CODEC], capture_output=True, check=True)
    theirs = msgpack.unpackb(done.stdout)
    value = {"a": np.arange(6, dtype="<f4").reshape(2, 3), "n": np.int16(3), "t": "x"}
    value["i"] = np.zeros((4, 5, 3), np.uint8)
    assert OPENPI.pack(value) == theirs[0]
    found = VLA_EVAL.unpack(theirs[1])
    for name, array in value.items():
        np.testing.assert_array_equal(found[name], array)


class Plain:
    """An adapter that sends the number in an observation, with two images."""

    def inputs(self, obs, rows=None):
        image = np.full((8, 8, 3), 2, np.uint8)
        images = {"agentview": image, "robot0_eye_in_hand": image // 2}
        return [PolicyInput(images, np.full(8, obs["x"][i]), "to do") for i in rows]

    def actions(self, predicted):
        return predicted


def test_our_client_and_vla_eval_server(python, tmp_path):
    task, port = get_suite("libero_goal").tasks[0], free_port()
    with process(str(python), "-c", MODEL, str(port)):
        client = VlaEvalClient(f"ws://127.0.0.1:{port}", Limits(60, 60))
        try:
            assert client.announced["model_server"] == "Counting"
            assert client.announced["action_spec"]["gripper"]["format"] == "binary_close_positive"
            actor = ClockedActor(RemoteActor(client, Plain(), [EpisodeStart(task, i) for i in range(4)]))
            actor.reset(4)
            for step in range(4):
                actions = actor.act({"x": np.arange(4.0)})
                assert actions[:, 0].tolist() == [0, 1, 2, 3]
                assert (actions[:, 1] == step // 2 * 2).all(), "the server hands out chunks of two"
                assert (actions[:, 2] == 192).all() and (actions[:, 3] == 5).all()
            assert actions[0, 4] > 1, "requests in flight are computed as a batch"
            actor.note(np.ones(4, bool), np.ones(4, bool))
            actor.reset(4)
            with pytest.raises(ServerError, match="failed: observation_failed: ValueError: thirteen"):
                actor.act({"x": np.full(4, 13.0)})
        finally:
            client.close()
