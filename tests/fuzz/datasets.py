"""A tiny dataset of each format, as files in memory, and ways to damage it."""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from pathlib import Path

from hypothesis import strategies as st

__all__ = ["DATASETS", "Damage", "apply_damages", "damages", "write_files"]

Files = Mapping[str, bytes]

MATRIX = "0 -1 0 {x}\n1 0 0 2\n0 0 1 3\n0 0 0 1\n"
TIMES = [1305031102.0 + 0.1 * i for i in range(6)]


def _seven_scenes() -> Files:
    splits = {"TrainSplit.txt": b"sequence1\nsequence2\n", "TestSplit.txt": b"sequence3\n"}
    frames = {f"seq-0{s}/frame-00000{i}": MATRIX.format(x=i + s).encode() for s in (1, 2, 3) for i in range(3)}
    return (
        splits
        | {f"{stem}.pose.txt": pose for stem, pose in frames.items()}
        | {f"{stem}.color.png": b"" for stem in frames}
    )


def _twelve_scenes() -> Files:
    info = b"m_colorWidth = 1296\nm_calibrationColorIntrinsic = 1158 0 649 0 0 1153 483 0 0 0 1 0 0 0 0 1\n"
    split = b"sequence0 [frames=3]  [start=0 ; end=2]\nsequence1 [frames=3]  [start=3 ; end=5]\n"
    frames = {f"data/frame-00000{i}.pose.txt": MATRIX.format(x=i).encode() for i in range(6)}
    return {"info.txt": info, "split.txt": split} | frames | {f"data/frame-00000{i}.color.jpg": b"" for i in range(6)}


def _tum() -> Files:
    listed = "# color images\n" + "".join(f"{t:.6f} rgb/{t:.6f}.png\n" for t in TIMES)
    poses = "# ground truth\n" + "".join(f"{t + 0.003:.4f} {i} 2 3 0 0 0.6 0.8\n" for i, t in enumerate(TIMES))
    images = {f"rgb/{t:.6f}.png": b"" for t in TIMES}
    return {"rgb.txt": listed.encode(), "groundtruth.txt": poses.encode()} | images


def _icl_nuim() -> Files:
    poses = "".join(f"{i} {i} 2 3 0 0 0.6 0.8\n" for i in range(6))
    listed = "".join(f"{i} depth/{i}.png {i} rgb/{i}.png\n" for i in range(6))
    images = {f"rgb/{i}.png": b"" for i in range(6)}
    return {"livingRoom2.gt.freiburg": poses.encode(), "associations.txt": listed.encode()} | images


def _cambridge() -> Files:
    head = "Visual Landmark Dataset V1\nImageFile, Camera Position [X Y Z W P Q R]\n\n"
    rows = [f"seq1/frame0000{i}.png {i} 2 3 0.8 0 0 0.6\n" for i in range(6)]
    lists = {"dataset_train.txt": head + "".join(rows[:4]), "dataset_test.txt": head + "".join(rows[4:])}
    images = {f"seq1/frame0000{i}.png": b"" for i in range(6)}
    return {name: text.encode() for name, text in lists.items()} | images


def _pose_list() -> Files:
    rows = "".join(f"{i}.png,{i},2,3,0.8,0,0,0.6\n" for i in range(6))
    return {"poses.csv": f"image,tx,ty,tz,qw,qx,qy,qz\n{rows}".encode()} | {f"{i}.png": b"" for i in range(6)}


def _colmap_text() -> Files:
    cameras = b"# Camera list\n1 PINHOLE 640 480 500 510 320 240\n"
    images = "".join(f"{i} 0.8 0 0 0.6 {i} 2 3 1 {i}.jpg\n1.5 2.5 -1\n" for i in range(6))
    model = {"sparse/0/cameras.txt": cameras, "sparse/0/images.txt": images.encode()}
    return model | {f"images/{i}.jpg": b"" for i in range(6)}


def _colmap_binary() -> Files:
    cameras = struct.pack("<QiiQQ4d", 1, 1, 1, 640, 480, 500, 510, 320, 240)
    images = struct.pack("<Q", 6)
    for i in range(6):
        images += struct.pack("<i7di", i, 0.8, 0, 0, 0.6, i, 2, 3, 1) + f"{i}.jpg".encode() + b"\0"
        images += struct.pack("<Qddq", 1, 1.5, 2.5, -1)
    return {"sparse/0/cameras.bin": cameras, "sparse/0/images.bin": images} | {f"images/{i}.jpg": b"" for i in range(6)}


def _transforms_json() -> Files:
    matrices = [[[0, -1, 0, i], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]] for i in range(6)]
    frames = [{"file_path": f"images/{i}.png", "transform_matrix": matrix} for i, matrix in enumerate(matrices)]
    head = {"fl_x": 500.0, "fl_y": 510.0, "cx": 320.0, "cy": 240.0, "w": 640, "h": 480}
    text = json.dumps(head | {"frames": frames}, indent=1)
    return {"transforms.json": text.encode()} | {f"images/{i}.png": b"" for i in range(6)}


def _kitti() -> Files:
    poses = "".join(f"-1 0 0 0 0 1 0 0 0 0 -1 {i}\n" for i in range(6))
    head = {"calib.txt": b"P2: 700 0 600 42 0 700 180 0 0 0 1 0\n", "times.txt": b"0\n0.1\n0.2\n0.3\n0.4\n0.5\n"}
    return head | {"poses.txt": poses.encode()} | {f"image_2/00000{i}.png": b"" for i in range(6)}


DATASETS: Mapping[str, Files] = {
    "7scenes": _seven_scenes(),
    "12scenes": _twelve_scenes(),
    "tum": _tum(),
    "icl_nuim": _icl_nuim(),
    "cambridge": _cambridge(),
    "poses.csv": _pose_list(),
    "colmap text": _colmap_text(),
    "colmap binary": _colmap_binary(),
    "transforms.json": _transforms_json(),
    "kitti": _kitti(),
}

WORDS = [
    *("nan", "-inf", "1e999", "-1e300", "9" * 5000, "0", "-1", "1,5", "0x1f", "1_000", "", "#", '"', "[", "{}", "null"),
    *(
        "true",
        "é",
        "\ufeff",
        "\u202e",
        "\0",
        "../../x.png",
        "a" * 300 + ".png",
        "/",
        ".",
        "~",
        "C:\\x.png",
        "\t",
        "seq1",
    ),
]
"""What stands in a file in place of a word."""

KINDS = ("word", "drop line", "repeat line", "swap lines", "flip", "cut", "empty", "remove", "insert", "rename")

Damage = tuple[str, int, int, str]
"""What is done, to which file, where in it, and the word that is put there."""

damages = st.lists(
    st.tuples(st.sampled_from(KINDS), st.integers(0, 999), st.integers(0, 9999), st.sampled_from(WORDS)),
    min_size=1,
    max_size=4,
)


def apply_damages(files: Files, chosen: list[Damage]) -> dict[str, bytes]:
    """The files of a dataset after some damages, most of them to files with content."""
    found = dict(files)
    for kind, which, where, word in chosen:
        written = sorted(name for name in found if found[name]) or sorted(found)
        names = sorted(found) if kind in ("remove", "rename") and where % 2 else written
        if not names:
            break
        name = names[which % len(names)]
        if kind == "remove":
            del found[name]
        elif kind == "rename":
            found[name.upper() if where % 2 else f"{name}.bak"] = found.pop(name)
        else:
            found[name] = _damage(found[name], kind, where, word)
    return found


def _damage(data: bytes, kind: str, where: int, word: str) -> bytes:
    """A file's bytes after one damage."""
    lines, at = data.split(b"\n"), where % max(1, len(data))
    row = where % len(lines)
    if kind == "word":
        words = data.split(b" ")
        words[where % len(words)] = word.encode()
        return b" ".join(words)
    if kind == "drop line":
        return b"\n".join(lines[:row] + lines[row + 1 :])
    if kind == "repeat line":
        return b"\n".join([*lines[:row], lines[row], *lines[row:]])
    if kind == "swap lines":
        lines[row], lines[0] = lines[0], lines[row]
        return b"\n".join(lines)
    if kind == "flip":
        return data[:at] + bytes([(data[at] if data else 0) ^ (1 << where % 8)]) + data[at + 1 :]
    return {"cut": data[:at], "empty": b"", "insert": data[:at] + word.encode() + data[at:]}[kind]


def write_files(root: Path, files: Files) -> Path:
    """A folder with these files; those whose names no file system takes are left out."""
    for name, data in files.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
    return root
