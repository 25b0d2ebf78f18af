"""New tasks, written as data only, that the expert solves as it is: a stack, and two steps with one's own object."""

import numpy as np
import pytest
import trimesh
import yaml

from libero_env.design.certify import certify
from libero_env.design.objects import register_object_file
from libero_env.tasks import get_suite, read_task, suite_names

pytestmark = [pytest.mark.sim, pytest.mark.slow]

STARTS, SOLVED = 5, 4

TASKS = yaml.safe_load("""
stack:
  scene: study
  objects: [cream_cheese, chocolate_pudding, butter]
  place:
    cream_cheese_1: {at: [0, 0], half: 0.05, yaw: [0, 1.5]}
    chocolate_pudding_1: {at: [-0.1, 0.18], half: 0.05, yaw: [0, 1.5]}
    butter_1: {at: [-0.1, -0.18], half: 0.05, yaw: [0, 1.5]}
  goal: [Stack butter_1 chocolate_pudding_1, Stack chocolate_pudding_1 cream_cheese_1]
  language: stack the butter on the chocolate pudding on the cream cheese
mix:
  scene: kitchen
  furniture: [wooden_cabinet]
  objects: [test_bobbin, alphabet_soup]
  place:
    wooden_cabinet_1: {at: [0.04, -0.31], half: 0.01, yaw: 3.14159}
    test_bobbin_1: {at: [-0.085, 0.125], half: [0.065, 0.075], yaw: 0}
    alphabet_soup_1: {at: [0.15, 0.17], half: 0.05, yaw: 0}
  init: [Open wooden_cabinet_1_top_region]
  goal: [In test_bobbin_1 wooden_cabinet_1_top_region, Close wooden_cabinet_1_top_region]
  language: put the bobbin in the top drawer of the cabinet and close it
""")


@pytest.fixture
def bobbin(objects_home):
    """A six-sided bobbin, 4 cm across and 4.4 cm tall, thinner at its top, from a mesh."""
    profile = np.array([[0, -0.022], [0.021, -0.022], [0.015, 0.022], [0, 0.022]])
    trimesh.creation.revolve(profile, sections=6).export(objects_home / "test_bobbin.stl")
    register_object_file(objects_home / "test_bobbin.stl", density=300.0)


@pytest.mark.parametrize("name", TASKS)
def test_a_new_task_is_solved(tmp_path, bobbin, name):
    file = tmp_path / f"{name}.yaml"
    file.write_text(yaml.safe_dump(TASKS[name]))
    task = read_task(file)
    known = [old.problem for suite in suite_names() for old in get_suite(suite).tasks]
    assert task.problem not in known
    certificate = certify([task], STARTS, progress=False)[0]
    assert len(certificate.outcomes) == STARTS
    assert len(certificate.lengths) >= SOLVED, certificate.summary()
