"""The tables of a run: columns in order, all rows present, numbers unchanged after writing and reading."""

from __future__ import annotations

import csv
import io
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from geometry.pose import Pose, ypr_sigmas
from lab.errors import RunError
from lab.files.text import columns
from lab.runs.frames.pipeline import FrameRecord
from lab.runs.tables import TableWriter, csv_word, pose_numbers
from tests.geometry.scenes import paper_rig, random_pose
from tests.lab.tables import rows_of
from tracking.detections import Detections
from tracking.statuses import MotionEstimate, PoseStatus, SpotStatus, TrackedFrame

HEADERS = {
    "detections.csv": columns.DETECTIONS,
    "spots.csv": columns.SPOTS,
    "beams.csv": columns.BEAMS,
    "attitude.csv": columns.ATTITUDE,
    "covariance.csv": columns.COVARIANCE,
}
RIG = paper_rig()
VIEWS = RIG.views()


def covariances(rng: np.random.Generator, *shape: int) -> np.ndarray:
    A = rng.normal(size=shape) * 0.1
    return A @ np.swapaxes(A, -1, -2) + 1e-6 * np.eye(shape[-1])


def a_record(rng: np.random.Generator, frame: int = 7, n_points: int = 4) -> FrameRecord:
    """A frame of random numbers; the third view is lost, the second camera has no picture."""
    n = len(VIEWS)
    uv, cov, gain = rng.uniform(-50, 1300, (n, 2)), covariances(rng, n, 2, 2), rng.random(n)
    uv[2], cov[2], gain[3:] = np.nan, np.nan, np.nan
    status = [SpotStatus.MATCHED] * 2 + [SpotStatus.LOST] + [SpotStatus.NO_IMAGE] * 3
    found = Detections(
        rng.uniform(0, 1000, (n_points, 2)), covariances(rng, n_points, 2, 2), *rng.random((5, n_points))
    )
    tracked = TrackedFrame(
        uv, cov, tuple(status), rng.uniform(0, 1000, (n, 2)), gain, np.arange(n), PoseStatus.MEASURED,
        random_pose(rng), covariances(rng, 6, 6), 5, 0.123, (), np.where(np.isnan(gain), np.nan, 0.99),
        motion=MotionEstimate(rng.normal(size=3), rng.normal(size=3), covariances(rng, 6, 6)),
    )  # fmt: skip
    return FrameRecord(frame, frame / 30, 1 / 30, (found, None), ("", "gone"), tracked)


def lost(record: FrameRecord) -> FrameRecord:
    tracked = replace(record.tracked, pose=None, pose_covariance=None, motion=None, pose_status=PoseStatus.LOST,
                      spots_used=0, rms_px=float("nan"))  # fmt: skip
    return replace(record, tracked=tracked)


def written(tmp_path, *records: FrameRecord, rig=RIG) -> dict[str, list[dict[str, str]]]:
    with TableWriter(tmp_path, rig) as tables:
        for record in records:
            tables.write(record)
    return {name: rows_of(tmp_path / name) for name in HEADERS}


def number(text: str) -> float:
    return float(text) if text else float("nan")


def numbers(row: dict[str, str], *names: str) -> np.ndarray:
    return np.array([number(row[n]) for n in names])


CONTRACT = {
    "detections.csv": "frame,camera,u_px,v_px,sigma_u_px,sigma_v_px,flux,peak,major_px,minor_px,angle_deg,cov_uv_px2",
    "spots.csv": "frame,t_s,camera,spot,u_px,v_px,sigma_u_px,sigma_v_px,status,predicted_u_px,predicted_v_px,gain,"
    "cov_uv_px2,label_probability",
    "beams.csv": "frame,t_s,beam,dx,dy,dz,px_m,py_m,pz_m,status",
    "attitude.csv": "frame,t_s,x_m,y_m,z_m,qw,qx,qy,qz,yaw_deg,pitch_deg,roll_deg,sigma_x_m,sigma_y_m,sigma_z_m,"
    "sigma_yaw_deg,sigma_pitch_deg,sigma_roll_deg,spots_used,rms_px,status,velocity_x_m_s,velocity_y_m_s,velocity_z_m_s,"
    "rate_x_rad_s,rate_y_rad_s,rate_z_rad_s,sigma_velocity_x_m_s,sigma_velocity_y_m_s,sigma_velocity_z_m_s,"
    "sigma_rate_x_rad_s,sigma_rate_y_rad_s,sigma_rate_z_rad_s",
    "covariance.csv": "frame,c00,c01,c02,c03,c04,c05,c11,c12,c13,c14,c15,c22,c23,c24,c25,c33,c34,c35,c44,c45,c55",
}


@pytest.mark.parametrize("name", CONTRACT)
def test_the_columns_are_those_of_the_contract_in_their_order(tmp_path, name):
    """The columns are repeated here: the contract is fixed, independently of lab/files/text/columns.py."""
    rng = np.random.default_rng(1)
    written(tmp_path, a_record(rng, 0), lost(a_record(rng, 1)))
    lines = (tmp_path / name).read_text().splitlines()
    assert lines[0] == CONTRACT[name]
    assert {line.count(",") for line in lines} == {CONTRACT[name].count(",")}  # those of a lost frame too


def test_a_run_without_frames_has_tables_with_headers(tmp_path):
    assert {name: len(rows) for name, rows in written(tmp_path).items()} == dict.fromkeys(HEADERS, 0)


def test_spots_are_read_as_they_were_written(tmp_path):
    record = a_record(np.random.default_rng(2))
    rows = written(tmp_path, record)["spots.csv"]
    t = record.tracked
    assert [(r["camera"], r["spot"]) for r in rows] == VIEWS
    assert [r["status"] for r in rows] == [s.value for s in t.status]
    for i, r in enumerate(rows):
        assert r["frame"] == "7"
        assert float(r["t_s"]) == pytest.approx(7 / 30, rel=1e-9)
        np.testing.assert_allclose(numbers(r, "u_px", "v_px"), t.uv_px[i], rtol=1e-9)
        np.testing.assert_allclose(numbers(r, "predicted_u_px", "predicted_v_px"), t.predicted_px[i], rtol=1e-9)
        np.testing.assert_allclose(number(r["gain"]), t.gain[i], rtol=1e-9)
        su, sv, cov = numbers(r, "sigma_u_px", "sigma_v_px", "cov_uv_px2")
        np.testing.assert_allclose([[su * su, cov], [cov, sv * sv]], t.cov_px2[i], rtol=1e-8)
        np.testing.assert_allclose(number(r["label_probability"]), t.label_probability[i], rtol=1e-9)
    assert rows[2]["u_px"] == rows[2]["sigma_u_px"] == rows[2]["cov_uv_px2"] == ""


def test_detections_are_read_as_they_were_written_and_a_camera_without_a_picture_has_none(tmp_path):
    record = a_record(np.random.default_rng(3))
    rows = written(tmp_path, record)["detections.csv"]
    found = record.detections[0]
    assert [r["camera"] for r in rows] == ["left"] * len(found)
    for i, r in enumerate(rows):
        np.testing.assert_allclose(numbers(r, "u_px", "v_px"), found.uv_px[i], rtol=1e-9)
        su, sv, cov = numbers(r, "sigma_u_px", "sigma_v_px", "cov_uv_px2")
        np.testing.assert_allclose([[su * su, cov], [cov, sv * sv]], found.cov_px2[i], rtol=1e-8)
        for name in ("flux", "peak", "major_px", "minor_px", "angle_deg"):
            assert number(r[name]) == pytest.approx(getattr(found, name)[i], rel=1e-9)


def test_an_unknown_value_of_a_detection_is_an_empty_field(tmp_path):
    record = a_record(np.random.default_rng(4))
    record = replace(record, detections=(Detections.at(np.array([[3.5, 4.5]]), np.eye(2)[None]), None))
    assert written(tmp_path, record)["detections.csv"] == [
        dict(zip(columns.DETECTIONS, ("7", "left", "3.5", "4.5", "1", "1", "", "", "", "", "", "0"), strict=True))
    ]


def test_poses_are_read_as_they_were_written(tmp_path):
    rng = np.random.default_rng(5)
    records = [a_record(rng, frame) for frame in range(20)]
    tables = written(tmp_path, *records)
    for record, row, covariance in zip(records, tables["attitude.csv"], tables["covariance.csv"], strict=True):
        t = record.tracked
        q = numbers(row, "qw", "qx", "qy", "qz")
        assert q[0] >= 0
        assert np.linalg.norm(q) == pytest.approx(1, abs=1e-9)
        back = Pose.from_quaternion(q, numbers(row, "x_m", "y_m", "z_m"))
        np.testing.assert_allclose(back.rotation, t.pose.rotation, atol=1e-9)
        np.testing.assert_allclose(back.translation, t.pose.translation, rtol=1e-9)
        ypr = numbers(row, "yaw_deg", "pitch_deg", "roll_deg")
        np.testing.assert_allclose(Pose.from_ypr(np.deg2rad(ypr), np.zeros(3)).rotation, t.pose.rotation, atol=1e-8)
        C = np.zeros((6, 6))
        C[np.triu_indices(6)] = [float(covariance[f"c{i}{j}"]) for i in range(6) for j in range(i, 6)]
        C += np.triu(C, 1).T
        np.testing.assert_allclose(C, t.pose_covariance, rtol=1e-8)
        np.testing.assert_allclose(
            numbers(row, "sigma_x_m", "sigma_y_m", "sigma_z_m") ** 2, np.diagonal(C)[:3], rtol=1e-8
        )
        sigmas = np.rad2deg(ypr_sigmas(t.pose, C))
        np.testing.assert_allclose(
            numbers(row, "sigma_yaw_deg", "sigma_pitch_deg", "sigma_roll_deg"), sigmas, rtol=1e-7
        )
        assert (row["spots_used"], row["rms_px"], row["status"]) == ("5", "0.123", "measured")
        moving = numbers(row, "velocity_x_m_s", "velocity_y_m_s", "velocity_z_m_s", *columns.MOTION[3:6])
        np.testing.assert_allclose(moving, [*t.motion.velocity, *t.motion.rate], rtol=1e-9)
        assert columns.MOTION[3:6] == ("rate_x_rad_s", "rate_y_rad_s", "rate_z_rad_s")
        np.testing.assert_allclose(
            numbers(row, *(f"sigma_{n}" for n in columns.MOTION[:6])) ** 2, np.diagonal(t.motion.covariance), rtol=1e-8
        )


def test_beams_are_the_rigs_lines_transformed_by_the_pose(tmp_path):
    record = a_record(np.random.default_rng(6))
    rows = written(tmp_path, record)["beams.csv"]
    assert [r["beam"] for r in rows] == list(RIG.beams)
    pose = record.tracked.pose
    for r in rows:
        beam = RIG.beams[r["beam"]]
        np.testing.assert_allclose(numbers(r, "dx", "dy", "dz"), pose.rotation @ beam.direction, rtol=1e-8, atol=1e-10)
        np.testing.assert_allclose(numbers(r, "px_m", "py_m", "pz_m"), pose.apply(beam.point), rtol=1e-8)
        assert r["status"] == "measured"


def test_a_lost_frame_has_a_row_with_empty_pose_fields_and_no_covariance(tmp_path):
    rng = np.random.default_rng(7)
    tables = written(tmp_path, a_record(rng, 0), lost(a_record(rng, 1)), a_record(rng, 2))
    row = tables["attitude.csv"][1]
    assert {n: v for n, v in row.items() if v} == {"frame": "1", "t_s": row["t_s"], "spots_used": "0", "status": "lost"}
    assert [r["frame"] for r in tables["covariance.csv"]] == ["0", "2"]
    beams = [r for r in tables["beams.csv"] if r["frame"] == "1"]
    assert [(r["beam"], r["dx"], r["pz_m"], r["status"]) for r in beams] == [(b, "", "", "lost") for b in RIG.beams]


def test_without_velocities_and_label_probabilities_their_fields_are_empty(tmp_path):
    record = a_record(np.random.default_rng(10))
    record = replace(record, tracked=replace(record.tracked, motion=None, label_probability=None))
    tables = written(tmp_path, record)
    assert {tables["attitude.csv"][0][name] for name in columns.MOTION} == {""}
    assert {row["label_probability"] for row in tables["spots.csv"]} == {""}
    assert tables["attitude.csv"][0]["status"] == "measured"


def test_the_causal_pass_has_its_own_tables_with_the_same_columns(tmp_path):
    rng = np.random.default_rng(11)
    smoothed, in_causal_pass = [a_record(rng, 0), a_record(rng, 1)], [a_record(rng, 0), lost(a_record(rng, 1))]
    with TableWriter(tmp_path, RIG, with_causal=True) as tables:
        for record, causal in zip(smoothed, in_causal_pass, strict=True):
            tables.write(record, causal)
    for name in ("attitude", "covariance"):
        plain, causal = ((tmp_path / f"{name}{which}.csv").read_text().splitlines() for which in ("", "_causal"))
        assert plain[0] == causal[0]
        assert {line.count(",") for line in plain + causal} == {plain[0].count(",")}
    rows = rows_of(tmp_path / "attitude_causal.csv")
    assert [r["status"] for r in rows] == ["measured", "lost"]
    assert float(rows[0]["x_m"]) == pytest.approx(in_causal_pass[0].tracked.pose.translation[0], rel=1e-9)
    (row,) = rows_of(tmp_path / "covariance_causal.csv")
    assert float(row["c00"]) == pytest.approx(in_causal_pass[0].tracked.pose_covariance[0, 0], rel=1e-9)


def test_a_covariance_with_very_unequal_axes_is_positive_definite_after_reading(tmp_path):
    """Sigmas of 1 m along one direction and 1 um across: with ten digits a variance would become negative."""
    rng = np.random.default_rng(12)
    axes = np.linalg.qr(rng.normal(size=(6, 6)))[0]
    C = axes @ np.diag([1.0, *[1e-12] * 5]) @ axes.T
    C = 0.5 * (C + C.T)
    record = a_record(rng)
    rows = written(tmp_path, replace(record, tracked=replace(record.tracked, pose_covariance=C)))["covariance.csv"]
    back = np.zeros((6, 6))
    back[np.triu_indices(6)] = [float(rows[0][name]) for name in columns.COVARIANCE[1:]]
    back += np.triu(back, 1).T
    assert np.array_equal(back, C)
    assert np.linalg.eigvalsh(back)[0] > 0.9e-12
    rounded = np.vectorize(lambda x: float(f"{x:.10g}"))(C)
    assert np.linalg.eigvalsh(rounded)[0] < 0


@pytest.mark.parametrize("what", ["pose", "motion", "spots"])
@pytest.mark.filterwarnings("error")
def test_a_negative_variance_is_never_written(tmp_path, what):
    """The frame checks remove such values; in the writer they are an error of the program, not an empty field."""
    record = a_record(np.random.default_rng(13))
    t, bad = record.tracked, np.diag([1.0, 1.0, 1.0, 1.0, 1.0, -1e-12])
    wrong = {
        "pose": replace(t, pose_covariance=bad),
        "motion": replace(t, motion=replace(t.motion, covariance=bad)),
        "spots": replace(t, cov_px2=np.where(np.arange(len(VIEWS))[:, None, None] == 1, -t.cov_px2, t.cov_px2)),
    }
    with pytest.raises(RunError, match="frame 7: internal error: a variance is negative"):
        written(tmp_path, replace(record, tracked=wrong[what]))


def test_the_sixteen_numbers_of_the_pose_are_in_the_order_of_the_columns():
    pose = Pose.from_ypr(np.deg2rad([10.0, 20.0, 30.0]), np.array([1.0, 2.0, 3.0]))
    values = dict(zip(columns.ATTITUDE[2:18], pose_numbers(pose, np.diag([1e-6, 4e-6, 9e-6, 0, 0, 0])), strict=True))
    assert [values[n] for n in ("x_m", "y_m", "z_m")] == [1, 2, 3]
    np.testing.assert_allclose([values[n] for n in ("yaw_deg", "pitch_deg", "roll_deg")], [10, 20, 30])
    np.testing.assert_allclose([values[n] for n in ("sigma_x_m", "sigma_y_m", "sigma_z_m")], [1e-3, 2e-3, 3e-3])
    np.testing.assert_allclose([values[n] for n in ("qw", "qx", "qy", "qz")], pose.quaternion_wxyz)


@given(st.text(alphabet=st.characters(exclude_categories=("Cs",), exclude_characters="\0"), min_size=1))
def test_any_name_is_unchanged_in_a_field(name):
    assert next(csv.reader(io.StringIO(f"1,{csv_word(name)},2\n", newline=""))) == ["1", name, "2"]


def test_names_with_commas_and_quotes_are_unchanged_in_the_tables(tmp_path):
    rig = paper_rig()
    camera = rig.cameras["left"]
    odd = type(camera)('left, "upper"', "left", camera.image_size_px, camera.matrix, (), camera.camera_from_world)
    beams = {'A,"1"': replace(rig.beams["A"], name='A,"1"'), "B": rig.beams["B"], "C": rig.beams["C"]}
    spots = {n: replace(s, beam='A,"1"') if s.beam == "A" else s for n, s in rig.spots.items()}
    rig = replace(rig, cameras={odd.name: odd, "right": rig.cameras["right"]}, beams=beams, spots=spots)
    tables = written(tmp_path, a_record(np.random.default_rng(8)), rig=rig)
    assert {r["camera"] for r in tables["spots.csv"]} == {odd.name, "right"}
    assert {r["camera"] for r in tables["detections.csv"]} == {odd.name}
    assert [r["beam"] for r in tables["beams.csv"]] == ['A,"1"', "B", "C"]


def test_the_files_are_closed_when_the_run_fails(tmp_path):
    tables = TableWriter(tmp_path, RIG)

    def break_it():
        with tables:
            tables.write(a_record(np.random.default_rng(9)))
            raise RuntimeError("camera unplugged")

    with pytest.raises(RuntimeError, match="unplugged"):
        break_it()
    with pytest.raises(ValueError, match="closed file"):
        tables.write(a_record(np.random.default_rng(9)))


def test_rows_do_not_depend_on_the_block_size(tmp_path, monkeypatch):
    rng = np.random.default_rng(21)
    records = [a_record(rng, frame, n_points=frame % 5) for frame in range(150)]
    records = [lost(r) if r.frame % 7 == 3 else r for r in records]
    texts = []
    for block in (64, 1):
        folder = tmp_path / str(block)
        folder.mkdir()
        monkeypatch.setattr("lab.runs.tables._BLOCK", block)
        with TableWriter(folder, RIG, with_causal=True) as tables:
            for record in records:
                tables.write(record, lost(record) if record.frame % 11 == 0 else record)
        texts.append({path.name: path.read_bytes() for path in sorted(folder.iterdir())})
    assert texts[0] == texts[1]
    assert texts[0]["attitude.csv"].count(b"\n") == 151
