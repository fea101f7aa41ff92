"""NeighbourIndex: the nearest of many feature vectors, by comparing all, or approximately where there are many."""

from __future__ import annotations

import logging
from importlib.util import find_spec
from typing import Any

import torch
from torch import Tensor

from lightning_pose.models.parts.neighbour_graph import ABSENT, search_neighbours

__all__ = ["EXACT_LIMIT", "NeighbourIndex"]

log = logging.getLogger("lightning_pose")

EXACT_LIMIT = 20_000
"""Up to so many vectors, all distances are computed."""

LINKS, BUILD_LIST, SEARCH_LIST = 16, 40, 96
"""Of the graph in which faiss searches (HNSW, Malkov and Yashunin 2018): links of a node, candidates kept."""


class NeighbourIndex:
    """Searches the k nearest rows of a reference by L2.

    With more than `exact_limit` rows, and the extra `large` installed, an HNSW graph of faiss finds them approximately,
    in a time that hardly grows with the rows. One thread builds the graph, so that the same rows give the same graph.

    Args:
        reference: (N, D).
        exact_limit: up to so many rows all are compared.
    """

    def __init__(self, reference: Tensor, exact_limit: int = EXACT_LIMIT) -> None:
        self.reference = reference
        self._graph = None
        if len(reference) > exact_limit:
            if find_spec("faiss") is None:
                log.warning(
                    "%d images are compared with each other one by one; `uv sync --extra large` installs faiss, which "
                    "does without",
                    len(reference),
                )
            else:
                self._graph = _build_graph(reference)

    @property
    def exact(self) -> bool:
        """Whether all rows are compared."""
        return self._graph is None

    def search(
        self,
        query: Tensor,
        k: int,
        query_frame: Tensor | None = None,
        reference_frame: Tensor | None = None,
        gap: int = 1,
    ) -> Tensor:
        """Find neighbours; arguments and result are those of `search_neighbours`."""
        if self._graph is None:
            return search_neighbours(query, self.reference, k, query_frame, reference_frame, gap)
        # At most so many rows, of different frames, are within the gap of a frame.
        most = k if query_frame is None else k + 2 * gap - 1
        _, found = self._graph.search(_to_array(query), min(most, len(self.reference)))
        table = torch.from_numpy(found).to(query.device)
        if query_frame is not None and reference_frame is not None:
            near_in_time = (reference_frame[table.clamp(min=0)] - query_frame[:, None]).abs() < gap
            table = table.masked_fill(near_in_time, ABSENT)
            table = table.gather(1, (table == ABSENT).byte().argsort(dim=1, stable=True))  # the absent ones last
        table = table[:, :k]
        return torch.nn.functional.pad(table, (0, k - table.shape[1]), value=ABSENT)


def _build_graph(reference: Tensor) -> Any:
    import faiss

    graph = faiss.IndexHNSWFlat(reference.shape[1], LINKS)
    graph.hnsw.efConstruction, graph.hnsw.efSearch = BUILD_LIST, SEARCH_LIST
    threads = faiss.omp_get_max_threads()
    faiss.omp_set_num_threads(1)
    graph.add(_to_array(reference))
    faiss.omp_set_num_threads(threads)
    return graph


def _to_array(rows: Tensor) -> Any:
    """(N, D) float32 as faiss reads them."""
    return rows.detach().float().cpu().contiguous().numpy()
