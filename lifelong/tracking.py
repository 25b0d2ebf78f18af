"""Optional copies of a run's metrics in Weights & Biases, TensorBoard or trackio."""

import hashlib
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from libero_env.errors import require_package
from lifelong.errors import LifelongError, writing


class Tracker:
    """Interface of a tracker; this one does nothing."""

    def start(self, name: str, directory: str, config: Mapping[str, Any]) -> None:
        """Start a run, or resume the run of the same name.

        Args:
            directory: Folder for files of the tracker.
            config: Configuration of the run.

        Raises:
            LifelongError: The tracker does not start.
        """

    def log(self, values: Mapping[str, float], step: int) -> None:
        """Log metrics by name; a step is an epoch, counted over all tasks."""

    def finish(self) -> None:
        """End the run."""


def _identity(name: str, directory: str) -> str:
    """Return a name that runs in other folders do not have, nor one that was begun anew in the same folder."""
    begun = Path(directory, "config.yaml")  # written once
    stamp = begun.stat().st_mtime_ns if begun.is_file() else 0
    return f"{name}-{hashlib.sha256(f'{os.path.abspath(directory)} {stamp}'.encode()).hexdigest()[:8]}"


class WandB(Tracker):
    """Logs to Weights & Biases.

    Args:
        mode: `offline` writes into the run directory without a login; `wandb sync` uploads it later. `online` uploads.
        project: Name of the project.
        entity: User or team; None for the default of the login.

    Raises:
        MissingPackageError: The package wandb is not installed.
    """

    def __init__(
        self,
        *,
        mode: Literal["offline", "online"] = "online",
        project: str = "libero-lifelong",
        entity: str | None = None,
    ):
        require_package("wandb")
        self.mode, self.project, self.entity = mode, project, entity

    def start(self, name: str, directory: str, config: Mapping[str, Any]) -> None:
        """Start a run; see `Tracker`."""
        import wandb

        try:
            self._run = wandb.init(
                mode=self.mode,
                project=self.project,
                entity=self.entity,
                name=name,
                config=dict(config),
                id=_identity(name, directory).replace("/", "-"),  # an identifier of W&B has no slash
                resume="allow",
                dir=directory,
            )
        except (wandb.Error, OSError) as error:
            raise LifelongError(
                f"W&B does not start ({error}); log in with `wandb login`, or set tracker.mode=offline"
            ) from error

    def log(self, values: Mapping[str, float], step: int) -> None:
        """Log metrics by name; a step is an epoch, counted over all tasks."""
        self._run.log(dict(values), step=step)

    def finish(self) -> None:
        """End the run; after an error as one that failed."""
        self._run.finish(exit_code=int(sys.exc_info()[0] is not None))


class Trackio(Tracker):
    """Logs to trackio, which keeps its runs in `~/.cache/huggingface/trackio`; `trackio show` draws them.

    Args:
        project: Name of the project.
        space_id: Space of the Hugging Face Hub that shows the project; None for this machine.

    Raises:
        MissingPackageError: The package trackio is not installed.
    """

    def __init__(self, *, project: str = "libero-lifelong", space_id: str | None = None):
        require_package("trackio")
        self.project, self.space_id = project, space_id

    def start(self, name: str, directory: str, config: Mapping[str, Any]) -> None:
        """Start a run; see `Tracker`."""
        import trackio

        self._run = trackio.init(
            project=self.project,
            name=_identity(name, directory),  # by which trackio knows it
            space_id=self.space_id,
            config=dict(config),
            resume="allow",
        )

    def log(self, values: Mapping[str, float], step: int) -> None:
        """Log metrics by name; a step is an epoch, counted over all tasks."""
        self._run.log(dict(values), step=step)

    def finish(self) -> None:
        """End the run."""
        self._run.finish()


class TensorBoard(Tracker):
    """Writes event files into the folder `tensorboard` of the run; `tensorboard --logdir runs` draws them.

    Raises:
        MissingPackageError: The package tensorboard is not installed.
    """

    def __init__(self) -> None:
        require_package("tensorboard")

    def start(self, name: str, directory: str, config: Mapping[str, Any]) -> None:
        """Start a run; see `Tracker`."""
        from torch.utils.tensorboard import SummaryWriter

        folder = Path(directory) / "tensorboard"
        with writing(folder, "TensorBoard's files"):
            self._writer = SummaryWriter(folder)

    def log(self, values: Mapping[str, float], step: int) -> None:
        """Log metrics by name; a step is an epoch, counted over all tasks."""
        for name, value in values.items():
            self._writer.add_scalar(name, value, step)

    def finish(self) -> None:
        """End the run."""
        self._writer.close()
