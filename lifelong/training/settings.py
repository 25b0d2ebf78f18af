"""Settings of the training of a task."""

from collections.abc import Sequence
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field

from libero_env.validation import checked
from lifelong.errors import ConfigError
from lifelong.types import Count, Natural, NonNegative


def _read_off(value: Any) -> Any:
    return "off" if value is False else value  # YAML reads an unquoted off as False


Rate = Annotated[float, Field(ge=0, lt=1)]


@checked
class FitSettings:
    """Settings of the training of a task; the defaults are those of LIBERO's paper (appendix B) and code.

    Attributes:
        epochs: Passes over the task's windows.
        batch_size: Number of windows per step.
        steps_per_epoch: Number of steps that count as one epoch. None: every window once (the last batch is
            filled up).
        lr: Learning rate of AdamW after the warm-up.
        lr_min: Learning rate that the cosine schedule falls to. It would be that of the step after the last one of the
            task, which is a little above it.
        warmup_steps: Number of steps over which the learning rate rises linearly from zero.
        betas: AdamW's decay rates.
        weight_decay: AdamW's decoupled weight decay.
        grad_clip: Largest norm of the gradient; 0 disables clipping.
        lr_every: When the cosine's learning rate is set anew: at every `step`, or once for each `epoch`, as in the
            original, whose last epoch then ends above `lr_min`.
        last_batch: What an epoch that passes every window once does with a last batch of too few windows: `filled` up
            from another permutation, or `short`, as in the original.
        statistics_first: Whether BatchNorm's running statistics adapt to a task before its first step: all windows
            pass the network once in training mode, as where the original measures the loss at epoch 0. Without
            effect on policies without such layers.
        precision: `bf16` autocast, `fp32`, `fp32_strict` (without TF32 on a GPU), or `auto`: bf16 where the
            processor supports it.
        accumulate: Number of micro-batches that a batch is divided into, one after the other in memory. The
            gradient is that of the whole batch, up to rounding and to what the policy draws itself (dropout).
        compile: `torch.compile` of the policy's loss: `off`, `default`, or `reduce-overhead`, which on a GPU
            replays CUDA graphs. Compilation changes rounding.
    """

    epochs: Count = 50
    batch_size: Count = 32
    steps_per_epoch: Count | None = None
    lr: NonNegative = 1e-4
    lr_min: NonNegative = 1e-5
    warmup_steps: Natural = 0
    betas: Annotated[Sequence[Rate], Field(min_length=2, max_length=2)] = (0.9, 0.999)
    weight_decay: NonNegative = 1e-4
    grad_clip: NonNegative = 100.0
    lr_every: Literal["step", "epoch"] = "step"
    last_batch: Literal["filled", "short"] = "filled"
    statistics_first: bool = False
    precision: Literal["auto", "bf16", "fp32", "fp32_strict"] = "auto"
    accumulate: Count = 1
    compile: Annotated[Literal["off", "default", "reduce-overhead"], BeforeValidator(_read_off)] = "off"

    def __post_init__(self) -> None:
        if self.lr_min > self.lr:
            raise ConfigError(
                f"train.lr_min is {self.lr_min:g}, above train.lr, {self.lr:g}: the rate would rise; lower both"
            )
