"""The figure of neighbours: which images are joined, and where they are drawn."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml

from lightning_pose.errors import ConfigError
from lightning_pose.studies.neighbours import SceneNeighbours, draw_neighbours, read_neighbours
from lightning_pose.sweeps.base_config import ParsedConfig
from tests.helpers import Workplace


def write_config(workplace: Workplace, name: str, **settings: object) -> Path:
    """The workplace's config with another model, on features of one row."""
    config = yaml.safe_load(workplace.config.read_text())
    config["model"] = {"class_path": f"lightning_pose.models.{name}", "init_args": settings}
    config["data"]["init_args"]["extractor"] = {"class_path": "tests.studies.test_studies.Flat"}
    file = workplace.folder / "neighbours.yaml"
    file.write_text(yaml.safe_dump(config))
    return file


def test_neighbours_are_the_training_images_with_the_nearest_features(workplace: Workplace) -> None:
    file = write_config(workplace, "NodePose", neighbours=3, normalize=False)
    config = ParsedConfig(["--config", str(file), "--data.root", str(workplace.scene)])
    found = read_neighbours(config)
    assert found.split == ("training", "training", "test", "test")
    data = config.parser.instantiate_classes(config.config)["data"]
    train, test = data.dataset("train").data, data.dataset("test").data
    for query, (part, own) in enumerate([(train, True), (train, True), (test, False), (test, False)]):
        row = int((1 + query % 2) / 3 * len(part.frame))
        np.testing.assert_array_equal(found.query_m[query], part.position_m[row])
        distance = (train.features - part.features[row]).norm(dim=1)
        if own:
            distance[row] = np.inf
        expected = train.position_m[distance.argsort()[:3]]
        np.testing.assert_array_equal(found.neighbours_m[query], expected)


def test_a_star_for_each_query_and_a_dot_for_each_neighbour() -> None:
    training = np.array([[0.0, 0, 0], [4, 0, 0], [0, 0, 3]])
    scene = SceneNeighbours("room", training, np.array([[0.0, 0, 1]]), ("test",), (training[1:],))
    assert scene.describe(0) == "test image, neighbours 3.1 m away (median)"
    (axes,) = draw_neighbours({"room": scene}, "title").axes
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("x (m)", "z (m)")
    drawn = [np.asarray(line.get_xydata()).tolist() for line in axes.get_lines()]
    assert drawn == [[[0, 0], [4, 0], [0, 3]], [[0, 1], [4, 0]], [[0, 1], [0, 3]], [[4, 0], [0, 3]], [[0, 1]]]


def test_a_system_without_a_graph_of_images_is_refused(workplace: Workplace) -> None:
    file = write_config(workplace, "DensePoseNet")
    with pytest.raises(ConfigError, match=r"figure.kind neighbours shows NodePose's graph, not that of .*DensePoseNet"):
        read_neighbours(ParsedConfig(["--config", str(file), "--data.root", str(workplace.scene)]))
