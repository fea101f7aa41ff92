"""DensePoseNet: the thesis's sizes, its principal components, and its refusals."""

from __future__ import annotations

import io

import numpy as np
import pytest
import torch
from lightning import Trainer
from sklearn.decomposition import PCA

from lightning_pose.errors import ConfigError
from lightning_pose.evaluation.costs import measure_weights
from lightning_pose.models import DensePoseNet
from tests.models.helpers import LearnableProblem


@pytest.mark.parametrize(("components", "count"), [(None, 566_151), (280, 113_543)])
def test_the_thesis_counts_its_parameters(components: int | None, count: int) -> None:
    network = DensePoseNet(input_shape=[2048], components=components).network
    assert sum(parameter.numel() for parameter in network.parameters()) == count


def test_it_reads_principal_components_of_the_training_features() -> None:
    problem = LearnableProblem([32])
    for data in problem.splits.values():
        data.data.features.add_(torch.linspace(1, 2, 32))  # their mean is a component only if it is not taken away
    model = DensePoseNet(input_shape=[32], components=4, standardize_features=False)
    trainer = Trainer(max_epochs=1, accelerator="cpu", logger=False, enable_checkpointing=False,
                      enable_progress_bar=False, enable_model_summary=False)  # fmt: skip
    trainer.fit(model, datamodule=problem)
    features = problem.data.data.features
    ours = model.network[0](features).double().numpy()  # type: ignore[index]
    theirs = PCA(4, svd_solver="full").fit_transform(features.double().numpy())
    assert np.square(ours).mean() == pytest.approx(1, rel=1e-3)
    theirs *= np.sign((ours * theirs).sum(0)) / np.sqrt(np.square(theirs).mean())
    np.testing.assert_allclose(ours, theirs, atol=3e-3)  # half precision
    assert not any("components" in name for name, _ in model.named_parameters()), "they are not trained"
    rebuilt = DensePoseNet(input_shape=[32], components=4, standardize_features=False)
    rebuilt.load_state_dict(model.state_dict())
    torch.testing.assert_close(rebuilt.eval()(features), model.eval()(features))


def test_components_save_bytes_of_frames_and_of_files() -> None:
    whole, reduced = (DensePoseNet(input_shape=[2048], components=components) for components in (None, 280))
    assert (whole.reduced_shape, reduced.reduced_shape) == ((2048,), (280,))
    sizes = [measure_weights(model.network) for model in (whole, reduced)]
    assert sizes == pytest.approx([566_151 * 4, 113_543 * 4], rel=0.02)
    files = [io.BytesIO(), io.BytesIO()]
    for model, file in zip((whole, reduced), files, strict=True):
        torch.save(model.state_dict(), file)
    assert len(files[1].getvalue()) < 0.75 * len(files[0].getvalue()), "the components included"


def test_relu_follows_each_layer_but_the_last() -> None:
    model = DensePoseNet(input_shape=[8], units=[6, 5])
    features = torch.randn(20, 8, generator=torch.Generator().manual_seed(0))
    linear = [module for module in model.network if isinstance(module, torch.nn.Linear)]  # type: ignore[union-attr]
    expected = features
    for layer in linear[:-1]:
        expected = (expected @ layer.weight.T + layer.bias).clamp(min=0)
    expected = expected @ linear[-1].weight.T + linear[-1].bias
    torch.testing.assert_close(model.eval().network(features), expected)  # type: ignore[operator]


def test_headline_names_what_differs() -> None:
    assert DensePoseNet(input_shape=[32]).headline == "D=32"
    assert DensePoseNet(input_shape=[32], components=8).headline == "D=32 components=8"


def test_more_components_than_there_are_is_refused() -> None:
    model = DensePoseNet(input_shape=[32], components=30)
    with pytest.raises(ConfigError, match="components is 30, but the training features have only 7 principal"):
        Trainer(accelerator="cpu", logger=False, enable_checkpointing=False).fit(
            model, datamodule=LearnableProblem([32])
        )


def test_sizes_out_of_range_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"units is \[\]; give the width of one layer or more"):
        DensePoseNet(input_shape=[32], units=[])
    with pytest.raises(ConfigError, match="components is 0; give 1 or more"):
        DensePoseNet(input_shape=[32], components=0)
