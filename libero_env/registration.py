"""Gymnasium's names for the tasks, `libero/<suite>-<index>`. Importing this module registers them, and only that.

    gymnasium.make("libero_env.registration:libero/libero_object-3")  # the part before the colon is imported
    gymnasium.make_vec("libero/libero_object-3", num_envs=8)  # a `BatchEnv`

Gymnasium 1 has no entry point for packages: whoever wants the names imports this module, or names it as above.
"""

import gymnasium

from libero_env.tasks.builder import load_data

NAMESPACE = "libero"


def env_ids() -> dict[str, str]:
    """Name in Gymnasium -> task, for all tasks of all suites; reads the lists of tasks, builds nothing."""
    sizes: dict[str, int] = {}
    for suite in load_data("suites.yaml"):
        if isinstance(suite, dict):  # suites that consist of others come after them
            sizes |= {name: sum(sizes[part] for part in parts) for name, parts in suite.items()}
        else:
            sizes[suite] = len(load_data(f"{suite}.yaml")["tasks"])
    return {f"{NAMESPACE}/{name}-{i}": f"{name}/{i}" for name, size in sizes.items() for i in range(size)}


def register() -> None:
    """Register every task that is not yet registered."""
    for name, task in env_ids().items():
        if name not in gymnasium.registry:
            gymnasium.register(
                name,
                entry_point="libero_env.envs.env:LiberoEnv",
                vector_entry_point="libero_env.envs.batch:BatchEnv",
                kwargs={"task": task},
            )


register()
