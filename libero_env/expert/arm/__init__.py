"""The arm and the hand: the gripper's dimensions, postures, reachability, servo control."""
