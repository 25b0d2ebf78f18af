"""What the vector environments share."""

from typing import Any, NoReturn, Self

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode

from libero_env.envs.checks import ClosedGymEnvironmentError
from libero_env.errors import InvalidInputError
from libero_env.timing import CONTROL_HZ


class LiberoVectorEnv(gymnasium.vector.VectorEnv):
    """A vector environment without autoreset, which `with` closes; after `close` every use is an error."""

    metadata = {"render_modes": [], "render_fps": CONTROL_HZ, "autoreset_mode": AutoresetMode.DISABLED}

    _running: np.ndarray

    @property
    def running(self) -> np.ndarray:
        """Whether each environment is in an episode, (num_envs,) bool."""
        return self._running.copy()

    def render(self) -> NoReturn:
        """Raise: `render_cameras` or `call` return images of vector environments."""
        self.require_open()
        raise InvalidInputError("a vector environment has no render(); its observations have the images")

    def require_open(self) -> None:
        """Raise a `ClosedEnvironmentError` after `close`."""
        if self.closed:
            raise ClosedGymEnvironmentError("this environment is closed; make another")

    def __enter__(self) -> Self:
        """Return the environments; they are closed at the end of the block."""
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __getstate__(self) -> dict[str, Any]:
        raise InvalidInputError(
            "an environment cannot be copied or pickled: it holds simulations, processes or an OpenGL context. Make "
            "another with the same task and config=, and pass it the state: set_state(get_state())"
        )
