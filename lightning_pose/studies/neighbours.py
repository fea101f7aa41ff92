"""The neighbours of some images, seen in the scene: where the training images with the nearest features were taken."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import matplotlib
import numpy as np
import torch
from matplotlib.figure import Figure

from lightning_pose.data.datamodule import SceneDataModule
from lightning_pose.errors import ConfigError
from lightning_pose.figures.style import MODEL, OTHERS, STYLE, TRAINING, find_longest_axes
from lightning_pose.models.parts.neighbour_graph import ABSENT, search_neighbours
from lightning_pose.sweeps.base_config import ParsedConfig

__all__ = ["SceneNeighbours", "draw_neighbours", "read_neighbours"]

SHARES = (1 / 3, 2 / 3)  # of a split, where its two queries are taken
COLORS = (MODEL, "#E69F00", *(color for color, _ in OTHERS))


class SceneNeighbours(NamedTuple):
    """Two training images and two test images of a scene, with their nearest training images in feature space.

    Attributes:
        scene: its name.
        training_m: (N, 3) positions of all training images.
        query_m: (Q, 3) positions of the queries, of training first.
        split: the split of each query.
        neighbours_m: for each query (K, 3) positions of its neighbours.
    """

    scene: str
    training_m: np.ndarray
    query_m: np.ndarray
    split: tuple[str, ...]
    neighbours_m: tuple[np.ndarray, ...]

    def describe(self, query: int) -> str:
        """The split of a query, and how far from it its neighbours were taken."""
        distance = np.linalg.norm(self.neighbours_m[query] - self.query_m[query], axis=1)
        return f"{self.split[query]} image, neighbours {np.median(distance):.2g} m away (median)"


def read_neighbours(config: ParsedConfig) -> SceneNeighbours:
    """Find the neighbours of four images as NodePose with this config does; nothing is trained.

    Raises:
        ConfigError: the model joins no images.
    """
    settings = config.config.as_dict()["model"]
    if not str(settings["class_path"]).endswith(".NodePose"):
        raise ConfigError(f"figure.kind neighbours shows NodePose's graph, not that of {settings['class_path']}")
    data = config.parser.instantiate_classes(config.config)["data"]
    assert isinstance(data, SceneDataModule)
    data.prepare_data()
    train, test = data.dataset("train").data, data.dataset("test").data
    queries = [(split, part, int(share * len(part.frame))) for split, part in (("training", train), ("test", test))
               for share in SHARES]  # fmt: skip
    features, position_m, frame = (
        torch.stack([getattr(part, name)[row] for _, part, row in queries])
        for name in ("features", "position_m", "frame")
    )
    init = settings["init_args"]
    keys = [torch.nn.functional.normalize(x, dim=1) if init["normalize"] else x for x in (features, train.features)]
    table = search_neighbours(keys[0], keys[1], init["neighbours"], frame, train.frame)
    return SceneNeighbours(
        scene=data.scene.name,
        training_m=train.position_m.numpy(),
        query_m=position_m.numpy(),
        split=tuple(split for split, _, _ in queries),
        neighbours_m=tuple(train.position_m[row[row != ABSENT]].numpy() for row in table),
    )


@matplotlib.rc_context(STYLE)
def draw_neighbours(scenes: Mapping[str, SceneNeighbours], title: str) -> Figure:
    """Draw a panel a scene, in the plane of the two longest axes of its training positions (thesis, fig. 4.4).

    Args:
        scenes: by the text above a panel.
        title: the heading.
    """
    figure = Figure(figsize=(6.4 * len(scenes), 6.2), dpi=130, layout="constrained")
    figure.suptitle(title, x=0.015, ha="left", fontsize=12, fontweight="bold")
    for axes, (name, found) in zip(figure.subplots(1, len(scenes), squeeze=False)[0], scenes.items(), strict=True):
        plane = list(find_longest_axes(found.training_m))
        axes.plot(*found.training_m[:, plane].T, ".", color=TRAINING, markersize=3, label="training images")
        for query, color in zip(range(len(found.query_m)), COLORS, strict=False):
            at = found.query_m[query, plane]
            for neighbour in found.neighbours_m[query][:, plane]:
                axes.plot(*np.stack([at, neighbour]).T, "-", color=color, linewidth=0.5, alpha=0.5)
            axes.plot(*found.neighbours_m[query][:, plane].T, ".", color=color, markersize=5)
            axes.plot(*at, "*", color=color, markersize=13, markeredgecolor="#1a1a1a", label=found.describe(query))
        axes.set(title=name, xlabel=f"{'xyz'[plane[0]]} (m)", ylabel=f"{'xyz'[plane[1]]} (m)", aspect="equal")
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.12), fontsize=8)
    return figure
