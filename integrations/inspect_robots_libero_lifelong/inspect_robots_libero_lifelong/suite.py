"""A suite of LIBERO as a task of Inspect Robots: a scene for each task and stored initial state."""

from collections.abc import Sequence

from inspect_robots.scene import Scene
from inspect_robots.task import Task

from inspect_robots_libero_lifelong.errors import as_config_error
from libero_env.errors import LiberoError
from libero_env.init_states.store import NUM_INIT_STATES
from libero_env.tasks import get_suite


@as_config_error()
def suite_task(
    suite: str = "libero_spatial",
    task_ids: Sequence[int] | int | None = None,
    num_starts: int = NUM_INIT_STATES,
    max_steps: int = 600,
) -> Task:
    """Return the tasks of a suite from their first initial states, scored by success at the end.

    Args:
        suite: Name of the suite.
        task_ids: Indices of the tasks; None for all.
        num_starts: Number of initial states of each task.
        max_steps: Maximum number of steps of the policy.

    Raises:
        ConfigError: The suite, a task or a state does not exist.
    """
    tasks = get_suite(suite).tasks
    wanted = range(len(tasks)) if task_ids is None else [task_ids] if isinstance(task_ids, int) else task_ids
    if wrong := [i for i in wanted if i not in range(len(tasks))]:
        raise LiberoError(f"task_ids {wrong} do not exist: {suite} has 0 to {len(tasks) - 1}")
    if num_starts not in range(1, NUM_INIT_STATES + 1):
        raise LiberoError(f"num_starts is {num_starts!r}; valid: 1 to {NUM_INIT_STATES}")
    scenes = [
        Scene(
            id=f"{suite}-{i}-start{start}",
            instruction=tasks[i].language,
            metadata={"task": tasks[i].id, "init_state": start},
        )
        for i in wanted
        for start in range(num_starts)
    ]
    return Task(suite, scenes, "success_at_end", max_steps=max_steps)
