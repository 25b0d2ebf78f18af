"""Optional copy of a run's metrics on Weights & Biases."""

from collections.abc import Mapping
from typing import Any, Literal

from lifelong.errors import LifelongError, require_package


class Tracker:
    """Logs metrics to Weights & Biases (W&B).

    Args:
        mode: `disabled` does nothing. `offline` writes into the run directory without a login; `wandb sync` uploads
            it later. `online` uploads at once.
        project: Name of the W&B project.
        entity: W&B user or team; None for the default of the login.

    Raises:
        MissingPackageError: The package wandb is not installed.
    """

    def __init__(
        self,
        *,
        mode: Literal["disabled", "offline", "online"] = "disabled",
        project: str = "libero-lifelong",
        entity: str | None = None,
    ):
        if mode != "disabled":
            require_package("wandb", "wandb")
        self.mode, self.project, self.entity = mode, project, entity
        self._run: Any = None

    def start(self, name: str, directory: str, config: Mapping[str, Any]) -> None:
        """Start a run, or resume the run of the same name.

        Args:
            directory: Folder for the files of W&B.
            config: Configuration of the run.

        Raises:
            LifelongError: W&B does not start.
        """
        if self.mode == "disabled":
            return
        import wandb

        try:
            self._run = wandb.init(
                mode=self.mode,
                project=self.project,
                entity=self.entity,
                name=name,
                id=name.replace("/", "-"),
                resume="allow",
                dir=directory,
                config=dict(config),
            )
        except (wandb.Error, OSError) as error:
            raise LifelongError(
                f"W&B does not start ({error}); log in with `wandb login`, or set wandb.mode=offline"
            ) from error

    def log(self, values: Mapping[str, float]) -> None:
        """Log metrics by name."""
        if self._run is not None:
            self._run.log(dict(values))

    def finish(self, summary: Mapping[str, Any] | None = None) -> None:
        """Log the summary of the run, and end it."""
        if self._run is not None:
            self._run.summary.update(dict(summary or {}))
            self._run.finish()
            self._run = None
