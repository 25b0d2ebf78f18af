"""Checks of a problem that need the models of its objects: sites of regions, and states of joints."""

from typing import TYPE_CHECKING

import mujoco

from libero_env.objects.model import OPPOSITE_STATES
from libero_env.tasks.checks import ProblemError
from libero_env.tasks.problem_types import Fault
from libero_env.text import suggest

if TYPE_CHECKING:
    from libero_env.sim.scene import Scene


def check_models(scene: "Scene") -> None:
    """Check that the models of a scene have what its problem names.

    Raises:
        ProblemError: They do not; the message names the region or atom and what there is.
    """
    _check_sites(scene)
    _check_states(scene)


def _check_sites(scene: "Scene") -> None:
    """Check that a region in an atom, which has no rectangle, is a site of its target's model."""
    problem, model = scene.problem, scene.model
    for atom in (*problem.init, *problem.goal.atoms()):
        for region in filter(None, map(problem.region, atom.args)):
            if region.ranges or mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, region.address) >= 0:
                continue
            prefix = f"{region.target}_"
            sites = [model.site(i).name for i in range(model.nsite)]
            own = [s.removeprefix(prefix) for s in sites if s.startswith(prefix) and not s.endswith("_site")]
            near = suggest(region.name, own)
            what = f"{region.target} has no region {region.name!r}{'.' if near else ''}{near}"
            expected = f"one of {', '.join(own)}" if own else f"{region.target} itself, which has no regions"
            raise ProblemError(Fault("no-site", what, expected, ":regions", region.address), problem.language)


def _check_states(scene: "Scene") -> None:
    """Check that what a goal wants open or turned on has a range for that state, if it has a joint at all."""
    for i, atom in enumerate(scene.problem.goal.atoms()):
        state, owner = atom.predicate.lower(), scene.owner(atom.args[0]) if atom.args else None
        if state not in OPPOSITE_STATES or owner is None or not scene.joints.get(atom.args[0]):
            continue
        if state not in (known := scene.entities[owner].articulation):
            what = f"{atom}: the state {state!r} of a {scene.entities[owner].category} is not defined"
            fault = Fault("no-joint", what, f"one of {', '.join(sorted(known)) or 'no state'}", ":goal", i)
            raise ProblemError(fault, scene.problem.language)
