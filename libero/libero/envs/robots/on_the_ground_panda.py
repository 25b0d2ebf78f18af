"""The arm without a pedestal: floor, coffee table and living room."""

from libero.libero.envs.robots.panda import Panda, behind_a_table


class OnTheGroundPanda(Panda):
    """The arm on the ground."""

    base_xpos_offset = {
        "bins": (-0.5, -0.1, 0.0),
        "empty": (-0.6, 0.0, 0.0),
        "table": behind_a_table(-0.16, 0.0),
        "coffee_table": behind_a_table(-0.16, 0.41),
        "living_room_table": behind_a_table(-0.16, 0.42),
    }
