"""Wraps any PyTorch Geometric convolution for bipartite graphs: separate source and target nodes."""

from __future__ import annotations

import inspect

import torch
from torch import Tensor, nn

from lightning_pose.errors import ConfigError

__all__ = ["GraphConvolution", "PoseHeads"]

_SHORT_NAMES = {"wl": "GraphConv", "gcn": "GCNConv"}
_LINEAR_IN_MESSAGES = ("GraphConv", "SAGEConv")  # of a node's neighbours they read the joined messages alone


class GraphConvolution(nn.Module):
    """One convolution from source nodes to target nodes.

    Args:
        conv: `wl` (PyG's GraphConv: Morris et al., AAAI 2019), `gcn` (GCNConv: Kipf & Welling, ICLR 2017), or the
            name of any convolution of `torch_geometric.nn` that takes different source and target nodes, such as
            SAGEConv, GATConv, GATv2Conv or TransformerConv.
        in_width: columns of a node's state.
        out_width: columns of its new state.
        aggr: how messages are joined: `add`, `mean` or `max`; the convolution's own way if not given, which for `gcn`
            is a mean.

    Attributes:
        takes_mean: whether the neighbours' mean is all that it reads of them, so that a random part of them stands for
            all.

    Raises:
        ConfigError: there is no such convolution, or it cannot be built from two widths.
    """

    def __init__(self, conv: str, in_width: int, out_width: int, aggr: str | None = None) -> None:
        super().__init__()
        # Seconds to import, which would be paid for every architecture.
        from torch_geometric import nn as pyg

        name = _SHORT_NAMES.get(conv, conv)
        self.is_gcn = name == "GCNConv"
        options: dict[str, object] = {} if aggr is None else {"aggr": aggr}
        try:
            kind: type[nn.Module] = getattr(pyg, name)
            # PyG would join a target to the source of the same number, which is another node: we add the loops.
            self.has_loops = "add_self_loops" in inspect.signature(kind).parameters
            if self.has_loops:
                options["add_self_loops"] = False
            if self.is_gcn:
                options["normalize"] = False  # it would need the degrees of sources, which are not known here
                if aggr == "mean":
                    del options["aggr"]  # its weights make the mean already; a second division would shrink it
            self.layer = kind(in_width, out_width, **options)
            with torch.no_grad():
                shape = self(torch.zeros(1, in_width), torch.zeros(2, in_width), torch.tensor([[0, 1], [0, 0]])).shape
        except (AttributeError, TypeError, ValueError, RuntimeError, AssertionError) as error:
            raise ConfigError(
                f"conv {conv!r} with aggr {aggr!r} cannot be built ({error}); give wl, gcn, or a convolution of "
                "torch_geometric.nn from source to target nodes, such as SAGEConv or GATConv"
            ) from error
        self.takes_mean = name in _LINEAR_IN_MESSAGES and getattr(self.layer, "aggr", None) == "mean"
        if shape != (1, out_width):
            raise ConfigError(f"conv {conv!r} answers with shape {tuple(shape)}, not {(1, out_width)}; give another")

    def forward(self, target: Tensor, source: Tensor, edges: Tensor) -> Tensor:
        """Compute new states of the target nodes from their neighbours.

        Args:
            target: (B, in_width).
            source: (M, in_width); may be `target` itself.
            edges: (2, E), rows of `source` above rows of `target`.

        Returns:
            (B, out_width), without an activation.
        """
        if not self.has_loops:
            return self.layer((source, target), edges)
        B = len(target)
        itself = torch.arange(B, device=target.device)
        nodes, first = (target, 0) if source is target else (torch.cat([target, source]), B)
        edges = torch.stack([torch.cat([edges[0] + first, itself]), torch.cat([edges[1], itself])])
        if not self.is_gcn:
            return self.layer(nodes, edges)[:B]
        # All nodes have equally many neighbours: GCN's D^-1/2 (A + I) D^-1/2 is the mean over a node and them.
        weight = 1 / edges[1].bincount(minlength=B)[edges[1]].to(nodes.dtype)
        return self.layer(nodes, edges, weight)[:B]


class PoseHeads(nn.Module):
    """Two linear layers side by side: (B, width) -> (B, 7), three for the position and four for the quaternion."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.position = nn.Linear(width, 3)
        self.quat = nn.Linear(width, 4)

    def forward(self, state: Tensor) -> Tensor:
        return torch.cat([self.position(state), self.quat(state)], dim=-1)
