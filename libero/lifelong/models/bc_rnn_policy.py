"""ResNet-RNN under the original's name; see `lifelong.policies.bc_rnn`.

Shape legend: B batch, T time, A action.
"""

from collections.abc import Mapping
from typing import Any

from torch import Tensor

from libero.lifelong.models.modules.extra_modules import ExtraModalities
from libero.lifelong.models.native_policy import NativePolicy, resnet_sizes
from lifelong.errors import PolicyError
from lifelong.policies import BCRNN

State = tuple[Tensor, Tensor]


class BCRNNPolicy(NativePolicy):
    """One vector of language, proprioception and cameras at each step, and an LSTM over time.

    When acting its state is carried, and reset every `data.seq_len` steps, as windows in training begin without one.
    """

    kind = BCRNN
    _state: State | None = None
    _age = 0  # steps since the state was empty

    def _arguments(self, policy: Any) -> dict[str, Any]:
        if policy.get("rnn_bidirectional"):
            raise PolicyError("rnn_bidirectional: a policy that acts cannot look ahead; set it to false")
        if policy.get("extra_num_layers"):
            raise PolicyError("extra_num_layers: this policy does not encode proprioception; set it to 0")
        return {
            "image_embed": policy.image_embed_size,
            "text_embed": policy.text_embed_size,
            "rnn_hidden": policy.rnn_hidden_size,
            "rnn_layers": policy.rnn_num_layers,
            "dropout": policy.rnn_dropout,
            **resnet_sizes(policy),
        }

    def forward(
        self, data: Mapping[str, Any], init_state: State | None = None, return_state: bool = False
    ) -> Any:
        """Return the distribution of actions (B, T, A) from a state, by default empty; and the state after it."""
        latent, state = self.network.rnn(self.spatial_encode(data), init_state)
        dist = self.policy_head(latent)
        return (dist, state) if return_state else dist

    def reset(self) -> None:
        """See `BasePolicy`."""
        super().reset()
        self._state, self._age = None, 0

    def _latest_latent(self, data: Mapping[str, Any]) -> Tensor:
        if self._age == self.max_seq_len:
            self.reset()
        latent, self._state = self.network.rnn(self.spatial_encode(data), self._state)
        self._age += 1
        return latent[:, -1]
