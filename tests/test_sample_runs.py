"""The sample runs are reproduced by their script and agree with their README."""

import importlib
import importlib.util
import re

import cv2
import numpy as np
import pytest

from lab.calibrate.rig.rig import calibrate_rig
from lab.files.rig.rig_file import joint_covariance, load_rig_file
from lab.report.run.page import write_report
from lab.runs.input_check import check
from lab.runs.process import process_run
from lab.simulate.scene import compose
from tests.lab.fake_results import make as make_results
from tests.paths import ROOT

NUMBER = re.compile(r"[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?")
FOLDER = ROOT / "sample_runs"
PICTURE = ROOT / "docs" / "report.txt"
if not FOLDER.is_dir():
    pytest.skip("a source distribution has no sample runs", allow_module_level=True)
shown = importlib.import_module("docs.website.figures").shown
_SPEC = importlib.util.spec_from_file_location("sample_runs_make", FOLDER / "make.py")
make = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(make)

README = (FOLDER / "README.md").read_text(encoding="utf-8")


def test_every_sample_is_in_the_script_and_in_the_readme():
    runs = {p.parent.name for p in FOLDER.glob("*/run.yaml")}
    assert runs == set(make.SAMPLES)
    for name in runs:
        assert f"| `{name}` |" in README


@pytest.mark.parametrize("name", make.SAMPLES)
def test_the_readme_shows_the_command_that_the_script_runs(name):
    command = re.search(rf"beampose simulate (\S+) (.*)--out sample_runs/{name}$", README, re.MULTILINE)
    words = command[2].replace("--video", "--video True").replace("--points", "--points True").split()
    options = dict(zip(words[::2], words[1::2], strict=True))
    sample = dict(make.SAMPLES[name])
    assert command[1] == sample.pop("scenario")
    assert options == {f"--{key}": str(value) for key, value in sample.items()}


@pytest.mark.parametrize("name", make.SAMPLES)
def test_every_sample_is_a_run_that_can_be_processed(name):
    assert check(FOLDER / name).exit_status == 0


def test_the_calibration_is_reproduced(tmp_path):
    """Byte for byte, except for the last digits of a solved camera: they depend on the processor."""
    made = make.make("calibration", tmp_path / "again")
    kept = sorted(p.relative_to(FOLDER / "calibration") for p in (FOLDER / "calibration").rglob("*.*"))
    assert [p.relative_to(made) for p in sorted(made.rglob("*.*"))] == kept
    for path in kept:
        again, here = (made / path).read_bytes(), (FOLDER / "calibration" / path).read_bytes()
        if path.suffix == ".yaml" and again != here:
            assert NUMBER.sub("", again.decode()).split() == NUMBER.sub("", here.decode()).split()
            new, old = (np.array([float(x) for x in NUMBER.findall(text.decode())]) for text in (again, here))
            np.testing.assert_allclose(new, old, rtol=1e-8)
        else:
            assert again == here


@pytest.mark.slow
def test_the_calibrated_rig_is_reproduced_and_its_covariance_is_correct(tmp_path):
    outcome = calibrate_rig(FOLDER / "calibration", tmp_path / "rig")
    assert outcome.exit_status == 0
    fresh, kept = (load_rig_file(p / "rig.yaml") for p in (tmp_path / "rig", FOLDER / "calibrated"))
    again, known = (joint_covariance(f.rig, f.covariances, "") for f in (fresh, kept))
    assert again.names == known.names
    sigma = np.sqrt(np.diagonal(known.matrix))
    np.testing.assert_allclose(np.sqrt(np.diagonal(again.matrix)), sigma, rtol=1e-3, atol=1e-12)
    for (
        name,
        camera,
    ) in fresh.rig.cameras.items():  # on another processor the result may differ by a thousandth of a sigma
        i = known.names.index(f"cameras.{name}.fx")
        assert abs(camera.matrix[0, 0] - kept.rig.cameras[name].matrix[0, 0]) < 0.01 * sigma[i]
    errors = process_run(FOLDER / "calibrated", tmp_path / "run").summary["errors"]["pose"]["measured"]
    # All frames share the calibration's errors, so their mean NEES scatters like that of a few frames: 2 to 12 in 98 %.
    assert 2 < errors["nees_mean"] < 12


def test_the_points_are_reproduced_byte_for_byte(tmp_path):
    made = make.make("four-skew-beams", tmp_path / "again")
    for path in ("detections.csv", "rig.yaml", "run.yaml", "truth/pose.csv", "truth/spots.csv"):
        assert (made / path).read_bytes() == (FOLDER / "four-skew-beams" / path).read_bytes()


@pytest.mark.parametrize("name", ["huo2015", "sharp-turns", "damaged"])
def test_the_pictures_are_reproduced(name, tmp_path, monkeypatch):
    monkeypatch.setitem(make.SAMPLES[name], "frames", 2)
    made = make.make(name, tmp_path / "again")
    for path in sorted((made / "frames").glob("*/*.png")):
        again, kept = (cv2.imread(str(p), -1).astype(int) for p in (path, FOLDER / name / path.relative_to(made)))
        # On another processor a few pixels may be rounded differently.
        assert np.abs(again - kept).max() <= 1
        assert (again != kept).mean() < 1e-4


@pytest.mark.slow
def test_the_papers_run_passes_with_sigmas_that_agree_with_the_truth(tmp_path):
    """Its light has speckle that no fit shows, and texture that its unlit background does not show."""
    outcome = process_run(FOLDER / "huo2015", tmp_path / "run")
    assert outcome.verdict.status == "pass"
    now, then = (
        [re.match(r"([^:]*):? ?(\S*)", line).groups() for line in lines]
        for lines in (shown((tmp_path / "run/report.html").read_text("utf-8")), PICTURE.read_text("utf-8").splitlines())
    )
    assert [name for name, _ in now] == [name for name, _ in then]
    for (name, new), (_, old) in zip(now[1:], then[1:], strict=True):
        assert float(new) == pytest.approx(float(old), rel=0.05), f"{name}: `python -m docs.website.figures report`"
    for name in ("pose", "pose_causal"):
        assert 0.7 < outcome.summary["errors"][name]["measured"]["nees_mean"] / 6 < 1.35


def test_the_picture_of_the_report_has_the_key_figures_of_todays_reports(tmp_path):
    """The values are compared by the slow test above, which processes the recording of the picture."""
    fake = make_results(tmp_path, 120)
    write_report(fake.results, fake.run_folder)
    page = shown((fake.results / "report.html").read_text("utf-8"))
    lines = PICTURE.read_text("utf-8").splitlines()
    assert lines[0] == "PASS"
    assert [line.split(":")[0] for line in lines[1:]] == [line.split(":")[0] for line in page[1:]]


def test_the_papers_run_agrees_with_its_readme_line():
    sample = make.SAMPLES["huo2015"]
    scene = compose(sample["scenario"], sample["seed"], sample["frames"])
    spots = [spot for _, spot in scene.model.views]
    line = next(line for line in README.splitlines() if line.startswith("| `huo2015`"))
    exits = re.findall(r"[Ss]pot (\d).*?in frames (\d+) to (\d+)", line)
    assert {spot for spot, _, _ in exits} == {"3", "6"}
    for spot, first, last in exits:
        out = np.flatnonzero(scene.in_view[:, spots.index(spot)] == 0)
        assert (out[0], out[-1]) == (int(first), int(last))
    assert list(np.flatnonzero(scene.turned)) == [int(n) for n in re.findall(r"(\d+) \((?:pitch|yaw)\)", line)]
