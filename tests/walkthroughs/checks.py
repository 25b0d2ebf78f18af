"""What must hold after each block, by its id."""

import ast
import os
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import torch
from torch.utils.data import default_collate

from libero.libero.envs import OffScreenRenderEnv
from libero.libero.envs.base_object import get_object_fn
from libero.libero.envs.predicates import get_predicate_fn_dict
from libero.libero.utils.mu_utils import get_scene_class
from libero_env.tasks import bddl, get_suite
from libero_env.tasks.problem import differences
from tests.walkthroughs.completions import Replay


@dataclass(frozen=True)
class Ran:
    """A block that was run.

    Attributes:
        names: the scope after it.
        out: what it printed.
        source: its text, as it was run.
        folder: where it ran.
    """

    names: dict[str, Any]
    out: str
    source: str
    folder: Path


CHECKS: dict[str, Callable[[Ran], None]] = {}


def check(*ids: str) -> Callable[[Callable[[Ran], None]], Callable[[Ran], None]]:
    def keep(function: Callable[[Ran], None]) -> Callable[[Ran], None]:
        CHECKS.update(dict.fromkeys(ids, function))
        return function

    return keep


# The quick reference ----------------------------------------------------------------------------------------------


@check("quick.1")
def _(ran: Ran) -> None:
    assert ran.names["obs"]["agentview_image"].std() > 10
    assert "put both the alphabet soup and the tomato sauce in the basket" in ran.out
    ran.names["env"].close()


@check("quick.2-3")
def _(ran: Ran) -> None:
    reached_by_hand(next(ran.folder.joinpath("my_tasks").glob("*.bddl")), "moka_pot_1", "plate_1")


@check("quick.3-folders", "3.5-folders")
def _(ran: Ran) -> None:
    named = re.findall(r"[├└]── (\w+/|\w+\.\w+)", ran.source)
    there = {path.name + "/" * path.is_dir() for path in ran.folder.joinpath("custom_assets").rglob("*")}
    assert named
    assert set(named) - {"libero_mug_yellow.xml"} <= there  # its text is left to the reader


@check("quick.3-1")
def _(ran: Ran) -> None:
    made = ran.names["MyCustomObject"]()
    assert get_object_fn("my_custom_object") is ran.names["MyCustomObject"]
    assert made.joints == ["my_object_joint0"]
    assert abs(made.horizontal_radius - 0.02) < 1e-3


@check("quick.3-2")
def _(ran: Ran) -> None:
    assert get_scene_class("SceneWithCustomObject") is ran.names["SceneWithCustomObject"]


@check("quick.4-2")
def _(ran: Ran) -> None:
    policy = ran.names["MyPolicy"](ran.names["cfg"], ran.names["shape_meta"])
    window = default_collate([dataset[0] for dataset in ran.names["datasets"]])
    dist = policy({"rgb": window["obs"]["agentview_rgb"]}, window["task_emb"])
    loss = -dist.log_prob(window["actions"][:, -1]).mean()
    loss.backward()
    assert all(p.grad is not None for p in policy.image_encoder.parameters())


@check("quick.4-3")
def _(ran: Ran) -> None:
    class Completed(Replay, ran.names["MyAlgorithm"]):
        pass

    cfg, few = ran.names["cfg"], ran.names["few"]
    algorithm = Completed(2, cfg=cfg)
    before = [p.detach().clone() for p in algorithm.policy.parameters()]
    for task, data in enumerate(few):
        algorithm.learn_one_task(task, data, cfg)
    assert len(algorithm.memory_buffer) == 4
    assert algorithm.ewc_loss().item() == 0  # at its anchor
    assert any(not torch.equal(a, b) for a, b in zip(before, algorithm.policy.parameters(), strict=True))


@check("quick.4-4")
def _(ran: Ran) -> None:
    rates = ran.names["evaluate_all_tasks"](None, ran.names["benchmark"], lambda _: np.zeros(7), 1)
    assert rates == {0: 0.0}
    assert np.isclose([ran.names["forgetting"], ran.names["forward_transfer"]], [0.4, 0.8]).all()
    assert ran.names["plt"].gca().lines
    ran.names["plt"].close("all")


@check("debug.1")
def _(ran: Ran) -> None:
    paths = ran.out.split()
    assert len(paths) == 2
    assert all(map(os.path.isdir, paths))


@check("debug.3")
def _(ran: Ran) -> None:
    assert {"MUJOCO_GL=egl", "PYOPENGL_PLATFORM=egl"} <= set(ran.out.split())


@check("debug.4")
def _(ran: Ran) -> None:
    assert ran.out.strip() == "['data']"


@check("speed.1")
def _(ran: Ran) -> None:
    assert ran.names["cfg"].train.batch_size == 64
    assert ran.names["scaler"].scale(torch.ones(())).item() >= 1


@check("speed.2")
def _(ran: Ran) -> None:
    assert not torch.equal(ran.names["before"], ran.names["model"].linear.weight)


@check("minimal")
def _(ran: Ran) -> None:
    assert ran.out.splitlines()[-1] == "Success: False"
    assert ran.names["step"] == 99


# The first notebook -----------------------------------------------------------------------------------------------


@check("1.1")
def _(ran: Ran) -> None:
    paths = (
        "benchmark_root_path", "init_states_default_path", "bddl_files_default_path", "datasets_default_path"
    )  # fmt: skip
    assert all(os.path.isdir(ran.names[path]) for path in paths)


@check("1.2")
def _(ran: Ran) -> None:
    assert ran.folder.joinpath(".libero", "config.yaml").exists()
    assert ran.names["get_libero_path"]("bddl_files") == ran.names["bddl_files_default_path"]


@check("1.3-output")
def _(ran: Ran) -> None:
    shown = dict(re.findall(r"'(\w+)': <class '(\w+)'>", ran.source))
    assert shown == {name: cls.__name__ for name, cls in ran.names["benchmark_dict"].items()}


@check("1.4")
def _(ran: Ran) -> None:
    assert ran.out.strip() == "10 tasks in the benchmark"
    assert os.path.exists(ran.names["bddl_file"])


@check("1.5")
def _(ran: Ran) -> None:
    file = ran.names["benchmark_instance"].get_task(0).bddl_file
    env = OffScreenRenderEnv(bddl_file_name=file, use_camera_obs=False)
    rows, size = re.search(r"\((\d+), (\d+)\)", ran.out).groups()
    assert int(rows) == 50
    # [time, qpos, qvel] is 123 numbers long as in the text; the fixtures' poses come behind
    assert env.get_sim_state().size == 123 <= int(size)
    assert int(size) in (123, 123 + 7 * len(env.env.fixtures_dict))
    env.close()


@check("1.6")
def _(ran: Ran) -> None:
    assert ran.names["obs"]["agentview_image"].shape == (128, 128, 3)


# Tasks ------------------------------------------------------------------------------------------------------------


@check("2.1")
def _(ran: Ran) -> None:
    assert len(ran.names["object_dict"]) == 50


@check("2.3")
def _(ran: Ran) -> None:
    shown = {"true", "false", "in", "on", "up", "open", "close", "turnon", "turnoff", "printjointstate"}
    assert shown <= set(ran.names["predicate_dict"])


@check("2.5-goals")
def _(ran: Ran) -> None:
    goals = [ast.literal_eval(line) for line in ran.source.splitlines() if not line.startswith("#")]
    assert len(goals) == 4
    known = get_predicate_fn_dict()
    assert all(goal[0].lower() in known for goal in goals)


@check("2.6")
def _(ran: Ran) -> None:
    path = ran.names["bddl_file_path"]
    same = next(t for t in get_suite("libero_90").tasks if t.name == Path(path).stem)
    assert differences(bddl.read(path), same.problem) == []


@check("2.6-file")
def _(ran: Ran) -> None:
    written = bddl.read(ran.names["bddl_file_path"])
    shown = re.findall(r"\((On) (\w+) (\w+)\)", ran.source)
    atoms = (*written.init, *written.goal.parts)
    assert sorted((atom.predicate, *atom.args) for atom in atoms) == sorted(shown)
    assert written.language in ran.source
    named = dict(re.findall(r"^(\w+) - (\w+)$", ran.source, re.M))
    assert named == {**written.fixtures, **written.objects}


# Objects ----------------------------------------------------------------------------------------------------------


@check("3.2")
def _(ran: Ran) -> None:
    xml = ran.folder / "custom_assets" / "libero_mug" / "libero_mug.xml"
    yellow = ran.folder / "custom_assets" / "libero_mug_yellow" / "libero_mug_yellow.xml"
    yellow.write_text(xml.read_text().replace("libero_mug", "libero_mug_yellow"))
    mug = ran.names["LiberoMugYellow"](name="libero_mug_yellow_1")
    assert (mug.category_name, mug.joints) == ("libero_mug_yellow", ["libero_mug_yellow_1_joint0"])
    assert get_object_fn("libero_mug") is ran.names["LiberoMug"]


@check("3.4")
def _(ran: Ran) -> None:
    problem = bddl.read(ran.names["bddl_file"])
    goal = [atom.args for atom in problem.goal.parts]
    assert goal == [("libero_mug_1", "plate_1"), ("libero_mug_yellow_1", "plate_1")]
    env = OffScreenRenderEnv(bddl_file_name=ran.names["bddl_file"], camera_heights=32, camera_widths=32)
    env.seed(0)
    assert env.reset()["libero_mug_1_pos"][2] > 0.8
    assert not env.step(np.zeros(7))[2]
    env.close()


# Learning ---------------------------------------------------------------------------------------------------------


@check("4.1-config")
def _(ran: Ran) -> None:
    """The keys that the text lists are there; it shortens and changes their values."""
    keys = re.findall(r"^'(\w+)':", re.sub(r"^cfg = \{", "", ran.source), re.M)
    cfg, group = ran.names["cfg"], None
    assert len(keys) > 10
    for key in keys:
        if key in ("policy", "data", "train", "eval"):
            group = cfg[key]
        else:
            assert key in group, key
    assert cfg.data.obs.modality.keys() == {"rgb", "depth", "low_dim"}


@check("4.3")
def _(ran: Ran) -> None:
    policy = ran.names["CustomTransformerPolicy"](ran.names["cfg"], ran.names["shape_meta"])
    window = default_collate([ran.names["datasets"][0][0]])
    obs = {"rgb": window["obs"]["agentview_rgb"]}
    assert policy.get_action(obs, window["task_emb"]).shape == (1, 7)
    # what is seen counts, and so does when
    policy.eval()
    seen = (obs, {"rgb": obs["rgb"] * 0}, {"rgb": obs["rgb"].flip(1)})
    means = [policy(one, window["task_emb"]).mean for one in seen]
    assert not torch.allclose(means[0], means[1])
    assert not torch.allclose(means[0], means[2])


@check("4.5")
def _(ran: Ran) -> None:
    saved, algorithm = ran.names["saved"], ran.names["algorithm"]
    assert [saved[0]["average"], saved[1]["average"]] == [0.0, 0.0]
    assert set(saved[1]) == {0, 1, "average"}
    assert len(algorithm.replay_buffer) == 8  # four windows of each task
    assert algorithm._compute_ewc_loss().item() == 0
    stored = [path.name for path in ran.folder.rglob("checkpoint_task_*.pth")]
    assert sorted(stored) == ["checkpoint_task_0.pth", "checkpoint_task_1.pth"]


@check("4.6")
def _(ran: Ran) -> None:
    rates = ((0.8, 0.0, 0.0), (0.6, 0.9, 0.1), (0.2, 0.7, 0.6))
    found: dict[int, dict] = {}
    for step, row in enumerate(rates):
        found[step] = {task: {"success_rate": rate} for task, rate in enumerate(row)}
        found[step]["average"] = float(np.mean(row))
    assert np.isclose(ran.names["compute_forgetting"](found), (0.6 + 0.2) / 2)
    assert np.isclose(ran.names["compute_forward_transfer"](found), (0.9 + 0.6) / 2)
    ran.names["visualize_results"](found, str(ran.folder))
    assert {path.name for path in ran.folder.glob("*.png")} == {"heatmap.png", "learning_curve.png"}
    ran.names["plt"].close("all")


# Files and pictures -----------------------------------------------------------------------------------------------


@check("hdf5")
def _(ran: Ran) -> None:
    for words in (
        "Top-level keys: ['data']", "agentview_rgb is a Dataset", "Dtype: uint8", "bddl_file_name: "
    ):  # fmt: skip
        assert words in ran.out


@check("hdf5-tree")
def _(ran: Ran) -> None:
    _, *shown = [line.removeprefix("-") for line in ran.source.splitlines()]
    with h5py.File(ran.names["hdf5_file"]) as file:
        demo = file["data/demo_0"]
        assert {name for name in shown if not name.startswith("--")} <= set(demo)
        assert {name.removeprefix("--") for name in shown if name.startswith("--")} <= set(demo["obs"])
        assert demo["robot_states"].shape[1] == 9
        assert demo["states"].shape[1] >= 79  # the text's number; the fixtures' poses come behind


@check("bddl")
def _(ran: Ran) -> None:
    task = get_suite("libero_goal").tasks[0]
    problem = bddl.parse(ran.source)
    # a language of its own in the file; otherwise what the suite has
    assert differences(problem, task.problem) == []
    path = ran.folder / "drawer.bddl"
    path.write_text(ran.source)
    env = OffScreenRenderEnv(bddl_file_name=path, camera_heights=32, camera_widths=32)
    env.reset()
    env.env.object_states_dict["wooden_cabinet_1_middle_region"].set_joint(-0.15)
    assert env.check_success()
    env.close()


@check("render")
def _(ran: Ran) -> None:
    assert "Demonstration replay complete!" in ran.out
    assert "Setting initial state from demonstration..." in ran.out
    assert ran.names["obs"]["agentview_image"].std() > 10


def reached_by_hand(path: Path, thing: str, on: str) -> None:
    """A task file makes a scene whose goal is reached when `thing` is put on `on`, and not before."""
    env = OffScreenRenderEnv(bddl_file_name=path, camera_heights=32, camera_widths=32)
    env.seed(0)
    obs = env.reset()
    assert not env.check_success()
    qpos = env.sim.data.get_joint_qpos(f"{thing}_joint0").copy()
    qpos[:3] = obs[f"{on}_pos"] + (0, 0, qpos[2] - obs[f"{on}_pos"][2] + 0.02)
    env.sim.data.set_joint_qpos(f"{thing}_joint0", qpos)
    env.sim.forward()
    done = False
    for _ in range(20):
        done = env.step(np.zeros(7))[2]
    assert done
    env.close()
