"""The arm on its two mounts, and as robosuite offers it."""

from libero.libero.envs.robots.mounted_panda import MountedPanda
from libero.libero.envs.robots.on_the_ground_panda import OnTheGroundPanda
from libero.libero.envs.robots.single_arm import SingleArm

ROBOT_CLASS_MAPPING = dict.fromkeys(("Panda", "MountedPanda", "OnTheGroundPanda"), SingleArm)
