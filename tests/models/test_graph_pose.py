"""GraphPose: cells as nodes, images apart, places, readouts and sizes."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from lightning_pose.errors import ConfigError
from lightning_pose.models import GraphPose

SHAPE = [6, 4, 5]


def make(**settings: Any) -> GraphPose:
    torch.manual_seed(0)
    return GraphPose(input_shape=SHAPE, **{"neighbours": 3, "channels": [8, 8], **settings}).eval()


def maps(count: int = 3) -> torch.Tensor:
    return torch.randn(count, *SHAPE, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize("conv", ["wl", "gcn", "SAGEConv", "GATConv"])
def test_images_do_not_hear_each_other(conv: str) -> None:
    features = maps().requires_grad_()
    for row, position_m in enumerate(make(conv=conv)(features).position_m):
        (gradient,) = torch.autograd.grad(position_m.sum(), features, retain_graph=True)
        assert gradient.flatten(1).any(1).nonzero().flatten().tolist() == [row]


@pytest.mark.parametrize(("places", "same"), [(False, True), (True, False)])
def test_cells_have_places_only_where_asked(places: bool, same: bool) -> None:
    model, features = make(places=places), maps()
    mirrored = model(features.flip(3)).position_m
    assert torch.allclose(mirrored, model(features).position_m, atol=1e-5) is same


def test_readouts_differ() -> None:
    assert not torch.allclose(make(readout="max")(maps()).position_m, make()(maps()).position_m)


def test_each_channel_is_standardized_over_images_and_cells() -> None:
    model = make()
    features = maps(20) * torch.arange(1.0, 7.0)[:, None, None] + 3
    model.fit_feature_scale(features)
    scaled = (features - model.feature_mean) / model.feature_scale
    torch.testing.assert_close(scaled.mean((0, 2, 3)), torch.zeros(6), atol=1e-5, rtol=0)
    torch.testing.assert_close(scaled.std((0, 2, 3)), torch.ones(6), atol=1e-3, rtol=0)


@pytest.mark.parametrize(("conv", "factor"), [("wl", 2), ("gcn", 1)])
def test_parameters_of_the_thesis(conv: str, factor: int) -> None:
    model = GraphPose(input_shape=[2048, 7, 7], conv=conv)
    weights = 2048 * 256 + 256 * 128 + 128 * 64
    assert sum(p.numel() for p in model.network.parameters()) == factor * weights + 256 + 128 + 64 + 65 * 7


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"neighbours": 0}, r"neighbours is 0; give 1 or more"),
        ({"channels": []}, r"channels are \[\].*give widths"),
        ({"dropout": -0.5}, r"dropout is -0.5; give"),
        ({"readout": "sum"}, r"readout is 'sum'; give one of mean, max"),
    ],
)
def test_settings_out_of_range_are_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        make(**settings)
