"""The README's picture: test frames of the synthetic room, and a map of where a quickstart run locates them.

    python -m docs.make_picture mlruns/checkpoints/RUN_ID/best.ckpt docs/quickstart.png

Run it from the repository, after `fit --config configs/quickstart.yaml`.
"""

from __future__ import annotations

import argparse
import io
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.patches import Polygon, Rectangle
from PIL import Image
from scipy.spatial.transform import Rotation

from lightning_pose.data.datamodule import room_folder
from lightning_pose.figures.style import MODEL, STYLE, TRAINING, TRUTH
from lightning_pose.localization.localizer import Localizer
from lightning_pose.localization.located_pose import stack_poses
from lightning_pose.localization.trained_system import TrainedSystem
from lightning_pose.scenes.formats import load_scene
from lightning_pose.scenes.scene import Scene
from lightning_pose.scenes.synthetic.room import make_room

SHOWN = (0.25, 0.5, 0.75)
"""Which test frames are shown, as parts of the test split: the quarters, whatever their errors are."""

ALONE = "#E69F00"
VIEW_DEPTH_M = 0.8
LETTERS = "ABC"
LABEL = {"facecolor": "white", "edgecolor": "none", "pad": 2}
COLORS = 256
"""A palette keeps the file small."""


def view_triangles(position_m: np.ndarray, quat_wxyz: np.ndarray, half_angle: float) -> np.ndarray:
    """Camera views from above, (N, 3, 2): the camera centre and the two ends of its field of view, in metres."""
    rotations = Rotation.from_quat(quat_wxyz, scalar_first=True)
    forward = rotations.apply([0.0, 0.0, 1.0])[:, :2]
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    side = forward[:, ::-1] * [1, -1] * np.tan(half_angle)
    centre = position_m[:, :2]
    ends = [centre + VIEW_DEPTH_M * (forward - side), centre + VIEW_DEPTH_M * (forward + side)]
    return np.stack([centre, *ends], axis=1)


def draw_room(axes: Axes, seed: int) -> None:
    """Outline the walls of the synthetic room and fill the tops of its furniture."""
    room = make_room(seed)
    width, depth = room.size_m[:2]
    axes.add_patch(Rectangle((-width / 2, -depth / 2), width, depth, fill=False, lw=2, ec="#555555"))
    for quad in room.quads:
        footprint = abs(quad.u[0] * quad.v[1] - quad.u[1] * quad.v[0])
        if 0.02 < footprint < 0.5 * width * depth:
            corners = [quad.corner, quad.corner + quad.u, quad.corner + quad.u + quad.v, quad.corner + quad.v]
            axes.add_patch(Polygon(np.array(corners)[:, :2], fc="#f2ead9", ec="#d8cdb5", zorder=0.5))


def draw_map(
    axes: Axes, scene: Scene, refined: tuple[np.ndarray, np.ndarray], alone_m: np.ndarray, shown: list[int]
) -> None:
    """Draw training frames, true and predicted test positions, and the views of the frames shown, from above."""
    position_m, quat_wxyz = refined
    draw_room(axes, seed=0)
    test = [scene.frames[i] for i in scene.splits["test"]]
    truth = np.array([frame.position_m for frame in test])
    training = np.array([scene.frames[i].position_m for i in scene.splits["train"]])
    axes.plot(*training[:, :2].T, ".", color=TRAINING, markersize=4, label="training frames")
    segments = list(np.stack([truth[:, :2], alone_m[:, :2]], axis=1))
    axes.add_collection(LineCollection(segments, colors=ALONE, linewidths=0.7, alpha=0.4))
    axes.plot(*alone_m[:, :2].T, ".", color=ALONE, markersize=5, label="test frames, the network alone")
    axes.plot(*truth[:, :2].T, ".", color=TRUTH, markersize=9, label="test frames, true")
    axes.plot(*position_m[:, :2].T, ".", color=MODEL, markersize=4, label="test frames, refined by the map")
    camera = test[0].intrinsics
    assert camera is not None
    half_angle = float(np.arctan(camera.cx / camera.fx))
    quats = np.array([test[i].quat_wxyz for i in shown])
    for color, width, centres, turns in (
        (TRUTH, 3.5, truth[shown], quats),
        (MODEL, 1.2, position_m[shown], quat_wxyz[shown]),
    ):
        triangles = view_triangles(centres, turns, half_angle)
        axes.add_collection(PolyCollection(list(triangles), facecolors="none", edgecolors=color, linewidths=width))
    for letter, i in zip(LETTERS, shown, strict=True):
        x, y = truth[i, :2].tolist()
        axes.annotate(letter, (x, y), xytext=(-6, -18), textcoords="offset points", fontsize=13, weight="bold")
    axes.set(
        aspect="equal",
        xlabel="x (m)",
        ylabel="y (m)",
        title="The room from above: true and predicted cameras",
    )
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.1), ncols=2, markerscale=2)


@matplotlib.rc_context(STYLE)
def draw_picture(scene: Scene, refined: tuple[np.ndarray, np.ndarray], alone_m: np.ndarray) -> Figure:
    """Test frames on the left, the map on the right.

    Args:
        scene: the synthetic room.
        refined: (N, 3) positions and (N, 4) quaternions of the N test frames.
        alone_m: (N, 3) positions by the network alone.
    """
    test = [scene.frames[i] for i in scene.splits["test"]]
    shown = [int(part * len(test)) for part in SHOWN]
    figure = Figure(figsize=(10.5, 6), dpi=100, layout="constrained")
    grid = figure.add_gridspec(len(shown), 2, width_ratios=[1, 3])
    for row, (letter, i) in enumerate(zip(LETTERS, shown, strict=True)):
        axes = figure.add_subplot(grid[row, 0])
        axes.imshow(Image.open(test[i].image))
        axes.text(0.03, 0.95, letter, transform=axes.transAxes, va="top", fontsize=13, weight="bold", bbox=LABEL)
        axes.set_axis_off()
    draw_map(figure.add_subplot(grid[:, 1]), scene, refined, alone_m, shown)
    return figure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("picture", type=Path)
    args = parser.parse_args()
    scene = load_scene(room_folder(seed=0, frames=300))
    system = TrainedSystem.from_checkpoint(args.checkpoint)
    images = [scene.frames[i].image for i in scene.splits["test"]]
    refined = stack_poses(Localizer(system).localize(images))
    system.model.refinement = None
    alone_m, _ = stack_poses(Localizer(system).localize(images))
    drawn = io.BytesIO()
    draw_picture(scene, refined, alone_m).savefig(drawn)
    Image.open(drawn).convert("RGB").quantize(COLORS).save(args.picture, optimize=True)
    print(args.picture)


if __name__ == "__main__":
    main()
