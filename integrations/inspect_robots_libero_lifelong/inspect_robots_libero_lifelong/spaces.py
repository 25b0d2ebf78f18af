"""What embodiment and policy agree on: the action, and names of observations."""

import numpy as np
from inspect_robots.spaces import ActionSemantics, Box

# Inspect Robots' name of a reading -> ours; its canonical names where it has one
STATE = {
    "joint_pos": "joint_states",
    "joint_vel": "joint_velocities",
    "eef_pos": "ee_pos",
    "eef_quat": "ee_quat",
    "eef_axis_angle": "ee_ori",
    "gripper_qpos": "gripper_states",
}
ACTION = Box(
    shape=(7,),
    low=-np.ones(7),
    high=np.ones(7),
    semantics=ActionSemantics(
        control_mode="eef_delta_pose",
        rotation_repr="axis_angle",
        gripper="binary",
        frame="base",
        dim_labels=("dx", "dy", "dz", "drx", "dry", "drz", "gripper"),
    ),
)
