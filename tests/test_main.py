"""The dispatcher: help, unknown verbs, exit codes, the real entry point, and what it does not import."""

from __future__ import annotations

import errno
import gc
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from lightning_pose import __main__
from lightning_pose.__main__ import VERBS, main
from lightning_pose.errors import ConfigError
from lightning_pose.scenes.synthetic import render_room
from tests.helpers import Workplace


def run_verb(monkeypatch: pytest.MonkeyPatch, error: BaseException) -> int:
    """The exit code where a verb's main raises this."""

    def broken(argv: list[str]) -> int:
        raise error

    monkeypatch.setattr(__main__, "import_module", lambda name: SimpleNamespace(main=broken))
    return main(["check", "DIR"])


@pytest.mark.parametrize(("argv", "code"), [(["--help"], 0), (["-h"], 0), ([], 2)])
def test_help_lists_every_verb(argv: list[str], code: int, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(argv) == code
    shown = capsys.readouterr().out
    assert all(verb in shown for verb in VERBS)
    assert "configs/quickstart.yaml" in shown


@pytest.mark.parametrize(("verb", "hint"), [("fitt", "did you mean fit?"), ("xyz", "choose one of fit, validate")])
def test_an_unknown_verb_gets_a_hint(verb: str, hint: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([verb]) == 2
    line = capsys.readouterr().err
    assert line.startswith(f"error: there is no verb {verb!r}; {hint}")
    assert line.count("\n") == 1


def test_a_mistake_is_one_line(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_verb(monkeypatch, ConfigError("n is 0; give 1 or more")) == 2
    assert capsys.readouterr().err == "error: n is 0; give 1 or more\n"


def test_an_interrupt_has_its_exit_code(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_verb(monkeypatch, KeyboardInterrupt()) == 130
    assert capsys.readouterr().err == "interrupted\n"


def test_an_internal_error_keeps_its_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ZeroDivisionError):
        run_verb(monkeypatch, ZeroDivisionError())


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_has_help(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main([verb, "--help"])
    assert stop.value.code == 0
    assert "usage" in capsys.readouterr().out


def test_the_entry_point_trains(workplace: Workplace) -> None:
    process = workplace.start("fit", "--config", workplace.config, "--trainer.max_epochs", "1")
    stdout, stderr = process.communicate(timeout=250)
    assert process.returncode == 0, stderr
    assert "retrieval_top1" in stdout
    assert "epoch 1/1" in stderr
    assert "Warning" not in stderr
    assert workplace.runs()[0].info.status == "FINISHED"


def test_the_entry_point_refuses(workplace: Workplace) -> None:
    process = workplace.start("check", "nowhere")
    stdout, stderr = process.communicate(timeout=250)
    assert (process.returncode, stdout) == (2, "")
    assert stderr.startswith("error: nowhere")
    assert stderr.count("\n") == 1


def test_light_modules_stay_light() -> None:
    light = [
        *("", ".__main__", ".paths", ".commands.check", ".commands.synth", ".scenes.formats"),
        *(".localization.localizer", ".evaluation.baselines.images", ".figures.images"),
    ]
    imports = "\n".join(f"import lightning_pose{name}" for name in light)
    check = f"import sys\n{imports}\nsys.exit(', '.join(sorted({{'lightning', 'mlflow'}} & set(sys.modules))) or 0)"
    process = subprocess.run([sys.executable, "-c", check], capture_output=True, text=True, check=False)
    assert process.returncode == 0, process.stderr


def find_torch(code: str, *args: object) -> subprocess.CompletedProcess[str]:
    """Run code that has `main` in a fresh Python; the last line that it prints says whether torch was imported."""
    code = f"import sys\nfrom lightning_pose.__main__ import main\n{code}\nprint('torch' in sys.modules)"
    return subprocess.run([sys.executable, "-c", code, *map(str, args)], capture_output=True, text=True, check=False)


def test_help_imports_no_torch() -> None:
    code = "for verb in sys.argv[1:]:\n  try: main([verb, '--help'])\n  except SystemExit: pass\nmain(['--help'])"
    verbs = ["localize", "report", "check", "export", "export-map", "reconstruct", "serve", "synth"]
    found = find_torch(code, *verbs)
    assert found.stdout.splitlines()[-1] == "False", found.stderr
    assert found.stdout.count("usage: ") == 9


def test_a_check_that_matches_images_imports_no_torch(tmp_path: Path) -> None:
    found = find_torch("main(['check', sys.argv[1]])", render_room(tmp_path / "room", frames=24, size=(160, 120)))
    assert "off their" in found.stdout, found.stdout + found.stderr
    assert found.stdout.splitlines()[-1] == "False", found.stderr


def test_a_verb_is_imported_without_garbage_collection(monkeypatch: pytest.MonkeyPatch) -> None:
    collects = []

    def load(name: str) -> SimpleNamespace:
        collects.append(gc.isenabled())
        return SimpleNamespace(main=lambda argv: collects.append(gc.isenabled()) or 0)

    monkeypatch.setattr(__main__, "import_module", load)
    monkeypatch.setattr(gc, "freeze", lambda: None)  # what other tests leave behind is still collected
    monkeypatch.delitem(sys.modules, "lightning_pose.commands.check", raising=False)
    assert main(["check", "DIR"]) == 0
    assert collects == [False, True]


def test_a_full_disk_is_one_line(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_verb(monkeypatch, OSError(errno.ENOSPC, "No space left on device", "room/frame.png")) == 2
    assert capsys.readouterr().err.startswith("error: room/frame.png cannot be written (No space left on device); free")
