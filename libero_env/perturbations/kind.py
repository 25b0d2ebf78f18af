"""What a kind of perturbation is: a layer, a unit, an amount at severity 1, and a function that draws a change."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

Layer = Literal["problem", "look", "start", "observation", "action"]
LAYERS: tuple[Layer, ...] = ("problem", "look", "start", "observation", "action")


@dataclass(frozen=True)
class Kind:
    """A kind of perturbation.

    Attributes:
        name: Name, as in `camera=0.3`.
        layer: What it acts on; layers are applied in the order of `LAYERS`.
        unit: Unit of its amount.
        at_one: Amount at severity 1.
        what: What changes, in one sentence.
        draw: Function of the amount, a `DrawKey`'s generator and what the layer gives to it (a task, a scene, nothing)
            that returns the change.
        scale: How the amount grows: `linear`, in proportion to severity; `ratio`, from 1 in equal factors; `count`, in
            whole numbers from 1.
        physical: Whether what can be solved changes: physics, start, or actions.
        is_drawn: Whether anything is drawn, so that another draw may be solved where one is not.
        draws_materials: Whether scenes need materials to draw with, see `libero_env.sim.scene.build_scene`.
        exclusive: Whether no other kind of its layer may be named beside it.
    """

    name: str
    layer: Layer
    unit: str
    at_one: float
    what: str
    draw: Callable[..., Any]
    scale: Literal["linear", "ratio", "count"] = "linear"
    physical: bool = False
    is_drawn: bool = True
    draws_materials: bool = False
    exclusive: bool = False

    @property
    def is_rendered(self) -> bool:
        """Whether only what is seen or said changes, so that recorded states can be rendered with it."""
        return self.layer in ("look", "observation") or (self.layer == "problem" and not self.physical)

    def amount(self, severity: float) -> float:
        """Return the amount at a severity in [0, 1], in `unit`."""
        if self.scale == "ratio":
            return float(self.at_one**severity)
        if self.scale == "count":
            return 0.0 if severity == 0 else float(max(1, round(severity * self.at_one)))
        return float(severity * self.at_one)
