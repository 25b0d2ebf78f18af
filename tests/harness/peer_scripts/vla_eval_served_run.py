"""Run in vla-eval's environment: `vla_eval.evaluate(docker=False)` of a run of this package, served by `RunServer`.

Arguments: directory of the run; the evaluation's benchmarks as JSON.
"""

import hashlib
import json
import sys

import numpy as np
import vla_eval
from vla_eval_libero_lifelong.server import RunServer


class Recording(RunServer):
    """Keeps the actions of each episode."""

    def __init__(self, run: str):
        super().__init__(run, device="cpu")
        self.episodes: dict[str, list[np.ndarray]] = {}

    def predict(self, obs, ctx):
        answer = super().predict(obs, ctx)
        self.episodes.setdefault(ctx.episode_id, []).append(answer["actions"])
        return answer


def main() -> None:
    server = Recording(sys.argv[1])
    results = vla_eval.evaluate(
        server, {"benchmarks": json.loads(sys.argv[2]), "output_dir": "results"}, docker=False
    )
    episodes = [e for result in results for task in result["tasks"] for e in task["episodes"]]
    print(
        json.dumps(
            {
                "errors": [result["num_errors"] for result in results],
                "success": [bool(e["metrics"]["success"]) for e in episodes],
                "steps": [e["steps"] for e in episodes],
                "actions": [
                    hashlib.sha256(np.asarray(a, "<f8").tobytes()).hexdigest()[:16]
                    for a in server.episodes.values()
                ],
            }
        )
    )


if __name__ == "__main__":
    main()
