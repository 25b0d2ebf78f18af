"""The scenes of a perturbed task, and what a configuration of an environment must have for its perturbations."""

from collections.abc import Sequence
from dataclasses import replace

from libero_env.envs.config import EnvConfig
from libero_env.envs.scenes import Compile, TaskScenes
from libero_env.errors import InvalidInputError
from libero_env.perturbations.appearance import CAMERA
from libero_env.perturbations.episodes import Change, PerturbedEpisodes, needs_materials, scene_problem
from libero_env.perturbations.filters import ActionDelay, ActionGain, ActionNoise, StateBias
from libero_env.perturbations.hooks import EventHooks, PerturbationHooks
from libero_env.perturbations.perturbation import Perturbation, perturb_task
from libero_env.sim.observations import IMAGES
from libero_env.tasks import Task
from libero_env.tasks.cameras import camera_name


def open_perturbed(
    base: Task, changes: Sequence[Perturbation | Change], compiled: Compile, num: int
) -> TaskScenes:
    """Compile the scenes of a task without and with changes.

    Args:
        base: Task without perturbations.
        changes: Perturbations and absolute changes.
        compiled: Function that compiles the scene of a problem.
        num: Number of simulations.
    """
    spare = needs_materials(changes)
    base_scene = compiled(base.problem, spare_materials=spare)
    sampled = [one for one in changes if isinstance(one, Perturbation)]
    changed, later = perturb_task(base, sampled, base_scene), None
    problem = scene_problem(changed, base)
    if events := [replace(one, trigger="") for one in sampled if one.layer == "problem" and one.trigger]:
        later = perturb_task(base, events[:1], base_scene)
        problem = replace(problem, regions=later.problem.regions)
    scene = compiled(problem, spare_materials=spare)
    perturbed = PerturbedEpisodes(changes, base, base_scene, scene, num)
    own = PerturbationHooks(perturbed, base)
    hooks = (EventHooks(perturbed, own), own) if perturbed.events else (own,)
    return TaskScenes(changed, scene, base, base_scene, later, perturbed, hooks)


def check_config(config: EnvConfig) -> None:
    """Check that each perturbation of a configuration changes something that is observed or done.

    Raises:
        InvalidInputError: One does not; the message says what to add.
    """
    is_seen = not config.cameras or CAMERA in map(camera_name, config.cameras)
    observed = ", ".join(config.observations)
    images = {*config.observations} & {*IMAGES} if config.cameras else set()
    unfelt = {*config.observations}.isdisjoint(("proprioception", *StateBias.entries))
    for one in config.perturb:
        kind = one.definition if isinstance(one, Perturbation) else one
        name = getattr(one, "kind", "")
        if images and "rgb" not in images and getattr(kind, "only_rgb", False):
            what = (
                f"colours only, and observations={observed} have none: add rgb, or leave the perturbation out"
            )
        elif (isinstance(one, StateBias) or name == "proprio_bias") and config.observations and unfelt:
            what = (
                f"what the robot feels, which is not in observations={observed}; add proprioception, or leave the "
                "perturbation out"
            )
        elif name in ("camera", "fov") and not is_seen:
            what = (
                f"the camera {CAMERA}, which is not among cameras={', '.join(config.cameras)}; add it, or leave the "
                "perturbation out"
            )
        elif (
            isinstance(one, Perturbation | ActionDelay | ActionGain | ActionNoise)
            and one.layer == "action"
            and not config.control_delta
        ):
            what = (
                "how far relative actions move the arm; with control_delta=False they are goals: leave "
                "control_delta=True"
            )
        else:
            continue
        raise InvalidInputError(f"perturb={one} changes {what}")
