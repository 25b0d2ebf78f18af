"""Five new tasks, written as data only, that the expert solves as it is: a drawer, a stack, a door, a knob, and a
two-step task with an object of the user's own."""

import mujoco
import numpy as np
import pytest
import yaml

from libero_env.design.certify import certify
from libero_env.objects import ObjectModel, register_object
from libero_env.objects.catalog import _registered
from libero_env.tasks import get_suite, read_task, suite_names

pytestmark = [pytest.mark.sim, pytest.mark.slow]

STARTS, SOLVED = 5, 4

TASKS = yaml.safe_load("""
drawer:
  scene: living_room
  furniture: [white_cabinet]
  objects: [red_coffee_mug, popcorn]
  place:
    white_cabinet_1: {at: [0.02, -0.29], half: 0.02, yaw: [3.0, 3.3]}
    red_coffee_mug_1: {at: [-0.15, 0.15], half: 0.05, yaw: 0}
    popcorn_1: {at: [0.15, 0.15], half: 0.05, yaw: 0}
  goal: Open white_cabinet_1_bottom_region
  language: open the bottom drawer of the white cabinet
stack:
  scene: study
  objects: [cream_cheese, chocolate_pudding, butter]
  place:
    cream_cheese_1: {at: [0, 0], half: 0.05, yaw: [0, 1.5]}
    chocolate_pudding_1: {at: [-0.1, 0.18], half: 0.05, yaw: [0, 1.5]}
    butter_1: {at: [-0.1, -0.18], half: 0.05, yaw: [0, 1.5]}
  goal: [Stack butter_1 chocolate_pudding_1, Stack chocolate_pudding_1 cream_cheese_1]
  language: stack the butter on the chocolate pudding on the cream cheese
door:
  scene: kitchen
  furniture: [microwave]
  objects: [ketchup, plate]
  place:
    microwave_1: {at: [0.05, 0.32], half: 0.02, yaw: [-0.15, 0.15]}
    ketchup_1: {at: [0.1, -0.1], half: 0.05, yaw: 0}
    plate_1: {at: [-0.1, -0.2], half: 0.05, yaw: 0}
  init: [Close microwave_1]
  goal: Open microwave_1
  language: open the microwave behind the ketchup
knob:
  scene: table
  furniture: [flat_stove]
  objects: [porcelain_mug, white_yellow_mug]
  place:
    flat_stove_1: {at: [-0.1, -0.25], half: 0.02, yaw: [0.2, 0.5]}
    porcelain_mug_1: {at: [-0.16, -0.06], half: 0.04, yaw: 0}
    white_yellow_mug_1: {at: [0.1, 0.1], half: 0.05, yaw: 0}
  init: [Turnoff flat_stove_1]
  goal: Turnon flat_stove_1
  language: turn on the stove next to the mugs
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

BOBBIN = """
<mujoco>
  <asset><mesh name="bobbin" file="{file}"/></asset>
  <worldbody>
    <body name="main">
      <geom name="g0" type="mesh" mesh="bobbin" density="300" friction="1 0.005 0.0001" group="0"/>
      <geom type="mesh" mesh="bobbin" rgba="0.7 0.3 0.5 1" group="1" contype="0" conaffinity="0" mass="0"/>
    </body>
  </worldbody>
</mujoco>
"""


@pytest.fixture
def bobbin(tmp_path):
    """A six-sided bobbin, 4 cm across and 4.4 cm tall, thinner at its top, from an MJCF file with a mesh."""
    corners = np.arange(6) * np.pi / 3
    rings = [
        np.column_stack([r * np.cos(corners), r * np.sin(corners), np.full(6, z)])
        for r, z in ((0.021, -0.022), (0.015, 0.022))
    ]
    lines = [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in np.concatenate(rings)]
    lines += [f"f {k + 1} {(k + 1) % 6 + 1} {(k + 1) % 6 + 7} {k + 7}" for k in range(6)]
    lines += ["f 6 5 4 3 2 1", "f 7 8 9 10 11 12"]
    mesh, model = tmp_path / "bobbin.obj", tmp_path / "bobbin.xml"
    mesh.write_text("\n".join(lines) + "\n")
    model.write_text(BOBBIN.format(file=mesh))

    def build():
        low, high = (0.0, 0.0, -0.022), (0.0, 0.0, 0.022)
        spec = mujoco.MjSpec.from_file(str(model))
        return ObjectModel("test_bobbin", spec, bottom_offset=low, top_offset=high, horizontal_radius=0.021)

    register_object("test_bobbin", build)
    yield
    del _registered["test_bobbin"]


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
