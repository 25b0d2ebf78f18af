"""What object states and the arm use of their environment."""

from typing import Protocol

from libero._adapters.envs.sim import ClientSimulations, MjSim
from libero_env.sim.scene import Scene
from libero_env.sim.state import StateView


class Domain(Protocol):
    """One simulation of a task file; see `libero.libero.envs.bddl_base_domain.BDDLBaseDomain`."""

    scene: Scene
    simulations: ClientSimulations
    sim: MjSim
    view: StateView
