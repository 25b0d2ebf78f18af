"""Run in Inspect Robots' environment: what its `ConfigError` says of options that are not valid, as JSON."""

import json

from inspect_robots.errors import ConfigError
from inspect_robots.registry import resolve

said = []
for kind, name, options in (
    ("embodiment", "libero", {"robot": "panda"}),
    ("embodiment", "libero", {"perturb": "camera=0.5@25%"}),
    ("task", "libero", {"suite": "libero_goal", "task_ids": [77]}),
    ("task", "libero", {"num_starts": 51}),
    ("policy", "libero_run", {"run": "nowhere"}),
):
    try:
        resolve(kind, name, **options)
    except ConfigError as error:
        said.append(str(error))
print(json.dumps(said))
