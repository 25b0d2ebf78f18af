"""What `lifelong.eval` is asked for."""

from pathlib import Path
from typing import Literal

from pydantic.dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """Measure the success of a stored policy on a task.

    Attributes:
        experiment_dir: Folder of the runs.
        benchmark: Name of the benchmark, such as libero_object.
        task_id: Position of the task in the benchmark.
        algo: Algorithm of the run.
        policy: Policy of the run.
        seed: Seed of the run.
        ep: Epoch of a multitask run's checkpoint (default: the last).
        load_task: Last task before the checkpoint (default: task_id).
        run: Number of the run (default: the newest).
        device_id: Number of the GPU, if there is one.
        n_eval: Number of episodes (default: as in the run).
        max_steps: Maximum steps of an episode (default: as in the run).
        save_videos: Write a video of each episode.
    """

    experiment_dir: Path = Path("experiments")
    benchmark: str
    task_id: int
    algo: Literal["agem", "base", "er", "ewc", "multitask", "packnet", "single_task"]
    policy: Literal["bc_rnn_policy", "bc_transformer_policy", "bc_vilt_policy"]
    seed: int
    ep: int | None = None
    load_task: int | None = None
    run: int | None = None
    device_id: int = 0
    n_eval: int | None = None
    max_steps: int | None = None
    save_videos: bool = False
