"""What a landmark map says of images that it must refuse (another scene, blank, mirrored), and of spoiled test frames.

    python benchmarks/map_unseen.py --root DIR --other DIR [--other_camera CAMERA] [--pgt DIR] [--n_features 300]

AUROC: how often a random test frame has more inliers than a random image of the row. About 3 CPU minutes on the kitchen
cut with the office as the other scene, whose features are cached.
"""

from __future__ import annotations

import argparse
import contextlib
import io
from collections.abc import Callable, Sequence

import cv2
import numpy as np
import torch
from map_trials import (
    Errors,
    FittedMap,
    add_scene_arguments,
    find_truths,
    fit_map,
    list_reasons,
    load_scene,
    print_table,
)
from scipy.spatial.transform import Rotation
from scipy.stats import rankdata

from lightning_pose.features import SURF
from lightning_pose.mapping.map_localizer import MapAnswer
from lightning_pose.models.parts.frame_cameras import list_cameras
from lightning_pose.scenes.images import read_gray

FAR = (0.25, 5.0)
"""An accepted pose farther off than so many metres or degrees is a false one."""

Image = np.ndarray


def blur(sigma: float) -> Callable[[Image], Image]:
    return lambda image: cv2.GaussianBlur(image, (0, 0), sigma)


def expose(factor: float) -> Callable[[Image], Image]:
    return lambda image: np.clip(image.astype(np.float32) * factor, 0, 255).astype(np.uint8)


def cover(*halves: slice) -> Callable[[Image], Image]:
    def change(image: Image) -> Image:
        covered = image.copy()
        covered[tuple(slice(n * h.start // 2, n * h.stop // 2) for n, h in zip(image.shape, halves, strict=False))] = 0
        return covered

    return change


def make_noise(image: Image) -> Image:
    return np.random.default_rng(int(image.sum())).integers(0, 256, image.shape, dtype=np.uint8)


CHANGES: dict[str, Callable[[Image], Image]] = {
    "black": np.zeros_like,
    "white": lambda image: np.full_like(image, 255),
    "noise": make_noise,
    "mirrored": lambda image: np.ascontiguousarray(image[:, ::-1]),
    "upside down": lambda image: np.ascontiguousarray(image[::-1, ::-1]),
    "left half covered": cover(slice(0, 2), slice(0, 1)),
    "right half covered": cover(slice(0, 2), slice(1, 2)),
    "upper half covered": cover(slice(0, 1), slice(0, 2)),
    "lower half covered": cover(slice(1, 2), slice(0, 2)),
    **{f"blurred, {sigma} px": blur(sigma) for sigma in (1, 2, 4, 6, 8, 12)},
    "exposed 10 times": expose(10),
    "exposed 0.1 times": expose(0.1),
}
"""A test frame to what it becomes."""

MUST_REFUSE = ("black", "white", "noise", "mirrored")


def rank_test_first(test: Sequence[float], others: Sequence[float]) -> float:
    """Area under the ROC curve: the share of pairs in which the test frame has more, equal ones counted half."""
    ranks = rankdata(np.concatenate([test, others]))[: len(test)]
    return float((ranks.sum() - len(test) * (len(test) + 1) / 2) / (len(test) * len(others)))


def make_row(name: str, answers: Sequence[MapAnswer], test: Sequence[MapAnswer], errors: Errors | None) -> list[object]:
    inliers = [answer.inliers for answer in answers]
    shares, of_test = ([answer.inliers / max(answer.visible, 1) for answer in each] for each in (answers, test))
    accepted = np.array([answer.accepted for answer in answers])
    false = error = "-"
    if errors is not None and accepted.any():
        position_m, orientation_deg = errors.position_m[accepted], errors.orientation_deg[accepted]
        false = int(((position_m > FAR[0]) | (orientation_deg > FAR[1])).sum())
        error = f"{np.median(position_m):.3f} / {np.median(orientation_deg):.2f}"
    auroc = [f"{rank_test_first(*each):.4f}" for each in (([a.inliers for a in test], inliers), (of_test, shares))]
    most = f"{int(np.median(inliers))}, {max(inliers)}"
    return [name, f"{accepted.sum()} of {len(answers)}", error, false, most, *auroc, list_reasons(answers)]


def ask_other(fitted: FittedMap, root: str, camera: str | None, surf: SURF) -> list[MapAnswer]:
    """The map's answers for all frames of another scene, each with its own camera, or the map's."""
    other = load_scene(root, extractor=surf, camera=camera)
    other.fill()
    frames = list(range(len(other.scene.frames)))
    return fitted.module.network.locate(
        other.read_features(frames), list_cameras(other, frames, fitted.module.network.view)
    )


def ask_changed(fitted: FittedMap, surf: SURF, change: Callable[[Image], Image]) -> list[MapAnswer]:
    """The map's answers for the test frames after a change."""
    frames = fitted.data.scene.splits["test"].tolist()
    records = [surf.extract([change(read_gray(fitted.data.scene.frames[i].image))])[0] for i in frames]
    features = torch.from_numpy(np.stack([surf.features(record) for record in records]))
    return fitted.module.network.locate(features, list_cameras(fitted.data, frames, fitted.module.network.view))


def measure_upside_down(fitted: FittedMap, answers: list[MapAnswer]) -> Errors:
    """Errors of images that were turned by half a turn, as if the camera had been turned."""
    errors = fitted.measure(answers)
    quats = fitted.data.dataset("test").data.quat_wxyz.double().numpy()
    truth = Rotation.from_quat(quats, scalar_first=True) * Rotation.from_euler("z", 180, degrees=True)
    found = Rotation.from_matrix(np.array([answer.pose.rotation for answer in answers]))
    return Errors(errors.position_m, np.degrees((truth.inv() * found).magnitude()), errors.accepted)


def main() -> None:
    """Print a table for each ground truth, as Markdown."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_scene_arguments(parser)
    parser.add_argument("--other", required=True, help="the folder of another scene")
    parser.add_argument("--other_camera", help="its camera, as data.camera has it, where the scene has none")
    parser.add_argument("--n_features", type=int, default=300)
    args = parser.parse_args()
    for truth in find_truths(args):
        surf = SURF(args.n_features, with_geometry=True)
        with contextlib.redirect_stdout(io.StringIO()):
            fitted = fit_map(load_scene(args.root, truth, args.pgt, surf))
        test = fitted.locate()
        rows = [make_row("test frames", test, test, fitted.measure(test))]
        rows.append(make_row("the other scene", ask_other(fitted, args.other, args.other_camera, surf), test, None))
        for name, change in CHANGES.items():
            answers = ask_changed(fitted, surf, change)
            errors = measure_upside_down(fitted, answers) if name == "upside down" else fitted.measure(answers)
            rows.append(make_row(name, answers, test, None if name in MUST_REFUSE else errors))
            print("...", *rows[-1], flush=True)
        print(f"{fitted.data.scene.name}, {truth} ground truth, {args.n_features} features")
        head = ["images", "accepted", "m / deg", "false", "inliers: median, most", "AUROC", "of the share", "refused"]
        print_table(head, rows)


if __name__ == "__main__":
    main()
