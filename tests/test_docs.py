"""The pages' commands: each parses as the program is now, and is run here, by another test, or carries a date."""

from __future__ import annotations

import ast
import contextlib
import re
import shlex
import shutil
from collections.abc import Callable, Iterator
from importlib import import_module
from inspect import signature
from pathlib import Path
from typing import NamedTuple

import pytest

from lightning_pose import data, features, models
from lightning_pose.__main__ import VERBS, main
from lightning_pose.cli import PoseCLI
from lightning_pose.commands.parser import VerbParser
from lightning_pose.runs import logger
from lightning_pose.scenes.synthetic import render_room
from tests.data.helpers import write_recording
from tests.helpers import REPOSITORY, Workplace

PAGES = sorted([*REPOSITORY.glob("*.md"), *(REPOSITORY / "docs").glob("*.md")])
PROGRAM = "python -m lightning_pose "
SHELL = ("uv", "python", "mlflow", "bash", "docker", "curl", "pip")
DATED = re.compile(r"\b[Rr]un on 20\d\d-\d\d-\d\d|has not been built yet")
CHECKPOINT = REPOSITORY / "tests" / "checkpoint" / "files" / "surf_lstm_0_1.ckpt"
SYSTEMS = ("linear_posenet", "surf_lstm", "cnn_rnn")

SMALL = "--trainer.accelerator cpu --report.log_model false"
RUN = {
    f"{PROGRAM}check DIR": "",
    f"{PROGRAM}fit --config configs/landmark_map.yaml --data.root DIR": SMALL,
    f'{PROGRAM}fit --config configs/surf_lstm.yaml --data.train_scenes "[rgbd_dataset_freiburg1_xyz]" '
    '--data.test_scenes "[rgbd_dataset_freiburg1_rpy]"': f"{SMALL} --trainer.max_epochs 1",
    f"{PROGRAM}report --baselines --published": "",
    f"{PROGRAM}report --by features --pick spread --out table.tex": "",
}
"""Commands that are run here, in this order, and what makes them small."""

ELSEWHERE = {
    f"{PROGRAM}fit --config configs/quickstart.yaml": "test_configs.py",
    f"{PROGRAM}fit --config configs/cnn_rnn.yaml": "test_configs.py",
    f"{PROGRAM}fit --config configs/surf_lstm.yaml --data.root DIR --ckpt_path last": "test_cli.py",
    f"{PROGRAM}fit --config configs/surf_lstm.yaml --data.root DIR --trainer.devices 2": "runs/test_devices.py",
    f"{PROGRAM}check dataset": "commands/test_check.py",
    f"{PROGRAM}fit --config configs/landmark_map.yaml --data.root dataset": "test_configs.py",
    f"{PROGRAM}predict --ckpt_path FILE --allow my_package.MyNet": "test_trust.py",
    "mlflow ui --backend-store-uri sqlite:///mlruns/mlflow.db": "runs/test_mlflow_ui.py",
}
"""Commands that other tests run, on data of their own."""

SET_UP = ("python -m pip install uv", "pytest", "ruff", "pyright", "pre-commit", "bash .ci/run", "uv sync", "mkdocs")
"""Beginnings of commands that every installation or `.ci/run` runs."""


class Command(NamedTuple):
    """A command of a page, without `uv run`.

    Attributes:
        place: the page and its line.
        text: the command on one line.
        section: the text between the headings around it.
    """

    place: str
    text: str
    section: str


def list_commands(page: Path) -> Iterator[Command]:
    """The commands in a page's blocks of code, parts of `&&` one by one."""
    section = ""
    for part in re.split(r"(?m)^(?=#+ )", page.read_text()):
        section = part
        for block in re.findall(r"(?m)(?:^(?:    .*)?\n)+|^```(?:sh|bash|console)\n[^`]*", section):
            for line in re.sub(r"\\\n\s*", "", block).splitlines():
                if line.split()[:1] and line.split()[0] in SHELL:
                    number = page.read_text().count("\n", 0, page.read_text().find(block)) + 1
                    for text in line.strip().split(" && "):
                        text = re.sub(r"^uv run (?:--extra \w+ )?", "", text)
                        yield Command(f"{page.relative_to(REPOSITORY)}:{number}", text, section)


PYTHON = [block for page in PAGES for block in re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL)]
COMMANDS = [command for page in PAGES for command in list_commands(page)]


class Parsed(BaseException):
    """The parser has accepted the command, which ends here."""


def end_after(parse: Callable[..., object]) -> Callable[..., None]:
    """A method that parses, and then raises `Parsed`."""

    def parse_and_end(*args: object) -> None:
        parse(*args)
        raise Parsed

    return parse_and_end


@pytest.fixture
def parse_only(monkeypatch: pytest.MonkeyPatch) -> None:
    """Commands end once their options are understood."""
    monkeypatch.setattr(VerbParser, "parse_args", end_after(VerbParser.parse_args))
    monkeypatch.setattr(PoseCLI, "parse_arguments", end_after(PoseCLI.parse_arguments))


def fill_in(text: str, folder: str) -> list[str]:
    """The words after `python -m lightning_pose`, with values for the placeholders of pages."""
    text = re.sub(r"\[(--[^\]]*)\]", r"\1", text.removeprefix(PROGRAM))
    text = re.sub(r"\b(mlruns/checkpoints/RUN_ID/best\.ckpt|BEST|FILE)\b", str(CHECKPOINT), text)
    text = text.replace("mlruns/sweeps/surf_lstm-DIR/best.yaml", "configs/surf_lstm.yaml")
    for name, value in {"DIR": folder, "PGT": folder, "SEED": "0", "TRUTH": "sfm", "N": "2"}.items():
        text = re.sub(rf"\b{name}\b", value, text)
    return [str(REPOSITORY / word) if re.match(r"(configs|sweeps)/", word) else word for word in shlex.split(text)]


def parses(text: str, folder: Path) -> bool:
    """Whether the program understands a command."""
    try:
        main(fill_in(text, str(folder)))
    except Parsed:
        return True
    return False


def test_there_are_commands() -> None:
    assert len(COMMANDS) > 40
    assert {command.place.partition(":")[0] for command in COMMANDS} > {"README.md", "docs/usage.md", "docs/results.md"}


@pytest.mark.usefixtures("parse_only")
def test_every_command_parses(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for text, place in {command.text: command.place for command in COMMANDS}.items():
        if text.startswith(PROGRAM):
            assert any(parses(text.replace("SYSTEM", system), tmp_path) for system in SYSTEMS), f"{place}: {text}"


def test_a_renamed_option_does_not_parse(parse_only: None, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert not parses(f"{PROGRAM}fit --config configs/surf_lstm.yaml --data.folder DIR", tmp_path)
    assert not parses(f"{PROGRAM}report --with_baselines", tmp_path)
    assert not parses(f"{PROGRAM}sweep sweeps/surf_lstm.yaml --trials 3", tmp_path)


def test_files_that_commands_name_exist() -> None:
    pattern = re.compile(r"(?:configs|sweeps|benchmarks|examples)/[a-z0-9_/]+\.(?:yaml|py)")
    pages = [page for page in PAGES if page.name != "CONTRIBUTING.md"]  # whose new files tests write
    named = {file for page in pages for file in pattern.findall(page.read_text())}
    assert len(named) > 20
    assert sorted(file for file in named if not (REPOSITORY / file).is_file()) == []


def test_every_command_is_run_or_dated() -> None:
    unproven = [
        f"{command.place}: {command.text}"
        for command in COMMANDS
        if command.text not in RUN
        and command.text not in ELSEWHERE
        and not command.text.startswith(SET_UP)
        and not DATED.search(command.section)
    ]
    assert unproven == [], 'put "Run on DATE." into the section, or run the command in a test'


def test_what_is_run_is_still_on_a_page() -> None:
    assert {*RUN, *ELSEWHERE} - {command.text for command in COMMANDS} == set()
    assert [file for file in ELSEWHERE.values() if not (REPOSITORY / "tests" / file).is_file()] == []


def test_the_commands_run(workplace: Workplace, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    room = render_room(tmp_path / "room", frames=30, size=(160, 120))
    for number, name in enumerate(("xyz", "rpy"), start=1):
        write_recording(workplace.folder / f"rgbd_dataset_freiburg1_{name}", workplace.scene, number)
    for text, small in RUN.items():
        assert workplace.command(*fill_in(f"{text} {small}", str(room))) == 0, capsys.readouterr().err
    assert (workplace.folder / "table.tex").is_file()
    assert "LandmarkMap" in capsys.readouterr().out
    (run,) = (run for run in workplace.runs() if run.data.tags["architecture"] == "LandmarkMap")
    shutil.copy(workplace.checkpoint(run, "best"), workplace.folder / "best.ckpt")
    shutil.copy(next(room.rglob("*.png")), workplace.folder / "image.jpg")
    for block in PYTHON:
        if 'Localizer.load("best.ckpt")' in block:
            with contextlib.chdir(workplace.folder):
                exec(block, {})
            assert "accepted" in capsys.readouterr().out


def test_what_python_imports_exists() -> None:
    assert len(PYTHON) > 6
    for block in PYTHON:
        for node in ast.walk(ast.parse(block)):
            if isinstance(node, ast.ImportFrom) and str(node.module).startswith("lightning_pose"):
                module = import_module(str(node.module))
                assert [name.name for name in node.names if not hasattr(module, name.name)] == []


def list_parameters(kind: type) -> set[str]:
    """Names of the settings of a class and of its base classes, to which it passes further ones on."""
    return {name for base in kind.__mro__ if "__init__" in vars(base) for name in signature(base).parameters}


def test_options_in_the_text_exist(capsys: pytest.CaptureFixture[str]) -> None:
    known = set()
    for verb in VERBS:
        with pytest.raises(SystemExit):
            main([verb, "--help"])
        known |= set(re.findall(r"--[\w.-]+", capsys.readouterr().out))
    for prefix, package, names in (
        ("--model.", models, models.__all__),
        ("--data.", data, ("ImageDataModule", "ClipDataModule")),
        ("--data.extractor.", features, features.__all__),
        ("--trainer.logger.", logger, logger.__all__),
    ):
        classes = [kind for name in names if isinstance(kind := getattr(package, name), type)]
        known |= {prefix + name for kind in classes for name in list_parameters(kind)}
    spans = [span for page in PAGES for span in re.findall(r"`([^`\n]*)`", page.read_text())]
    spans = [span for span in spans if not span.startswith(SHELL)]
    spans += [command.text for command in COMMANDS if command.text.startswith(PROGRAM)]
    named = {option.rstrip(".") for span in spans for option in re.findall(r"(?<!\S)\[?(--[a-z][\w.-]+)", span)}
    assert len(named) > 20
    assert sorted(named - known) == []
