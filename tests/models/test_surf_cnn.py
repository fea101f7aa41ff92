"""SurfCNN: the sizes of table 2.2, and settings that do not fit."""

from __future__ import annotations

import pytest
import torch

from lightning_pose.errors import ConfigError
from lightning_pose.models import SurfCNN


@pytest.mark.parametrize(("n_features", "parameters"), [(300, 1.31e7), (100, 6.6e6)])
def test_the_thesis_counts_its_parameters(n_features: int, parameters: float) -> None:
    with torch.device("meta"):
        model = SurfCNN(input_shape=[n_features, 64])
    assert sum(parameter.numel() for parameter in model.parameters()) == pytest.approx(parameters, rel=0.1)


@pytest.mark.parametrize("ordered", [True, False])
@pytest.mark.parametrize("shape", [(1, 64), (7, 33), (50, 128), (20, 68)])
def test_any_input_has_a_pose(shape: tuple[int, int], ordered: bool) -> None:
    model = SurfCNN(input_shape=list(shape), channels=[4, 4, 4, 4, 4], units=8, ordered=ordered).eval()
    assert model(torch.randn(2, *shape)).position_m.shape == (2, 3)


@pytest.mark.parametrize(
    ("channels", "kernels"), [([4, 4], [3]), ([], []), ([4], [4])], ids=["lengths", "none", "even kernel"]
)
def test_settings_that_do_not_fit_are_refused(channels: list[int], kernels: list[int]) -> None:
    with pytest.raises(ConfigError, match=r"channels \[.*kernels \[.*give as many of each, kernels odd"):
        SurfCNN(input_shape=[20, 64], channels=channels, kernels=kernels)


@pytest.mark.parametrize(("layers", "widths"), [(1, [4]), (3, [4, 6, 8]), (5, [4, 6, 8, 8, 8]), (None, [4, 6, 8])])
def test_layers_cut_the_lists_or_repeat_their_last(layers: int | None, widths: list[int]) -> None:
    model = SurfCNN(input_shape=[20, 64], channels=[4, 6, 8], kernels=[7, 5, 3], layers=layers, units=8).eval()
    convolutions = [module for module in model.modules() if isinstance(module, torch.nn.Conv2d)]
    assert [module.out_channels for module in convolutions] == widths
    assert [module.kernel_size[0] for module in convolutions] == [7, 5, 3, 3, 3][: len(widths)]
    assert model(torch.randn(2, 20, 64)).position_m.shape == (2, 3)


def test_no_layers_are_refused() -> None:
    with pytest.raises(ConfigError, match="layers is 0; give 1 or more"):
        SurfCNN(input_shape=[20, 64], layers=0)


@pytest.mark.parametrize("ordered", [True, False])
def test_the_order_of_features_matters_only_where_it_is_told_to(ordered: bool) -> None:
    model = SurfCNN(input_shape=[20, 64], channels=[4, 6], kernels=[7, 5], units=8, ordered=ordered).eval()
    features = torch.randn(3, 20, 64)
    before, after = (model.network(rows) for rows in (features, features.flip(1)))
    assert torch.allclose(before, after, atol=1e-6) != ordered


def test_an_unordered_network_is_as_large_for_any_number_of_features() -> None:
    sizes = {
        sum(parameter.numel() for parameter in SurfCNN(input_shape=[n, 64], units=8, ordered=False).parameters())
        for n in (1, 30, 100)
    }
    assert len(sizes) == 1


@pytest.mark.parametrize(("ordered", "headline"), [(True, "N=100"), (False, "N=100 unordered")])
def test_headline(ordered: bool, headline: str) -> None:
    assert SurfCNN([4], [3], units=8, ordered=ordered, input_shape=[100, 64]).headline == headline
