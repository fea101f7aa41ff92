"""LinearPoseNet: the exact solution, how lambda is chosen, what it keeps, and how Lightning runs it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lightning import Trainer
from sklearn.decomposition import PCA
from sklearn.linear_model import Ridge
from sklearn.pipeline import make_pipeline
from torch.utils.data import DataLoader

from lightning_pose.data.batches import PoseBatch, PoseDataset, make_loader
from lightning_pose.errors import ConfigError
from lightning_pose.evaluation.costs import measure_weights
from lightning_pose.geometry.quaternions import align_hemisphere
from lightning_pose.losses import LossConfig
from lightning_pose.models import LinearPoseNet
from lightning_pose.runs.checkpoints import BestCheckpoint, LastCheckpoint
from tests.models.helpers import LearnableProblem, random_poses

D = 16

SETTINGS = {"world_size": 2, "limit_train_batches": 1.0}
"""Of a trainer with two processes."""


class NoisyProblem(LearnableProblem):
    """Features that give the pose with noise; validation and test frames are others than those of training."""

    def __init__(self, count: int = 40, val: int = 12) -> None:
        super().__init__([D])
        parts = {"train": count, "val": val, "test": 12}
        position_m, quat_wxyz = random_poses(sum(parts.values()), seed=3)
        generator = torch.Generator().manual_seed(5)
        pose = torch.cat([position_m, quat_wxyz], dim=-1)
        features = pose @ torch.randn(7, D, generator=generator)
        features += torch.randn(features.shape, generator=generator)
        whole = PoseBatch(features, position_m, quat_wxyz, torch.arange(len(features)))
        cut = zip(*(tensor.split(list(parts.values())) for tensor in whole), strict=True)
        self.splits = {split: PoseDataset(PoseBatch(*part)) for split, part in zip(parts, cut, strict=True)}
        self.data, self.held = self.splits["train"], self.splits["val"].data

    def val_dataloader(self) -> DataLoader[PoseBatch] | list[Any]:
        return make_loader(self.dataset("val"), batch_size=5, shuffle=False) if len(self.held.frame) else []

    def describe(self) -> dict[str, str]:
        return {"class_path": "noise"}


def fit(
    problem: NoisyProblem, folder: Path | None = None, epochs: int = 1, limit: float = 1.0, **settings: Any
) -> LinearPoseNet:
    model = LinearPoseNet(input_shape=[D], **settings)
    trainer = Trainer(
        max_epochs=epochs,
        limit_train_batches=limit,
        accelerator="cpu",
        logger=False,
        callbacks=[BestCheckpoint(), LastCheckpoint()] if folder else [],
        enable_checkpointing=folder is not None,
        default_root_dir=folder,
        enable_progress_bar=False,
        enable_model_summary=False,
    )
    trainer.fit(model, datamodule=problem)
    assert trainer.current_epoch == 1, "one pass is all there is"
    return model.eval()


def arrays(model: LinearPoseNet, data: PoseBatch) -> tuple[np.ndarray, np.ndarray]:
    quat_wxyz = align_hemisphere(data.quat_wxyz, model.quat_reference)
    return data.features.double().numpy(), torch.cat([data.position_m, quat_wxyz], dim=1).double().numpy()


def check_predicts(model: LinearPoseNet, theirs: Any, features: torch.Tensor) -> None:
    """The same poses as scikit-learn's, the quaternion normalised."""
    expected = theirs.predict(features.double().numpy())
    position_m, quat_wxyz = model(features)
    np.testing.assert_allclose(position_m.detach().numpy(), expected[:, :3], rtol=1e-5, atol=1e-5)
    expected = expected[:, 3:] / np.linalg.norm(expected[:, 3:], axis=1, keepdims=True)
    np.testing.assert_allclose(quat_wxyz.detach().numpy(), expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("standardize", [True, False])
@pytest.mark.parametrize("components", [None, 5])
def test_it_is_scikit_learns_ridge(standardize: bool, components: int | None) -> None:
    problem = NoisyProblem(val=0)
    model = fit(problem, lambdas=[3.0], components=components, standardize=standardize)
    theirs = Ridge(3.0) if components is None else make_pipeline(PCA(5, svd_solver="full"), Ridge(3.0))
    theirs.fit(*arrays(model, problem.data.data))
    check_predicts(model, theirs, problem.data.data.features)


@pytest.mark.parametrize("limit", [0.5, 1], ids=["half of them", "one batch"])
def test_a_limit_on_batches_limits_what_it_learns_from(limit: float, monkeypatch: pytest.MonkeyPatch) -> None:
    problem = NoisyProblem(val=0)
    half = PoseDataset(PoseBatch(*(tensor[:20] for tensor in problem.data.data)))
    monkeypatch.setattr(problem, "train_dataloader", lambda: make_loader(problem.data, batch_size=20, shuffle=False))
    model = fit(problem, limit=limit, lambdas=[3.0], standardize=False)
    check_predicts(model, Ridge(3.0).fit(*arrays(model, half.data)), problem.data.data.features)


def test_refit_learns_from_the_validation_frames_too() -> None:
    problem = NoisyProblem()
    kept, refitted = (fit(problem, lambdas=[3.0], refit=refit) for refit in (False, True))
    train, held = arrays(kept, problem.data.data), arrays(kept, problem.held)
    check_predicts(kept, Ridge(3.0).fit(*train), problem.held.features)
    both = [np.concatenate(parts) for parts in zip(train, held, strict=True)]
    check_predicts(refitted, Ridge(3.0).fit(*both), problem.held.features)


def test_the_lambda_with_the_lowest_validation_loss_is_kept() -> None:
    problem = NoisyProblem()
    problem.splits["test"].data.features.neg_()  # by these frames the strongest lambda would be best
    lambdas = [1e-3, 1.0, 30.0, 1e5]
    loss = LossConfig(form="split", orientation_weight=10.0, normalize_quat=True)
    chosen = fit(problem, lambdas=lambdas, refit=False, loss=loss)
    losses = []
    for strength in lambdas:
        alone = fit(problem, lambdas=[strength], refit=False, loss=loss)
        losses.append(float(alone.trainer.callback_metrics["val/loss"]))
    assert float(chosen.trainer.callback_metrics["val/loss"]) == pytest.approx(min(losses))
    assert float(chosen.trainer.callback_metrics["train/lambda"]) == pytest.approx(lambdas[int(np.argmin(losses))])


def test_metrics_and_checkpoints_are_written(tmp_path: Path) -> None:
    problem = NoisyProblem()
    model = fit(problem, tmp_path, epochs=3, lambdas=[1.0, 10.0])
    names = {"train/loss", "val/loss", "val/position_median_m", "val/orientation_median_deg", "train/lambda"}
    assert names <= model.trainer.callback_metrics.keys()
    for name in ("best", "last"):
        (file,) = tmp_path.rglob(f"{name}.ckpt")
        saved = torch.load(file, weights_only=True)["state_dict"]
        torch.testing.assert_close(saved["network.weight"], model.network.weight.detach())
    again = LinearPoseNet(input_shape=[D], lambdas=[1.0, 10.0])
    trainer = Trainer(max_epochs=2, accelerator="cpu", logger=False, enable_checkpointing=False,
                      enable_progress_bar=False, enable_model_summary=False)  # fmt: skip
    trainer.fit(again, datamodule=problem, ckpt_path=str(file), weights_only=True)
    torch.testing.assert_close(again.network.weight, model.network.weight)


@pytest.mark.parametrize(("components", "count"), [(None, 14336), (280, 1960)])
def test_the_thesis_counts_its_parameters(components: int | None, count: int, tmp_path: Path) -> None:
    model = LinearPoseNet(input_shape=[2048], components=components)
    assert sum(parameter.numel() for parameter in model.network.parameters()) == count
    torch.save(model.state_dict(), tmp_path / "weights")
    assert (tmp_path / "weights").stat().st_size < 100_000


@pytest.mark.parametrize(("components", "numbers"), [(None, 2048), (280, 280)])
def test_components_save_bytes_of_frames_and_weights(components: int | None, numbers: int) -> None:
    model = LinearPoseNet(input_shape=[2048], components=components)
    assert model.reduced_shape == (numbers,)
    assert 7 * numbers * 4 <= measure_weights(model.network) < 7 * numbers * 4 + 2500


def test_headline_names_what_differs() -> None:
    assert LinearPoseNet(input_shape=[32]).headline == "D=32"
    assert LinearPoseNet(input_shape=[32], components=8).headline == "D=32 components=8"


@pytest.mark.parametrize("lambdas", [[], [0.0], [1.0, -2.0]])
def test_lambdas_out_of_range_are_refused(lambdas: list[float]) -> None:
    with pytest.raises(ConfigError, match=r"lambdas is \[.*; give one or more numbers above 0"):
        LinearPoseNet(input_shape=[D], lambdas=lambdas)


def test_no_components_are_refused() -> None:
    with pytest.raises(ConfigError, match="components is 0; give 1 or more"):
        LinearPoseNet(input_shape=[D], components=0)


def test_several_lambdas_without_validation_frames_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"lambdas is \[1.0, 2.0\], .*give one, or set data.val_fraction"):
        fit(NoisyProblem(val=0), lambdas=[1.0, 2.0])


def test_a_frame_that_a_sampler_repeats_counts_once(monkeypatch: pytest.MonkeyPatch) -> None:
    data = NoisyProblem(count=7, val=0).data.data
    for rank, own in ((0, 4), (1, 3)):  # two processes take 4 frames each of 7; the second's last is a repetition
        model = LinearPoseNet(input_shape=[D])
        monkeypatch.setattr(LinearPoseNet, "trainer", type("Two", (), SETTINGS | {"global_rank": rank})())
        model.on_train_epoch_start()
        for rows in (slice(0, 3), slice(3, 4)):
            model.add_frames(PoseBatch(*(tensor[rows] for tensor in data)), frames=7)
        assert model.moments.count == own
