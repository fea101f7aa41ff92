"""Which case for whom: KernelPoseNet alone, refined by a landmark map, and the map alone, on good and on bad data.

    python benchmarks/map_cases.py --root DIR [--pgt DIR] [--only CASE ...]

The systems are those of configs/kernel_posenet.yaml (its own settings, with `model.refine: true`) and of
configs/landmark_map.yaml, whose refused frames have the pose of the most similar training frame. About one CPU minute
a case on the kitchen cut.
"""

from __future__ import annotations

import argparse
import contextlib
import io
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import torch
import yaml
from map_trials import add_scene_arguments, find_truths, load_scene, measure_poses, print_table, train

from lightning_pose.data import ImageDataModule
from lightning_pose.data.batches import PoseBatch
from lightning_pose.evaluation.baselines.images import evaluate_baselines
from lightning_pose.features import CNN
from lightning_pose.features.base import FeatureExtractor
from lightning_pose.metrics.summary import summarize_errors
from lightning_pose.models import KernelPoseNet, Pose
from lightning_pose.models.parts.answers import convert_answers, replace_accepted
from lightning_pose.models.parts.frame_cameras import list_cameras
from lightning_pose.models.parts.refinement import MapRefinement
from lightning_pose.scenes.images import read_gray, read_rgb

CONFIG = Path(__file__).parents[1] / "configs" / "kernel_posenet.yaml"

Change = Callable[[np.ndarray], np.ndarray]
Row = list[object]


def thin_out(step: int) -> Callable[[ImageDataModule], None]:
    """Train and validate on every so many frames only."""

    def choose(data: ImageDataModule) -> None:
        for split in ("train", "val"):
            data.replace_split(split, data.scene.splits[split][::step])

    return choose


def test_on_half(half: int) -> Callable[[ImageDataModule], None]:
    """Test on one half of the recording, the first (0) or the second (1); learn from the other, test frames too."""

    def choose(data: ImageDataModule) -> None:
        every, val = np.arange(len(data.scene.frames)), data.scene.splits["val"]
        tested = every * 2 // len(every) == half
        data.replace_split("val", val[~tested[val]])
        data.replace_split("test", every[tested])
        data.replace_split("train", np.setdiff1d(every[~tested], val))

    return choose


CASES: dict[str, Callable[[ImageDataModule], None]] = {
    "all training frames": lambda data: None,
    "every 10th training frame": thin_out(10),
    "every 30th training frame": thin_out(30),
    "first half, tested on the second": test_on_half(1),
    "second half, tested on the first": test_on_half(0),
}
BLURS = (2, 4, 8)


def fit_refined(root: str, truth: str, pgt: str | None, case: str) -> tuple[KernelPoseNet, ImageDataModule]:
    settings = yaml.safe_load(CONFIG.read_text())
    data = load_scene(root, truth, pgt, CNN(**settings["data"]["init_args"]["extractor"]["init_args"]))
    CASES[case](data)
    model = KernelPoseNet(input_shape=list(data.input_shape), refine=True, **settings["model"]["init_args"])
    with contextlib.redirect_stdout(io.StringIO()):
        train(model, data)
    return model, data


def extract(extractor: FeatureExtractor, data: ImageDataModule, change: Change) -> torch.Tensor:
    """Features of the test frames after a change."""
    read = read_gray if extractor.color == "gray" else read_rgb
    images = (data.scene.frames[i].image for i in data.scene.splits["test"])
    return torch.from_numpy(
        np.stack([extractor.features(extractor.extract([change(read(image))])[0]) for image in images])
    )


@torch.inference_mode()
def ask(
    model: KernelPoseNet, data: ImageDataModule, case: str, truth: str, change: Change | None
) -> tuple[Row, list[Row]]:
    """A row of medians, and one of all metrics for each system."""
    test, refinement = data.dataset("test").data, model.refinement
    assert isinstance(refinement, MapRefinement)
    frames = test.frame.tolist()
    features = test.features if change is None else extract(data.extractor, data, change)
    keypoints = refinement.read_keypoints(frames) if change is None else extract(refinement.extractor, data, change)
    alone: Pose = model(features)
    answers = refinement.network.locate(keypoints, list_cameras(data, frames, refinement.network.view))
    poses = {
        "regressor alone": alone,
        "refined": replace_accepted(alone, answers, model.world_frame),
        "map alone": convert_answers(answers, model.world_frame),
    }
    errors = {name: measure_poses(pose, test, answers) for name, pose in poses.items()}
    learnt = [data.dataset(split).data for split in ("train", "val")]
    known = PoseBatch(*(torch.cat(tensors) for tensors in zip(*learnt, strict=True)))
    top = evaluate_baselines(
        known.features, known.position_m, known.quat_wxyz, features, test.position_m, test.quat_wxyz
    )["retrieval_top1"].metrics
    accepted = errors["refined"].accepted
    row: Row = [case, truth, f"{top['position_median_m']:.3f} / {top['orientation_median_deg']:.1f}"]
    row += [errors["regressor alone"].medians, errors["refined"].medians, errors["refined"].within_5cm]
    row += [errors["map alone"].medians, errors["map alone"].within_5cm, f"{accepted.mean():.0%}"]
    row.append(errors["refined"].select(accepted).medians if accepted.any() else "-")
    details: list[Row] = [
        [case, truth, name, *list_metrics(of.position_m, of.orientation_deg)] for name, of in errors.items()
    ]
    return row, details


METRICS = (
    "position_median_m", "orientation_median_deg", "position_mean_m", "orientation_mean_deg", "position_p95_m",
    "orientation_p95_deg", "recall_1cm_1deg", "recall_2cm_2deg", "recall_5cm_5deg", "recall_10cm_5deg",
)  # fmt: skip


def list_metrics(position_m: np.ndarray, orientation_deg: np.ndarray) -> list[str]:
    found = summarize_errors(position_m, orientation_deg)
    return [f"{found[name]:.0%}" if name.startswith("recall") else f"{found[name]:.4f}" for name in METRICS]


def main() -> None:
    """Print two tables, as Markdown: the cases, and all metrics of each system."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_scene_arguments(parser)
    parser.add_argument("--only", nargs="+", choices=list(CASES), default=list(CASES))
    about = "pixels by which test frames are blurred, for the system that learnt from all training frames"
    parser.add_argument("--blurs", nargs="*", type=float, default=BLURS, metavar="SIGMA", help=about)
    args = parser.parse_args()
    rows: list[Row] = []
    details: list[Row] = []
    for truth in find_truths(args):
        for case in args.only:
            model, data = fit_refined(args.root, truth, args.pgt, case)
            changes: dict[str, Change | None] = {case: None}
            if case == "all training frames":
                for sigma in args.blurs:
                    changes[f"test frames blurred, {sigma:g} px"] = lambda x, s=sigma: cv2.GaussianBlur(x, (0, 0), s)
            for name, change in changes.items():
                row, more = ask(model, data, name, truth, change)
                rows.append(row)
                details += more
                print("...", *row, flush=True)
    head = ["case", "ground truth", "retrieval, top 1", "regressor alone", "refined", "5 cm", "map alone", "5 cm"]
    print_table([*head, "accepted", "of these"], rows)
    print_table(["case", "ground truth", "system", *METRICS], details)


if __name__ == "__main__":
    main()
