"""`segslam simulate` as typed: KITTI's folders out, and bad usage in one line."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from segslam import cli
from segslam.core.pose_files import write_kitti
from segslam.scans import open_dataset


def simulate(*arguments: object) -> int:
    with pytest.raises(SystemExit) as ended:
        cli.main(["simulate", *(str(argument) for argument in arguments)])
    return int(ended.value.code or 0)


def test_it_writes_the_requested_number_of_scans(tmp_path, capsys):
    assert simulate(tmp_path / "out", "--frames", 2, "--sensor", "vlp16", "--sequence", "05") == 0
    dataset = open_dataset(tmp_path / "out", sequence="05")
    assert len(dataset) == 2
    assert len(dataset.reference) == 2
    assert capsys.readouterr().out == ""


def test_it_follows_a_pose_file(tmp_path):
    poses = np.tile(np.eye(4), (30, 1, 1))
    poses[:, 2, 3] = np.arange(30)
    write_kitti(tmp_path / "07.txt", poses)
    out = tmp_path / "out"
    assert simulate(out, "--poses", tmp_path / "07.txt", "--frames", 3, "--sensor", "vlp16", "--quiet") == 0
    reference = open_dataset(out, sequence="00").reference
    np.testing.assert_allclose(reference.T_world_lidar[:, 0, 3], [0, 1, 2], atol=1e-6)


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (("--frames", 0), "frames"),
        (("--sensor", "sonar"), "Invalid value for '--sensor'"),
        (("--poses", "missing.txt"), "missing.txt"),
        (("--seed", -1), "seed"),
        (("--set", "world.cars=99"), "world.cars"),
        (("--set", "world.castles=1"), "known keys: cars, trees"),
        (("--set", "cars=3"), "section.key=value, for example world.cars=3"),
    ],
)
def test_bad_usage_is_reported(tmp_path, capsys, arguments, complaint):
    assert simulate(tmp_path / "out", *arguments) == 2
    assert complaint in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.long
def test_existing_data_is_kept_without_the_option_overwrite(tmp_path, capsys):
    asked = (tmp_path / "out", "--frames", 1, "--sensor", "vlp16", "--quiet")
    assert simulate(*asked) == 0
    assert simulate(*asked) == 2
    assert "--overwrite" in capsys.readouterr().err
    assert simulate(*asked, "--overwrite", "--set", "sensor.dropout=0.5") == 0
    assert len(open_dataset(tmp_path / "out", sequence="00")) == 1


@pytest.mark.long
@pytest.mark.usefixtures("ctrl_c_works")
def test_ctrl_c_leaves_a_shorter_sequence(tmp_path):
    with subprocess.Popen(
        [sys.executable, "-m", "segslam", "simulate", str(tmp_path), "--sensor", "vlp16", "--frames", "5000"],
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONUNBUFFERED": "1"},
    ) as run:
        try:
            wait_for(tmp_path / "sequences/00/velodyne/000003.bin")
            run.send_signal(signal.SIGINT)
            _, expected = run.communicate(timeout=60)
        finally:
            run.kill()
    assert run.returncode == 130
    assert "scans are complete" in expected
    dataset = open_dataset(tmp_path, sequence="00")
    assert 4 <= len(dataset) < 5000
    assert [scan.index for scan in dataset] == list(range(len(dataset)))


def wait_for(file: Path) -> None:
    for _ in range(1200):
        if file.exists():
            return
        time.sleep(0.05)
    pytest.fail(f"{file} did not appear within a minute")


def test_it_writes_only_the_scans_in_the_lists_of_pairs(tmp_path):
    (tmp_path / "pairs.txt").write_text("1 4\n4 2\n")
    chosen = ("--pairs", tmp_path / "pairs.txt", "--sample", 2)
    assert simulate(tmp_path / "some", *chosen, "--sensor", "vlp16", "--quiet") == 0
    dataset = open_dataset(tmp_path / "some")
    assert dataset.scan_index.tolist() == [1, 2, 4]
    assert len(dataset.reference) == 3
    assert simulate(tmp_path / "all", "--frames", 5, "--sensor", "vlp16", "--quiet") == 0
    scan = "sequences/00/velodyne/000004.bin"
    assert (tmp_path / "some" / scan).read_bytes() == (tmp_path / "all" / scan).read_bytes()
    whole = open_dataset(tmp_path / "all").reference
    np.testing.assert_allclose(dataset.reference.T_world_lidar, whole.T_world_lidar[[1, 2, 4]])


def test_a_number_of_pairs_without_a_list_is_refused(tmp_path, capsys):
    assert simulate(tmp_path / "some", "--sample", 2) == 2
    assert "--sample 2: only for lists of pairs; give them with --pairs" in capsys.readouterr().err
    assert not (tmp_path / "some").exists()


def test_a_list_of_another_drive_is_refused(tmp_path, capsys):
    (tmp_path / "pairs.txt").write_text("1 400000\n")
    assert simulate(tmp_path / "out", "--pairs", tmp_path / "pairs.txt", "--sensor", "vlp16", "--quiet") == 2
    assert "scan 400000" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
