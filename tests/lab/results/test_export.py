"""Exported motions are the same when the library of the format reads them: places, turns about each axis, times."""

from __future__ import annotations

import importlib
import json
import tomllib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import lab
from cli import main
from lab.files.text import columns
from lab.files.text.csv_text import write_table
from lab.packages import PACKAGES
from lab.results.export import FORMATS
from tests.lab.command import typed
from tests.paths import ROOT

# world_from_body by axis and angle (deg), place (m) and status of each frame; frame 4 is missing, 6 has no pose.
MOTION = [
    (0, "z", 0.0, (0.0, 0.0, 0.0), "measured"),
    (1, "z", 30.0, (1.0, 0.0, 0.0), "measured"),
    (2, "y", 30.0, (0.0, 1.0, 0.0), "measured"),
    (3, "x", 30.0, (0.0, 0.0, 1.0), "measured"),
    (5, "z", 150.0, (0.123456789, -2.5, 1 / 3), "predicted"),
    (6, "", 0.0, (0.0, 0.0, 0.0), "lost"),
    (7, "x", -170.0, (-0.7, 0.2, 0.4), "measured"),
]
RATE = 200.0
POSED = [m for m in MOTION if m[4] != "lost"]


def turned(axis: str, degrees: float) -> np.ndarray:
    """The body's axes in world, as columns, from sines and cosines: x to y about z, y to z about x, z to x about y."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    i, j = {"z": (0, 1), "x": (1, 2), "y": (2, 0)}[axis]
    out = np.eye(3)
    out[i, i], out[j, j], out[j, i], out[i, j] = c, c, s, -s
    return out


def covariance(frame: int) -> np.ndarray:
    A = np.random.default_rng(frame).normal(size=(6, 6)) * [1e-3, 2e-3, 3e-3, 1e-4, 2e-4, 3e-4]
    return A.T @ A


@pytest.fixture(scope="module")
def results(tmp_path_factory) -> Path:
    """A results folder with this motion."""
    folder = tmp_path_factory.mktemp("results") / "turns"
    folder.mkdir()
    rows, covariances = [], []
    for frame, axis, degrees, place, status in MOTION:
        pose = [""] * 16
        if axis:
            x, y, z, w = Rotation.from_matrix(turned(axis, degrees)).as_quat(canonical=True)
            ypr = Rotation.from_matrix(turned(axis, degrees)).as_euler("ZYX", degrees=True)
            pose = [*map(repr, map(float, (*place, w, x, y, z, *ypr))), *["0.001"] * 6]
            upper = covariance(frame)[np.triu_indices(6)]
            covariances.append([frame, *map(repr, upper.tolist())])
        rows.append([frame, repr(frame / RATE), *pose, 5, "0.1" if axis else "", status, *[""] * 12])
    write_table(folder / "attitude.csv", columns.ATTITUDE, rows)
    write_table(folder / "covariance.csv", columns.COVARIANCE, covariances)
    summary = {"schema": "beampose/summary/1", "name": "turns", "verdict": {"status": "check"}, "rig": "rig.yaml"}
    inputs = [{"path": "here/rig.yaml", "sha256": "ab12", "bytes": 3}]
    (folder / "summary.json").write_text(json.dumps({**summary, "inputs": inputs}))
    return folder


@dataclass
class Read:
    """What another library reads: of n poses, and the texts of the file."""

    t_s: np.ndarray
    place_m: np.ndarray
    axes: np.ndarray  # (n, 3, 3), body axes in world as columns
    texts: str
    status: list[str] | None = None  # of all frames
    covariance: np.ndarray | None = None  # (n, 6, 6) as in covariance.csv


def read_tum(path: Path) -> Read:
    values = np.loadtxt(path)
    return Read(values[:, 0], values[:, 1:4], Rotation.from_quat(values[:, 4:]).as_matrix(), path.read_text())


def read_mcap(path: Path) -> Read:
    reader = importlib.import_module("mcap.reader").make_reader(path.open("rb"))
    found = [(c.topic, json.loads(m.data), m.log_time) for _, c, m in reader.iter_messages()]
    moved = [m for topic, m, _ in found if topic == "/tf"]
    rows = [m for topic, m, _ in found if topic == "/beampose/attitude"]
    assert all(
        log == m["timestamp"]["sec"] * 10**9 + m["timestamp"]["nsec"] for topic, m, log in found if topic == "/tf"
    )
    assert {(m["parent_frame_id"], m["child_frame_id"]) for m in moved} == {("world", "body")}
    return Read(
        np.array([m["timestamp"]["sec"] + 1e-9 * m["timestamp"]["nsec"] for m in moved]),
        np.array([[m["translation"][k] for k in "xyz"] for m in moved]),
        Rotation.from_quat([[m["rotation"][k] for k in "xyzw"] for m in moved]).as_matrix(),
        " ".join(m.metadata["conventions"] + m.metadata["rig"] for m in reader.iter_metadata()),
        [row["status"] for row in rows],
        np.array([np.reshape(row["covariance"], (6, 6)) for row in rows if row["covariance"] is not None]),
    )


def read_rosbag2(path: Path) -> Read:
    types = importlib.import_module("rosbags.typesys")
    store = types.get_typestore(types.Stores.ROS2_HUMBLE)
    poses, moved, status = [], [], []
    with importlib.import_module("rosbags.rosbag2").Reader(path) as bag:
        for connection, _, raw in bag.messages():
            message = store.deserialize_cdr(raw, connection.msgtype)
            {"/beampose/pose": poses, "/tf": moved, "/beampose/status": status}[connection.topic].append(message)
    places = [m.pose.pose.position for m in poses]
    quaternions = [m.pose.pose.orientation for m in poses]
    axes = Rotation.from_quat([[q.x, q.y, q.z, q.w] for q in quaternions]).as_matrix()
    for pose, tf in zip(poses, moved, strict=True):
        assert (tf.transforms[0].header.frame_id, tf.transforms[0].child_frame_id) == ("world", "body")
        assert tf.transforms[0].transform.rotation == pose.pose.pose.orientation
    # ROS: rotations about the fixed axes of the header's frame. Exp(w) R = R Exp(R^T w).
    T = np.zeros((len(poses), 6, 6))
    T[:, :3, :3], T[:, 3:, 3:] = np.eye(3), np.swapaxes(axes, 1, 2)
    C = np.array([m.pose.covariance.reshape(6, 6) for m in poses])
    return Read(
        np.array([m.header.stamp.sec + 1e-9 * m.header.stamp.nanosec for m in poses]),
        np.array([[p.x, p.y, p.z] for p in places]),
        axes,
        (path / "metadata.yaml").read_text(),
        [m.data for m in status],
        T @ C @ np.swapaxes(T, 1, 2),
    )


def read_c3d(path: Path) -> Read:
    file = importlib.import_module("ezc3d").c3d(str(path))
    points = file["data"]["points"][:3] / 1e3
    assert file["parameters"]["POINT"]["UNITS"]["value"] == ["mm"]
    valid = file["data"]["meta_points"]["residuals"][0, 0] >= 0
    assert np.isnan(points[:, :, ~valid]).all()
    words = {2: "lost", 1: "predicted", 0: "measured"}
    codes = file["data"]["analogs"][0, 0]
    own = file["parameters"]["BEAMPOSE"]
    return Read(
        np.flatnonzero(valid) / file["parameters"]["POINT"]["RATE"]["value"][0],
        points[:, 0, valid].T,
        np.moveaxis(points[:, 1:, valid] - points[:, :1, valid], 2, 0),
        "".join(own["CONVENTIONS"]["value"] + own["RIG"]["value"]),
        [words[round(code)] for code in codes if code >= 0],
    )


def read_hdf5(path: Path) -> Read:
    with importlib.import_module("h5py").File(path) as file:
        table = file["attitude"]
        known = np.isfinite(table["x_m"][:])
        assert (table["x_m"].attrs["unit"], table["yaw_deg"].attrs["unit"]) == ("m", "deg")
        assert table["velocity_x_m_s"].attrs["unit"] == "m/s"
        return Read(
            table["t_s"][known],
            np.stack([table[c][known] for c in ("x_m", "y_m", "z_m")], -1),
            Rotation.from_quat(np.stack([table[c][known] for c in ("qx", "qy", "qz", "qw")], -1)).as_matrix(),
            file.attrs["conventions"] + file.attrs["rig"],
            [word.decode() for word in table["status"][:]],
            file["covariance"][known],
        )


def read_parquet(path: Path) -> Read:
    table = importlib.import_module("pyarrow.parquet").read_table(path)
    assert table.schema.field("rate_x_rad_s").metadata == {b"unit": b"rad/s"}
    frame = table.to_pandas()
    known = frame[frame["x_m"].notna()]
    C = np.zeros((len(known), 6, 6))
    for name in columns.COVARIANCE[1:]:
        C[:, int(name[1]), int(name[2])] = C[:, int(name[2]), int(name[1])] = known[name]
    return Read(
        known["t_s"].to_numpy(),
        known[["x_m", "y_m", "z_m"]].to_numpy(),
        Rotation.from_quat(known[["qx", "qy", "qz", "qw"]].to_numpy()).as_matrix(),
        b" ".join(table.schema.metadata.values()).decode(),
        frame["status"].tolist(),
        C,
    )


READERS = {
    "tum": read_tum, "mcap": read_mcap, "rosbag2": read_rosbag2, "c3d": read_c3d, "hdf5": read_hdf5,
    "parquet": read_parquet,
}  # fmt: skip
CANNOT_MARK_PREDICTED = ("tum",)
SINGLE_PRECISION = ("c3d",)  # 24 bits: 2.5 m to 1.5e-7 m


def exported(results: Path, to: str, out: Path, *more: str) -> str:
    """What the command prints."""
    if to in PACKAGES:
        pytest.importorskip(PACKAGES[to][0])
    done = typed("export", results, "--to", to, "--out", out, *more)
    assert done.exit_code == 0, done.output
    return done.output


@pytest.mark.parametrize("to", FORMATS)
def test_the_other_library_reads_the_same_motion(results, tmp_path, to):
    said = exported(results, to, tmp_path / f"motion{FORMATS[to].suffix}")
    read = READERS[to](tmp_path / f"motion{FORMATS[to].suffix}")
    expected = [m for m in POSED if to not in CANNOT_MARK_PREDICTED or m[4] == "measured"]
    assert f"({len(expected)} poses)" in said
    within = 4e-7 if to in SINGLE_PRECISION else 1e-9
    np.testing.assert_allclose(read.t_s, [m[0] / RATE for m in expected], rtol=0, atol=within)
    np.testing.assert_allclose(read.place_m, [m[3] for m in expected], rtol=0, atol=within)
    np.testing.assert_allclose(read.axes, [turned(m[1], m[2]) for m in expected], rtol=0, atol=within)
    if read.status is not None:
        assert read.status == [m[4] for m in MOTION]
    if read.covariance is not None:
        np.testing.assert_allclose(read.covariance, [covariance(m[0]) for m in expected], rtol=1e-9, atol=1e-18)
    assert "world_from_body" in read.texts.replace("\n", "")
    assert "ab12" in read.texts
    if read.status is None:
        assert "2 of 7 frames" in said


@pytest.mark.parametrize("to", FORMATS)
def test_an_earlier_file_is_replaced_and_a_foreign_folder_is_not(results, tmp_path, to):
    out = tmp_path / "motion"
    exported(results, to, out)
    exported(results, to, out)
    assert len(READERS[to](out).t_s) > 0
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis/chapter.tex").write_text("years")
    with pytest.raises(lab.InputError):
        lab.export(results, to, tmp_path / "thesis")
    (tmp_path / "thesis/metadata.yaml").write_text("rosbag2_bagfile_information: {}")  # a bag of another program
    with pytest.raises(lab.InputError):
        lab.export(results, to, tmp_path / "thesis")
    assert (tmp_path / "thesis/chapter.tex").read_text() == "years"


def test_a_recording_with_gaps_has_a_rate_and_a_note_where_its_times_are_not_even(results, tmp_path):
    uneven = tmp_path / "uneven"
    uneven.mkdir()
    for file in results.iterdir():
        (uneven / file.name).write_text(file.read_text().replace("\n3,0.015,", "\n3,0.0165,"))
    assert "times differ by up to 1.5 ms" in exported(uneven, "c3d", tmp_path / "m.c3d")
    assert "times differ" not in exported(results, "c3d", tmp_path / "m.c3d")


def test_times_before_zero_are_an_error_where_the_format_has_none(results, tmp_path):
    early = tmp_path / "early"
    early.mkdir()
    for file in results.iterdir():
        (early / file.name).write_text(file.read_text().replace("\n0,0.0,", "\n0,-0.5,"))
    for to in ("mcap", "rosbag2"):
        with pytest.raises(lab.InputError, match=r"expected times from 0"):
            lab.export(early, to, tmp_path / "m")
    assert lab.export(early, "tum", tmp_path / "m").exit_status == 0


def test_results_without_a_pose_or_without_causal_poses_are_an_error(results, tmp_path):
    nothing = tmp_path / "nothing"
    nothing.mkdir()
    for file in results.iterdir():
        (nothing / file.name).write_text(file.read_text())
    lost = ["0", "0", *[""] * 16, "0", "", "lost", *[""] * 12]
    write_table(nothing / "attitude.csv", columns.ATTITUDE, [lost])
    for to in ("tum", "rosbag2", "c3d"):
        with pytest.raises(lab.InputError, match=r"expected a frame with a (measured )?pose"):
            lab.export(nothing, to, tmp_path / "m")
    for to in ("mcap", "hdf5", "parquet"):  # which contain the statuses
        assert "(0 poses)" in lab.export(nothing, to, tmp_path / "m").line()
    with pytest.raises(lab.InputError, match=r"expected attitude_causal\.csv"):
        lab.export(results, "tum", tmp_path / "m", causal=True)


def test_a_package_that_is_missing_is_named_with_its_extra(results, tmp_path, monkeypatch):
    real = importlib.import_module
    monkeypatch.setattr(
        importlib, "import_module", lambda name, *a: real("no_such_module" if name.startswith("ezc3d") else name, *a)
    )
    with pytest.raises(lab.InputError, match=r"--to c3d: .*ezc3d.*pip install 'beampose\[c3d\]'"):
        lab.export(results, "c3d", tmp_path / "m.c3d")


def test_every_extra_is_declared_with_its_package_and_part_of_the_tests():
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    declared = {extra: [r.split(">=")[0] for r in extras[extra]] for extra in PACKAGES}
    assert declared == {extra: [package] for extra, (_, package) in PACKAGES.items()}
    (tested,) = [r for r in extras["dev"] if r.startswith("beampose[")]
    assert sorted(tested.removeprefix("beampose[").removesuffix("]").split(",")) == sorted(PACKAGES)


def test_the_command_offers_the_formats_and_the_documentation_lists_them():
    (option,) = [p for p in main.commands["export"].params if p.name == "to"]
    assert list(option.type.choices) == list(FORMATS)
    table = (ROOT / "docs/formats.md").read_text().split("{ #export }")[1].split("\n#")[0]
    assert [f for f in FORMATS if f"| `{f}` |" not in table] == []
