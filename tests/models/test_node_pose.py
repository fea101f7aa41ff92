"""NodePose: what queries receive, the memory in its checkpoint, and its sizes."""
# pyright: reportCallIssue=false, reportAttributeAccessIssue=false, reportIndexIssue=false
# (torch types what modules hold as Tensor or Module, which layers here are known not to be)

from __future__ import annotations

from itertools import combinations
from typing import Any

import pytest
import torch
from lightning import Trainer
from torch import Tensor
from torch_geometric.nn import GATConv, GCNConv, GraphConv

from lightning_pose.data.batches import PoseBatch
from lightning_pose.errors import CheckpointError, ConfigError
from lightning_pose.geometry.quaternions import align_hemisphere, orientation_error_deg
from lightning_pose.models import NodePose
from lightning_pose.models.parts.neighbour_graph import list_edges, sample_neighbours, search_neighbours
from tests.models.helpers import LearnableProblem, random_poses

WIDTH = 16
CONVOLUTIONS = ["wl", "gcn", "SAGEConv", "GATConv", "GATv2Conv", "TransformerConv"]


def frames(count: int, seed: int = 0) -> PoseBatch:
    features = torch.randn(count, WIDTH, generator=torch.Generator().manual_seed(seed))
    return PoseBatch(features, *random_poses(count, seed), torch.arange(count))


def make(count: int = 30, **settings: Any) -> NodePose:
    torch.manual_seed(0)
    settings = {"neighbours": 3, "channels": [12, 8, 8], **settings}
    model = NodePose(input_shape=[WIDTH], **settings)
    train = frames(count)
    model.fit_scale(train.position_m, train.quat_wxyz)
    model.fit_feature_scale(train.features)
    model.store_training(train)
    return model.eval()


def make_like(model: NodePose) -> NodePose:
    """The same weights, in a model that computes the whole graph in every step."""
    other = make()
    other.load_state_dict(model.state_dict())
    return other


def decode(model: NodePose, features: Tensor) -> Tensor:
    return torch.cat(model.decode_features(features), dim=1)


@pytest.mark.parametrize("neighbour_poses", [0, 2])
@pytest.mark.parametrize("conv", CONVOLUTIONS)
def test_an_answer_does_not_depend_on_the_batch(conv: str, neighbour_poses: int) -> None:
    model = make(conv=conv, neighbour_poses=neighbour_poses)
    queries = frames(9, seed=1).features
    together = decode(model, queries)
    for size in (1, 2, 5):
        apart = torch.cat([decode(model, part) for part in queries.split(size)])
        torch.testing.assert_close(apart, together, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(decode(model, queries.repeat(3, 1))[:9], together, atol=1e-5, rtol=1e-5)


def test_queries_never_affect_each_other() -> None:
    model = make(neighbour_poses=2)
    queries = frames(4, seed=1).features.requires_grad_()
    for row, pose in enumerate(decode(model, queries)):
        (gradient,) = torch.autograd.grad(pose.sum(), queries, retain_graph=True)
        assert gradient.any(1).nonzero().flatten().tolist() == [row]


@pytest.mark.parametrize(("conv", "layer"), [("wl", GraphConv), ("gcn", GCNConv), ("GATConv", GATConv)])
def test_it_equals_pyg_on_the_joint_graph_of_training_images_and_queries(conv: str, layer: type) -> None:
    model = make(conv=conv, neighbour_poses=0)
    queries = frames(5, seed=1).features
    nodes = torch.cat([model.memory_features, queries])
    table = torch.cat(
        [
            model.memory_table,
            search_neighbours(*(torch.nn.functional.normalize(x, dim=1) for x in (queries, model.memory_features)), 3),
        ]
    )
    state, edges = (nodes - model.feature_mean) / model.feature_scale, list_edges(table)
    for convolution in model.network.convolutions:
        plain = layer(*(12, 8) if state.shape[1] == 12 else (state.shape[1], convolution.layer.out_channels))
        plain.load_state_dict(convolution.layer.state_dict())
        state = plain(state, edges).relu()
    expected = model.network.heads(state[30:]) * model.pose_scale + model.pose_mean
    torch.testing.assert_close(decode(model, queries), expected, atol=1e-5, rtol=1e-5)


def test_training_sees_no_pose_but_the_target() -> None:
    model = make(neighbour_poses=2).train()
    before = torch.cat(model.decode_batch(frames(30)), dim=1)
    model.memory_pose = torch.zeros_like(model.memory_pose)
    torch.testing.assert_close(torch.cat(model.decode_batch(frames(30)), dim=1), before, atol=0, rtol=0)


def test_the_nearest_neighbours_correct_the_answer() -> None:
    batch, queries = frames(30), frames(4, seed=1).features
    plain, model = make(neighbour_poses=0), make(neighbour_poses=2, slope=0.25)
    with torch.no_grad():
        own, known = decode(plain, queries), torch.cat(plain.train().decode_batch(batch), dim=1)
    pose = torch.cat([batch.position_m, align_hemisphere(batch.quat_wxyz, model.quat_reference)], dim=1)
    keys = (torch.nn.functional.normalize(features, dim=1) for features in (queries, batch.features))
    nearest = search_neighbours(*keys, 2)
    expected = (pose[nearest] + 0.25 * (own[:, None] - known[nearest])).mean(1)
    torch.testing.assert_close(decode(model, queries), expected, atol=1e-5, rtol=1e-5)


def test_a_slope_of_zero_is_retrieval() -> None:
    model = make(neighbour_poses=1, slope=0.0)
    position_m, quat_wxyz = model(frames(30).features[[4, 9]])
    torch.testing.assert_close(position_m.float(), frames(30).position_m[[4, 9]])
    assert orientation_error_deg(quat_wxyz, frames(30).quat_wxyz[[4, 9]]).max() < 0.1


def test_a_sampled_graph_with_all_neighbours_is_the_full_graph() -> None:
    batch = PoseBatch(*(tensor[[3, 20, 11]] for tensor in frames(30)))
    full = torch.cat(make().train().decode_batch(batch), dim=1)
    sampled = torch.cat(make(full_graph_limit=0).train().decode_batch(batch), dim=1)
    torch.testing.assert_close(sampled, full, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("aggr", [None, "add", "mean", "max"])
@pytest.mark.parametrize("conv", ["wl", "gcn", "SAGEConv"])
def test_above_the_limit_training_is_of_the_model_that_is_evaluated(conv: str, aggr: str | None) -> None:
    batch, settings = frames(30), {"conv": conv, "aggr": aggr, "neighbours": 12, "neighbour_poses": 0}
    full = torch.cat(make(**settings).train().decode_batch(batch), dim=1)
    large = make(full_graph_limit=0, fanout=3, **settings).train()
    trained = torch.cat(large.decode_batch(batch), dim=1)
    if large.network.takes_means:
        assert not torch.allclose(trained, full), "neighbours are drawn"
        first = large.network.convolutions[0]
        state = large.memory_features
        exact = first(state, state, list_edges(large.memory_table))
        drawn = [first(state, state, list_edges(sample_neighbours(large.memory_table, 3))) for _ in range(400)]
        torch.testing.assert_close(torch.stack(drawn).mean(0), exact, atol=0.1, rtol=0)
    else:
        torch.testing.assert_close(trained, full, atol=1e-5, rtol=1e-5)


def test_above_the_limit_neighbours_count_as_they_were_last_computed_and_anew_in_each_epoch() -> None:
    first, other = (PoseBatch(*(tensor[rows] for tensor in frames(30))) for rows in (slice(0, 4), slice(20, 24)))
    model = make(full_graph_limit=0).train()
    model.decode_batch(first)
    with torch.no_grad():
        for parameter in model.network.convolutions[0].parameters():
            parameter.mul_(2)
    full = torch.cat(make_like(model).train().decode_batch(other), dim=1)
    assert not torch.allclose(torch.cat(model.decode_batch(other), dim=1), full)
    model.on_train_epoch_start()
    torch.testing.assert_close(torch.cat(model.decode_batch(other), dim=1), full, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize(
    ("conv", "aggr", "takes"),
    [("wl", "mean", True), ("SAGEConv", None, True), ("wl", None, False), ("wl", "max", False), ("gcn", None, False),
     ("gcn", "mean", False), ("GATConv", "mean", False), ("TransformerConv", "mean", False)],
)  # fmt: skip
def test_neighbours_are_drawn_where_their_mean_is_all_that_counts(conv: str, aggr: str | None, takes: bool) -> None:
    assert make(conv=conv, aggr=aggr).network.takes_means == takes


def test_memory_is_in_the_order_of_frames() -> None:
    train = frames(30)
    model, shuffled = make(), make()
    shuffled.store_training(PoseBatch(*(tensor.flip(0) for tensor in train)))
    queries = frames(5, seed=1).features
    torch.testing.assert_close(decode(shuffled, queries), decode(model, queries))
    assert torch.equal(shuffled.memory_frame, torch.arange(30))


def test_memory_is_the_training_split() -> None:
    problem = LearnableProblem([WIDTH])
    model = NodePose(input_shape=[WIDTH], neighbours=3, channels=[12, 8])
    Trainer(max_epochs=1, accelerator="cpu", logger=False, enable_checkpointing=False,
            enable_progress_bar=False, enable_model_summary=False).fit(model, datamodule=problem)  # fmt: skip
    assert torch.equal(model.memory_features, problem.data.data.features)
    assert torch.equal(model.memory_frame, problem.data.data.frame)
    torch.testing.assert_close(
        model.memory_pose[:, :3] * model.pose_scale[:3] + model.pose_mean[:3], problem.data.data.position_m
    )


def test_frames_within_the_gap_are_not_joined() -> None:
    table = make(gap=10).memory_table
    own = torch.arange(30)[:, None]
    assert ((table - own).abs() >= 10).all()
    pairs = list(combinations(range(30), 2))
    assert any(abs(i - j) < 10 for i, j in pairs if j in make().memory_table[i])


def test_answers_follow_the_weights() -> None:
    model = make()
    queries = frames(3, seed=1).features
    before = decode(model, queries).detach()
    model.train().decode_batch(frames(30))  # as a step would, after which Lightning sets `training` by itself
    with torch.no_grad():
        model.network.convolutions[0].layer.lin_rel.weight.mul_(2)
    for module in model.modules():
        module.training = False
    assert not torch.allclose(decode(model, queries), before)


def test_answers_under_inference_mode_can_be_followed_by_gradients() -> None:
    model = make()
    queries = frames(3, seed=1).features
    with torch.inference_mode():
        model(queries)
    model(queries).position_m.sum().backward()


@pytest.mark.parametrize("way", ["load_state_dict", "on_load_checkpoint"])
def test_a_checkpoint_brings_its_memory(way: str) -> None:
    model = make(neighbour_poses=2)
    fresh = NodePose(input_shape=[WIDTH], neighbours=3, channels=[12, 8, 8], neighbour_poses=2).eval()
    if way == "on_load_checkpoint":
        fresh.on_load_checkpoint({"state_dict": model.state_dict()})
    fresh.load_state_dict(model.state_dict())
    queries = frames(5, seed=1).features
    torch.testing.assert_close(decode(fresh, queries), decode(model, queries), atol=0, rtol=0)


def test_a_checkpoint_of_other_features_or_neighbours_is_refused() -> None:
    saved = {"state_dict": make().state_dict()}
    with pytest.raises(CheckpointError, match=r"\(16,\) in the checkpoint and \(17,\) here.*data.extractor"):
        NodePose(input_shape=[WIDTH + 1], neighbours=3, channels=[12, 8, 8]).on_load_checkpoint(saved)
    with pytest.raises(CheckpointError, match=r"memory_table has shape \(30, 3\) .* \(30, 4\) here"):
        NodePose(input_shape=[WIDTH], neighbours=4, channels=[12, 8, 8]).on_load_checkpoint(saved)


def test_fewer_training_images_than_neighbours_will_do() -> None:
    model = make(count=2, neighbours=5, neighbour_poses=2)
    assert decode(model, frames(3, seed=1).features).isfinite().all()
    assert torch.cat(model.train().decode_batch(frames(2)), dim=1).isfinite().all()


@pytest.mark.parametrize(("conv", "factor"), [("wl", 2), ("gcn", 1)])
def test_parameters_of_the_thesis(conv: str, factor: int) -> None:
    model = NodePose(input_shape=[2048], conv=conv)
    weights = 2048 * 256 + 256 * 128 + 128 * 64
    assert sum(p.numel() for p in model.network.parameters()) == factor * weights + 256 + 128 + 64 + 65 * 7


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"neighbours": 0}, r"neighbours is 0; give 1 or more"),
        ({"gap": 0}, r"gap is 0; give 1 or more"),
        ({"fanout": 0}, r"fanout is 0; give 1 or more"),
        ({"neighbour_poses": 6}, r"neighbour_poses is 6 and neighbours is 5; give 0 to"),
        ({"channels": []}, r"channels are \[\].*give widths"),
        ({"dropout": 1.0}, r"dropout is 1.0; give"),
        ({"conv": "NoConv"}, r"conv 'NoConv' .*cannot be built.*give wl, gcn"),
        ({"conv": "ChebConv"}, r"conv 'ChebConv' .*cannot be built.*SAGEConv"),
        ({"aggr": "sideways"}, r"aggr 'sideways' cannot be built"),
    ],
)
def test_settings_out_of_range_are_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        NodePose(input_shape=[WIDTH], **settings)
