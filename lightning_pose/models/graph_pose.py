"""GraphPose: each image is a graph whose nodes are the cells of a CNN's feature map (thesis, chapter 4)."""

from __future__ import annotations

from typing import Any, ClassVar, Literal, get_args

import torch
from torch import Tensor, nn

from lightning_pose.errors import ConfigError
from lightning_pose.models.base import PoseModule
from lightning_pose.models.parts.graph_conv import GraphConvolution, PoseHeads
from lightning_pose.models.parts.neighbour_graph import list_edges, search_within_graph

__all__ = ["GraphPose"]

Readout = Literal["mean", "max"]


class GraphPose(PoseModule):
    """Graph convolutions over the cells of a (C, h, w) map, each joined to the K cells with the nearest features.

    The thesis's 7 x 7 cells are 49 nodes. It does not state how the nodes' states become one: here by their mean or
    maximum.

    Args:
        neighbours: K.
        conv: `wl`, `gcn`, or the name of another convolution of PyG, as for `GraphConvolution`.
        aggr: how a node joins its neighbours' messages: `add`, `mean`, `max`; the convolution's own way if not given.
        channels: width of each convolution.
        dropout: before each convolution.
        readout: `mean` or `max` over the nodes.
        places: add each cell's place in the image to its node's features; the thesis does not.
        **kwargs: what `PoseModule` takes.

    Raises:
        ConfigError: a number is out of its range, or a convolution cannot be built.
    """

    input_ranks: ClassVar[tuple[int, ...]] = (3,)

    def __init__(
        self,
        neighbours: int = 5,
        conv: str = "wl",
        aggr: str | None = None,
        channels: list[int] = [256, 128, 64],  # noqa: B006  (never changed; shown as it is in --help)
        dropout: float = 0.0,
        readout: Readout = "mean",
        places: bool = False,
        **kwargs: Any,
    ) -> None:
        super().__init__(**kwargs)
        if neighbours < 1:
            raise ConfigError(f"neighbours is {neighbours}; give 1 or more")
        if not channels or not 0 <= dropout < 1:
            raise ConfigError(f"channels are {channels} and dropout is {dropout}; give widths, and 0 to below 1")
        if readout not in get_args(Readout):
            raise ConfigError(f"readout is {readout!r}; give one of {', '.join(get_args(Readout))}")
        self.neighbours = neighbours
        width = self.input_shape[0] + (2 if places else 0)
        convolutions = [
            GraphConvolution(conv, before, after, aggr)
            for before, after in zip([width, *channels], channels, strict=False)
        ]
        self.network = _CellNetwork(convolutions, PoseHeads(channels[-1]), neighbours, dropout, readout, places)

    @property
    def feature_axis(self) -> int:
        return -3  # the channels of a map

    @property
    def headline(self) -> str:
        return f"D={self.input_shape[0]} neighbours={self.neighbours}"


class _CellNetwork(nn.Module):
    """Graph convolutions over the cells of maps, a readout over each map's nodes, and the heads of the pose."""

    def __init__(
        self,
        convolutions: list[GraphConvolution],
        heads: PoseHeads,
        neighbours: int,
        dropout: float,
        readout: Readout,
        places: bool,
    ) -> None:
        super().__init__()
        self.neighbours, self.readout, self.places = neighbours, readout, places
        self.convolutions = nn.ModuleList(convolutions)
        self.dropout = nn.Dropout(dropout)
        self.heads = heads

    def forward(self, maps: Tensor) -> Tensor:
        """(B, C, h, w) -> (B, 7)."""
        B, _, h, w = maps.shape
        nodes = maps.flatten(2).transpose(1, 2)
        edges = list_edges(search_within_graph(nodes, self.neighbours))
        if self.places:
            grid = torch.cartesian_prod(
                torch.linspace(-1, 1, h, device=maps.device), torch.linspace(-1, 1, w, device=maps.device)
            )
            nodes = torch.cat([nodes, grid.to(nodes.dtype).expand(B, -1, -1)], dim=2)
        state = nodes.flatten(0, 1)
        for convolution in self.convolutions:
            state = self.dropout(state)
            state = convolution(state, state, edges).relu()
        cells = state.view(B, h * w, -1)
        return self.heads(cells.mean(1) if self.readout == "mean" else cells.amax(1))
