"""Names of the tasks in Gymnasium, `libero/<suite>-<index>`. Importing this module registers them.

    gymnasium.make("libero_env.registration:libero/libero_object-3")  # the part before the colon is imported
    gymnasium.make_vec("libero/libero_object-3", num_envs=8)  # a `BatchEnv`

Gymnasium 1 has no entry point for packages, so this module has to be imported, or named as in the first example.
"""

import gymnasium

from libero_env.storage import read_yaml

NAMESPACE = "libero"


def env_ids() -> dict[str, str]:
    """Return the task of each name in Gymnasium, for all tasks of all suites; only lists of tasks are read."""
    sizes: dict[str, int] = {}
    for suite in read_yaml("tasks/data/suites.yaml"):
        if isinstance(suite, dict):  # suites that consist of others come after them
            sizes |= {name: sum(sizes[part] for part in parts) for name, parts in suite.items()}
        else:
            sizes[suite] = len(read_yaml(f"tasks/data/{suite}.yaml")["tasks"])
    return {f"{NAMESPACE}/{name}-{i}": f"{name}/{i}" for name, size in sizes.items() for i in range(size)}


def register() -> None:
    """Register all tasks that are not registered yet."""
    for name, task in env_ids().items():
        if name not in gymnasium.registry:
            gymnasium.register(
                name,
                entry_point="libero_env.envs.env:LiberoEnv",
                vector_entry_point="libero_env.envs.batch:BatchEnv",
                kwargs={"task": task},
            )


register()
