"""A model server of vla-eval with the policy of a run.

    from vla_eval_libero_lifelong.server import RunServer
    vla_eval.evaluate(RunServer("runs/..."), config, docker=False)

It asks for `LiberoBenchmark` with the run's own observations, which reach it as they are, so that it acts as in
`libero eval RUN`.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from vla_eval.model_servers.predict import PredictModelServer

from libero_env.tasks import Task, get_suite
from libero_eval.servers.serving import PREFIX, ServedPolicy, Session
from lifelong.errors import PolicyError
from lifelong.evaluation.restore import restore


class RunServer(PredictModelServer):
    """The policy of a run, for `vla_eval_libero_lifelong.benchmark:LiberoBenchmark`.

    Args:
        run: Directory of the run, or one of its checkpoints.
        after: The policy after this task, from 0; None for the last.
        device: `auto`, `cpu`, `cuda`, `cuda:1`.
        seed: Seed of stochastic policies.
        allow: Packages whose classes the run's configuration may name besides this one's.

    Raises:
        LifelongError: There is no such run or checkpoint.
    """

    def __init__(
        self,
        run: str,
        after: int | None = None,
        device: str = "auto",
        seed: int = 0,
        allow: Sequence[str] = (),
    ):
        super().__init__()
        self.served = ServedPolicy(restore(Path(run), after=after, device=device, allow=allow), seed=seed)
        self._sessions: dict[str, Session] = {}
        self._begins: dict[str, dict[str, Any]] = {}
        self._words: dict[str, str | None] = {}  # that each session was told

    def get_observation_params(self) -> dict[str, Any]:
        """Return what the benchmark must send, as its constructor's arguments."""
        spec, settings = self.served.run.policy.spec, self.served.run.eval
        return {
            "card": "libero",
            "observations": [*spec.views, *spec.proprio],
            "camera_size": list(spec.image_size),
            "drawing": self.served.run.data.drawing,
            "robot": self.served.run.data.robot,
            "num_steps_wait": settings.settle_steps,
            "max_steps": settings.horizon,
        }

    def get_action_spec(self) -> dict[str, Any]:
        """Return the conventions of actions."""
        from vla_eval.specs import GRIPPER_CLOSE_POS, POSITION_DELTA, ROTATION_AA

        return {"position": POSITION_DELTA, "rotation": ROTATION_AA, "gripper": GRIPPER_CLOSE_POS}

    def get_observation_spec(self) -> dict[str, Any]:
        """Return the names of the observations, and nothing on their conventions, which are our own."""
        from vla_eval.specs import LANGUAGE, RAW

        spec = self.served.run.policy.spec
        return {"language": LANGUAGE, **{PREFIX + name: RAW for name in (*spec.views, *spec.proprio)}}

    async def on_episode_start(self, config: dict[str, Any], ctx: Any) -> None:
        """Let the next observation begin an episode, with the random numbers of `libero eval`.

        Raises:
            PolicyError: The client does not say which task and which initial state.
        """
        about = config.get("task") or {}
        if not {"suite", "task_id", "episode_idx"} <= set(about):
            raise PolicyError(
                f"an episode has a task with suite, task_id and episode_idx; got {sorted(about) or 'nothing'}"
            )
        task: Task = get_suite(about["suite"]).tasks[int(about["task_id"])]
        self._begins[ctx.session_id] = self.served.beginning(task, int(about["episode_idx"]))
        if ctx.session_id not in self._sessions:
            self._sessions[ctx.session_id] = self.served.session()

    def predict(self, obs: dict[str, Any], ctx: Any) -> dict[str, Any]:
        """Return the action of one step, (7,).

        Raises:
            PolicyError: The observation lacks something that the policy needs, or the instruction has changed.
        """
        session = self._sessions.get(ctx.session_id)
        if session is None:
            raise PolicyError("an observation came before the start of an episode")
        arrays = {key: value for key, value in obs.items() if key.startswith(PREFIX)}
        if not arrays:
            raise PolicyError(
                "the observations have no names of ours; the benchmark is "
                "vla_eval_libero_lifelong.benchmark:LiberoBenchmark"
            )
        begin, words = self._begins.pop(ctx.session_id, {}), obs.get("task_description")
        if begin and words not in (None, begin["prompt"]):  # perturbed
            begin["instruction"] = words
        if not begin and words != self._words[ctx.session_id]:
            raise PolicyError(
                "an event has changed the goal, and a run cannot be told so during an episode here: leave out goal@ "
                "of world.perturb, or use libero eval"
            )
        self._words[ctx.session_id] = words
        answer = session.infer({**arrays, **begin})
        return {"actions": answer["actions"][0]}


if __name__ == "__main__":
    from vla_eval.model_servers.serve import run_server

    run_server(RunServer)
