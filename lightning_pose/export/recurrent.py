"""An LSTM over clips of any length for ONNX: torch's own tracer fixes the number of steps."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

__all__ = ["RecurrentClips", "list_translations"]

GATES = (0, 3, 1, 2)
"""Torch's gates (input, forget, cell, output) in the order of ONNX (input, output, forget, cell)."""


@torch.library.custom_op("lightning_pose::lstm_over_time", mutates_args=())
def lstm_over_time(frames: Tensor, weight: Tensor, recurrent: Tensor, bias: Tensor, units: int) -> Tensor:
    """(T, directions * units) states of the last layer for (T, F) frames; only ONNX computes it."""
    raise NotImplementedError("it stands for ONNX's LSTM while a graph is traced")


@lstm_over_time.register_fake
def _(frames: Tensor, weight: Tensor, recurrent: Tensor, bias: Tensor, units: int) -> Tensor:
    return frames.new_empty(frames.shape[0], len(weight) * units)


class RecurrentClips(nn.Module):
    """CNNRNN's network on one clip (1, T, C, H, W): convolutions over each frame, an LSTM over time, poses (1, T, 7).

    Args:
        network: with its weights.
    """

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.convolutions, self.head = network.get_submodule("convolutions"), network.get_submodule("head")
        lstm = network.get_submodule("lstm")
        assert isinstance(lstm, nn.LSTM)
        assert lstm.num_layers == 1, "CNNRNN has one"
        self.units = lstm.hidden_size
        ends = ["_l0", "_l0_reverse"] if lstm.bidirectional else ["_l0"]
        for name, kinds in (("weight", ["weight_ih"]), ("recurrent", ["weight_hh"]), ("bias", ["bias_ih", "bias_hh"])):
            rows = [torch.cat([_order_gates(getattr(lstm, kind + end)) for kind in kinds]) for end in ends]
            self.register_buffer(name, torch.stack(rows).detach())

    weight: Tensor
    recurrent: Tensor
    bias: Tensor

    def forward(self, clips: Tensor) -> Tensor:
        frames = self.convolutions(clips[0]).flatten(1)
        return self.head(lstm_over_time(frames, self.weight, self.recurrent, self.bias, self.units))[None]


def _order_gates(weight: Tensor) -> Tensor:
    """The four gates of a weight (4 * units, ...) in ONNX's order."""
    return weight.unflatten(0, (4, -1))[list(GATES)].flatten(0, 1)


def list_translations() -> dict[Callable[..., object], Callable[..., object]]:
    """What torch's exporter writes for the operators here."""
    from onnxscript import opset20

    op: Any = opset20  # its types are those of ONNX, which checkers do not know

    def write_lstm(frames: Any, weight: Any, recurrent: Any, bias: Any, units: int) -> Any:
        directions = weight.shape[0]
        states, _, _ = op.LSTM(
            op.Unsqueeze(frames, op.Constant(value_ints=[1])),
            weight,
            recurrent,
            bias,
            hidden_size=units,
            direction="bidirectional" if directions == 2 else "forward",
        )  # (T, directions, 1, units)
        return op.Reshape(states, op.Constant(value_ints=[-1, directions * units]))

    return {torch.ops.lightning_pose.lstm_over_time.default: write_lstm}
