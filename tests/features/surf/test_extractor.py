"""Tests of SURF: agreement with OpenCV 4.12's answers, and what must hold on any image.

`data/surf_opencv.npz` holds, for four made images, the 100 strongest keypoints (x, y, size, response, and
angle where oriented) and descriptors (in 127ths) of OpenCV's SURF with 4 octaves of 3 layers and threshold 1.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor

from lightning_pose.errors import ConfigError, ImageError
from lightning_pose.features.surf import SURF
from lightning_pose.features.surf.descriptor import compute_descriptors, compute_orientations
from lightning_pose.features.surf.detector import detect_keypoints, find_maxima, find_maxima_in_strips
from lightning_pose.features.surf.hessian import (
    LAYERS,
    OCTAVES,
    compute_determinants,
    compute_determinants_at,
    compute_integral_image,
    compute_margin,
)

REFERENCE = np.load(Path(__file__).parent / "data" / "surf_opencv.npz")
TEXTURED = ("blobs", "shapes", "fractal")


def image(name: str) -> Tensor:
    return torch.from_numpy(REFERENCE[f"{name}_image"])[None]


def texture(height: int = 240, width: int = 320, seed: int = 0) -> Tensor:
    noise = np.random.default_rng(seed).integers(0, 256, (height // 8 + 2, width // 8 + 2), np.uint8)
    large = cv2.resize(noise, None, fx=8, fy=8, interpolation=cv2.INTER_CUBIC)
    return torch.from_numpy(large[:height, :width].copy())[None]


def matches(wanted: Tensor, found: Tensor, pixels: float = 1.5, scale: float = 0.2) -> tuple[Tensor, Tensor]:
    """For each wanted keypoint: the nearest found one of similar size, and whether it is close enough."""
    away = (wanted[:, None, :2] - found[:, :2]).norm(dim=2)
    away[(wanted[:, 2:3] - found[:, 2]).abs() > scale * wanted[:, 2:3]] = torch.inf
    distance, nearest = away.min(1)
    return nearest, distance < pixels


def similarity(wanted: Tensor, found: Tensor) -> float:
    return (wanted * found).sum(1).median().item()


@pytest.mark.parametrize("name", TEXTURED)
@pytest.mark.parametrize("upright", [True, False])
def test_agrees_with_opencv(name: str, upright: bool) -> None:
    prefix = name if upright else f"{name}_oriented"
    keypoints = torch.from_numpy(REFERENCE[f"{prefix}_keypoints"])
    descriptors = torch.from_numpy(REFERENCE[f"{prefix}_descriptors"]) / 127
    found = SURF(300, upright, threshold=1)(image(name))
    nearest, close = matches(keypoints, found.keypoints[0, : int(found.count)], pixels=0.1, scale=0.01)
    assert close.float().mean() >= 0.99
    ours = found.keypoints[0, nearest[close]]
    np.testing.assert_allclose(ours[:, 3], keypoints[close, 3], rtol=1e-4, atol=0)
    assert similarity(descriptors[close], found.descriptors[0, nearest[close]]) > 0.999
    turn = (ours[:, 4] - (270 if upright else keypoints[close, 4]) + 180) % 360 - 180
    assert turn.abs().median() < 0.1


@pytest.mark.parametrize("upright", [True, False])
def test_low_texture_gives_few_features_and_zero_rows(upright: bool) -> None:
    found = SURF(300, upright, threshold=1)(image("low_texture"))
    count = int(found.count)
    assert count == len(REFERENCE["low_texture_keypoints"])
    assert found.keypoints[0, :count, 3].min() > 1
    assert not found.keypoints[0, count:].any()
    assert not found.descriptors[0, count:].any()


@pytest.mark.parametrize("upright", [True, False])
def test_rows_are_sorted_and_normalised(upright: bool) -> None:
    keypoints, descriptors, count = SURF(200, upright)(texture())
    assert (keypoints.shape, descriptors.shape, count.tolist()) == ((1, 200, 5), (1, 200, 64), [200])
    assert (keypoints.dtype, descriptors.dtype, count.dtype) == (torch.float32, torch.float32, torch.int64)
    assert (keypoints[0, :, 3].diff() <= 0).all()
    np.testing.assert_allclose(descriptors.norm(dim=-1), 1, rtol=1e-5)
    angle = keypoints[0, :, 4]
    assert (angle == 270).all() if upright else ((angle >= 0) & (angle < 360)).all() and angle.std() > 30


@pytest.mark.parametrize("level", [0, 77, 255])
@pytest.mark.parametrize("upright", [True, False])
def test_blank_image_is_all_zeros(level: int, upright: bool) -> None:
    found = SURF(20, upright)(torch.full((2, 120, 90), level, dtype=torch.uint8))
    assert not any(t.any() for t in found)


@pytest.mark.parametrize("shape", [(1, 1), (1, 500), (8, 9), (22, 22), (23, 23), (27, 40), (33, 33), (45, 61)])
@pytest.mark.parametrize("upright", [True, False])
def test_tiny_images(shape: tuple[int, int], upright: bool) -> None:
    found = SURF(20, upright)(texture(*shape))
    assert found.keypoints.shape == (1, 20, 5)
    assert found.descriptors.isfinite().all()
    if min(shape) < 22:
        assert not any(t.any() for t in found)


@pytest.mark.parametrize("shape", [(241, 319), (133, 401), (480, 35)])
def test_odd_sizes(shape: tuple[int, int]) -> None:
    keypoints, _, count = SURF(20)(texture(*shape))
    x, y = keypoints[0, : int(count), :2].unbind(1)
    assert count > 5
    assert ((x > 0) & (x < shape[1]) & (y > 0) & (y < shape[0])).all()


def test_no_images_give_no_features() -> None:
    assert SURF(20)(torch.zeros((0, 50, 60), dtype=torch.uint8)).descriptors.shape == (0, 20, 64)


def test_batch_equals_single() -> None:
    images = torch.cat([texture(seed=s) for s in range(3)] + [torch.zeros((1, 240, 320), dtype=torch.uint8)])
    together = SURF(80)(images)
    for i in range(4):
        for one, all_ in zip(SURF(80)(images[i : i + 1]), together, strict=True):
            np.testing.assert_allclose(one[0], all_[i], atol=1e-6, rtol=0)


@pytest.mark.parametrize("n", [80, 700])
def test_stages_work_on_batches(n: int) -> None:
    images = torch.cat([texture(120, 160), torch.zeros((1, 120, 160), dtype=torch.uint8), texture(120, 160, seed=1)])
    integral = compute_integral_image(images)
    together = detect_keypoints(integral, n, 0.0)
    index = torch.arange(3).repeat_interleave(n)
    place = together.xy.flatten(0, 1), together.size.flatten()
    angles = compute_orientations(integral, index, *place).view(3, n)
    descriptors = compute_descriptors(integral, index, *place, angles.flatten()).view(3, n, 64)
    for i in range(3):
        alone = detect_keypoints(integral[i : i + 1], n, 0.0)
        assert all(torch.equal(a[0], b[i]) for a, b in zip(alone, together, strict=True))
        one = compute_descriptors(integral[i : i + 1], index[:n], alone.xy[0], alone.size[0], angles[i])
        np.testing.assert_allclose(
            compute_orientations(integral[i : i + 1], index[:n], alone.xy[0], alone.size[0]),
            angles[i],
            atol=1e-2,
            rtol=0,
        )
        np.testing.assert_allclose(one, descriptors[i], atol=1e-6, rtol=0)


@pytest.mark.parametrize("shape", [(240, 320), (61, 700), (33, 40), (22, 22)])
def test_strips_find_the_maxima_that_whole_planes_have(shape: tuple[int, int]) -> None:
    integral = compute_integral_image(texture(*shape))
    (_, *wanted), (_, *found) = find_maxima(integral, 0.5), find_maxima_in_strips(integral[0], 0.5)
    count = int((wanted[2] > 0).sum())
    assert count > 500 if shape == (240, 320) else count == found[0].shape[1]
    assert all(torch.equal(a[:, :count], b) for a, b in zip(wanted, found, strict=True))


def test_memory_made_in_inference_mode_serves_outside_it() -> None:
    integral = compute_integral_image(texture(120, 168))[0]
    with torch.inference_mode():
        _, *wanted = find_maxima_in_strips(integral, 0.5)
    _, *found = find_maxima_in_strips(integral, 0.5)
    assert all(torch.equal(a, b) for a, b in zip(wanted, found, strict=True))


def test_threads_do_not_share_memory() -> None:
    surf, images = SURF(100), [texture(seed=seed) for seed in range(8)]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(surf, images))
    for image_, found in zip(images, together, strict=True):
        assert all(torch.equal(a, b) for a, b in zip(surf(image_), found, strict=True))


def test_a_few_are_a_prefix_of_many() -> None:
    few, many = SURF(50)(image("shapes")), SURF(700)(image("shapes"))
    assert torch.equal(few.keypoints, many.keypoints[:, :50])
    np.testing.assert_allclose(few.descriptors, many.descriptors[:, :50], atol=1e-6, rtol=0)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_float_equals_uint8(dtype: torch.dtype) -> None:
    gray = texture()
    for a, b in zip(SURF(50)(gray), SURF(50)(gray.to(dtype) / 255), strict=True):
        assert torch.equal(a, b)


def test_threshold_keeps_the_strong() -> None:
    every = SURF(300)(texture())
    limit = every.keypoints[0, 40, 3].item()
    strong = SURF(300, threshold=limit)(texture())
    assert strong.count.item() == 40
    assert torch.equal(strong.keypoints[0, :40], every.keypoints[0, :40])


def test_translation_moves_keypoints() -> None:
    large = texture(300, 400)
    here, there = SURF(100)(large[:, :280, :360]), SURF(400)(large[:, 16:, 24:])
    moved = here.keypoints[0] - torch.tensor([24.0, 16.0, 0, 0, 0])
    window = 1.4 * moved[:, 2:3] + 2
    inside = ((moved[:, :2] > window) & (moved[:, :2] < torch.tensor([336.0, 264.0]) - window)).all(1)
    assert inside.sum() > 20
    nearest, close = matches(moved[inside], there.keypoints[0], pixels=0.01, scale=0.001)
    assert close.all()
    np.testing.assert_allclose(here.descriptors[0, inside], there.descriptors[0, nearest], atol=1e-4, rtol=0)


def test_oriented_descriptors_turn_with_the_image() -> None:
    gray = texture(256, 256)
    turned = gray.rot90(dims=(1, 2))  # counterclockwise: (x, y) -> (y, 255 - x)
    for upright, same in ((False, True), (True, False)):
        here, there = SURF(60, upright)(gray), SURF(200, upright)(turned.contiguous())
        x, y, size = here.keypoints[0, :, :3].unbind(1)
        nearest, close = matches(torch.stack([y, 255 - x, size], 1), there.keypoints[0])
        assert close.float().mean() > 0.9
        assert (similarity(here.descriptors[0, close], there.descriptors[0, nearest[close]]) > 0.98) is same
        if not upright:
            turn = (here.keypoints[0, close, 4] - there.keypoints[0, nearest[close], 4]) % 360
            assert (turn - 90).abs().median() < 2


def test_integral_images_are_exact_beyond_int32() -> None:
    integral = compute_integral_image(torch.full((1, 3000, 3000), 255, dtype=torch.uint8))[0]
    assert integral[0].eq(0).all()
    assert integral[:, 0].eq(0).all()
    assert integral[-1, -1] < 0  # wrapped around
    box = integral[-1, -1] - integral[-1, -101] - integral[-101, -1] + integral[-101, -101]
    assert box == 255 * 100 * 100


@pytest.mark.parametrize("octave", range(OCTAVES))
@pytest.mark.parametrize("layer", range(LAYERS))
def test_determinants_of_a_grid_and_of_single_samples_agree(octave: int, layer: int) -> None:
    integral = compute_integral_image(texture(300, 340))
    first = compute_margin(layer)
    n, m = (300 >> octave) - 2 * first, (340 >> octave) - 2 * first
    grid = torch.empty(1, n, m)
    compute_determinants(integral, octave, layer, first, torch.empty(4, integral.numel()), grid)
    row, col = (
        t.flatten() for t in torch.meshgrid(torch.arange(1, n - 1, 5), torch.arange(1, m - 1, 3), indexing="ij")
    )
    every = torch.full_like(row, octave), torch.full_like(row, layer), torch.zeros_like(row)
    single = compute_determinants_at(integral, *every, row + first, col + first)
    around = torch.stack([grid[0, row + i, col + j] for i in (-1, 0, 1) for j in (-1, 0, 1)]).view_as(single)
    np.testing.assert_allclose(single, around, rtol=1e-4, atol=grid.abs().max().item() * 1e-6)


def test_every_tensor_is_made_on_the_device_of_the_images() -> None:
    gray = texture()
    for upright in (True, False):
        wanted = SURF(50, upright)(gray)
        with torch.device("meta"):  # a tensor made on the default device would not mix with the images
            found = SURF(50, upright)(gray)
        assert all(torch.equal(a, b) for a, b in zip(wanted, found, strict=True))


def test_records() -> None:
    small, large = texture(120, 100)[0].numpy(), texture()[0].numpy()
    surf = SURF(50, threshold=0.5)
    records = surf.extract([large, small, large])
    for record, (height, width) in zip(records, [large.shape, small.shape, large.shape], strict=True):
        assert {k: (v.dtype, v.shape) for k, v in record.items()} == {
            "descriptors": (np.float32, (300, 64)),
            "keypoints": (np.float32, (300, 5)),
            "count": (np.int64, ()),
            "image_size": (np.int64, (2,)),
        }
        np.testing.assert_array_equal(record["image_size"], (width, height))
    np.testing.assert_array_equal(records[0]["descriptors"], records[2]["descriptors"])
    wanted = SURF(300, threshold=0.5)(torch.from_numpy(small)[None])
    np.testing.assert_array_equal(records[1]["keypoints"], wanted.keypoints[0].numpy())
    assert records[1]["count"] == wanted.count.item()
    assert surf.features(records[0]).shape == surf.feature_shape == (50, 64)
    assert SURF(50, with_geometry=True).features(records[1]).shape == (50, 68)
    assert surf.extract([]) == []
    assert surf.name == "surf"
    assert surf.settings == {"upright": True, "threshold": 0.5, "n_stored": 300}


@pytest.mark.parametrize(
    ("images", "message"),
    [
        (torch.zeros((40, 50), dtype=torch.uint8), r"\(40, 50\).*image\[None\]"),
        (torch.zeros((1, 3, 40, 50), dtype=torch.uint8), r"\(1, 3, 40, 50\).*\(B, H, W\)"),
        (torch.zeros((1, 0, 50), dtype=torch.uint8), r"\(1, 0, 50\)"),
        (torch.zeros((1, 40, 50), dtype=torch.int64), r"torch.int64.*uint8"),
        (torch.zeros((1, 40, 50), dtype=torch.bool), r"torch.bool.*uint8"),
        (torch.full((1, 40, 50), 255.0), r"255 to 255.*0..1"),
        (torch.full((1, 40, 50), torch.nan), r"nan.*0..1"),
    ],
)
def test_wrong_images(images: Tensor, message: str) -> None:
    with pytest.raises(ImageError, match=message):
        SURF(20)(images)


@pytest.mark.parametrize(
    "wrong", [np.zeros((4, 5, 3), np.uint8), np.zeros((4, 5), np.float32), np.zeros((0, 5), np.uint8)]
)
def test_wrong_arrays(wrong: np.ndarray) -> None:
    with pytest.raises(ImageError, match=r"image 1 has shape .* give \(H, W\) uint8"):
        SURF(20).extract([np.zeros((4, 5), np.uint8), wrong])


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"n_features": 0}, "n_features is 0"),
        ({"threshold": -1.0}, "threshold is -1.0; give 0"),
        ({"threshold": float("nan")}, "nan"),
    ],
)
def test_wrong_settings(settings: dict, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        SURF(**settings)
