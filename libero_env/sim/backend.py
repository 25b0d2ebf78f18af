"""Backends of the physics: MuJoCo on the processor, or MuJoCo Warp with many simulations on a GPU.

A backend is named in a line of text: `mujoco`, `warp`, or with settings `warp,device=cuda:1,contacts=256`.
"""

import importlib.util
from dataclasses import dataclass

from libero_env.doors import doors
from libero_env.errors import InvalidInputError, LiberoError, install_command, require_known
from libero_env.text import shown

MUJOCO, WARP = "mujoco", "warp"
DEFAULT_CONTACTS = 192  # of a simulation; scenes rest on 24 to 90, and a hand that works adds up to 60
MOST_CONTACTS = 4096
_SETTINGS = ("device", "contacts")
MISSING = (
    f"backend=warp needs MuJoCo Warp, which is not installed: {install_command('warp')}; "
    "backend=mujoco runs without it"
)


@dataclass(frozen=True)
class Backend:
    """A backend of the physics with its settings.

    Attributes:
        name: `mujoco` or `warp`.
        device: Device of Warp, such as `cpu` or `cuda:1`; None for the first GPU, or the processor where there is none.
        contacts: Largest number of contacts of a simulation, for which Warp allocates memory.
    """

    name: str = MUJOCO
    device: str | None = None
    contacts: int = DEFAULT_CONTACTS

    @classmethod
    def read(cls, value: "Backend | str") -> "Backend":
        """Return a backend from its text.

        Args:
            value: Text such as `warp` or `warp,device=cpu,contacts=256`, or a backend.

        Raises:
            UnknownNameError: The backend or a setting does not exist.
            InvalidInputError: A value is not valid.
        """
        if isinstance(value, cls):
            return value
        if not isinstance(value, str):
            raise InvalidInputError(f"backend is {shown(value)}; expected a text such as mujoco or warp")
        name, *settings = value.split(",")
        require_known("backend", name, (MUJOCO, *doors("backends")))
        found: dict[str, str] = {}
        for setting in settings:
            key, _, text = setting.partition("=")
            require_known("setting of a backend", key, _SETTINGS)
            if key in found:
                raise InvalidInputError(f"backend={value}: {key} is given twice; expected it once")
            found[key] = text
        if name == MUJOCO and found:
            raise InvalidInputError(
                f"backend={value}: mujoco has no settings; device and contacts are warp's"
            )
        if found.get("device") == "":
            raise InvalidInputError(f"backend={value}: device is a device of Warp, such as cpu or cuda:0")
        contacts = found.get("contacts", str(DEFAULT_CONTACTS))
        if not (contacts.isascii() and contacts.isdigit() and 1 <= int(contacts[:9]) <= MOST_CONTACTS):
            raise InvalidInputError(f"backend={value}: contacts is a whole number from 1 to {MOST_CONTACTS}")
        return cls(name, found.get("device"), int(contacts))

    def __str__(self) -> str:
        parts = [self.name, *([f"device={self.device}"] if self.device else [])]
        return ",".join(parts + ([f"contacts={self.contacts}"] if self.contacts != DEFAULT_CONTACTS else []))

    @property
    def is_warp(self) -> bool:
        """Whether the physics is that of MuJoCo Warp."""
        return self.name == WARP

    def require_installed(self) -> None:
        """Check that the packages of the backend are there.

        Raises:
            LiberoError: They are not; the message says how to install them.
        """
        if self.is_warp and any(importlib.util.find_spec(name) is None for name in ("warp", "mujoco_warp")):
            raise LiberoError(MISSING)
