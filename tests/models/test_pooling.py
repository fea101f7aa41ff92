"""Pools of the clip networks are averages: on windows of known values, and unlike maxima."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn

from lightning_pose.evaluation.responses import record_responses
from lightning_pose.models import CNN3D, CNNRNN, ClipModule


def averages(image: Tensor, width: int) -> Tensor:
    """(..., H, W) means over windows of `width`, those at the border over what is there."""
    rows = [part.mean(-2, keepdim=True) for part in image.split(width, dim=-2)]
    return torch.cat([part.mean(-1, keepdim=True) for part in torch.cat(rows, -2).split(width, dim=-1)], -1)


@pytest.mark.parametrize(("network", "width"), [(CNNRNN, 2), (CNN3D, 5)])
def test_the_second_convolution_reads_averages_of_the_first(network: type[ClipModule], width: int) -> None:
    torch.manual_seed(0)
    model = network(input_shape=[3, 20, 30], channels=4, units=8).eval()
    found = record_responses(model, torch.rand(3, 3, 20, 30))
    first = found["activation 1"]  # batch normalisation, which is fresh, comes between in CNNRNN
    scale = (1 + 1e-5) ** -0.5 if network is CNNRNN else 1.0
    pooled = averages(first, width) * scale
    second = [layer for layer in model.network.modules() if isinstance(layer, (nn.Conv2d, nn.Conv3d))][1]  # type: ignore[union-attr]
    if isinstance(second, nn.Conv3d):
        blocks = nn.functional.pad(pooled.transpose(0, 1)[None], (0, 0, 0, 0, 1, 1))
        expected = second(blocks)[0].transpose(0, 1)
    else:
        expected = second(pooled)
    torch.testing.assert_close(found["convolution 2"], expected, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize(("network", "width"), [(CNNRNN, 4), (CNN3D, 25)])
def test_the_linear_layers_read_averages_of_the_second(network: type[ClipModule], width: int) -> None:
    torch.manual_seed(0)
    model = network(input_shape=[3, 20, 30], channels=4, units=8).eval()
    seen: list[Tensor] = []
    reader = model.network.lstm if network is CNNRNN else model.network.head  # type: ignore[union-attr]
    reader.register_forward_pre_hook(lambda module, arguments: seen.append(arguments[0]))  # type: ignore[union-attr]
    second = record_responses(model, torch.rand(3, 3, 20, 30))["activation 2"]
    scale, window = ((1 + 1e-5) ** -0.5, 2) if network is CNNRNN else (1.0, 5)
    expected = averages(second, window).flatten(1) * scale
    torch.testing.assert_close(seen[0].flatten(0, 1), expected, atol=1e-5, rtol=1e-4)
