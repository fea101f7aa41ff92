"""Tables of the terminal: with rows and columns exchanged if only then they fit, and with all of their text."""

from __future__ import annotations

import pytest

from lightning_pose.terminal import Sheet

HEADS = ["scene", "median position error (m)", "parameters", "features, ms a frame", "bytes of the weights' file"]
ROWS = [["office", "1.35", "196,507", "24.3", "794,358"], ["[desk]", "0.2", "7", "1", "30"]]


@pytest.mark.parametrize(("width", "beside"), [(120, "[desk]"), (66, "[desk]"), (48, "1.35")])
def test_every_number_is_whole(width: int, beside: str, capsys: pytest.CaptureFixture[str]) -> None:
    """A usual table where numbers fit, however many lines the headings take; else each row is a column."""
    Sheet("title", HEADS, ROWS).show(width)
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= width
    assert all(any(cell in line for line in lines) for row in ROWS for cell in row)
    assert any("0.2" in line and beside in line for line in lines)


def test_a_long_table_is_not_exchanged(capsys: pytest.CaptureFixture[str]) -> None:
    Sheet("title", ["number"], [["1"]] * 50, "a caption").show(20)
    assert len(capsys.readouterr().out.splitlines()) > 50
