"""From a mesh and a YAML scene to a trained and evaluated policy, through the command line."""

import json
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
import trimesh
import yaml
from PIL import Image

from libero_cli.main import main
from libero_env.envs.env import LiberoEnv
from libero_env.tasks import read_task, write_task

pytestmark = [pytest.mark.sim, pytest.mark.slow]

TINY = (
    "preset=smoke", "algo=er", "threads=1", "data.demos=2",
    "data.seq_len=2", "data.image_size=32", "train.epochs=1",
    "train.steps_per_epoch=3", "train.batch_size=4", "eval.every=1", "eval.horizon=8", "eval.episodes=1",
    "eval.curve_episodes=1", "train.warmup_steps=0"
)  # fmt: skip
SCENE = {
    "fixtures": {"kitchen_table": "kitchen_table"},
    "objects": ["checked_bar", "basket"],
    "place": {"checked_bar_1": {"at": [0.0, 0.0], "half": 0.01}, "basket_1": [0.0, 0.25]},
}


@pytest.fixture
def home(tmp_path, monkeypatch) -> Path:
    for variable, folder in (("OBJECTS", "objects"), ("CACHE", "cache"), ("DEMOS", "demos")):
        monkeypatch.setenv(f"LIBERO_{variable}", str(tmp_path / folder))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["libero"])
    return tmp_path


def write_bar(path: Path) -> None:
    """Write a textured bar of 40 x 60 x 40, as an exporter in millimetres does."""
    mesh = trimesh.creation.box((40, 60, 40))
    squares = np.kron([[0, 1] * 4, [1, 0] * 4] * 4, np.ones((8, 8)))[..., None] * [200, 120, 40]
    Image.fromarray(squares.astype(np.uint8)).save(path.with_name("checks.png"))
    path.with_suffix(".mtl").write_text("newmtl skin\nmap_Kd checks.png\n")
    lines = [f"mtllib {path.stem}.mtl", "usemtl skin", *(f"v {x} {y} {z}" for x, y, z in mesh.vertices)]
    lines += ["vt 0 0", "vt 1 0", "vt 1 1", *(f"f {a}/1 {b}/2 {c}/3" for a, b, c in mesh.faces + 1)]
    path.write_text("\n".join(lines) + "\n")


def test_from_a_mesh_to_a_report(home, capsys):
    write_bar(home / "bar.obj")
    assert main(["objects", "add", "bar.obj", "--name", "checked_bar", "--size", "0.06"]) == 0
    assert "grasp     4.0 cm wide" in capsys.readouterr().out

    (home / "scene.yaml").write_text(yaml.safe_dump(SCENE))
    task = {"scene": "scene.yaml", "goal": "In checked_bar_1 basket_1_contain_region"}
    (home / "put_the_bar_in_the_basket.yaml").write_text(yaml.safe_dump(task))
    written = write_task(read_task("put_the_bar_in_the_basket.yaml"), "put_the_bar_in_the_basket.bddl")

    env = LiberoEnv(str(written), camera_size=(32, 32))
    obs, _ = env.reset(seed=0)
    start = env.view.body_pos("checked_bar_1").copy()
    moved = env.step(np.array([0, 0, 1, 0, 0, 0, -1.0]))[0]
    assert obs["agentview_rgb"].shape == (32, 32, 3) and moved["ee_pos"][2] > obs["ee_pos"][2]
    assert env.view.body_pos("checked_bar_1") == pytest.approx(start, abs=1e-3)  # it rests where it was put
    env.close()

    make = ["demos", "generate", "--bddl", str(written), "--n", "2", "--size", "32", "--workers", "1"]
    assert main(make) == 0
    (file,) = (home / "demos").rglob("*.hdf5")
    with h5py.File(file) as demos:
        assert "checked_bar" in demos["data"].attrs["bddl_file_content"]
        assert len(demos["data"]) == 2 and demos["data/demo_0/obs/agentview_rgb"].shape[1:] == (32, 32, 3)

    changed = task | {"place": {"basket_1": [0.05, 0.25]}}
    (home / "second.yaml").write_text(yaml.safe_dump(changed))
    files = f"benchmark.files=[{written},second.yaml]"
    assert main(["train", "benchmark=own", files, *TINY]) == 0
    (log,) = (home / "runs" / "own").rglob("results.jsonl")
    summary = json.loads((log.parent / "results.json").read_text())
    assert summary["finished"] and summary["tasks_learned"] == 2
    assert len(list((home / "cache" / "init_states").glob("*.npz"))) == 2  # of each task, drawn once
    assert "put the bar in the basket" in (log.parent / "report.html").read_text()
