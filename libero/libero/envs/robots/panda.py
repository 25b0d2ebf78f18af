"""The arm: what does not depend on its mount, and the arm on a pedestal and on the ground."""

from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np

from libero_env.assets.robot import ARM_JOINTS, FINGER_JOINTS, GRIP_SITE, REST_QPOS


class Panda:
    """Properties of the arm.

    Attributes:
        default_mount: Name of the mount; None for the ground.
        base_xpos_offset: Workspace -> position of the base, (3,) m; for a table a function of its length.
        horizontal_radius: Radius that is kept free around the arm, m.
    """

    default_mount: ClassVar[str | None] = None
    default_gripper: ClassVar[str] = "PandaGripper"
    default_controller_config: ClassVar[str] = "default_panda"
    arm_type: ClassVar[str] = "single"
    naming_prefix: ClassVar[str] = "robot0_"
    eef_name: ClassVar[str] = "robot0_right_hand"
    grip_site: ClassVar[str] = GRIP_SITE
    joints: ClassVar[tuple[str, ...]] = ARM_JOINTS
    gripper_joints: ClassVar[tuple[str, ...]] = FINGER_JOINTS
    base_xpos_offset: ClassVar[dict[str, Any]] = {}
    dof: ClassVar[int] = len(ARM_JOINTS)
    horizontal_radius: ClassVar[float] = 0.5
    _horizontal_radius: ClassVar[float] = 0.5

    def __init__(self, idn: int = 0):
        self.idn, self.name = idn, f"Panda{idn}"

    init_qpos = property(lambda self: np.array(REST_QPOS), doc="Rest pose, (7,) rad.")
    top_offset = property(lambda self: np.array([0.0, 0.0, 1.0]), doc="Highest point over the base, (3,) m.")


def behind_a_table(x: float, height: float) -> Callable[[float], tuple[float, float, float]]:
    """Return the position of the base behind a table as a function of the length of the table."""
    return lambda table_length: (x - table_length / 2, 0.0, height)


COMMON_OFFSETS = {"bins": (-0.5, -0.1, 0.0), "empty": (-0.6, 0.0, 0.0), "table": behind_a_table(-0.16, 0.0)}


class MountedPanda(Panda):
    """The arm on a pedestal."""

    default_mount = "RethinkMount"
    base_xpos_offset = {
        **COMMON_OFFSETS,
        "kitchen_table": behind_a_table(-0.16, 0.0),
        "study_table": behind_a_table(-0.25, 0.0),
    }


class OnTheGroundPanda(Panda):
    """The arm on the ground."""

    base_xpos_offset = {
        **COMMON_OFFSETS,
        "coffee_table": behind_a_table(-0.16, 0.41),
        "living_room_table": behind_a_table(-0.16, 0.42),
    }
