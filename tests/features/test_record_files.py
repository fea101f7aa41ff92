"""Tests of record files: read whole, or reported as damaged."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from lightning_pose.errors import CacheError
from lightning_pose.features.base import Record
from lightning_pose.features.record_files import DamagedError, read_record, write_file_atomically, write_record
from tests.helpers import limit_file_size

RECORD = {
    "descriptors": np.arange(6, dtype=np.float32).reshape(2, 3).T,  # not contiguous, as a slice may be
    "count": np.array(2, np.int64),
    "none": np.zeros((0, 5), np.float32),
}


def same(a: Record | None, b: Record) -> bool:
    return a is not None and a.keys() == b.keys() and all(np.array_equal(a[k], b[k]) for k in b)


def test_round_trip(tmp_path: Path) -> None:
    file = tmp_path / "ab" / "x.safetensors"
    write_record(file, RECORD)
    record = read_record(file)
    assert record is not None
    assert same(record, RECORD)
    assert {name: (a.dtype, a.shape) for name, a in record.items()} == {
        name: (a.dtype, a.shape) for name, a in RECORD.items()
    }
    assert [p.name for p in file.parent.iterdir()] == ["x.safetensors"]


def test_absent_file_is_none(tmp_path: Path) -> None:
    assert read_record(tmp_path / "x.safetensors") is None


def test_every_flipped_byte_is_noticed(tmp_path: Path) -> None:
    file = tmp_path / "x.safetensors"
    write_record(file, RECORD)
    whole = file.read_bytes()
    for position in range(len(whole)):
        for mask in (0x01, 0x20, 0xFF):
            file.write_bytes(whole[:position] + bytes([whole[position] ^ mask]) + whole[position + 1 :])
            with suppress(DamagedError):
                assert same(read_record(file), RECORD), f"byte {position} ^ {mask:#x} went unnoticed"


def test_every_truncation_is_noticed(tmp_path: Path) -> None:
    file = tmp_path / "x.safetensors"
    write_record(file, RECORD)
    whole = file.read_bytes()
    for length in range(len(whole)):
        file.write_bytes(whole[:length])
        with pytest.raises(DamagedError):
            read_record(file)


def test_full_disk(tmp_path: Path) -> None:
    with limit_file_size(3), pytest.raises(CacheError, match=r"File too large.*free some space, or set LIGHTNING_POSE"):
        write_file_atomically(tmp_path / "x", b"data")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("owner", ["surf-1/bb", "orb-1/aa"])
def test_a_record_of_another_image_is_noticed(owner: str, tmp_path: Path) -> None:
    """As when a file of the cache is copied over another one, of that extractor or of another."""
    file = tmp_path / "x.safetensors"
    write_record(file, RECORD, "surf-1/aa")
    assert same(read_record(file, "surf-1/aa"), RECORD)
    with pytest.raises(DamagedError, match="it is the record of surf-1/aa"):
        read_record(file, owner)


def test_a_record_of_an_earlier_version_is_believed(tmp_path: Path) -> None:
    file = tmp_path / "x.safetensors"
    write_record(file, RECORD)
    assert same(read_record(file, "surf-1/aa"), RECORD)


def test_unreadable_file(tmp_path: Path) -> None:
    folder = tmp_path / "x.safetensors"
    folder.mkdir()
    with pytest.raises(CacheError, match=r"x\.safetensors cannot be read"):
        read_record(folder)
