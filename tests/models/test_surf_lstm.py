"""SurfLSTM: the thesis's size, its variants, and what it reads."""

from __future__ import annotations

from typing import Any, Literal

import pytest
import torch
from torch import nn

from lightning_pose.errors import ConfigError
from lightning_pose.models import SurfLSTM


def count(module: nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())


def test_the_thesis_counts_its_parameters() -> None:
    assert count(SurfLSTM(input_shape=[50, 64])) == pytest.approx(3.73e5, rel=0.01)


@pytest.mark.parametrize(("cell", "gates"), [("lstm", 4), ("gru", 3), ("rnn", 1)])
@pytest.mark.parametrize("bidirectional", [True, False])
def test_cells_and_directions(cell: Literal["lstm", "gru", "rnn"], gates: int, bidirectional: bool) -> None:
    model = SurfLSTM(input_shape=[6, 8], cell=cell, bidirectional=bidirectional, layers=2, units=5)
    directions = 2 if bidirectional else 1
    first = gates * 5 * (8 + 5 + 2)
    second = gates * 5 * (5 * directions + 5 + 2)
    assert count(model.network) == directions * (first + second) + (5 * directions + 1) * 7
    assert model(torch.randn(3, 6, 8)).position_m.shape == (3, 3)


def test_both_directions_read_the_whole_sequence() -> None:
    model = SurfLSTM(input_shape=[6, 8], layers=1, units=5)
    features = torch.randn(1, 6, 8, requires_grad=True)
    model(features).position_m.sum().backward()
    assert features.grad is not None
    assert features.grad.abs().sum(-1).all()


def test_headline_names_what_differs() -> None:
    assert SurfLSTM(input_shape=[50, 64]).headline == "N=50"
    assert SurfLSTM(input_shape=[50, 64], cell="gru", bidirectional=False).headline == "N=50 gru one-way"


@pytest.mark.parametrize("name", ["units", "layers"])
def test_sizes_out_of_range_are_refused(name: str) -> None:
    sizes: dict[str, Any] = {name: 0}
    with pytest.raises(ConfigError, match=f"{name} is 0; give 1 or more"):
        SurfLSTM(input_shape=[6, 8], **sizes)


@pytest.mark.filterwarnings("error")
def test_dropout_after_one_layer_does_not_warn() -> None:
    SurfLSTM(input_shape=[6, 8], layers=1, dropout=0.5)
