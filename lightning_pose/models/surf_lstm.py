"""SurfLSTM: a recurrent network over descriptors in the order of their strength (thesis, chapter 3)."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

import torch
from torch import Tensor, nn

from lightning_pose.errors import ConfigError
from lightning_pose.models.base import PoseModule

__all__ = ["SurfLSTM"]

CELLS = {"lstm": nn.LSTM, "gru": nn.GRU, "rnn": nn.RNN}


class SurfLSTM(PoseModule):
    """Recurrent layers over (N, D) descriptors; the final states of the last layer give the pose.

    The thesis (section 3.2.3) has two bidirectional LSTM layers of 100 units; figure 3.6 compares the other cells.
    Its equation 3.6 misprints the gates: this is the standard LSTM.

    Args:
        cell: kind of recurrent cell.
        bidirectional: also read from the weakest to the strongest.
        layers: recurrent layers.
        units: width of each layer and direction.
        dropout: between layers and before the last linear layer.
        **kwargs: what `PoseModule` takes.

    Raises:
        ConfigError: `layers` or `units` is not positive.
    """

    input_ranks: ClassVar[tuple[int, ...]] = (2,)

    def __init__(
        self,
        cell: Literal["lstm", "gru", "rnn"] = "lstm",
        bidirectional: bool = True,
        layers: int = 2,
        units: int = 100,
        dropout: float = 0.0,
        **kwargs: Any,
    ) -> None:
        super().__init__(**kwargs)
        for name, value in (("layers", layers), ("units", units)):
            if value < 1:
                raise ConfigError(f"{name} is {value}; give 1 or more")
        self.cell = cell
        self.bidirectional = bidirectional
        _, width = self.input_shape
        self.network = _RecurrentRegressor(CELLS[cell], width, units, layers, bidirectional, dropout)

    @property
    def headline(self) -> str:
        direction = "" if self.bidirectional else " one-way"
        return f"N={self.input_shape[0]}" + (f" {self.cell}" if self.cell != "lstm" else "") + direction


class _RecurrentRegressor(nn.Module):
    """Recurrent layers, and a linear layer on the final states of the last one."""

    def __init__(
        self,
        cell: type[nn.LSTM | nn.GRU | nn.RNN],
        width: int,
        units: int,
        layers: int,
        bidirectional: bool,
        dropout: float,
    ) -> None:
        super().__init__()
        between = dropout if layers > 1 else 0.0  # torch warns of dropout after the only layer
        self.rnn = cell(width, units, layers, batch_first=True, dropout=between, bidirectional=bidirectional)
        self.directions = 2 if bidirectional else 1
        self.dropout = nn.Dropout(dropout)
        self.head = nn.Linear(units * self.directions, 7)

    def forward(self, descriptors: Tensor) -> Tensor:
        """(B, N, D) -> (B, 7)."""
        _, state = self.rnn(descriptors)
        hidden = state[0] if isinstance(state, tuple) else state  # (layers * directions, B, units)
        final = torch.cat(list(hidden[-self.directions :]), dim=-1)
        return self.head(self.dropout(final))
