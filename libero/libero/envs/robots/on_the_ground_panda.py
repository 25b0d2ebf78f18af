"""The arm without a pedestal: floor, coffee table and living room."""

from libero.libero.envs.robots.panda import COMMON_OFFSETS, Panda, behind_a_table


class OnTheGroundPanda(Panda):
    """The arm on the ground."""

    base_xpos_offset = {
        **COMMON_OFFSETS,
        "coffee_table": behind_a_table(-0.16, 0.41),
        "living_room_table": behind_a_table(-0.16, 0.42),
    }
