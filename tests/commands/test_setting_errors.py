"""Messages about wrong settings: one line, in words that a user of YAML knows."""

from __future__ import annotations

import pytest

from lightning_pose.commands.setting_errors import REMEDY, explain_setting_error

UNION = """Parser key "trainer.logger":
  Does not validate against any of the Union subtypes
  Subtypes: [<class 'lightning.pytorch.loggers.logger.Logger'>, collections.abc.Iterable, <class 'bool'>, NoneType]
  Errors:
    - Expected a path but 5 either not accessible or invalid
    - Expected a dot import path string: 5
    - Expected a <class 'collections.abc.Iterable'>
    - Expected a <class 'bool'>
    - Expected a <class 'NoneType'>
  Given value type: <class 'int'>
  Given value: 5"""


@pytest.mark.parametrize(
    ("message", "line"),
    [
        (UNION, "trainer.logger: give the class path of a class or a list or true or false, not 5"),
        (
            "Parser key \"data\":\n  val_fraction: Expected a <class 'float'>. Got value: x",
            "give a number (float), not x",
        ),
        (
            "model: form: Expected a typing.Literal['joint', 'split']. Got value: bad",
            "give one of 'joint', 'split', not bad",
        ),
        (
            "model:\n  - Expected a path but a.B either not accessible or invalid\n  Import path does not correspond to"
            " a subclass of PoseModule\n - Expected a <class 'NoneType'>\n Given value: a.B",
            "model: a.B: Import path does not correspond to a subclass of PoseModule",
        ),
        (
            UNION.replace("- Expected a dot import path string: 5", "- no server there; start it"),
            "trainer.logger: 5: no server there; start it",
        ),
        ("data: Option 'root' is not accepted", "data: Option 'root' is not accepted"),
        (
            "the following arguments are required: fit.data, fit.model",
            "there is no data and no model; give a complete config, such as --config configs/surf_lstm.yaml",
        ),
        ("unrecognized arguments: --confg x", "unrecognized arguments: --confg x"),
    ],
)
def test_a_message_in_plain_words(message: str, line: str) -> None:
    explained = explain_setting_error(message)
    assert explained.endswith(f"{line}; {REMEDY}")
    assert "Expected" not in explained
    assert explain_setting_error(explained) == explained
    assert explain_setting_error(f"data: {explained}\n- Expected a <class 'NoneType'>") == f"data: {explained}"
