"""Recordings of the original, repeated through the facade by the client that made them."""

import importlib.util

import numpy as np
import pytest
import yaml

from libero.libero.envs import ControlEnv

pytestmark = [pytest.mark.sim, pytest.mark.slow]
RECORDINGS = """
libero_10-00-grasp libero_10-03-predicates libero_10-04-grasp libero_10-08-predicates libero_10-09-random
libero_90-01-predicates libero_90-20-random libero_90-60-grasp libero_90-70-predicates libero_90-85-random
libero_goal-00-random libero_goal-01-predicates libero_goal-02-grasp libero_object-00-predicates
libero_object-00-random libero_object-03-grasp libero_spatial-00-grasp libero_spatial-02-predicates
libero_spatial-07-random
"""


@pytest.fixture
def replay(shared, tmp_path, monkeypatch):
    official = shared / "official"
    folders = {"assets": "assets", "bddl_files": "bddl_files", "init_states": "init_files"}
    paths = {key: str(official / folder) for key, folder in folders.items()}
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(paths))
    monkeypatch.setenv("LIBERO_CONFIG_PATH", str(tmp_path))
    monkeypatch.delenv("LIBERO_ASSETS", raising=False)
    spec = importlib.util.spec_from_file_location("replay", shared / "parity" / "replay.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("name", RECORDINGS.split())
def test_recording(replay, shared, name):
    with np.load(shared / "parity" / f"{name}.npz", allow_pickle=False) as stored:
        z = _Recording({key: stored[key] for key in stored.files})
    env, _ = replay.make_env(str(z["suite"]), int(z["task_id"]), ControlEnv)
    replay.set_fixtures(env, replay.json.loads(str(z["fixtures"])))
    message, agrees = (replay.predicates if "truth" in z.files else replay.trajectory)(z, env)
    env.close()
    assert agrees, message


class _Recording(dict):
    """Arrays in memory, with the interface of the file."""

    @property
    def files(self):
        return list(self)
