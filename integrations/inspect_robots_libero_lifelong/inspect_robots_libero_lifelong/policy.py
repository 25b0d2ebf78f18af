"""The policy of a run of libero-lifelong as a policy of Inspect Robots."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from inspect_robots.policy import PolicyBase, PolicyInfo
from inspect_robots.scene import Scene
from inspect_robots.spaces import CameraSpec, ObservationSpace
from inspect_robots.types import Action, ActionChunk, Observation

from inspect_robots_libero_lifelong.errors import as_config_error
from inspect_robots_libero_lifelong.spaces import ACTION, STATE
from libero_env.tasks import get_task
from libero_env.timing import CONTROL_HZ
from libero_eval.servers.serving import PREFIX, ServedPolicy
from lifelong.errors import PolicyError
from lifelong.evaluation.restore import restore


class RunPolicy(PolicyBase):
    """The policy of a run; on scenes of the task `libero` it acts as in `libero eval RUN`.

    Args:
        run: Directory of the run, or one of its checkpoints.
        after: The policy after this task, from 0; None for the last.
        device: `auto`, `cpu`, `cuda`, `cuda:1`.
        seed: Seed of stochastic policies.
        allow: Packages whose classes the run's configuration may name besides those of libero-lifelong.

    Raises:
        ConfigError: There is no such run or checkpoint.
    """

    @as_config_error()
    def __init__(
        self,
        run: str,
        after: int | None = None,
        device: str = "auto",
        seed: int = 0,
        allow: Sequence[str] = (),
    ):
        loaded = restore(Path(run), after=after, device=device, allow=allow)
        self._served = ServedPolicy(loaded, seed=seed)
        self._session = self._served.session()
        spec = loaded.policy.spec
        self._images = spec.views
        self._state = {key: name for key, name in STATE.items() if name in spec.proprio}
        self._world = {
            "settle_steps": loaded.eval.settle_steps,
            "drawing": loaded.data.drawing,
            "robot": loaded.data.robot,
        }
        self._begin: dict[str, Any] = {}
        self._told: str | None = None
        self.info = PolicyInfo(
            name="libero_run",
            action_space=ACTION,
            observation_space=ObservationSpace(
                cameras=tuple(CameraSpec(view, *spec.image_size) for view in spec.views),
                state_keys=frozenset(self._state),
            ),
            control_hz=float(CONTROL_HZ),
            checkpoint=loaded.weights_digest,
        )

    def reset(self, scene: Scene) -> None:
        """Let the next observation begin an episode, with the random numbers of `libero eval`."""
        self._begin = {"reset": True, "prompt": scene.instruction}
        if {"task", "init_state"} <= set(scene.metadata):
            task = get_task(scene.metadata["task"])
            self._begin = {**self._served.beginning(task, scene.metadata["init_state"]), **self._begin}

    def act(self, observation: Observation) -> ActionChunk:
        """Return the action of one step.

        Raises:
            PolicyError: The embodiment `libero` has other options than the run, images have another size than the
                policy's, there is no task with this instruction, or it changes during the episode.
        """
        for key, value in self._world.items():
            if (other := observation.extra.get(key, value)) != value:
                raise PolicyError(f"{key} of the embodiment is {other}, of the run {value}: -E {key}={value}")
        images = {PREFIX + name: observation.images[name] for name in self._images}
        state = {PREFIX + name: observation.state[key] for key, name in self._state.items()}
        words = observation.instruction
        if self._begin and words not in (None, self._begin["prompt"]):  # perturbed
            self._begin["instruction"] = words
        if not self._begin and words != self._told:
            raise PolicyError(
                "an event has changed the goal, and a run cannot be told so during an episode here: leave out goal@ "
                "of -E perturb, or use libero eval"
            )
        self._told = words
        answer = self._session.infer({**images, **state, **self._begin})
        self._begin = {}
        return ActionChunk([Action(data) for data in answer["actions"]])
