"""The arm and its gripper: dimensions, postures, inverse kinematics, servo control."""
