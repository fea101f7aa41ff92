"""Models of clips through the command line: fit, test elsewhere, predict, and what the run keeps."""

from __future__ import annotations

import contextlib
import io
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from lightning_pose.evaluation.baselines.visual_odometry import read_clip_poses, run_visual_odometry
from lightning_pose.geometry.quaternions import orientation_error_deg, position_error_m
from lightning_pose.geometry.relative import absolute_poses, relative_poses
from lightning_pose.localization.localizer import Localizer
from lightning_pose.localization.located_pose import stack_poses
from lightning_pose.localization.video import VideoTracker
from lightning_pose.scenes.formats import load_scene
from tests.helpers import Trained, Workplace, write_scene


@pytest.fixture(scope="module")
def clip_run(tmp_path_factory: pytest.TempPathFactory, scene: Path, store: Path) -> Trained:
    """A tiny CNN3D, trained on clips of four frames."""
    workplace = Workplace.make(tmp_path_factory.mktemp("clips"), scene, store)
    config = yaml.safe_load(workplace.config.read_text())
    config["model"] = {
        "class_path": "lightning_pose.models.CNN3D",
        "init_args": {"channels": 4, "units": 8, "integrate": True},
    }
    config["data"]["class_path"] = "lightning_pose.data.ClipDataModule"
    config["data"]["init_args"] |= {"root": None, "train_scenes": [str(scene)], "clip_length": 4, "hop": 2}
    workplace.config.write_text(yaml.safe_dump(config))
    return Trained.make(workplace)


def trajectory(run: Trained, name: str) -> np.ndarray:
    client, run_id = run.workplace.client, run.run.info.run_id
    return np.loadtxt(client.download_artifacts(run_id, f"trajectories/{name}/seq-03.tum"))


def test_tags_say_what_the_errors_are_relative_to(clip_run: Trained) -> None:
    tags = clip_run.run.data.tags
    expected = {"task": "relative", "clip_length": "4", "stride": "1", "relative_frame": "camera", "test_frames": "10"}
    assert expected.items() <= tags.items()


def test_errors_by_length_are_curves(clip_run: Trained) -> None:
    client, run_id = clip_run.workplace.client, clip_run.run.info.run_id
    for system in ("test", "baseline/no_motion", "baseline/visual_odometry", "baseline/constant_velocity"):
        curve = {m.step: m.value for m in client.get_metric_history(run_id, f"{system}/position_median_m_by_length")}
        assert list(curve) == [2, 4, 5, 10]
        assert curve[4] == pytest.approx(clip_run.run.data.metrics[f"{system}/position_median_m"], rel=1e-4)
    assert {"test/drift_percent_by_length", "test/ate_rmse_m", "test/rpe_rmse_deg"} <= clip_run.run.data.metrics.keys()
    assert "baseline/visual_odometry/ate_rmse_m" in clip_run.run.data.metrics


def test_a_stride_has_its_odometry(clip_run: Trained) -> None:
    """Clips begin at every frame, also at those between the frames that are chained."""
    workplace = clip_run.workplace
    options = ("--data.stride", "2", "--data.hop", "1", "--data.clip_length", "3")
    assert workplace.command("test", "--ckpt_path", clip_run.best, *options) == 0
    tested = next(run for run in workplace.runs() if run.data.tags["verb"] == "test")
    scene = load_scene(workplace.scene)
    frames = [scene.frames[i] for i in scene.splits["test"]]
    clips = np.arange(len(frames) - 4)[:, None] + np.array([0, 2, 4])
    motion = run_visual_odometry(frames, clips, progress=False)
    truth = relative_poses(*read_clip_poses(frames, clips))
    errors = position_error_m(motion.position_m, truth[0])[:, 1:].flatten()
    found = tested.data.metrics["baseline/visual_odometry/position_mean_m"]
    assert found == pytest.approx(float(errors.mean()), abs=1e-4)


def test_standing_still_is_as_wrong_as_the_truth_moves(clip_run: Trained) -> None:
    truth = torch.from_numpy(trajectory(clip_run, "truth"))
    starts = [0, 2, 4, 6]
    clips = [truth[start : start + 4] for start in starts]
    metres = torch.cat([position_error_m(clip[1:, 1:4], clip[0, 1:4]) for clip in clips])
    quats = [clip[:, [7, 4, 5, 6]] for clip in clips]
    degrees = torch.cat([orientation_error_deg(quat[1:], quat[0]) for quat in quats])
    metrics = clip_run.run.data.metrics
    assert metrics["baseline/no_motion/position_mean_m"] == pytest.approx(float(metres.mean()), rel=1e-4)
    assert metrics["baseline/no_motion/orientation_mean_deg"] == pytest.approx(float(degrees.mean()), abs=1e-3)
    ratio = metrics["test/position_median_m"] / metrics["baseline/no_motion/position_median_m"]
    assert metrics["test/skill_position"] == pytest.approx(ratio)


def test_the_localizer_chains_a_video(clip_run: Trained) -> None:
    images = sorted((clip_run.workplace.scene / "seq-03").glob("*.png"))
    poses = Localizer.load(clip_run.best, allow="tests").localize(images)
    position_m, quat_wxyz = map(torch.from_numpy, stack_poses(poses))
    truth, kept = (torch.from_numpy(trajectory(clip_run, name)) for name in ("truth", "predictions"))
    placed = absolute_poses(position_m, quat_wxyz, truth[0, 1:4], truth[0, [7, 4, 5, 6]])
    torch.testing.assert_close(placed[0], kept[:, 1:4], atol=1e-4, rtol=0)
    assert orientation_error_deg(placed[1], kept[:, [7, 4, 5, 6]]).max() < 0.01


def test_a_live_video_is_chained_frame_by_frame(clip_run: Trained) -> None:
    """The verb takes images in order for one video; every frame has a pose when it comes."""
    folder = clip_run.workplace.scene / "seq-03"
    with contextlib.redirect_stdout(io.StringIO()) as stdout:
        assert clip_run.workplace.command("localize", clip_run.best, folder, "--allow", "tests") == 0
    rows = np.loadtxt(io.StringIO(stdout.getvalue()))
    assert len(rows) == len(list(folder.glob("*.png")))
    np.testing.assert_allclose(rows[0, 1:], [0, 0, 0, 0, 0, 0, 1])
    tracker = VideoTracker(Localizer.load(clip_run.best, allow="tests"))
    poses = [tracker.localize(image) for image in sorted(folder.glob("*.png"))]
    np.testing.assert_allclose(rows[:, 1:4], stack_poses(poses)[0], atol=1e-8)


def test_predict_writes_the_same(clip_run: Trained, capsys: pytest.CaptureFixture[str]) -> None:
    assert clip_run.workplace.command("predict", "--ckpt_path", clip_run.best) == 0
    (line,) = capsys.readouterr().out.splitlines()
    np.testing.assert_allclose(
        np.loadtxt(clip_run.workplace.folder / line), trajectory(clip_run, "predictions"), atol=1e-5
    )


def test_a_checkpoint_is_tested_where_it_has_never_been(
    clip_run: Trained, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = write_scene(tmp_path / "other", train=(6, 6), test=8)
    assert clip_run.workplace.command("test", "--ckpt_path", clip_run.best, "--data.test_scenes", f"[{other}]") == 0
    assert "wall to other" in capsys.readouterr().out
    run = clip_run.workplace.runs()[0]
    assert run.data.tags["split"] == "unseen"
    assert run.data.tags["scene"] == "wall to other"


def test_raw_images_show_what_the_layers_respond_to(clip_run: Trained) -> None:
    workplace = clip_run.workplace
    pixels = ["--data.extractor", "lightning_pose.features.Pixels"]
    pixels += ["--data.extractor.height", "24", "--data.extractor.width", "32"]
    assert workplace.run("fit", *pixels, "--trainer.max_epochs", "1", "--report.visual_odometry", "false") == 0
    run = workplace.runs()[0]
    figures = {Path(file.path).name for file in workplace.client.list_artifacts(run.info.run_id, "figures")}
    assert figures == {"trajectory.png", "error_by_length.png", "responses.png"}
    assert "baseline/visual_odometry/position_median_m" not in run.data.metrics
    assert "baseline/no_motion/position_median_m" in run.data.metrics


def test_the_last_run_goes_on_only_on_its_own_scenes(
    clip_run: Trained, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = write_scene(tmp_path / "other", train=(9, 9), test=8)
    more = ["--ckpt_path", "last", "--trainer.max_epochs", "3", "--report.visual_odometry", "false"]
    assert clip_run.workplace.run("fit", *more, "--data.train_scenes", f"[{other}]") == 2
    assert f"no run of CNN3D on data.root=None data.train_scenes=['{other}']" in capsys.readouterr().err
    assert clip_run.workplace.run("fit", "--report.visual_odometry", "false") == 0  # the newest, whatever ran before
    runs = len(clip_run.workplace.runs())
    assert clip_run.workplace.run("fit", *more) == 0
    assert len(clip_run.workplace.runs()) == runs
    assert "epoch 3/3" in capsys.readouterr().err
