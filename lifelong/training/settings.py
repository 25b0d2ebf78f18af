"""Settings of the training of a task."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from lifelong.errors import ConfigError
from lifelong.training.precision import COMPILE_MODES


@dataclass(frozen=True)
class FitSettings:
    """Settings of the training of a task; the defaults are those of LIBERO's paper (appendix B) and code.

    Attributes:
        epochs: Passes over the task's windows.
        batch_size: Number of windows per step.
        steps_per_epoch: Number of steps that count as one epoch. None: every window once (the last batch is
            filled up).
        lr: Learning rate of AdamW after the warm-up.
        lr_min: Learning rate at the last step of the task, where the cosine schedule ends.
        warmup_steps: Number of steps over which the learning rate rises linearly from zero.
        betas: AdamW's decay rates.
        weight_decay: AdamW's decoupled weight decay.
        grad_clip: Largest norm of the gradient; 0 disables clipping.
        precision: `bf16` autocast, `fp32`, or `auto`: bf16 where the processor supports it.
        accumulate: Number of micro-batches that a batch is divided into, one after the other in memory. The
            gradient is that of the whole batch, up to rounding and to what the policy draws itself (dropout).
        compile: `torch.compile` of the policy's loss: `off`, `default`, or `reduce-overhead`, which on a GPU
            replays CUDA graphs. Compilation changes rounding.
    """

    epochs: int = 50
    batch_size: int = 32
    steps_per_epoch: int | None = None
    lr: float = 1e-4
    lr_min: float = 1e-5
    warmup_steps: int = 0
    betas: Sequence[float] = (0.9, 0.999)
    weight_decay: float = 1e-4
    grad_clip: float = 100.0
    precision: Literal["auto", "bf16", "fp32"] = "auto"
    accumulate: int = 1
    compile: Literal["off", "default", "reduce-overhead"] = "off"

    def __post_init__(self) -> None:
        if self.compile is False:  # YAML reads an unquoted off as False
            object.__setattr__(self, "compile", "off")
        for name, valid in (("precision", ("auto", "bf16", "fp32")), ("compile", COMPILE_MODES)):
            if getattr(self, name) not in valid:
                raise ConfigError(f"train.{name} is {getattr(self, name)!r}; valid: {', '.join(valid)}")
        for name in ("epochs", "batch_size", "accumulate"):
            if getattr(self, name) < 1:
                raise ConfigError(f"train.{name} is {getattr(self, name)}; it must be at least 1")
