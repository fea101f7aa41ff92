"""The renderer: exact geometry, occlusion, rectangles that reach behind the camera, no aliasing."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from lightning_pose.scenes.synthetic.render import Renderer, make_camera
from lightning_pose.scenes.synthetic.room import Quad, make_room

SIZE = (320, 240)
CAMERA = make_camera(SIZE)
AHEAD = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 1], [0, 0, 0, 1]], float)
"""One metre above the origin, looking along y."""


def plain(corner: tuple, u: tuple, v: tuple, gray: int) -> Quad:
    return Quad(np.array(corner, float), np.array(u, float), np.array(v, float), np.full((64, 64, 3), gray, np.uint8))


def sky() -> Quad:
    return plain((-500, 90, 500), (1000, 0, 0), (0, 0, -1000), 200)


def board(squares: tuple[int, int], side_px: int) -> np.ndarray:
    """Black and white squares inside a white margin of one square."""
    rows, columns = np.indices((squares[1], squares[0]))
    black = np.pad((rows + columns) % 2 == 0, 1)
    return cv2.cvtColor(np.kron(np.where(black, 20, 235), np.ones((side_px, side_px))).astype(np.uint8), 8)


def turned(pose: np.ndarray, rotation_vector: tuple[float, float, float], shift_m: tuple) -> np.ndarray:
    moved = pose.copy()
    moved[:3, :3] = pose[:3, :3] @ cv2.Rodrigues(np.array(rotation_vector))[0]
    moved[:3, 3] += shift_m
    return moved


def project(points: np.ndarray, pose: np.ndarray) -> np.ndarray:
    rays = (points - pose[:3, 3]) @ pose[:3, :3]
    return rays[:, :2] / rays[:, 2:] * (CAMERA.fx, CAMERA.fy) + (CAMERA.cx, CAMERA.cy)


@pytest.mark.parametrize("rotation", [(0.0, 0.0, 0.0), (0.1, -0.3, 0.2), (-0.15, 0.25, -0.4)])
def test_corners_of_a_board_appear_where_the_pose_and_the_camera_project_them(rotation: tuple) -> None:
    side_m = 0.15
    quad = Quad(
        np.array([-0.6, 2, 1.5]), np.array([8 * side_m, 0, 0]), np.array([0, 0, -7 * side_m]), board((6, 5), 60)
    )
    pose = turned(AHEAD, rotation, (0.1, -0.2, 0.05))
    gray = cv2.cvtColor(Renderer([quad], CAMERA, SIZE).render(pose).astype(np.uint8), cv2.COLOR_BGR2GRAY)

    columns, rows = np.meshgrid(np.arange(2, 7), np.arange(2, 6))
    points = np.stack([-0.6 + columns * side_m, np.full(rows.shape, 2.0), 1.5 - rows * side_m], -1).reshape(-1, 3)
    expected = project(points, pose)
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-4)
    start = np.round(expected).astype(np.float32).reshape(-1, 1, 2)
    found = cv2.cornerSubPix(gray, start, (5, 5), (-1, -1), criteria).reshape(-1, 2)
    assert np.abs(found - expected).max() < 0.1


def test_a_floor_under_and_behind_the_camera_ends_at_its_far_edge() -> None:
    floor = plain((-50, 5, 0), (100, 0, 0), (0, -10, 0), 60)
    image = Renderer([sky(), floor], CAMERA, SIZE).render(AHEAD)[..., 0]
    edge = CAMERA.cy + CAMERA.fy / 5
    rows = np.arange(SIZE[1])
    assert (image[rows < edge - 1] == 200).all()
    assert (image[rows > edge + 1] == 60).all()


def test_the_nearest_rectangle_hides_the_others_whatever_their_order() -> None:
    near = plain((-0.5, 2, 1.5), (1, 0, 0), (0, 0, -1), 20)
    far = plain((-1, 3, 2), (2, 0, 0), (0, 0, -2), 100)
    for quads in ([sky(), near, far], [sky(), far, near]):
        image = Renderer(quads, CAMERA, SIZE).render(AHEAD)[..., 0]
        assert image[120, 160] == 20
        assert image[120, 160 + int(0.8 / 3 * CAMERA.fx)] == 100
        assert image[120, 5] == 200


def test_a_rectangle_is_invisible_from_behind_and_edge_on() -> None:
    back = plain((0.5, 2, 1.5), (-1, 0, 0), (0, 0, -1), 20)
    edge_on = plain((0, 1, 1.5), (0, 1, 0), (0, 0, -1), 20)
    image = Renderer([sky(), back, edge_on], CAMERA, SIZE).render(AHEAD)
    assert (image == 200).all()


def test_squares_far_smaller_than_a_pixel_become_gray() -> None:
    squares = board((254, 254), 4)
    quad = Quad(np.array([-20.0, 20, 21]), np.array([40.0, 0, 0]), np.array([0, 0, -40.0]), squares)
    small = (64, 48)
    image = Renderer([quad], make_camera(small), small).render(AHEAD)
    assert image[10:-10, 10:-10].std() < 6
    assert image[10:-10, 10:-10].mean() == pytest.approx(127, abs=5)


def test_a_moving_camera_blurs() -> None:
    quad = Quad(np.array([-0.6, 2, 1.5]), np.array([1.2, 0, 0]), np.array([0, 0, -1.0]), board((10, 10), 20))
    renderer = Renderer([quad], CAMERA, SIZE)
    still = renderer.render(AHEAD)
    moving = renderer.render(np.array([turned(AHEAD, (0, yaw, 0), (0, 0, 0)) for yaw in np.linspace(-0.01, 0.01, 4)]))
    assert cv2.Laplacian(moving, cv2.CV_32F).var() < 0.7 * cv2.Laplacian(still, cv2.CV_32F).var()


def test_walls_floor_and_ceiling_face_inwards() -> None:
    room = make_room(1)
    for quad in room.quads[:6]:
        inwards = room.size_m * (0, 0, 0.5) - (quad.corner + (quad.u + quad.v) / 2)
        assert np.cross(quad.v, quad.u) @ inwards > 0
