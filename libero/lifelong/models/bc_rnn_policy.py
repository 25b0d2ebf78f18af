"""ResNet-RNN under the original's names; see `lifelong.policies.bc_rnn`.

Shape legend: B batch, T time, F features of a frame, A action.
"""

from collections.abc import Mapping
from typing import Any

from torch import Tensor

from libero.lifelong.models.modules.extra_modules import ExtraModalities
from libero.lifelong.models.native_policy import NativePolicy, build_language, fuse_all, image_sizes
from lifelong.errors import PolicyError
from lifelong.policies import BCRNN

__all__ = ["BCRNNPolicy", "ExtraModalities"]

State = tuple[Tensor, Tensor]


class BCRNNPolicy(NativePolicy):
    """Language, readings and cameras as one vector of a step, and an LSTM over time.

    When acting its state is carried, and emptied every `data.seq_len` steps, as windows in training begin empty.
    """

    def _network(self, policy: Any, more: dict[str, Any]) -> BCRNN:
        if policy.get("rnn_bidirectional"):
            raise PolicyError("rnn_bidirectional: a policy that acts cannot look ahead; set it to false")
        if policy.get("extra_num_layers"):
            raise PolicyError("extra_num_layers: this policy takes readings as they are; set it to 0")
        sizes = {
            "image_embed": policy.image_embed_size,
            "text_embed": policy.text_embed_size,
            "rnn_hidden": policy.rnn_hidden_size,
            "rnn_layers": policy.rnn_num_layers,
            "dropout": policy.rnn_dropout,
            **image_sizes(policy),
        }
        network = self._build(BCRNN, {**sizes, **more})
        fuse_all(network, policy)
        network.language.linear = build_language(  # type: ignore[assignment]
            policy, "the RNN", policy.text_embed_size
        )
        self._state: State | None = None
        self._age = 0  # steps that the state has seen
        return network

    def forward(
        self, data: Mapping[str, Any], init_state: State | None = None, return_state: bool = False
    ) -> Any:
        """The distribution of actions (B, T, A), from a state (empty without one), and the state behind it."""
        latent, state = self.network.rnn(self.spatial_encode(data), init_state)
        dist = self.policy_head(latent)
        return (dist, state) if return_state else dist

    def reset(self) -> None:
        """See `BasePolicy`."""
        super().reset()
        self._state, self._age = None, 0

    def _latest(self, data: Mapping[str, Any]) -> Tensor:
        if self._age == self.max_seq_len:
            self._state, self._age = None, 0
        latent, self._state = self.network.rnn(self.spatial_encode(data), self._state)
        self._age += 1
        return latent[:, -1]
