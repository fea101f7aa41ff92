"""`poses.csv`: columns by name in any order, splits and cameras where the file has them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lightning_pose.errors import DataError
from lightning_pose.scenes.formats import load_scene
from lightning_pose.scenes.scene import Intrinsics
from tests.data.helpers import make_image

HALF = 0.5**0.5


def write(root: Path, text: str, count: int = 4) -> Path:
    for i in range(count):
        make_image(root / f"{i}.jpg")
    (root / "poses.csv").write_text(text)
    return root


@pytest.mark.parametrize(
    ("header", "row"),
    [
        ("image,tx,ty,tz,qw,qx,qy,qz", "{i}.jpg,1,2,3,{h},0,0,{h}"),
        ("qx;qy;qz;qw;x;y;z;file", "0;0;{h};{h};1;2;3;{i}.jpg"),
        ("# timestamp\tfilename\tqw\tqx\tqy\tqz\tpx\tpy\tpz", "0.5\t{i}.jpg\t{h}\t0\t0\t{h}\t1\t2\t3"),
        ('"image","tx","ty","tz","qw","qx","qy","qz"', '"{i}.jpg",1,2,3,{h},0,0,{h}'),
    ],
)
def test_the_header_says_the_order(header: str, row: str, tmp_path: Path) -> None:
    scene = load_scene(write(tmp_path, "\n".join([header, *(row.format(i=i, h=HALF) for i in range(4))])))
    assert (scene.format, len(scene.frames)) == ("pose_list", 4)
    frame = scene.frames[2]
    assert (frame.image, frame.index) == (tmp_path / "2.jpg", 2)
    assert frame.timestamp == (0.5 if "timestamp" in header else None)
    np.testing.assert_allclose(frame.position_m, [1, 2, 3])
    np.testing.assert_allclose(frame.quat_wxyz, [HALF, 0, 0, HALF])


def test_splits_sequences_and_cameras(tmp_path: Path) -> None:
    lines = ["image,sequence,split,fx,fy,cx,cy,tx,ty,tz,qw,qx,qy,qz"]
    lines += [f"{i}.jpg,{'ab'[i // 2]},{'train' if i < 2 else 'test'},500,510,320,240,0,0,0,1,0,0,0" for i in range(4)]
    scene = load_scene(write(tmp_path, "\n".join(lines)), val_fraction=0)
    assert [frame.sequence for frame in scene.frames] == ["a", "a", "b", "b"]
    assert scene.splits["test"].tolist() == [2, 3]
    assert scene.split_source == "official"
    assert scene.frames[0].intrinsics == Intrinsics(500, 510, 320, 240)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r"poses.csv has 0 lines; give a header, such as image,tx"),
        ("image,x,y,z,a,b,c,d\n0.jpg,0,0,0,1,0,0,0", r"poses.csv:1: the header is `image,x,y,z,a,b,c,d`; name the"),
        ("tx,ty,tz,qw,qx,qy,qz\n0,0,0,1,0,0,0", r"name the columns, such as image,tx"),
        ("image,tx,ty,tz,qw,qx,qy,qz\n0.jpg,0,0", r"poses.csv:2: 3 columns, but the header has 8"),
        ("image,split,tx,ty,tz,qw,qx,qy,qz\n0.jpg,dev,0,0,0,1,0,0,0", r"poses.csv:2: the split is 'dev'"),
        ("image,tx,ty,tz,qw,qx,qy,qz\n0.jpg,0,x,0,1,0,0,0", r"poses.csv:2: the pose has NaN or infinite numbers"),
        ("image,tx,ty,tz,qw,qx,qy,qz\n9.jpg,0,0,0,1,0,0,0", r"9.jpg is missing, listed in poses.csv"),
        ("image,tx,ty,tz,qw,qx,qy,qz,fx,fy,cx,cy\n0.jpg,0,0,0,1,0,0,0,0,1,1,1", r"poses.csv:2: the camera is 0 1"),
    ],
)
def test_faults(text: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(DataError, match=message):
        load_scene(write(tmp_path, text))
