"""openpi's own server file with a policy that needs no weights: python serve_openpi.py FOLDER PORT [ANSWER].

FOLDER has openpi's `websocket_policy_server.py`. ANSWER is what the policy does: `down` (the arm moves down), or
something that is not valid: `nan`, `short`, `wide`, `error`.
"""

import sys

import numpy as np

sys.path.insert(0, sys.argv[1])
from websocket_policy_server import WebsocketPolicyServer  # noqa: E402

ANSWER = sys.argv[3] if len(sys.argv) > 3 else "down"


class Policy:
    """Move down with the gripper open, in chunks of ten actions."""

    def infer(self, obs: dict) -> dict:
        shapes = [np.shape(obs[f"observation/{name}"]) for name in ("image", "wrist_image", "state")]
        assert shapes == [(224, 224, 3), (224, 224, 3), (8,)], shapes
        if ANSWER == "error":
            raise ValueError(f"the model does not know {obs['prompt']!r}")
        actions = np.tile([0.0, 0.0, -0.3, 0.0, 0.0, 0.0, -1.0], (10, 1))
        if ANSWER == "nan":
            actions[2, 3] = np.nan
        return {
            "actions": {"short": actions[:3], "wide": np.pad(actions, ((0, 0), (0, 1)))}.get(ANSWER, actions)
        }


metadata = {"model": ANSWER, "action": {"replan": 5}, "pixels.resize_size": [224, 224]}
WebsocketPolicyServer(Policy(), "127.0.0.1", int(sys.argv[2]), metadata).serve_forever()
