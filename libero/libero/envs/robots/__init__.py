"""The arm on its two mounts, and as robosuite offers it."""

from libero._adapters.lookup import alias_modules
from libero.libero.envs.robots.panda import MountedPanda, OnTheGroundPanda
from libero.libero.envs.robots.single_arm import SingleArm

ROBOT_CLASS_MAPPING = dict.fromkeys(("Panda", "MountedPanda", "OnTheGroundPanda"), SingleArm)

alias_modules(
    __name__,
    mounted_panda="MountedPanda",
    on_the_ground_panda="OnTheGroundPanda",
)
