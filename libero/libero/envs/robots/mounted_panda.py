"""The arm on its pedestal: table, kitchen and study."""

from libero.libero.envs.robots.panda import COMMON_OFFSETS, Panda, behind_a_table


class MountedPanda(Panda):
    """The arm on a pedestal."""

    default_mount = "RethinkMount"
    base_xpos_offset = {
        **COMMON_OFFSETS,
        "kitchen_table": behind_a_table(-0.16, 0.0),
        "study_table": behind_a_table(-0.25, 0.0),
    }
