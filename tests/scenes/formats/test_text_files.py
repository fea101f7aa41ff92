"""Files of numbers: encodings, separators, headers, and rows that cannot be read."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lightning_pose.errors import DataError
from lightning_pose.scenes.formats.text_files import find_column_order, parse_numbers, read_lines, read_table

COLUMNS = "timestamp tx ty tz qx qy qz qw"
ROW = "1 2 3 4 0.1 0.2 0.3 0.9"


@pytest.mark.parametrize(
    "text",
    [
        "1.5 -2 3e2",
        "1.5\t-2\t3e2",
        "1.5,-2,3e2",
        "1.5, -2, 3e2",
        "1.5;-2;3e2",
        "[1.5 -2 300.]",
        "[[1.5, -2],\n [300]]",
        "1,5 -2 3e2",
        "1,5;-2,0;300,0",
    ],
)
def test_separators(text: str) -> None:
    np.testing.assert_allclose(parse_numbers(text, 3), [1.5, -2, 300])


def test_commas_without_blanks_separate() -> None:
    np.testing.assert_allclose(parse_numbers("1,5", 2), [1, 5])


@pytest.mark.parametrize("text", ["nan", "NaN", "-nan(ind)", "-1.#IND", "1.#QNAN", "inf", "-INF", "1.#INF", "9" * 5000])
def test_what_is_no_finite_number(text: str) -> None:
    assert not np.isfinite(parse_numbers(text, 1)).any()


@pytest.mark.parametrize("text", ["", "one two", "1 2 3 4", "1 2"])
def test_wrong_counts_and_words_are_refused(text: str) -> None:
    with pytest.raises(ValueError, match=r"."):
        parse_numbers(text, 3)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_encodings_and_line_ends(encoding: str, end: str, tmp_path: Path) -> None:
    path = tmp_path / "x.txt"
    path.write_bytes(end.join(["# a", "1 2  ", "", "3 4", ""]).encode(encoding))
    assert read_lines(path) == [(2, "1 2"), (4, "3 4")]


def test_bytes_that_are_no_text_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "x.txt"
    path.write_bytes(b"\x80\x81")
    with pytest.raises(DataError, match=r"x\.txt cannot be read as text"):
        read_lines(path)


@pytest.mark.parametrize(
    ("header", "row"),
    [
        ("# timestamp tx ty tz qx qy qz qw", ROW),
        ("# timestamp tx ty tz qw qx qy qz", "1 2 3 4 0.9 0.1 0.2 0.3"),
        ("# Time,X,Y,Z,W,QX,QY,QZ", "1,2,3,4,0.9,0.1,0.2,0.3"),
        ("timestamp pos_x pos_y pos_z quat_w quat_x quat_y quat_z", "1 2 3 4 0.9 0.1 0.2 0.3"),
        ("num t x y z qx qy qz qw", f"17 {ROW}"),
        ("# trajectory of the camera: timestamp tx ty tz qw qx qy qz", "1 2 3 4 0.9 0.1 0.2 0.3"),
        ("# format: t qw qx qy qz x y z", "1 0.9 0.1 0.2 0.3 2 3 4"),
        ("# timestamp (s)\ttx (m)\tty (m)\ttz (m)\tqw\tqx\tqy\tqz", "1\t2\t3\t4\t0.9\t0.1\t0.2\t0.3"),
        (
            "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z [],"
            "v_RS_R_x [m s^-1],v_RS_R_y [m s^-1],v_RS_R_z [m s^-1]",
            "1,2,3,4,0.9,0.1,0.2,0.3,7,7,7",
        ),
        ("# ground truth, made by x y z", ROW),
        ("", ROW),
        ("# timestamp tx ty tz qw qx qy qz", "1,0 2,0 3,0 4,0 0,9 0,1 0,2 0,3"),
    ],
)
def test_header_gives_the_order_of_columns(header: str, row: str, tmp_path: Path) -> None:
    path = tmp_path / "x.txt"
    path.write_text(f"# first\n{header}\n{row}\n")
    table = read_table(path, COLUMNS)
    np.testing.assert_allclose(table.values, [[1, 2, 3, 4, 0.1, 0.2, 0.3, 0.9]])
    assert table.faults == [""]


def test_every_bad_row_has_a_fault_and_keeps_its_time(tmp_path: Path) -> None:
    path = tmp_path / "x.txt"
    rows = [ROW, "2 nan nan nan nan nan nan nan", "3 1 2", ROW, "nan 2 3 4 0 0 0 1", "lost"]
    path.write_text("\n".join(rows))
    table = read_table(path, COLUMNS)
    assert [fault[: fault.find(": ")] for fault in table.faults] == [
        "",
        f"{path}:2",
        f"{path}:3",
        "",
        f"{path}:5",
        f"{path}:6",
    ]
    np.testing.assert_array_equal(table.values[:, 0], [1, 2, 3, 1, np.nan, np.nan])
    assert "found `3 1 2`" in table.faults[2]


def test_columns_of_cambridge_lists() -> None:
    names = ("tx", "ty", "tz", "qw", "qx", "qy", "qz")
    assert find_column_order(["X", "Y", "Z", "W", "P", "Q", "R"], names) == [0, 1, 2, 3, 4, 5, 6]
    assert find_column_order(["X", "Y", "Z", "P", "Q", "R", "W"], names) == [0, 1, 2, 6, 3, 4, 5]
    assert find_column_order(["X", "Y", "Z"], names) is None
