"""Cameras: pixels of known rays, through every model."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from lightning_pose.errors import ConfigError
from lightning_pose.geometry.camera import CAMERA_MODELS, Camera

RAYS = np.random.default_rng(0).uniform([-0.5, -0.4], [0.5, 0.4], (60, 2))

EXAMPLES = {
    "SIMPLE_PINHOLE": "500,319.5,239.5",
    "PINHOLE": "500,510,319.5,239.5",
    "SIMPLE_RADIAL": "500,319.5,239.5,-0.1",
    "RADIAL": "500,319.5,239.5,-0.1,0.03",
    "OPENCV": "500,510,319.5,239.5,-0.1,0.03,0.002,-0.001",
    "FULL_OPENCV": "517.3,516.5,318.6,255.3,0.2624,-0.9531,-0.0054,0.0026,1.1633,0.01,-0.02,0.03",
    "SIMPLE_FISHEYE": "300,319.5,239.5",
    "FISHEYE": "300,310,319.5,239.5",
    "SIMPLE_RADIAL_FISHEYE": "300,319.5,239.5,0.05",
    "RADIAL_FISHEYE": "300,319.5,239.5,0.05,-0.01",
    "OPENCV_FISHEYE": "300,310,319.5,239.5,0.05,-0.01,0.002,0.001",
    "FOV": "300,310,319.5,239.5,0.9",
    "THIN_PRISM_FISHEYE": "300,310,319.5,239.5,0.05,-0.01,0.002,-0.003,0.002,0.001,0.004,-0.002",
    "RAD_TAN_THIN_PRISM_FISHEYE": "300,310,319.5,239.5,.1,-.02,.01,-.003,.002,.001,.004,-.002,.003,.001,-.002,.001",
}


def project(camera: Camera) -> np.ndarray:
    """Pixels of the rays, by OpenCV, or by COLMAP for the lenses that it alone has."""
    matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    points = np.column_stack([RAYS, np.ones(len(RAYS))])
    if camera.lens:
        import pycolmap

        pycolmap_camera = pycolmap.Camera(
            model=camera.lens, width=camera.width, height=camera.height,
            params=[camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion],
        )  # fmt: skip
        return np.asarray(pycolmap_camera.img_from_cam(points))
    if camera.fisheye:
        pixels, _ = cv2.fisheye.projectPoints(
            points[:, None], np.zeros(3), np.zeros(3), matrix, np.array(camera.distortion)
        )
    else:
        distortion = np.array(camera.distortion) if camera.distortion else None
        pixels, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, distortion)
    return pixels.reshape(-1, 2)


@pytest.mark.parametrize("model", CAMERA_MODELS)
def test_pixels_of_known_rays_give_the_rays_back(model: str) -> None:
    camera = Camera.parse(f"{model},640,480,{EXAMPLES[model]}")
    np.testing.assert_allclose(camera.normalize(project(camera)), RAYS, atol=1e-9)
    np.testing.assert_allclose(camera.project(RAYS), project(camera), atol=1e-9)
    assert Camera.parse(str(camera)) == replace(camera, distortion=Camera.parse(str(camera)).distortion)
    np.testing.assert_allclose(Camera.parse(str(camera)).project(RAYS), project(camera), atol=1e-9)


def test_the_first_pixel_is_at_the_origin() -> None:
    """A camera of two by two pixels that looks at the corner that all four share."""
    camera = Camera.parse("SIMPLE_PINHOLE,2,2,1,0.5,0.5")
    np.testing.assert_array_equal(camera.normalize(np.array([[0.0, 0.0], [0.5, 0.5], [1.0, 1.0]])).mean(0), [0, 0])
    np.testing.assert_array_equal(camera.resize(4, 4).project(np.zeros((1, 2))), [[1.5, 1.5]])


def test_a_resized_image_shows_the_same_rays() -> None:
    camera = Camera.parse(f"OPENCV,640,480,{EXAMPLES['OPENCV']}")
    pixels = project(camera)
    half = camera.resize(320, 240)
    np.testing.assert_allclose(half.normalize((pixels + 0.5) / 2 - 0.5), RAYS, atol=1e-9)
    np.testing.assert_allclose(half.half_view, camera.half_view)


def test_lower_case_and_spaces_are_read() -> None:
    assert Camera.parse(" pinhole, 640, 480, 500, 500, 320, 240 ") == Camera.parse("PINHOLE,640,480,500,500,320,240")


@pytest.mark.parametrize("model", ["FOV", "THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE"])
def test_wide_angles_and_pixels_that_no_ray_reaches(model: str) -> None:
    camera = Camera.parse(f"{model},640,480,{EXAMPLES[model]}")
    rays = np.array([[0.0, 0.0], [3.0, 0.0], [-2.0, 2.5]])
    np.testing.assert_allclose(camera.normalize(camera.project(rays)), rays, rtol=1e-6, atol=1e-12)
    assert (np.abs(camera.normalize(np.array([[5000.0, 200.0]]))) > 100).all()


def test_no_pixels_give_no_rays() -> None:
    assert Camera.parse("OPENCV,640,480," + EXAMPLES["OPENCV"]).normalize(np.zeros((0, 2))).shape == (0, 2)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("PINHOLE,640,480,500,500,320", "does not have the form PINHOLE,WIDTH,HEIGHT,FX,FY,CX,CY"),
        ("LENS,640,480,500", "'LENS' is no camera model; give one of SIMPLE_PINHOLE"),
        ("PINHOLE,640,480,0,500,320,240", "focal lengths must be above 0"),
        ("PINHOLE,1e300,1e300,500,500,320,240", "width and height must be 1 to 100000"),
        ("PINHOLE,0.5,480,500,500,320,240", "width and height must be 1 to 100000"),
        ("X" * 10_000, r"^.{200,500}$"),
        ("PINHOLE,640,480,a,500,320,240", "does not have the form"),
    ],
)
def test_a_camera_that_is_not_understood_is_refused(text: str, problem: str) -> None:
    with pytest.raises(ConfigError, match=problem):
        Camera.parse(text)
