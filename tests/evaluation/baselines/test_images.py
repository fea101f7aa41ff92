"""Baselines: known answers, every feature layout, determinism, and poor data."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from lightning_pose.errors import ConfigError
from lightning_pose.evaluation.baselines.images import BaselineResult, evaluate_baselines
from lightning_pose.features.retrieval import compute_global_vectors, find_nearest
from lightning_pose.geometry.quaternions import orientation_error_deg, position_error_m, quat_normalize

NAMES = ["train_mean", "retrieval_top1", "retrieval_top5", "oracle"]


def poses(n: int, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    position = torch.randn(n, 3, generator=generator)
    return position, quat_normalize(torch.randn(n, 4, generator=generator))


def evaluate(train: torch.Tensor, test: torch.Tensor, **settings: int) -> dict[str, BaselineResult]:
    return evaluate_baselines(train, *poses(len(train), 0), test, *poses(len(test), 1), **settings)


def descriptors(n: int, m: int = 40, seed: int = 0) -> torch.Tensor:
    """(n, m, 8): each image shows its own 10 of a world of 100 points, and noise elsewhere."""
    generator = torch.Generator().manual_seed(seed)
    world = torch.nn.functional.normalize(torch.randn(100, 8, generator=torch.Generator().manual_seed(9)), dim=-1)
    rows = torch.nn.functional.normalize(torch.randn(n, m, 8, generator=generator), dim=-1)
    for image in range(n):
        rows[image, :30] = world[(torch.arange(30) + 7 * image) % 100]
    return rows


def test_known_answers_on_a_line() -> None:
    """Training frames at x = 0..5, their features angles; the test frame looks like 4 but stands at 1.2."""
    angles = torch.deg2rad(10 * torch.arange(6.0))
    train = torch.stack([angles.cos(), angles.sin()], dim=1)
    position = torch.zeros(6, 3)
    position[:, 0] = torch.arange(6.0)
    quat = torch.stack([angles.cos(), angles.sin(), torch.zeros(6), torch.zeros(6)], dim=1)
    signs = torch.tensor([1.0, -1.0, 1.0, -1.0, 1.0, -1.0])[:, None]
    results = evaluate_baselines(
        train, position, quat * signs, 7 * train[4:5], torch.tensor([[1.2, 0.0, 0.0]]), quat[1:2]
    )
    assert list(results) == NAMES
    x = {name: result.position_m[0, 0].item() for name, result in results.items()}
    assert x == pytest.approx({"train_mean": 2.5, "retrieval_top1": 4, "retrieval_top5": 3, "oracle": 1})
    medians = {name: result.metrics["orientation_median_deg"] for name, result in results.items()}
    expected = {"train_mean": 30, "retrieval_top1": 60, "retrieval_top5": 40, "oracle": 0}
    assert medians == pytest.approx(expected, abs=1e-4)


def test_shapes_and_metrics_belong_to_the_answer() -> None:
    test_position, test_quat = poses(7, 1)
    for result in evaluate(torch.randn(12, 5), torch.randn(7, 5)).values():
        assert result.position_m.shape == (7, 3)
        assert result.quat_wxyz.shape == (7, 4)
        errors = position_error_m(result.position_m, test_position)
        assert result.metrics["position_median_m"] == pytest.approx(errors.quantile(0.5).item())
        assert orientation_error_deg(result.quat_wxyz, test_quat.double()).isfinite().all()


def test_oracle_keeps_centimetres_in_geographic_coordinates() -> None:
    offset = torch.tensor([5e5, 5e6, 100.0], dtype=torch.float64)
    position = offset + torch.tensor([[0.0, 0.0, 0.0], [0.02, 0.0, 0.0]], dtype=torch.float64)
    quat = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).expand(2, 4)
    results = evaluate_baselines(torch.eye(2), position, quat, torch.eye(2)[:1], position[1:] + 0.001, quat[:1])
    torch.testing.assert_close(results["oracle"].position_m, position[1:])


def test_vlad_finds_the_image_of_the_same_points() -> None:
    train = descriptors(13)
    test = descriptors(13, seed=5)[3:6].flip(1)  # other noise, other order
    vectors = compute_global_vectors(train, test)
    assert find_nearest(vectors[1], vectors[0], k=1).squeeze(1).tolist() == [3, 4, 5]


def test_vlad_vectors_are_unit_and_ignore_zero_rows() -> None:
    train = descriptors(13)
    padded = torch.cat([train, torch.zeros(13, 20, 8)], dim=1)
    train_vectors, padded_vectors = compute_global_vectors(train, padded)
    torch.testing.assert_close(train_vectors, padded_vectors)
    torch.testing.assert_close(train_vectors.norm(dim=1), torch.ones(13))
    assert train_vectors.shape == (13, 64 * 8)


def test_maps_are_pooled_and_numpy_is_welcome() -> None:
    maps = np.random.default_rng(0).random((6, 5, 2, 3), dtype=np.float32)
    from_maps, _ = compute_global_vectors(maps, maps)
    from_vectors, _ = compute_global_vectors(maps.mean((2, 3)), maps.mean((2, 3)))
    torch.testing.assert_close(from_maps, from_vectors)


def test_deterministic_and_blind_to_the_global_seed() -> None:
    train, test = descriptors(9), descriptors(4, seed=1)
    torch.manual_seed(1)
    first = evaluate(train, test, seed=3)
    torch.manual_seed(2)
    second = evaluate(train, test, seed=3)
    for name in NAMES:
        assert torch.equal(first[name].position_m, second[name].position_m)
        assert first[name].metrics == second[name].metrics


@pytest.mark.parametrize(
    ("train", "test"),
    [
        pytest.param(torch.zeros(6, 10, 8), torch.zeros(2, 10, 8), id="all blank, local"),
        pytest.param(torch.zeros(6, 8), torch.zeros(2, 8), id="all blank, global"),
        pytest.param(torch.randn(3, 2, 8), torch.randn(2, 2, 8), id="6 descriptors"),
        pytest.param(torch.randn(1, 1, 8).expand(6, 10, 8), torch.zeros(2, 10, 8), id="one descriptor repeated"),
        pytest.param(torch.randn(1, 8), torch.randn(2, 8), id="one training frame"),
    ],
)
@pytest.mark.filterwarnings("error")
def test_poor_data_still_gives_answers(train: torch.Tensor, test: torch.Tensor) -> None:
    for result in evaluate(train, test).values():
        assert result.position_m.isfinite().all()
        assert np.isfinite(list(result.metrics.values())).all()


def test_ties_go_to_the_earlier_frame() -> None:
    results = evaluate(torch.ones(6, 8), torch.zeros(2, 8))
    first = poses(6, 0)[0][0].double().expand(2, 3)
    torch.testing.assert_close(results["retrieval_top1"].position_m, first)


@pytest.mark.parametrize(("n_train", "n_test"), [(0, 2), (2, 0)])
def test_no_frames_are_refused(n_train: int, n_test: int) -> None:
    with pytest.raises(ConfigError, match=f"train has {n_train} and test {n_test}; check"):
        evaluate(torch.randn(n_train, 4), torch.randn(n_test, 4))


def test_layouts_that_differ_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"\(3, 4\) in train and \(3, 5\) in test; give both"):
        compute_global_vectors(torch.randn(3, 4), torch.randn(3, 5))
    with pytest.raises(ConfigError, match=r"give both as \(N, D\)"):
        compute_global_vectors(torch.randn(3), torch.randn(3))
