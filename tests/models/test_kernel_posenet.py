"""KernelPoseNet: the exact solution, its approximation, what it keeps, and its refusals."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from lightning import Trainer
from sklearn.gaussian_process.kernels import RBF
from sklearn.kernel_ridge import KernelRidge
from sklearn.preprocessing import KernelCenterer

from lightning_pose.data.batches import PoseBatch
from lightning_pose.errors import CheckpointError, ConfigError
from lightning_pose.geometry.quaternions import align_hemisphere
from lightning_pose.models import KernelPoseNet
from tests.models.test_linear_posenet import D, NoisyProblem


def fit(problem: NoisyProblem, **settings: Any) -> KernelPoseNet:
    model = KernelPoseNet(**{"input_shape": [D], "lambdas": [0.1], **settings})
    trainer = Trainer(max_epochs=1, accelerator="cpu", logger=False, enable_checkpointing=False,
                      enable_progress_bar=False, enable_model_summary=False)  # fmt: skip
    trainer.fit(model, datamodule=problem)
    return model.eval()


def reference(model: KernelPoseNet, train: PoseBatch, query: torch.Tensor, strength: float) -> np.ndarray:
    """scikit-learn's kernel ridge with a bias, as raw (Q, 7) poses."""
    unit = torch.nn.functional.normalize
    x, q = unit(train.features.double(), dim=1).numpy(), unit(query.double(), dim=1).numpy()
    kernel = RBF(float(1 / (2 * model.network.scale) ** 0.5))
    centre = KernelCenterer().fit(kernel(x))
    quat_wxyz = align_hemisphere(train.quat_wxyz, model.quat_reference)
    poses = torch.cat([train.position_m, quat_wxyz], dim=1).double().numpy()
    ridge = KernelRidge(alpha=strength, kernel="precomputed")  # type: ignore[arg-type]
    ridge.fit(centre.transform(kernel(x)), poses - poses.mean(0))
    return ridge.predict(centre.transform(kernel(q, x))) + poses.mean(0)


@pytest.mark.parametrize("refit", [False, True])
def test_it_is_scikit_learns_kernel_ridge(refit: bool) -> None:
    problem = NoisyProblem()
    model = fit(problem, refit=refit)
    whole = PoseBatch(*(torch.cat(pair) for pair in zip(problem.data.data, problem.held, strict=True)))
    expected = reference(model, whole if refit else problem.data.data, problem.held.features, 0.1)
    position_m, quat_wxyz = model(problem.held.features)
    np.testing.assert_allclose(position_m.detach().numpy(), expected[:, :3], rtol=1e-5, atol=1e-5)
    expected = expected[:, 3:] / np.linalg.norm(expected[:, 3:], axis=1, keepdims=True)
    np.testing.assert_allclose(quat_wxyz.detach().numpy(), expected, rtol=1e-5, atol=1e-5)


def test_gamma_is_measured_at_the_median_distance() -> None:
    model = fit(NoisyProblem(val=0), gamma=0.7)
    squared = torch.pdist(model.network.landmarks.double()).square().median()
    torch.testing.assert_close(torch.exp(-model.network.scale * squared), torch.exp(torch.tensor(-0.7)).double())


def test_few_landmarks_approximate() -> None:
    problem = NoisyProblem(count=120, val=0)
    query = problem.data.data.features
    exact, near, far = (fit(problem, landmarks=count)(query).position_m for count in (500, 60, 3))
    assert (near - exact).norm() < (far - exact).norm() / 4


def test_a_checkpoint_brings_its_landmarks() -> None:
    problem = NoisyProblem()
    model = fit(problem, landmarks=20)
    assert model.network.landmarks.shape == (20, D)
    assert model.network.weight.shape == (20, 7)
    rebuilt = KernelPoseNet(input_shape=[D])
    rebuilt.load_state_dict(model.state_dict())
    features = problem.held.features
    torch.testing.assert_close(rebuilt.eval()(features), model(features), atol=0, rtol=0)
    with pytest.raises(CheckpointError, match=r"has shape \(16,\) in the checkpoint and \(8,\) here"):
        KernelPoseNet(input_shape=[8]).on_load_checkpoint({"state_dict": model.state_dict()})


def test_equal_frames_will_do() -> None:
    problem = NoisyProblem(val=0)
    problem.data.data.features[:] = 1.0
    position_m, _ = fit(problem)(problem.data.data.features)
    torch.testing.assert_close(position_m[0], problem.data.data.position_m.double().mean(0), atol=1e-4, rtol=1e-4)


def test_headline_names_what_differs() -> None:
    assert KernelPoseNet(input_shape=[32], gamma=0.25).headline == "D=32 gamma=0.25"


@pytest.mark.parametrize("settings", [{"gamma": 0.0}, {"landmarks": 0}])
def test_numbers_out_of_range_are_refused(settings: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match=r"gamma is .* and landmarks is .*; give above 0"):
        KernelPoseNet(input_shape=[D], **settings)
