"""The code of docs/robots.md: a bag of ROS 2 becomes a dataset and is located; the node runs with stand-ins for ROS."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from lightning_pose.localization.localizer import Localizer
from lightning_pose.localization.located_pose import LocatedPose
from lightning_pose.scenes.formats import load_scene
from lightning_pose.scenes.images import read_rgb
from tests.helpers import REPOSITORY

NODE, BAGS = re.findall(r"```python\n(.*?)```", (REPOSITORY / "docs" / "robots.md").read_text(), re.DOTALL)
IMAGES, POSES, RAW = "/camera/compressed", "/slam/pose", "/camera/raw"
SECOND = 1_000_000_000
START = 1_764_000_000 * SECOND
ZEROS = np.zeros(36)


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bag of four images, compressed and raw, 0.1 s apart; poses every 0.2 s, the last before the last image."""
    rosbag2, typesys = pytest.importorskip("rosbags.rosbag2"), pytest.importorskip("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.ROS2_JAZZY)
    types, path = store.types, tmp_path_factory.mktemp("bags") / "walk"

    def head(time_ns: int) -> Any:
        stamp = types["builtin_interfaces/msg/Time"](sec=time_ns // SECOND, nanosec=time_ns % SECOND)
        return types["std_msgs/msg/Header"](stamp=stamp, frame_id="camera_optical_frame")

    with rosbag2.Writer(path, version=9) as writer:

        def connect(topic: str, kind: str) -> Any:
            opened = writer.add_connection(topic, kind, typestore=store)
            return lambda time_ns, message: writer.write(opened, time_ns, store.serialize_cdr(message, kind))

        write_image = connect(IMAGES, "sensor_msgs/msg/CompressedImage")
        write_raw = connect(RAW, "sensor_msgs/msg/Image")
        write_pose = connect(POSES, "geometry_msgs/msg/PoseStamped")
        for i in range(4):
            time_ns, pixels = START + i * SECOND // 10, make_picture(i)
            data = np.frombuffer(cv2.imencode(".png", pixels[..., ::-1])[1].tobytes(), np.uint8)
            kind = types["sensor_msgs/msg/CompressedImage"]
            write_image(time_ns, kind(header=head(time_ns), format="png", data=data))
            padded = np.pad(pixels[..., ::-1].reshape(48, -1), ((0, 0), (0, 4)))  # rows may be longer than the image
            kind = types["sensor_msgs/msg/Image"]
            raw = kind(head(time_ns), 48, 64, "bgr8", is_bigendian=0, step=196, data=padded.ravel())
            write_raw(time_ns, raw)
            if i % 2 == 0:
                point = types["geometry_msgs/msg/Point"](x=float(i), y=2.0, z=3.0)
                turn = types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.6, w=0.8)
                pose = types["geometry_msgs/msg/Pose"](position=point, orientation=turn)
                write_pose(time_ns, types["geometry_msgs/msg/PoseStamped"](header=head(time_ns), pose=pose))
    return path


def make_picture(number: int) -> np.ndarray:
    return np.random.default_rng(number).integers(0, 255, (48, 64, 3), dtype=np.uint8)


@pytest.fixture
def code() -> dict[str, Any]:
    """The names of the page's second block."""
    names: dict[str, Any] = {"__name__": "bags"}
    exec(compile(BAGS, "docs/robots.md", "exec"), names)
    return names


def test_images_are_read_compressed_and_raw(bag: Path, code: dict[str, Any]) -> None:
    for topic in (IMAGES, RAW):
        found = list(code["read_images"](bag, topic))
        assert [time_ns for time_ns, _ in found] == [START + i * SECOND // 10 for i in range(4)]
        assert all(np.array_equal(pixels, make_picture(i)) for i, (_, pixels) in enumerate(found))
    with pytest.raises(SystemExit, match=r"no topic /nothing; it has /camera/compressed, "):
        list(code["read_images"](bag, "/nothing"))


def test_a_bag_becomes_a_dataset(bag: Path, code: dict[str, Any], tmp_path: Path) -> None:
    assert code["write_dataset"](bag, tmp_path / "set", IMAGES, POSES) == 3  # the last has no pose after it
    scene = load_scene(tmp_path / "set")
    assert scene.format == "pose_list"
    np.testing.assert_allclose([frame.position_m for frame in scene.frames], [[0, 2, 3], [1, 2, 3], [2, 2, 3]])
    np.testing.assert_allclose([frame.quat_wxyz for frame in scene.frames], [[0.8, 0, 0, 0.6]] * 3)
    assert [frame.timestamp for frame in scene.frames] == pytest.approx([0, 0.1, 0.2])
    assert np.array_equal(read_rgb(scene.frames[1].image), make_picture(1))


class StandIn:
    """A localizer that accepts every second image."""

    def __init__(self) -> None:
        self.asked: list[tuple[tuple[int, ...], object, object]] = []

    def localize(self, image: Any, camera: object = None, prior: object = None) -> LocatedPose:
        self.asked.append((np.asarray(image).shape, camera, prior))
        status = "accepted" if len(self.asked) % 2 else "refused"
        return LocatedPose(np.array([1.0, 2, 3]), np.array([0.8, 0, 0, 0.6]), status, covariance=np.eye(6))


@pytest.fixture
def localizer(monkeypatch: pytest.MonkeyPatch) -> StandIn:
    standing_in = StandIn()
    monkeypatch.setattr(Localizer, "load", lambda source: standing_in)
    return standing_in


def test_a_bag_is_located(bag: Path, code: dict[str, Any], localizer: StandIn) -> None:
    found = list(code["locate_bag"]("model", bag, RAW))
    assert [time_ns for time_ns, _ in found] == [START + i * SECOND // 10 for i in range(4)]
    assert [pose.status for _, pose in found] == ["accepted", "refused"] * 2
    assert {shape for shape, _, _ in localizer.asked} == {(48, 64, 3)}


class Node:
    """Stands in for `rclpy.node.Node`."""

    def __init__(self, name: str) -> None:
        self.published: list[Any] = []
        self.callbacks: dict[str, Any] = {}

    def declare_parameter(self, name: str, value: str) -> Any:
        return SimpleNamespace(value=value)

    def create_publisher(self, kind: type, topic: str, depth: int) -> Any:
        return SimpleNamespace(publish=self.published.append)

    def create_subscription(self, kind: type, topic: str, callback: Any, qos: object) -> None:
        self.callbacks[topic] = callback

    def get_logger(self) -> Any:
        return SimpleNamespace(info=lambda text: None, warning=lambda text: None)


def make_answer() -> Any:
    pose = SimpleNamespace(position=SimpleNamespace(), orientation=SimpleNamespace())
    return SimpleNamespace(header=SimpleNamespace(), pose=SimpleNamespace(pose=pose, covariance=None))


@pytest.fixture
def node(monkeypatch: pytest.MonkeyPatch, localizer: StandIn) -> Any:
    """The page's node, with stand-ins for the modules of ROS."""
    names = {
        "rclpy": {},
        "rclpy.node": {"Node": Node},
        "rclpy.qos": {"qos_profile_sensor_data": None},
        "geometry_msgs": {},
        "geometry_msgs.msg": {"PoseWithCovarianceStamped": make_answer},
        "sensor_msgs": {},
        "sensor_msgs.msg": {"CameraInfo": SimpleNamespace, "CompressedImage": SimpleNamespace},
    }
    for name, content in names.items():
        module = ModuleType(name)
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, name, module)
    code: dict[str, Any] = {"__name__": "node"}
    exec(compile(NODE, "docs/robots.md", "exec"), code)
    return code["LocateCamera"]()


def test_the_node_publishes_accepted_poses(node: Any, localizer: StandIn) -> None:
    calibration = [500.0, 0.0, 31.5, 0.0, 510.0, 23.5, 0.0, 0.0, 1.0]
    info = SimpleNamespace(width=64, height=48, k=calibration, d=[0.1, 0.2, 0, 0, 0.3], distortion_model="plumb_bob")
    node.callbacks["camera_info"](info)
    data = cv2.imencode(".jpg", make_picture(0))[1].tobytes()
    for content in (data, data, b"no image", data):
        node.callbacks["image/compressed"](SimpleNamespace(data=content, header=SimpleNamespace(stamp=7)))
    camera = "FULL_OPENCV,64,48,500.0,510.0,31.5,23.5,0.1,0.2,0,0,0.3,0,0,0"
    assert [(shape, given) for shape, given, _ in localizer.asked] == [((48, 64, 3), camera)] * 3
    assert [prior is None for _, _, prior in localizer.asked] == [True, False, True]
    assert len(node.published) == 2
    answer = node.published[0]
    assert (answer.header.stamp, answer.header.frame_id) == (7, "map")
    assert vars(answer.pose.pose.orientation) == {"w": 0.8, "x": 0.0, "y": 0.0, "z": 0.6}
    assert len(answer.pose.covariance) == 36


def test_cameras_of_ros_are_read_by_the_localizer(node: Any) -> None:
    from lightning_pose.geometry.camera import Camera

    write_camera = type(node).take_camera.__globals__["write_camera"]
    kinds = {"plumb_bob": 5, "equidistant": 4, "rational_polynomial": 8, "thin_prism": 3}
    for model, count in kinds.items():
        info = SimpleNamespace(
            width=64, height=48, k=[500.0, 0, 31.5, 0, 510.0, 23.5, 0, 0, 1], d=[0.1] * count, distortion_model=model
        )
        text = write_camera(info)
        assert (text is None) == (model == "thin_prism")
        if text is not None:
            assert np.count_nonzero(Camera.parse(text).distortion) == count
            info.d = [0.0] * count
            assert Camera.parse(write_camera(info)).distortion == ()
