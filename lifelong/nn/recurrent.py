"""The recurrent network over time.

Shape legend: B batch, T time, F features of a frame.
"""

from typing import Annotated

from pydantic import Field
from torch import nn

from lifelong.types import Share, Width


class TemporalLSTM(nn.LSTM):
    """LSTM over windows, (B, T, F) -> (B, T, hidden).

    Args:
        in_dim: F.
        hidden: Size of the state.
        layers: Number of layers.
        dropout: Dropout between the layers; without effect where there is one.
    """

    def __init__(
        self,
        *,
        in_dim: int,
        hidden: Width = 1024,
        layers: Annotated[int, Field(ge=1, le=1000)] = 2,
        dropout: Share = 0.0,
    ) -> None:
        super().__init__(
            input_size=in_dim,
            hidden_size=hidden,
            num_layers=layers,
            dropout=dropout if layers > 1 else 0.0,
            batch_first=True,
        )
