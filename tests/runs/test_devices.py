"""Two processes on a CPU give the metrics and predictions of one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.helpers import Workplace, write_scene

CLOSED_FORM = ["--model", "lightning_pose.models.KernelPoseNet"]
VECTORS = ["--data.extractor", "tests.evaluation.test_unseen.Vectors"]


def run(workplace: Workplace, devices: str, capsys: pytest.CaptureFixture[str], *args: object) -> str:
    """What a command prints; Lightning starts the second process as the first was started, by `python -m`."""
    args = (*args, "--trainer.devices", devices)
    if devices == "1":
        capsys.readouterr()
        assert workplace.command(*args) == 0
        return capsys.readouterr().out
    process = workplace.start(*args)
    stdout, stderr = process.communicate(timeout=500)
    assert process.returncode == 0, stderr
    return stdout


def test_two_processes_are_one(workplace: Workplace, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    # Of 9 frames each process gets 5, so that one frame is repeated.
    scene = write_scene(tmp_path / "odd", train=(13, 12), test=9)
    metrics, files = [], []
    for devices in ("1", "2"):
        options = [*CLOSED_FORM, *VECTORS, "--data.root", scene]
        run(workplace, devices, capsys, "fit", "--config", workplace.config, *options)
        fitted = workplace.runs()[0]
        assert fitted.info.status == "FINISHED"
        metrics.append(fitted.data.metrics)
        checkpoint = workplace.checkpoint(fitted, "best")
        printed = run(workplace, devices, capsys, "predict", "--ckpt_path", checkpoint, "--allow", "tests")
        (line,) = printed.splitlines()
        files.append(np.loadtxt(workplace.folder / line))
    alone, together = metrics
    assert alone.keys() == together.keys()
    for name, value in alone.items():
        if not name.startswith("cost/"):
            assert together[name] == pytest.approx(value, rel=1e-6, abs=1e-6), name
    assert files[0].shape == (9, 8)
    np.testing.assert_allclose(files[1], files[0], atol=1e-6)
