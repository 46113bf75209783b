"""`beampose compare`: references in every format, tables and report, and what cannot be compared."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from geometry import rotations
from geometry.arrays import Array
from lab.errors import InputError
from lab.files.run.results import SUMMARY_SCHEMA
from lab.files.text import columns
from lab.results.compare import UNDETERMINED, _still, alignment_rows, compare, read_reference
from lab.results.compare_page import DIFFERENCES, compare_and_write
from tests.lab.tables import rows_of
from tests.tracking.comparison.motions import TRUTH, recordings, smooth
from tracking.comparison.frame_alignment import PoseSeries

SIMPLE = replace(TRUTH, rate=0.0)


def write_results(folder: Path, motion: PoseSeries) -> Path:
    """A result folder with the tables that a comparison reads."""
    folder.mkdir(parents=True)
    assert motion.rotation is not None
    assert motion.position_m is not None
    ypr = np.rad2deg(rotations.ypr_from_matrix(motion.rotation))
    q = rotations.quaternion_from_matrix(motion.rotation)
    with (folder / "attitude.csv").open("w") as file:
        file.write(",".join(columns.ATTITUDE) + "\n")
        for i, t in enumerate(motion.t_s.tolist()):
            numbers = [*motion.position_m[i], *q[i], *ypr[i], *np.sqrt(np.diag(motion.covariance[i]))]
            file.write(f"{i},{t!r},{','.join(repr(float(v)) for v in numbers)},6,0.1,measured{12 * ','}\n")
    upper = np.triu_indices(6)
    with (folder / "covariance.csv").open("w") as file:
        file.write(",".join(columns.COVARIANCE) + "\n")
        for i, C in enumerate(motion.covariance):
            file.write(f"{i},{','.join(repr(float(v)) for v in C[upper])}\n")
    (folder / "summary.json").write_text(json.dumps({"schema": SUMMARY_SCHEMA}))
    return folder


def write_tum(path: Path, motion: PoseSeries) -> Path:
    assert motion.rotation is not None
    assert motion.position_m is not None
    w, x, y, z = rotations.quaternion_from_matrix(motion.rotation).T
    rows = np.column_stack([motion.t_s, motion.position_m, x, y, z, w])
    path.write_text("# t x y z qx qy qz qw\n" + "".join(" ".join(map(repr, r)) + "\n" for r in rows.tolist()))
    return path


def write_csv(path: Path, header: str, *parts: Array) -> Path:
    rows = np.column_stack(parts).tolist()
    path.write_text(header + "\n" + "".join(",".join(map(repr, r)) + "\n" for r in rows))
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("compare")


@pytest.fixture(scope="module")
def motions() -> tuple[PoseSeries, PoseSeries]:
    return recordings(1, truth=SIMPLE)


@pytest.fixture(scope="module")
def result(folder, motions) -> Path:
    return write_results(folder / "results" / "one", motions[0])


def test_a_tum_file_gives_clocks_frames_tables_and_report(folder, result, motions):
    path = write_tum(folder / "other.tum", motions[1])
    out = folder / "compared"
    outcome = compare_and_write(result, None, path, out, sigma_m=1e-4, sigma_deg=np.rad2deg(5e-5))
    said = "\n".join(outcome.lines)
    assert re.search(r"time offset, reference minus result: 0\.13(69|70)\d+ ± 0\.0000\d+ s", said)
    assert "not determined" not in said
    rows = rows_of(out / "differences.csv")
    assert tuple(rows[0]) == DIFFERENCES
    assert len(rows) == 300
    rms = np.sqrt(np.mean([float(r["dx_m"]) ** 2 for r in rows if r["dx_m"]]))
    assert rms == pytest.approx(2.2e-4, rel=0.15)  # both sigmas together
    summary = json.loads((out / "comparison.json").read_text())
    assert outcome.lines[0].startswith("PASS: the differences agree with the stated uncertainties: chi-square")
    assert summary["verdict"]["status"] == "pass"
    assert summary["chi_square"]["per_degree_of_freedom"] == pytest.approx(0.97, abs=0.1)
    np.testing.assert_allclose(summary["alignment"]["lever_m"], SIMPLE.lever_m, atol=5e-4)
    page = (out / "report.html").read_text()
    assert page.count("<svg") >= 9
    assert "Not determined" not in page
    assert "http://" not in page.replace("http://www.w3.org", "")
    compare_and_write(result, None, path, out)  # an earlier comparison may be replaced


def test_differences_far_below_the_stated_uncertainties_do_not_agree_with_them(folder, result, motions):
    path = write_tum(folder / "other.tum", motions[1])
    outcome = compare_and_write(result, None, path, None, sigma_m=1e-2, sigma_deg=1.0)
    assert outcome.lines[0].startswith("PASS: the differences are smaller than the stated uncertainties: chi-square")


@pytest.mark.parametrize(
    ("frames", "alike", "words"),
    [(200, 4.0, "the differences agree with"), (80, 30.0, "the frames have too few independent errors to test")],
)
def test_smoothed_poses_agree_with_their_uncertainties_or_are_too_few_to_test_them(folder, frames, alike, words):
    """With 14 parameters of an alignment counted as 14, both would be smaller than the stated uncertainties."""
    result, reference = recordings(3, truth=SIMPLE, frames=frames, reference_sigmas=(1e-7, 1e-7), alike=alike)
    one = write_results(folder / "results" / f"alike-{frames}", result)
    path = write_tum(folder / f"alike-{frames}.tum", reference)
    assert compare_and_write(one, None, path, folder / f"alike-{frames}").lines[0].startswith(f"PASS: {words}")


def test_frames_that_are_excluded_have_a_colour_of_the_page_and_are_explained(folder, result, motions):
    """A shape of a class without a rule is black in every browser."""
    jumps = motions[1].position_m.copy()
    jumps[[50, 150]] += 0.1
    path = write_tum(folder / "jumps.tum", replace(motions[1], position_m=jumps))
    out = folder / "with-jumps"
    compare_and_write(result, None, path, out, sigma_m=1e-4, sigma_deg=np.rad2deg(5e-5))
    page = (out / "report.html").read_text()
    classes = set(re.findall(r'<rect class="(\w+)"', page))
    assert classes
    assert all(re.search(rf"svg rect\.{name}[,{{]", page) for name in classes)
    assert "yellow columns frames that were excluded as outliers" in page


def test_quaternions_and_angles_of_a_csv_table_agree(folder, result, motions):
    reference = motions[1]
    q = rotations.quaternion_from_matrix(reference.rotation)
    ypr = np.rad2deg(rotations.ypr_from_matrix(reference.rotation))
    one = write_csv(folder / "q.csv", "t_s,qw,qx,qy,qz", reference.t_s, q)
    two = write_csv(folder / "a.csv", "t_s,yaw_deg,pitch_deg,roll_deg", reference.t_s, ypr)
    a, b = (compare(result, reference=path, offset_s=0.1) for path in (one, two))
    np.testing.assert_allclose(a.alignment.body, b.alignment.body, atol=1e-8)
    assert not a.differences.compared[:3].any()
    assert a.differences.compared[3:].all()


def test_an_encoder_with_one_angle_is_a_reference(folder):
    rng = np.random.default_rng(1)
    t = np.arange(0, 6, 0.02)
    R, p = smooth(t, (1, 0, 0), places=0.0)
    covariance = np.zeros((len(t), 6, 6))
    covariance[:] = 1e-8 * np.eye(6)
    noisy = PoseSeries(t, R @ rotations.exp(1e-4 * rng.standard_normal((len(t), 3))), p, covariance)
    result = write_results(folder / "turntable", noisy)
    encoder = np.rad2deg(rotations.ypr_from_matrix(smooth(t + 0.05, (1, 0, 0))[0])[:, 0]) + 30.0
    path = write_csv(folder / "encoder.csv", "t_s,yaw_deg", t, encoder)
    found = compare(result, reference=path)
    assert found.estimate is not None
    assert found.alignment.offset_s == pytest.approx(-0.05, abs=2e-3)
    assert len(found.estimate.determined.world_axes) == 1
    rows = {name: value for name, value, _ in alignment_rows(found)}
    assert rows["world rotation z"] == UNDETERMINED
    assert UNDETERMINED not in (rows["world rotation x"], rows["world rotation y"])
    assert found.noise.factor == pytest.approx(1.0, abs=0.2)
    assert any("no pitch_deg and no roll_deg" in note for note in found.notes)


def test_two_results_are_compared_frame_by_frame_without_alignment(folder, result, motions):
    moved = PoseSeries(
        motions[0].t_s, motions[0].rotation, motions[0].position_m + np.array([1e-3, 0, 0]), motions[0].covariance
    )
    other = write_results(folder / "results" / "two", moved)
    found = compare(other, other=result)
    assert found.estimate is None
    assert found.axes[0].figures.mean == pytest.approx(1.0, abs=1e-9)  # mm: first minus second
    assert found.axes[1].figures.rms == 0.0
    aligned = compare(other, other=result, align=("world",))
    assert aligned.axes[0].figures.rms < 1e-6


def test_a_stationary_stand_gets_allan_deviations_and_no_time_offset(folder):
    def still(t):
        return smooth(np.zeros_like(t))

    mine, theirs = recordings(2, still, frames=600)
    result = write_results(folder / "still", mine)
    out = folder / "still-compared"
    outcome = compare_and_write(result, None, write_tum(folder / "still.tum", theirs), out)
    assert any(line.startswith("The time offset is not determined") for line in outcome.lines)
    rows = [r for r in rows_of(out / "allan.csv") if r["angle"] == "pitch"]
    assert float(rows[0]["deviation_deg"]) == pytest.approx(np.rad2deg(1e-4), rel=0.15)
    assert float(rows[0]["low_deg"]) < np.rad2deg(1e-4) < float(rows[0]["high_deg"])
    assert "Allan deviation" in (out / "report.html").read_text()


@pytest.mark.parametrize("axis", [0, 2])  # yaw, and roll: pitch ends at 90 deg
def test_a_stand_at_half_a_turn_is_as_still_as_one_that_is_not_turned(axis):
    angles = np.random.default_rng(1).normal(0, 1e-4, (600, 3))
    found = []
    for turn in (0.0, np.pi):
        R = rotations.matrix_from_ypr(angles + turn * np.eye(3)[axis])
        still = _still(PoseSeries(np.arange(600) * 0.01, R, np.zeros((600, 3)), np.tile(1e-8 * np.eye(6), (600, 1, 1))))
        assert still is not None
        assert [name for name, _ in still.of_result] == ["yaw", "pitch", "roll"]
        found.append([allan.deviation for _, allan in still.of_result])
    np.testing.assert_allclose(found[1], found[0], rtol=1e-6)


def test_a_reference_of_another_motion_is_reported_as_not_fitting(folder, result):
    t = np.arange(0, 7, 0.02)
    R, p = smooth(2.3 * t + 1.7, (-1.0, 2.0, 0.3))
    path = write_tum(folder / "wrong.tum", PoseSeries(t, R, p, np.zeros((len(t), 6, 6))))
    outcome = compare_and_write(result, None, path, None)
    assert any("The recordings do not fit" in line for line in outcome.lines)
    assert outcome.lines[0].startswith("CHECK: ")


def test_a_reference_with_sigmas_that_are_too_small_is_a_check_with_a_remedy(folder, result, motions):
    noise = 1e-3 * np.random.default_rng(4).normal(size=motions[1].position_m.shape)
    path = write_tum(folder / "noisy.tum", replace(motions[1], position_m=motions[1].position_m + noise))
    out = folder / "too-sure"
    outcome = compare_and_write(result, None, path, out, sigma_m=1e-4, sigma_deg=np.rad2deg(5e-5))
    assert outcome.lines[0].startswith("CHECK: the differences are larger than the stated uncertainties: chi-square")
    assert "--sigma-m" in outcome.lines[0]
    assert json.loads((out / "comparison.json").read_text())["verdict"]["evidence"][0]["code"] == "BP-X01"
    page = (out / "report.html").read_text()
    assert "Remedy:" in page
    assert "BP-X01" in page


def test_stated_sigmas_of_angles_become_the_covariance_of_the_body(folder):
    path = write_csv(
        folder / "sigmas.csv",
        "t_s,yaw_deg,pitch_deg,roll_deg,sigma_yaw_deg,sigma_pitch_deg,sigma_roll_deg",
        np.array([[0, 10, 50, 20, 0.1, 0.2, 0.3], [1, 12, 50, 20, 0.1, 0.2, 0.3]], dtype=float),
    )
    motion, _ = read_reference(path)
    J = rotations.ypr_jacobian(motion.rotation[0])
    sigmas = np.rad2deg(np.sqrt(np.diag(J @ motion.covariance[0, 3:, 3:] @ J.T)))
    np.testing.assert_allclose(sigmas, [0.1, 0.2, 0.3], rtol=1e-9)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "empty file"),
        ("t_s,x\n0,1\n1,2\n", "expected columns qw,qx,qy,qz or yaw_deg"),
        ("t_s,x_m,y_m\n0,1,2\n1,2,2\n", "found no z_m"),
        ("t_s,yaw_deg\n0,1\n0,2\n", "line 3: expected rising times"),
        ("t_s,yaw_deg\n0,1\n", "two complete rows"),
        ("t_s,yaw_deg\n0,1\n1,abc\n", "line 3: yaw_deg: expected a number"),
        ("t_s,yaw_deg\n0,1\n1,inf\n", "line 3: yaw_deg: expected a number"),
        ("t_s,qw,qx,qy,qz\n0,1,0,0,0\n1,2,0,0,0\n", "line 3: expected a quaternion of length 1"),
        ("t_s,x_m,y_m,z_m,sigma_x_m\n0,1,1,1,1\n1,1,1,1,-1\n", "line 3: sigma_x_m"),
        ("0 1 2 3 0 0 0 1\n1 1 2 3 0 0 1\n", "line 2: expected eight numbers"),
        ("0 1 2 3 0 0 0 1\n1 1 2 x 0 0 0 1\n", "line 2: expected eight numbers"),
        ("0 1 2 3 0 0 0 1\n1 1 2 3 0 0 0 9\n", "line 2: expected a quaternion"),
        ("0 1 2 3 0 0 0 1\n0 1 2 3 0 0 0 1\n", "line 2: expected rising times"),
        ("0 1 2 3 0 0 0 1\n1 1 2e9 3 0 0 0 1\n", "line 2: x y z: expected numbers within 1e"),
        ("0 1 2 3 0 0 0 1\n1e18 1 2 3 0 0 0 1\n", "line 2: t: expected numbers within 1e"),
        ("t_s,x_m,y_m,z_m\n0,1,1,1\n1,1,-2147483648,1\n", "line 3: y_m: expected numbers within 1e"),
        ("t_s,x_m,y_m,z_m,sigma_x_m\n0,1,1,1,1\n1,1,1,1,1e300\n", "line 3: sigma_x_m: expected numbers within"),
    ],
)
def test_a_wrong_reference_is_one_line_with_the_place(tmp_path, text, words):
    path = tmp_path / "reference.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=words) as caught:
        read_reference(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_what_cannot_be_compared_is_named(folder, result, motions):
    with pytest.raises(InputError, match="second result folder or --reference"):
        compare(result)
    with pytest.raises(InputError, match=r"summary\.json"):
        compare(folder, other=result)
    far = write_tum(folder / "far.tum", replace(motions[1], t_s=motions[1].t_s + 1e5))
    with pytest.raises(InputError, match="fewer than 8 common times; give the offset"):
        compare(result, reference=far, align=("world", "body"))
    with pytest.raises(InputError, match="something other than earlier results"):
        compare_and_write(result, result, None, result)


@pytest.mark.parametrize(
    ("first", "second", "words"),
    [
        ("a1", "a1", "Both results rest on the same pictures or points"),
        ("a1", "b2", "The results are of different recordings, run-a1 and run-b2"),
        ("", "b2", "Both results may rest on the same pictures"),
    ],
)
def test_two_results_of_different_recordings_are_said_to_be_so(folder, result, motions, first, second, words):
    """The rig and the truth may be the same for both."""
    pair = []
    for name, digest in zip(("left", "right"), (first, second), strict=True):
        path = write_results(folder / "results" / f"{name}-{first}-{second}", motions[0])
        listed = [("r/rig.yaml", "0"), ("r/truth/pose.csv", "1"), ("r/frames/left", digest)]
        inputs = [{"path": where, "sha256": sha} for where, sha in listed] if digest else None
        content = {"schema": SUMMARY_SCHEMA, "run_folder": f"/d/run-{digest}", "inputs": inputs}
        (path / "summary.json").write_text(json.dumps(content))
        pair.append(path)
    (note,) = compare(pair[0], other=pair[1]).notes
    assert note.startswith(words)
