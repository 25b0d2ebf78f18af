"""Run in vla-eval's environment: `vla_eval.evaluate(docker=False)` of a server that replays recorded actions.

Arguments: file with `actions` (T, 7); the evaluation's benchmarks as JSON; file for the observations of each episode's
first step.
"""

import json
import logging
import sys
from pathlib import Path

import numpy as np
import vla_eval
from vla_eval import specs
from vla_eval.model_servers.predict import PredictModelServer


class Replay(PredictModelServer):
    """Answers with recorded actions, and keeps the first observation of each episode."""

    def __init__(self, actions: np.ndarray):
        super().__init__()
        self.actions, self.first, self.started = actions, [], []

    async def on_episode_start(self, config, ctx) -> None:
        self.started.append(config["task"])

    def predict(self, obs, ctx):
        if ctx.is_first:
            self.first.append(obs)
        return {"actions": self.actions[min(ctx.step, len(self.actions) - 1)]}

    def get_observation_params(self):
        return {"send_wrist_image": True, "send_state": True}

    def get_action_spec(self):
        position, rotation, gripper = specs.POSITION_DELTA, specs.ROTATION_AA, specs.GRIPPER_CLOSE_POS
        return {"position": position, "rotation": rotation, "gripper": gripper}

    def get_observation_spec(self):
        seen = {"agentview": specs.IMAGE_RGB, "wrist": specs.IMAGE_RGB, "language": specs.LANGUAGE}
        return {**seen, "state": specs.STATE_EEF_POS_AA_GRIP}


class Messages(logging.Handler):
    """Keeps what vla-eval logs."""

    def __init__(self):
        super().__init__(logging.INFO)
        self.texts: list[str] = []

    def emit(self, record) -> None:
        self.texts.append(record.getMessage())


def main() -> None:
    server, said = Replay(np.load(sys.argv[1])["actions"]), Messages()
    logging.getLogger("vla_eval").addHandler(said)
    logging.getLogger("vla_eval").setLevel(logging.INFO)
    config = {"benchmarks": json.loads(sys.argv[2]), "output_dir": "results"}
    results = vla_eval.evaluate(server, config, docker=False)
    arrays = {}
    for i, obs in enumerate(server.first):
        arrays |= {f"{i}/{name}": image for name, image in obs["images"].items()}
        arrays |= {f"{i}/{name}": value for name, value in obs.items() if isinstance(value, np.ndarray)}
    np.savez(sys.argv[3], **arrays)
    episodes = [e for result in results for task in result["tasks"] for e in task["episodes"]]
    found = {
        "errors": [result["num_errors"] for result in results],
        "success": [bool(e["metrics"]["success"]) for e in episodes],
        "steps": [e["steps"] for e in episodes],
        "prompts": [obs["task_description"] for obs in server.first],
        "started": server.started,
        "recordings": len(list(Path("results").glob("*.sqlite"))),
        "specs": [text for text in said.texts if text.startswith("Spec")],
        "torch": "torch" in sys.modules,
    }
    print(json.dumps(found))


if __name__ == "__main__":
    main()
