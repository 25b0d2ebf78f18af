"""Five new tasks, written as data only, that the expert solves as it is: a drawer, a stack, a door, a knob, and a
two-step task with an object of the user's own."""

import mujoco
import numpy as np
import pytest

from libero_env.design.certify import certify
from libero_env.objects import ObjectModel, register_object
from libero_env.objects.catalog import _registered
from libero_env.tasks import get_suite, read_task, suite_names

pytestmark = [pytest.mark.sim, pytest.mark.slow]

STARTS, SOLVED = 10, 8

DRAWER = """
(define (problem LIBERO_Living_Room_Tabletop_Manipulation)
  (:domain robosuite)
  (:language open the bottom drawer of the white cabinet)
  (:regions
    (cabinet_place (:target living_room_table) (:ranges ((0.0 -0.31 0.04 -0.27))) (:yaw_rotation ((3.0 3.3))))
    (mug_place (:target living_room_table) (:ranges ((-0.2 0.1 -0.1 0.2))) (:yaw_rotation ((0.0 0.0))))
    (popcorn_place (:target living_room_table) (:ranges ((0.1 0.1 0.2 0.2))) (:yaw_rotation ((0.0 0.0))))
    (bottom_region (:target white_cabinet_1))
  )
  (:fixtures
    living_room_table - living_room_table
    white_cabinet_1 - white_cabinet
  )
  (:objects
    red_coffee_mug_1 - red_coffee_mug
    popcorn_1 - popcorn
  )
  (:obj_of_interest white_cabinet_1)
  (:init
    (On white_cabinet_1 living_room_table_cabinet_place)
    (On red_coffee_mug_1 living_room_table_mug_place)
    (On popcorn_1 living_room_table_popcorn_place)
  )
  (:goal (And (Open white_cabinet_1_bottom_region)))
)
"""

STACK = """
(define (problem LIBERO_Study_Tabletop_Manipulation)
  (:domain robosuite)
  (:language stack the butter on the chocolate pudding on the cream cheese)
  (:regions
    (cheese_place (:target study_table) (:ranges ((-0.05 -0.05 0.05 0.05))) (:yaw_rotation ((0.0 1.5))))
    (pudding_place (:target study_table) (:ranges ((-0.15 0.13 -0.05 0.23))) (:yaw_rotation ((0.0 1.5))))
    (butter_place (:target study_table) (:ranges ((-0.15 -0.23 -0.05 -0.13))) (:yaw_rotation ((0.0 1.5))))
  )
  (:fixtures study_table - study_table)
  (:objects
    cream_cheese_1 - cream_cheese
    chocolate_pudding_1 - chocolate_pudding
    butter_1 - butter
  )
  (:obj_of_interest butter_1 chocolate_pudding_1 cream_cheese_1)
  (:init
    (On cream_cheese_1 study_table_cheese_place)
    (On chocolate_pudding_1 study_table_pudding_place)
    (On butter_1 study_table_butter_place)
  )
  (:goal (And (Stack butter_1 chocolate_pudding_1) (Stack chocolate_pudding_1 cream_cheese_1)))
)
"""

DOOR = """
(define (problem LIBERO_Kitchen_Tabletop_Manipulation)
  (:domain robosuite)
  (:language open the microwave behind the ketchup)
  (:regions
    (microwave_place (:target kitchen_table) (:ranges ((0.03 0.3 0.07 0.34))) (:yaw_rotation ((-0.15 0.15))))
    (ketchup_place (:target kitchen_table) (:ranges ((0.05 -0.15 0.15 -0.05))) (:yaw_rotation ((0.0 0.0))))
    (plate_place (:target kitchen_table) (:ranges ((-0.15 -0.25 -0.05 -0.15))) (:yaw_rotation ((0.0 0.0))))
  )
  (:fixtures
    kitchen_table - kitchen_table
    microwave_1 - microwave
  )
  (:objects
    ketchup_1 - ketchup
    plate_1 - plate
  )
  (:obj_of_interest microwave_1)
  (:init
    (On microwave_1 kitchen_table_microwave_place)
    (On ketchup_1 kitchen_table_ketchup_place)
    (On plate_1 kitchen_table_plate_place)
    (Close microwave_1)
  )
  (:goal (And (Open microwave_1)))
)
"""

KNOB = """
(define (problem LIBERO_Tabletop_Manipulation)
  (:domain robosuite)
  (:language turn on the stove next to the mugs)
  (:regions
    (stove_place (:target main_table) (:ranges ((-0.12 -0.27 -0.08 -0.23))) (:yaw_rotation ((0.2 0.5))))
    (mug_place (:target main_table) (:ranges ((-0.2 -0.1 -0.12 -0.02))) (:yaw_rotation ((0.0 0.0))))
    (other_mug_place (:target main_table) (:ranges ((0.05 0.05 0.15 0.15))) (:yaw_rotation ((0.0 0.0))))
    (cook_region (:target flat_stove_1))
  )
  (:fixtures
    main_table - table
    flat_stove_1 - flat_stove
  )
  (:objects
    porcelain_mug_1 - porcelain_mug
    white_yellow_mug_1 - white_yellow_mug
  )
  (:obj_of_interest flat_stove_1)
  (:init
    (On flat_stove_1 main_table_stove_place)
    (On porcelain_mug_1 main_table_mug_place)
    (On white_yellow_mug_1 main_table_other_mug_place)
    (Turnoff flat_stove_1)
  )
  (:goal (And (Turnon flat_stove_1)))
)
"""

MIX = """
(define (problem LIBERO_Kitchen_Tabletop_Manipulation)
  (:domain robosuite)
  (:language put the bobbin in the top drawer of the cabinet and close it)
  (:regions
    (cabinet_place (:target kitchen_table) (:ranges ((0.03 -0.32 0.05 -0.3))) (:yaw_rotation ((3.14159 3.14159))))
    (bobbin_place (:target kitchen_table) (:ranges ((-0.15 0.05 -0.02 0.2))) (:yaw_rotation ((0.0 0.0))))
    (soup_place (:target kitchen_table) (:ranges ((0.1 0.12 0.2 0.22))) (:yaw_rotation ((0.0 0.0))))
    (top_region (:target wooden_cabinet_1))
  )
  (:fixtures
    kitchen_table - kitchen_table
    wooden_cabinet_1 - wooden_cabinet
  )
  (:objects
    test_bobbin_1 - test_bobbin
    alphabet_soup_1 - alphabet_soup
  )
  (:obj_of_interest test_bobbin_1 wooden_cabinet_1)
  (:init
    (On wooden_cabinet_1 kitchen_table_cabinet_place)
    (On test_bobbin_1 kitchen_table_bobbin_place)
    (On alphabet_soup_1 kitchen_table_soup_place)
    (Open wooden_cabinet_1_top_region)
  )
  (:goal (And (In test_bobbin_1 wooden_cabinet_1_top_region) (Close wooden_cabinet_1_top_region)))
)
"""

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

TASKS = {"drawer": DRAWER, "stack": STACK, "door": DOOR, "knob": KNOB, "mix": MIX}


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
    file = tmp_path / f"{name}.bddl"
    file.write_text(TASKS[name])
    task = read_task(file)
    known = [old.problem for suite in suite_names() for old in get_suite(suite).tasks]
    assert task.problem not in known
    certificate = certify([task], STARTS, progress=False)[0]
    assert len(certificate.outcomes) == STARTS
    assert len(certificate.lengths) >= SOLVED, certificate.summary()
