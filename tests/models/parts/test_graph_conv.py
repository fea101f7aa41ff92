"""Graph convolutions: what a node makes of its neighbours."""

from __future__ import annotations

import pytest
import torch

from lightning_pose.models.parts.graph_conv import GraphConvolution

SOURCE = torch.tensor([[1.0, 2.0], [3.0, 4.0], [8.0, 0.0]])
TARGET = torch.tensor([[2.0, 6.0]])
EDGES = torch.tensor([[0, 1, 2], [0, 0, 0]])


@pytest.mark.parametrize("aggr", [None, "add", "mean"])
def test_gcn_is_the_mean_of_a_node_and_its_neighbours(aggr: str | None) -> None:
    """Its normalised adjacency makes the mean, and `mean` must not divide by the degree once more."""
    convolution = GraphConvolution("gcn", 2, 2, aggr)
    convolution.layer.lin.weight.data = torch.eye(2)  # type: ignore[union-attr]
    expected = torch.cat([TARGET, SOURCE]).mean(0, keepdim=True)
    torch.testing.assert_close(convolution(TARGET, SOURCE, EDGES), expected)


@pytest.mark.parametrize(("aggr", "received"), [(None, [12.0, 6.0]), ("mean", [4.0, 2.0]), ("max", [8.0, 4.0])])
def test_wl_adds_its_neighbours_to_itself(aggr: str | None, received: list[float]) -> None:
    convolution = GraphConvolution("wl", 2, 2, aggr)
    for linear, weight in ((convolution.layer.lin_rel, 1.0), (convolution.layer.lin_root, 10.0)):  # type: ignore[union-attr]
        linear.weight.data = weight * torch.eye(2)  # type: ignore[union-attr]
        if linear.bias is not None:  # type: ignore[union-attr]
            linear.bias.data.zero_()  # type: ignore[union-attr]
    torch.testing.assert_close(convolution(TARGET, SOURCE, EDGES), 10 * TARGET + torch.tensor([received]))
