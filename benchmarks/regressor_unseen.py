"""What regressors say of images that they must refuse (another scene, blank, mirrored), and of spoiled test frames.

    python benchmarks/regressor_unseen.py CHECKPOINT... --root DIR --other DIR [--every 3]

Checkpoints are of the scene in DIR. An image is located as by `localize`; features are computed once for all
checkpoints with the same extractor. About 35 ms of CPU time an image.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

import numpy as np
from map_trials import load_scene, print_table
from map_unseen import CHANGES, MUST_REFUSE, Image

from lightning_pose.features import FeatureExtractor
from lightning_pose.features.base import Record
from lightning_pose.localization.load_source import find_checkpoint
from lightning_pose.localization.localizer import Localizer
from lightning_pose.localization.located_pose import LocatedPose
from lightning_pose.localization.trained_system import TrainedSystem
from lightning_pose.scenes.images import read_rgb
from lightning_pose.scenes.scene import Frame


def remember_last(extractor: FeatureExtractor) -> FeatureExtractor:
    """The extractor, which from now on answers again for its last image without computing anything."""
    compute = extractor.extract
    last: list[tuple[np.ndarray, list[Record]]] = []

    def extract(images: Sequence[np.ndarray]) -> list[Record]:
        if not (last and np.array_equal(last[0][0], images[0])):
            last[:] = [(images[0], compute(images))]
        return last[0][1]

    extractor.extract = extract
    return extractor


def load_localizers(models: Sequence[str]) -> list[Localizer]:
    """Localizers of checkpoints or run ids; those with the same extractor share it."""
    systems = [TrainedSystem.from_checkpoint(find_checkpoint(model, None)) for model in models]
    shared: list[FeatureExtractor] = []
    for system in systems:
        same = [extractor for extractor in shared if extractor.shares_records(system.extractor)]
        if not same:
            shared.append(remember_last(system.extractor))
        elif same[0].feature_shape == system.extractor.feature_shape:
            system.extractor = same[0]
    return [Localizer(system) for system in systems]


def describe(answers: Sequence[LocatedPose], truth: Sequence[Frame] | None) -> str:
    """How many are accepted, and their median errors where the poses are known."""
    accepted = [i for i, answer in enumerate(answers) if answer.accepted]
    text = f"{len(accepted)} of {len(answers)}"
    if truth is None or not accepted:
        return text
    away = [np.linalg.norm(answers[i].position_m - truth[i].position_m) for i in accepted]
    cosine = [abs(answers[i].quat_wxyz @ np.array(truth[i].quat_wxyz)) for i in accepted]
    return f"{text}, {np.median(away):.2f} m / {np.median(2 * np.degrees(np.arccos(np.clip(cosine, 0, 1)))):.0f} deg"


def main() -> None:
    """Print a table as Markdown, a row for each kind of image and a column for each checkpoint."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", nargs="+", help="checkpoints or run ids")
    parser.add_argument("--root", required=True)
    parser.add_argument("--other", required=True, help="the folder of another scene")
    parser.add_argument("--every", type=int, default=3, help="1 takes all images, 2 every second one, and so on")
    args = parser.parse_args()
    localizers = load_localizers(args.models)

    def ask(images: Sequence[Image]) -> list[list[LocatedPose]]:
        """Answers for each localizer; all of them are asked for an image before the next."""
        answers = [[localizer.localize(image) for localizer in localizers] for image in images]
        return [list(each) for each in zip(*answers, strict=True)]

    scene, other = load_scene(args.root).scene, load_scene(args.other).scene
    frames = [scene.frames[i] for i in scene.splits["test"][:: args.every]]
    images = [read_rgb(frame.image) for frame in frames]
    rows: list[list[object]] = [["test frames", *(describe(each, frames) for each in ask(images))]]
    others = ask([read_rgb(frame.image) for frame in other.frames[:: args.every]])
    rows.append([f"frames of {other.name}", *(describe(each, None) for each in others)])
    for name, change in CHANGES.items():
        truth = None if name in (*MUST_REFUSE, "upside down") else frames
        rows.append([name, *(describe(each, truth) for each in ask([change(image) for image in images]))])
        print("...", *rows[-1], flush=True)
    print_table(["images", *(localizer.system.name for localizer in localizers)], rows)


if __name__ == "__main__":
    main()
