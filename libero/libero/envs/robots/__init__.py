"""The arm: where it stands in the original's scenes."""

from libero.libero.envs.robots.mounted_panda import MountedPanda
from libero.libero.envs.robots.on_the_ground_panda import OnTheGroundPanda
from libero.libero.envs.robots.single_arm import SingleArm

ROBOT_CLASS_MAPPING = {
    "Panda": SingleArm,
    "MountedPanda": SingleArm,
    "OnTheGroundPanda": SingleArm,
}
