"""The pictures of docs/map_pictures.md: each stage of a landmark map of the synthetic room, drawn from what it returns.

    python -m docs.make_map_pictures docs/pictures

Run it from the repository. It renders the quickstart's room on first use, and needs no trained model.
"""

from __future__ import annotations

import argparse
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import matplotlib
import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from PIL import Image
from scipy.spatial.transform import Rotation

from docs.make_picture import draw_room
from lightning_pose.data import ImageDataModule
from lightning_pose.data.datamodule import room_folder
from lightning_pose.features import SURF
from lightning_pose.figures.maps import MatchedImage, draw_calibration, draw_map, draw_matched_images
from lightning_pose.figures.style import MODEL, STYLE, TRAINING
from lightning_pose.geometry.camera import Camera
from lightning_pose.geometry.epipolar import essential_matrices
from lightning_pose.mapping.build_map import map_frames, summarize_tracks
from lightning_pose.mapping.calibration import calibrate_map, measure_answers
from lightning_pose.mapping.depth_vote import AGREE_PX, vote_depths
from lightning_pose.mapping.frames import MapFrames
from lightning_pose.mapping.guided_matching import BAND_PX, KeypointMatches, match_pairs
from lightning_pose.mapping.map_localizer import MapAnswer, MapLocalizer
from lightning_pose.mapping.pairs import choose_pairs
from lightning_pose.mapping.scene_depth import measure_depth
from lightning_pose.models.parts.map_network import keypoints_to_frames
from lightning_pose.scenes.images import read_rgb, to_gray

REFUSED = "#D55E00"
COLORS = ("#0072B2", "#D55E00", "#009E73")
FRAME = 100
"""The training frame whose pairs, matches and votes are shown."""

BLURS_PX = (2.0, 3.0, 4.0, 5.0, 6.0, 8.0)
"""Standard deviations of blurs; the first is shown under which the map refuses."""

DPI = 110
DEPTH_M = (0.3, 10.0)
"""Depths that the votes are drawn between."""

QUALITY = 82  # of WebP


@dataclass(frozen=True)
class Stage:
    """The room's frames, and what the map's stages make of the training frames.

    Attributes:
        datamodule: of the room.
        camera: of all its images.
        train: training frames with keypoints and poses.
        test: test frames.
        pairs: (P, 2) training frames that are matched.
        matches: inside the epipolar bands.
    """

    datamodule: ImageDataModule
    camera: Camera
    train: MapFrames
    test: MapFrames
    pairs: np.ndarray
    matches: KeypointMatches

    def image(self, split: str, row: int) -> np.ndarray:
        """(H, W, 3) uint8, the frame in this row of a split."""
        scene = self.datamodule.scene
        return read_rgb(scene.frames[int(scene.splits[split][row])].image)


def read_stage() -> Stage:
    """Extract keypoints of the room, choose pairs and match them."""
    datamodule = ImageDataModule(extractor=SURF(300, with_geometry=True), root=str(room_folder(seed=0, frames=300)))
    datamodule.prepare_data()
    camera = datamodule.find_camera(int(datamodule.scene.splits["train"][0]))
    assert camera is not None, "the room knows its camera"
    train, test = (_read_frames(datamodule, camera, split) for split in ("train", "test"))
    pairs = choose_pairs(train, measure_depth(train)).pairs
    return Stage(datamodule, camera, train, test, pairs, match_pairs(train, pairs))


def _read_frames(datamodule: ImageDataModule, camera: Camera, split: str) -> MapFrames:
    numbers = datamodule.scene.splits[split].tolist()
    frames = [datamodule.scene.frames[i] for i in numbers]
    rotation = Rotation.from_quat(np.array([frame.quat_wxyz for frame in frames]), scalar_first=True).as_matrix()
    position = np.array([frame.position_m for frame in frames])
    return keypoints_to_frames(datamodule.read_features(numbers), [camera] * len(frames), rotation, position)


@matplotlib.rc_context(STYLE)
def draw_pairs(stage: Stage) -> Figure:
    """All pairs from above, and the partners of one frame."""
    figure = Figure(figsize=(7.5, 5.6), dpi=DPI, layout="constrained")
    axes = figure.add_subplot(title="Pairs of training frames, from above")
    draw_room(axes, seed=0)
    centre = stage.train.position[:, :2]
    of_frame = (stage.pairs == FRAME).any(axis=1)
    every = f"{len(stage.pairs)} pairs of {len(stage.train)} frames"
    partners = f"the {of_frame.sum()} pairs of one frame"
    for chosen, color, width, label in ((~of_frame, TRAINING, 0.3, every), (of_frame, MODEL, 1.6, partners)):
        segments = list(centre[stage.pairs[chosen]])
        axes.add_collection(LineCollection(segments, colors=color, linewidths=width, label=label))
    axes.plot(*centre.T, ".", color="#8c8c8c", markersize=4)
    axes.plot(*centre[FRAME], "o", color=MODEL, markersize=7)
    axes.set(aspect="equal", xlabel="x (m)", ylabel="y (m)")
    figure.legend(loc="outside lower center", ncols=2)
    return figure


def choose_partner(stage: Stage) -> int:
    """The number of the pair of `FRAME` with the median number of matches."""
    of_frame = np.flatnonzero(stage.pairs[:, 0] == FRAME)
    count = [(stage.matches.frame == stage.pairs[pair]).all(axis=1).sum() for pair in of_frame]
    return int(of_frame[np.argsort(count)[len(count) // 2]])


def _show(axes: Axes, pixels: np.ndarray, title: str) -> None:
    height, width = pixels.shape[:2]
    axes.imshow(to_gray(pixels), cmap="gray", vmin=-80, vmax=335)  # paler, so that the marks stand out
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), xticks=[], yticks=[])
    axes.set_title(title, fontsize=10)


@matplotlib.rc_context(STYLE)
def draw_bands(stage: Stage) -> Figure:
    """Three keypoints of one frame, and where their matches may lie in another."""
    a, b = stage.pairs[choose_partner(stage)].tolist()
    train, camera = stage.train, stage.camera
    found = (stage.matches.frame == [a, b]).all(axis=1) & vote_depths(train, stage.matches)
    rows = stage.matches.keypoint[found]
    pixels = [camera.project(train.points[frame, : train.count[frame]]) for frame in (a, b)]
    height = pixels[0][rows[:, 0], 1]
    shown = rows[[int(np.argmin(np.abs(height - level))) for level in np.quantile(height, [0.1, 0.5, 0.9])]]
    essential = essential_matrices(*(each[[i]] for i in (a, b) for each in (train.rotation, train.position)))[0]
    figure = Figure(figsize=(9.5, 3.9), dpi=DPI, layout="constrained")
    left, right = figure.subplots(1, 2)
    _show(left, stage.image("train", a), "three keypoints of one frame")
    _show(right, stage.image("train", b), f"another frame: the match lies within {BAND_PX:g} px of the line")
    for axes, points in zip((left, right), pixels, strict=True):
        axes.plot(*points.T, ".", color="#8c8c8c", markersize=3)
    x = np.array([-0.5, camera.width - 0.5])
    for (row_a, row_b), color in zip(shown, COLORS, strict=True):
        p, q, r = essential @ np.append(train.points[a, row_a], 1)
        y = camera.cy - camera.fy * (p * (x - camera.cx) / camera.fx + r) / q
        half = BAND_PX * np.hypot(p, q) / abs(q)
        band = np.column_stack([np.append(x, x[::-1]), np.append(y - half, (y + half)[::-1])])
        right.add_patch(Polygon(band, color=color, alpha=0.35, linewidth=0))
        left.plot(*pixels[0][row_a], "o", color=color, markersize=10, markerfacecolor="none", markeredgewidth=2)
        right.plot(*pixels[1][row_b], "o", color=color, markersize=10, markerfacecolor="none", markeredgewidth=2)
    return figure


def choose_keypoint(stage: Stage) -> tuple[list[tuple[float, float]], np.ndarray]:
    """A keypoint of `FRAME` two of whose matches are dropped: depths that each match allows, and which matches stay."""
    kept = vote_depths(stage.train, stage.matches)
    number, side = np.nonzero(stage.matches.frame == FRAME)
    row = stage.matches.keypoint[number, side]
    most: tuple[list[tuple[float, float]], np.ndarray] = [], np.zeros(0, bool)
    for each in np.unique(row):
        mine = number[row == each]
        ranges = [find_depth_range(stage, int(each), match) for match in mine]
        drawn = np.array([low < high for low, high in ranges])
        stays = kept[mine]
        if drawn.all() and (~stays).sum() >= 2 and stays.sum() > most[1].sum():
            most = ranges, stays
    return most


def find_depth_range(stage: Stage, row: int, match: int) -> tuple[float, float]:
    """The depths along the ray of a keypoint of `FRAME` that put it near a match's keypoint; (0, 0) if none does."""
    train, depth = stage.train, np.geomspace(*DEPTH_M, 1000)
    ray = train.rotation[FRAME] @ np.append(train.points[FRAME, row], 1)
    points = train.position[FRAME] + depth[:, None] * ray
    side = int(stage.matches.frame[match, 0] == FRAME)
    other = int(stage.matches.frame[match, side])
    local = (points - train.position[other]) @ train.rotation[other]
    observed = train.points[other, stage.matches.keypoint[match, side]]
    away = np.linalg.norm(local[:, :2] / np.maximum(local[:, 2:], 1e-9) - observed, axis=1)
    agrees = (away * train.focal_px[other] <= AGREE_PX) & (local[:, 2] > 0)
    low, high = depth[agrees][[0, -1]] if agrees.any() else (0.0, 0.0)
    return float(low), float(high)


@matplotlib.rc_context(STYLE)
def draw_votes(stage: Stage) -> Figure:
    """The depths that each match of one keypoint allows; a bar of another colour is a match that is dropped."""
    ranges, kept = choose_keypoint(stage)
    figure = Figure(figsize=(7.5, 3.4), dpi=DPI, layout="constrained")
    axes = figure.add_subplot(title="Depths that each match of one keypoint allows")
    for bar, i in enumerate(np.argsort(~kept, kind="stable")):
        low, high = ranges[i]
        axes.barh(bar, high - low, left=low, height=0.6, color=MODEL if kept[i] else REFUSED)
    axes.set(xscale="log", xlim=DEPTH_M, yticks=[], xlabel="depth along the keypoint's ray (m)")
    axes.set_xticks([0.3, 0.5, 1, 2, 5, 10], ["0.3", "0.5", "1", "2", "5", "10"])
    axes.invert_yaxis()
    axes.grid(visible=False, axis="y")
    for color, label in ((MODEL, f"{kept.sum()} matches stay"), (REFUSED, f"{(~kept).sum()} are dropped")):
        axes.barh(0, 0, color=color, label=label)
    figure.legend(loc="outside lower center", ncols=2)
    return figure


def draw_from_above(stage: Stage, localizer: MapLocalizer, answers: Sequence[MapAnswer]) -> Figure:
    """The map's points, the training cameras, and where test frames are located."""
    found = np.array([answer.pose.position for answer in answers])
    accepted = np.array([answer.accepted for answer in answers])
    cameras = stage.train.position, stage.test.position
    figure = draw_map(localizer.map.points, *cameras, found, accepted, "The map of the synthetic room, from above")
    figure.set_size_inches(7.5, 6.2)
    return figure


def draw_inliers(stage: Stage, localizer: MapLocalizer, answers: Sequence[MapAnswer]) -> Figure:
    """A test frame with the map's points in it, and the same frame so blurred that the map refuses it."""
    errors = measure_answers(answers, stage.test).position
    row = int(np.argsort(errors)[len(errors) // 2])
    sharp = stage.image("test", row)
    images = [_show_answer(stage, sharp, answers[row], "a test frame")]
    for blur_px in BLURS_PX:
        blurred = np.asarray(cv2.GaussianBlur(sharp, (0, 0), blur_px))
        answer = locate_image(stage, localizer, blurred)
        if not answer.accepted:
            images.append(_show_answer(stage, blurred, answer, f"blurred by {blur_px:g} px"))
            break
    figure = draw_matched_images(images, "Points of the map in an image")
    figure.set_size_inches(9.5, 4.3)
    if not len(images[-1].seen) and (legend := figure.axes[-1].get_legend()) is not None:
        legend.remove()  # refused before a pose was found that would put points into the image
    return figure


def locate_image(stage: Stage, localizer: MapLocalizer, pixels: np.ndarray) -> MapAnswer:
    """What the map says of an image (H, W, 3)."""
    extractor = SURF(300, with_geometry=True)
    features = torch.from_numpy(extractor.features(extractor.extract([to_gray(pixels)])[0]))[None]
    return localizer.locate(keypoints_to_frames(features, [stage.camera], np.eye(3)[None], np.zeros((1, 3))).query(0))


def _show_answer(stage: Stage, pixels: np.ndarray, answer: MapAnswer, caption: str) -> MatchedImage:
    caption = f"{caption}: {answer.reason or f'accepted with {answer.inliers} inliers'}"
    if answer.shown is None:
        nothing = np.zeros((0, 2))
        return MatchedImage(pixels, nothing, nothing, nothing, np.zeros(0, bool), caption)
    seen, projected, observed = (stage.camera.project(each) for each in answer.shown[:3])
    return MatchedImage(pixels, seen, projected, observed, answer.shown.inlier, caption)


def draw_radii(stage: Stage, answers: Sequence[MapAnswer], factors: tuple[float, float]) -> Figure:
    """How many test frames lie within multiples of their 90 % radius."""
    measured = measure_answers(answers, stage.test)
    accepted = measured.accepted
    errors = measured.position[accepted], measured.orientation_deg[accepted]
    radii = measured.position_sd[accepted] * factors[0], measured.orientation_sd_deg[accepted] * factors[1]
    figure = draw_calibration(errors, radii, "Test frames within multiples of their 90 % radius")
    figure.set_size_inches(7.5, 4.2)
    return figure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    stage = read_stage()
    mapped = map_frames(stage.train, adjust=False)
    calibration = calibrate_map(mapped)
    localizer = MapLocalizer(summarize_tracks(mapped))
    answers = [localizer.locate(stage.test.query(i)) for i in range(len(stage.test))]
    factors = calibration.position_factor, calibration.orientation_factor
    figures = {
        "map_pairs": draw_pairs(stage),
        "map_bands": draw_bands(stage),
        "map_votes": draw_votes(stage),
        "map_above": draw_from_above(stage, localizer, answers),
        "map_inliers": draw_inliers(stage, localizer, answers),
        "map_radii": draw_radii(stage, answers, factors),
    }
    for name, figure in figures.items():
        drawn = io.BytesIO()
        figure.savefig(drawn, dpi=DPI)
        Image.open(drawn).convert("RGB").save(folder / f"{name}.webp", quality=QUALITY, method=6)
        print(folder / f"{name}.webp")


if __name__ == "__main__":
    main()
