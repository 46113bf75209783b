"""`beampose doctor`: each fault that it looks for is reported, and an intact installation passes."""

from __future__ import annotations

import datetime
from pathlib import Path
from types import SimpleNamespace

import pytest

from lab.findings.finding import Level, finding
from lab.pictures.opencv import load_cv2
from lab.setup import doctor, installation
from lab.setup.installation import exit_status
from tests.lab.run_folders import RIG, write_run

TODAY = datetime.date(2026, 6, 1)


def test_the_installation_that_runs_these_tests_has_no_fault():
    assert [line for line in installation.check_installation() if line.level is Level.FAIL] == []
    assert [line for line in doctor.check_opencv() if line.level is Level.FAIL] == []


def test_a_library_that_cannot_be_loaded_is_named_with_its_package():
    line = installation.check_libraries({"numpy": "numpy", "no-such-package": "no_such_module"})
    assert (line.level, line.code) == (Level.FAIL, "BP-D02")
    assert "no-such-package (ModuleNotFoundError" in line.what
    assert "--force-reinstall no-such-package" in line.remedy


@pytest.mark.parametrize(("found", "state"), [("1.9.10", Level.FAIL), ("1.10", Level.PASS), ("2.0rc1", Level.PASS)])
def test_versions_are_compared_as_numbers(found, state):
    assert installation.check_versions({"numpy": found}, {"numpy": "1.10"}).level is state


def test_a_library_that_is_missing_fails():
    assert installation.check_versions({"python": "3.11"}, {"no-such-package": "1.0"}).level is Level.FAIL


def test_two_opencv_packages_are_a_warning():
    assert installation.check_opencv_packages({"opencv-python-headless"}).level is Level.PASS
    line = installation.check_opencv_packages({"opencv-python-headless", "opencv-python"})
    assert (line.level, line.code) == (Level.WARN, "BP-D03")


@pytest.mark.parametrize(
    ("environment", "state"),
    [
        ({"HOME": "/"}, Level.PASS),
        ({"NUMBA_DISABLE_JIT": "0"}, Level.PASS),
        ({"NUMBA_DISABLE_JIT": "1"}, Level.WARN),
        ({"OPENCV_IO_MAX_IMAGE_PIXELS": "1000"}, Level.WARN),
    ],
)
def test_variables_that_change_what_is_read_are_a_warning(environment, state):
    assert installation.check_variables(environment).level is state


def test_file_names_in_another_encoding_are_a_warning():
    assert [installation.check_encoding(e).level for e in ("utf-8", "ascii")] == [Level.PASS, Level.WARN]


class WithoutTiff:
    """OpenCV that cannot read TIFF."""

    def __getattr__(self, name):
        return getattr(load_cv2(), name)

    def imencode(self, suffix, picture):
        if suffix == ".tiff":
            raise load_cv2().error("no TIFF")
        return load_cv2().imencode(suffix, picture)


def test_a_picture_format_that_opencv_lacks_fails():
    line = doctor.check_pictures(WithoutTiff())
    assert line.level is Level.FAIL
    assert "cannot read .tiff with 8 bits, .tiff with 16 bits" in line.what


def test_a_video_format_that_opencv_lacks_is_a_warning(monkeypatch):
    monkeypatch.setattr(doctor, "VIDEOS", (("MJPG", ".avi"), ("none", ".none")))
    line = doctor.check_videos(load_cv2())
    assert line.level is Level.WARN
    assert line.what.startswith("videos: none cannot be read back")


@pytest.mark.parametrize(("free", "state"), [(10**10, Level.PASS), (10**9, Level.WARN), (10**6, Level.FAIL)])
def test_little_free_space_is_reported(tmp_path, monkeypatch, free, state):
    monkeypatch.setattr(doctor.shutil, "disk_usage", lambda folder: SimpleNamespace(free=free))
    assert doctor.check_space(doctor.existing(tmp_path / "not" / "made"), "results").level is state


def test_all_compiled_code_is_looked_at_and_a_missing_part_is_a_warning(monkeypatch):
    root = doctor.Path(doctor.geometry.__file__).parents[1]
    assert {"geometry", "tracking"} <= {f.relative_to(root).parts[0] for f in doctor.compiled_folders()}
    monkeypatch.setattr(doctor, "is_empty", lambda folder: True)
    assert doctor.check_cache().level is Level.WARN
    monkeypatch.setattr(doctor, "cache_folder", lambda folder: None)
    assert "cannot be kept" in doctor.check_cache().what


@pytest.mark.parametrize(
    ("block", "state", "words"),
    [
        ("", Level.WARN, "states no date"),
        ("{date: 2026-05-01, verdict: PASS}", Level.PASS, "31 days old"),
        ("{date: 2024-05-01, verdict: PASS}", Level.WARN, "without an expiry date"),
        ("{date: 2026-05-01, verdict: WARN, reasons: [few dots]}", Level.WARN, "few dots"),
        ("{date: 2026-05-01, verdict: FAIL, reasons: [bent]}", Level.FAIL, "bent"),
        ("{date: 2026-07-01, verdict: PASS}", Level.WARN, "in the future"),
        ("{date: 2026-05-01, verdict: PASS, valid_until: 2026-05-31}", Level.FAIL, "expired on 2026-05-31"),
        ("{date: 2026-05-01, verdict: PASS, valid_until: 2026-06-10}", Level.WARN, "in 9 days"),
        ("{date: 2026-05-01, verdict: PASS, valid_until: 2026-09-01}", Level.PASS, "valid until 2026-09-01"),
    ],
)
def test_the_age_of_a_calibration_is_judged(tmp_path: Path, block, state, words):
    path = tmp_path / "rig.yaml"
    path.write_text(RIG + (f"calibration: {block}\n" if block else ""))
    line = doctor.check_calibration(path, TODAY)
    assert (line.level, line.code) == (state, "BP-D09")
    assert words in line.what


def test_a_run_folder_and_a_camera_file_are_read_too(tmp_path):
    assert doctor.check_calibration(write_run(tmp_path / "run"), TODAY).level is Level.WARN
    camera = "schema: beampose/camera/1\nname: left\nimage_size_px: [64, 48]\n"
    camera += "camera_matrix: {fx: 40, fy: 40, cx: 31, cy: 23}\ncalibration: {date: DAY, verdict: PASS}\n"
    path = tmp_path / "camera.yaml"
    for day, state in (("2026-05-01", Level.PASS), ("may", Level.FAIL)):
        path.write_text(camera.replace("DAY", day))
        assert doctor.check_calibration(path, TODAY).level is state


def test_a_file_that_cannot_be_read_fails_as_a_wrong_file(tmp_path):
    line = doctor.check_calibration(tmp_path / "none.yaml", TODAY)
    assert (line.code, exit_status([line])) == ("BP-D10", 2)


def test_the_exit_status_is_that_of_the_most_basic_fault():
    installation, file, calibration = (finding(f"BP-D{n}", Level.FAIL, "") for n in ("01", "10", "09"))
    assert exit_status([finding("BP-D01", Level.WARN, "")]) == 0
    found = [[calibration], [calibration, installation], [calibration, installation, file]]
    assert [exit_status(f) for f in found] == [3, 1, 2]
