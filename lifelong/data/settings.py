"""What the policy sees and learns from."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from libero_env.demos.read import LOW_DIM_KEYS
from libero_env.errors import UnknownNameError
from lifelong.data.loading import BACKENDS, MEMORY
from lifelong.types import PolicySpec

CAMERAS = {"agentview_rgb": "agentview", "eye_in_hand_rgb": "robot0_eye_in_hand"}


@dataclass(frozen=True)
class DataSettings:
    """What the policy sees and learns from; see configs/data.

    `memory` and `backend` say where it is held and what reads it, see `lifelong.data.loading`; what comes out is
    the same.
    """

    demos: int
    image_size: int
    seq_len: int
    views: Sequence[str]
    proprio: Sequence[str]
    pairing: Literal["aligned", "stored"] = "aligned"
    labels: Literal["expert", "executed"] = "expert"
    folder: str | None = None
    memory: str = "auto"
    backend: str = "native"

    def __post_init__(self) -> None:
        valid = {
            "pairing": ("aligned", "stored"),
            "labels": ("expert", "executed"),
            "memory": MEMORY,
            "backend": BACKENDS,
            "views": CAMERAS,
            "proprio": LOW_DIM_KEYS,
        }
        for key, names in valid.items():
            value = getattr(self, key)
            for name in [value] if isinstance(value, str) else value:
                if name not in names:
                    raise UnknownNameError(f"data.{key}", name, names)

    def spec(self, language_dim: int) -> PolicySpec:
        """What the policy is built for."""
        return PolicySpec(
            views=tuple(self.views),
            image_size=(self.image_size, self.image_size),
            proprio={name: LOW_DIM_KEYS[name] for name in self.proprio},
            language_dim=language_dim,
            seq_len=self.seq_len,
        )
