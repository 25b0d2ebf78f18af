"""`libero demos show`: Rerun itself reads what is written, in an environment of its own."""

import sys

import numpy as np
import pytest

from libero_cli.main import main
from libero_env.curating.rendering import rerender
from libero_env.demos.config import RenderConfig
from libero_env.demos.read import read_episodes
from libero_env.tasks import get_task
from libero_integrations.exports.demonstrations import recorded_language
from tests.harness.demos import STEPS, record_wander
from tests.harness.peers import rerun

pytestmark = [pytest.mark.sim, pytest.mark.slow]


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    folder = tmp_path_factory.mktemp("demos")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("LIBERO_ASSETS", "builtin")
        first = record_wander(folder / "first.hdf5", "libero_goal/3", (16, 16))
        modalities = ("rgb", "depth", "segmentation_instance")
        config = RenderConfig(("agentview",), (16, 24), modalities, perturb="instruction=0.8")
        yield rerender(first, folder / "demo.hdf5", config, progress=False)


def test_rerun_reads_cameras_states_actions_and_predicates(file, tmp_path):
    found = rerun().run("show_demos.py", file, tmp_path / "out.rrd", cwd=tmp_path)
    episodes = {one.name: one for one in read_episodes(file)}
    assert set(episodes) == {"demo_0", "demo_1"}
    for name, one in episodes.items():
        for key in ("agentview_rgb", "agentview_depth", "agentview_segmentation"):
            assert found["rows"][f"/{name}/cameras/{key}"] >= STEPS
        for path, values in (
            ("action", one.actions),
            ("expert_action", one.expert_actions),
            *((f"state/{key}", one.obs[key]) for key in ("ee_pos", "joint_states", "gripper_states")),
        ):
            (column,) = (v for k, v in found["columns"][f"/{name}/{path}"].items() if k.endswith(":scalars"))
            np.testing.assert_array_equal(column, values)
            assert found["times"][f"/{name}/{path}"] == ["step", "time"]
        goals = [path for path in found["rows"] if path.startswith(f"/{name}/goal/")]
        assert len(goals) == 2 and any("akita_black_bowl_1" in path for path in goals)
        for path in goals:  # a random walk moves no bowl
            (column,) = (v for k, v in found["columns"][path].items() if k.endswith(":scalars"))
            assert column == [[0.0]] * STEPS
        assert recorded_language(file) != get_task("libero_goal/3").language
        assert recorded_language(file) in str(found["columns"][f"/{name}/task"])
        assert "wooden_cabinet_1" in str(found["columns"][f"/{name}/cameras/agentview_segmentation"])


def test_mistakes_are_one_line_and_write_nothing(file, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert main(["demos", "show", str(file), "--rerun", str(tmp_path / "out.rrd")]) == 2
    assert "pip install 'libero-lifelong[rerun]'" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
