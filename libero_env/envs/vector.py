"""What the vector environments of this package have in common."""

from typing import Any, NoReturn, Self

import gymnasium
from gymnasium.vector import AutoresetMode

from libero_env.envs.checks import ClosedGymEnvironmentError
from libero_env.errors import InvalidInputError
from libero_env.timing import CONTROL_HZ


class LiberoVectorEnv(gymnasium.vector.VectorEnv):
    """A vector environment without autoreset, which `with` closes; after `close` every use is an error."""

    metadata = {"render_modes": [], "render_fps": CONTROL_HZ, "autoreset_mode": AutoresetMode.DISABLED}

    def render(self) -> NoReturn:
        """Raise: `render_cameras` or `call` return images of vector environments."""
        self._check_open()
        raise InvalidInputError("a vector environment has no render(); its observations have the images")

    def __enter__(self) -> Self:
        """Return the environments; they are closed at the end of the block."""
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __getstate__(self) -> dict[str, Any]:
        raise InvalidInputError(
            "environments cannot be copied or pickled: they hold simulations and processes. "
            "Make others with the same arguments"
        )

    def _check_open(self) -> None:
        if self.closed:
            raise ClosedGymEnvironmentError(
                f"{type(self).__name__}: these environments are closed; make others"
            )
