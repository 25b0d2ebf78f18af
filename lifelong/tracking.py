"""Optional mirror of a run's numbers to Weights & Biases."""

from collections.abc import Mapping
from typing import Any, Literal

from lifelong.errors import ConfigError, LifelongError


class Tracker:
    """Sends numbers to W&B; does nothing where `mode` is `disabled`.

    `offline` writes beside the run and needs no login; `wandb sync` uploads it later.
    """

    def __init__(
        self,
        *,
        mode: Literal["disabled", "offline", "online"] = "disabled",
        project: str = "libero-lifelong",
        entity: str | None = None,
    ):
        if mode not in ("disabled", "offline", "online"):
            raise ConfigError(f"wandb.mode is {mode!r}; valid: disabled, offline, online")
        self.mode, self.project, self.entity = mode, project, entity
        self._run: Any = None

    def start(self, name: str, directory: str, config: Mapping[str, Any]) -> None:
        """Begin a run, or go on with the one of the same name.

        Raises:
            LifelongError: The package wandb is not there, or refuses to start.
        """
        if self.mode == "disabled":
            return
        try:
            import wandb
        except ImportError as error:
            raise LifelongError(
                f"wandb.mode={self.mode} needs the package wandb: pip install wandb, or wandb.mode=disabled"
            ) from error
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
                f"W&B does not start ({error}); `wandb login`, or wandb.mode=offline"
            ) from error

    def log(self, values: Mapping[str, float]) -> None:
        """Send numbers."""
        if self._run is not None:
            self._run.log(dict(values))

    def finish(self, summary: Mapping[str, Any] | None = None) -> None:
        """Send what the run came to, and end it."""
        if self._run is not None:
            self._run.summary.update(dict(summary or {}))
            self._run.finish()
            self._run = None
