"""Reads text files of numbers: encodings, separators, headers, and rows that cannot be read."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lightning_pose.errors import DataError

__all__ = [
    "NumberTable",
    "find_column_order",
    "find_file",
    "list_files",
    "parse_numbers",
    "read_lines",
    "read_matrix",
    "read_table",
    "read_text",
]

POSITION_PREFIXES = ("", "t", "p", "c", "pos", "position", "trans", "translation", "prsr", "ptx")
"""What stands before x, y or z in the name of a position's column, letters only."""

QUATERNION_PREFIXES = ("q", "quat", "quaternion", "rot", "rotation", "ori", "orientation", "qrs")
"""What stands before x, y, z or w in the name of a quaternion's column, letters only."""

DECIMAL_COMMA = re.compile(r"[+-]?\d+(?:,\d+)?(?:[eE][+-]?\d+)?")
NO_NUMBER = re.compile(r"[+-]?\d*\.?\d*#(?:INF|IND|QNAN|SNAN|NAN)\w*|[+-]?nan\(\w*\)", re.IGNORECASE)
"""How Windows programs print NaN and infinity: `1.#INF`, `-1.#IND`, `-nan(ind)`."""


class NumberTable(NamedTuple):
    """Rows of numbers out of a text file.

    Attributes:
        values: (N, C) float64; a row with a fault has NaN after its first column, and the first too if it is no number.
        places: `path:line` of each row.
        faults: what is wrong with each row, beginning with its place; empty if it is as expected.
        header: the lines before the first row and comments, as they stand in the file.
    """

    values: np.ndarray
    places: list[str]
    faults: list[str]
    header: list[str]


def list_files(folder: Path) -> list[Path]:
    """The entries of a folder by name, without hidden ones, such as the `._name` files of macOS."""
    return sorted(path for path in folder.iterdir() if not path.name.startswith("."))


def find_file(root: Path, name: str) -> Path:
    """The file of that name in a folder, in upper or lower case; `root / name` if there is none."""
    exact = root / name
    if exact.is_file() or not root.is_dir():
        return exact
    return next((path for path in list_files(root) if path.name.lower() == name.lower() and path.is_file()), exact)


def read_lines(path: Path, comments: bool = False) -> list[tuple[int, str]]:
    """Read the lines of a text file, stripped, with their numbers from 1, without blank lines.

    Args:
        path: UTF-8, or UTF-16 with a byte order mark.
        comments: whether to keep the lines that begin with `#`.

    Raises:
        DataError: the file is missing or is not text.
    """
    lines = ((number, line.strip()) for number, line in enumerate(read_text(path).splitlines(), start=1))
    return [(number, line) for number, line in lines if line and (comments or not line.startswith("#"))]


def read_text(path: Path) -> str:
    """Read a text file in UTF-8, or in UTF-16 with a byte order mark; the mark is left out.

    Raises:
        DataError: the file is missing or is not text.
    """
    try:
        data = path.read_bytes()
        text = data.decode("utf-16" if data[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig")
    except FileNotFoundError as error:
        raise DataError(f"{path} is missing; repeat the download or the unpacking") from error
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path} cannot be read as text ({error}); restore the original") from error
    return text


def parse_numbers(text: str, count: int | None = None) -> np.ndarray:
    """Read numbers that are separated by blanks, tabs, commas, semicolons or brackets.

    A decimal comma (`1,5 2,25`) is understood where blanks or semicolons separate `count` numbers.

    Args:
        text: the numbers; NaN and infinity too, as the usual programs print them.
        count: how many there are; any number of them if it is None.

    Returns:
        (count,) float64.

    Raises:
        ValueError: the text has another number of entries, or one that is not a number.
    """
    items = text.split()
    try:
        numbers = np.array(items, dtype=np.float64)  # most files, and the fastest way
    except ValueError:
        items = NO_NUMBER.sub("nan", text.strip(" \t;")).replace(";", " ").split()
        if len(items) == count and all(DECIMAL_COMMA.fullmatch(item) for item in items):
            items = [item.replace(",", ".") for item in items]
        else:
            items = [item for item in re.split(r"[\s,\[\]()]+", " ".join(items)) if item]
        numbers = np.array(items, dtype=np.float64)
    if count is not None and len(numbers) != count:
        raise ValueError(f"expected {count} numbers, found {len(numbers)}")
    return numbers


def read_matrix(path: Path) -> np.ndarray:
    """Read a file of one pose, (4, 4) float64; the last row may be left out.

    Raises:
        DataError: the file is missing or is not text.
        ValueError: it has another number of entries, or one that is not a number.
    """
    numbers = parse_numbers(read_text(path))
    if len(numbers) == 12:
        numbers = np.append(numbers, [0, 0, 0, 1])
    if len(numbers) != 16:
        raise ValueError(f"it has {len(numbers)} numbers")
    return numbers.reshape(4, 4)


def read_table(path: Path, columns: str) -> NumberTable:
    """Read a table of numbers, one row a line; the header may give another order of columns than `columns`.

    Args:
        path: the text file.
        columns: names of the columns, such as `timestamp tx ty tz qx qy qz qw`.

    Raises:
        DataError: the file is missing or is not text.
    """
    header, rows = _part_header(read_lines(path, comments=True))
    names = columns.split()
    order, width = list(range(len(names))), len(names)
    for line in header if rows else []:
        for words in _list_column_names(line):
            found = find_column_order(words, names)
            if found is not None and _holds_numbers(rows[0][1], len(words)):
                order, width = found, len(words)
    values, faults = np.full((len(rows), len(names)), np.nan), []
    for row, (number, line) in enumerate(rows):
        fault = ""
        try:
            values[row] = parse_numbers(line, width)[order]
        except ValueError:
            values[row, 0] = _parse_first_number(line)
            shown = line if len(line) < 200 else f"{line[:200]}..."
            fault = f"{path}:{number}: expected finite numbers `{columns}`, found `{shown}`; correct the line"
        if not fault and not np.isfinite(values[row]).all():
            fault = f"{path}:{number}: expected finite numbers `{columns}`, found `{line}`; correct the line"
        faults.append(fault)
    return NumberTable(values, [f"{path}:{number}" for number, _ in rows], faults, header)


def find_column_order(words: Iterable[str], names: Iterable[str]) -> list[int] | None:
    """Where each column stands, by the names in a header; None if the header does not name each column once.

    Args:
        words: the header's names, such as `timestamp x y z qw qx qy qz` or `t p_x p_y p_z q_w q_x q_y q_z`.
        names: the columns to find: `timestamp` (or `frame`), `tx` to `tz`, `qx` to `qz`, `qw`.
    """
    standard = [_find_standard_name(word) for word in words]
    wanted = ["timestamp" if name == "frame" else name for name in names]
    if any(standard.count(name) != 1 for name in wanted):
        return None
    return [standard.index(name) for name in wanted]


def _part_header(lines: list[tuple[int, str]]) -> tuple[list[str], list[tuple[int, str]]]:
    """Comments, and what stands before the first number; and the other lines with their numbers."""
    rows = [(number, line) for number, line in lines if not line.startswith("#")]
    header = [line for _, line in lines if line.startswith("#")]
    if rows and re.match(r"(?!nan|inf)[A-Za-z_]+\b", rows[0][1], re.IGNORECASE):
        header.append(rows.pop(0)[1])
    return header, rows


def _list_column_names(line: str) -> list[list[str]]:
    """The words of a header line without units in brackets, and likewise from the time on."""
    line = re.sub(r"[\[(][^\])]{0,12}[\])]", "", line.lstrip("# "))
    words = [word for word in re.split(r"[\s,;:\[\]()]+", line) if word]
    starts = [i for i, word in enumerate(words) if _find_standard_name(word) == "timestamp"]
    return [words, *(words[start:] for start in starts)]


def _holds_numbers(line: str, count: int) -> bool:
    """Whether a line is so many numbers."""
    try:
        return len(parse_numbers(line, count)) == count
    except ValueError:
        return False


def _find_standard_name(word: str) -> str:
    """`timestamp`, `tx` to `tz`, `qx` to `qz`, `qw`, for other names of the same; empty if it is none of these."""
    letters = re.sub(r"[^a-z]", "", word.lower())
    if letters in ("p", "q", "r"):  # Cambridge Landmarks: W P Q R
        return {"p": "qx", "q": "qy", "r": "qz"}[letters]
    if letters in ("t", "ts", "sec", "secs", "seconds", "nsec", "ns") or letters.startswith(("time", "stamp")):
        return "timestamp"
    prefix, axis = letters[:-1], letters[-1:]
    if (axis in ("x", "y", "z", "w") and prefix in QUATERNION_PREFIXES) or letters == "w":
        return f"q{axis}"
    return f"t{axis}" if axis in ("x", "y", "z") and prefix in POSITION_PREFIXES else ""


def _parse_first_number(line: str) -> float:
    """The first entry of a line as a number, NaN if it is none."""
    try:
        return float(re.split(r"[\s,;]+", line, maxsplit=1)[0])
    except ValueError:
        return float("nan")
