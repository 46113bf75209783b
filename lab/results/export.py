"""`beampose export`: the motion of a result in the files of other programs.

Each format states the same conventions in its own way: the pose is world_from_body, lengths are in m (C3D: mm), times
in s since frame 0. A format that cannot mark a pose as predicted contains measured ones only.
"""

from __future__ import annotations

import io
import json
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from geometry.arrays import Array, Bools
from lab.errors import InputError
from lab.files.run.results import POSE_STATUSES, PoseTrack, ResultFolder, read_result_table
from lab.files.text import columns
from lab.files.text.atomic_write import atomic_folder, atomic_write_bytes
from lab.files.text.error_text import require_one_of
from lab.files.text.json_text import plain_value
from lab.findings.finding import Done
from lab.packages import needed, versions
from tracking.statuses import PoseStatus

CONVENTIONS = (
    "Frames: world is the right-handed frame of the laboratory; body is fixed in the vehicle.",
    "Pose: world_from_body, x_world = R x_body + t; the quaternion is of R.",
    "Angles: R = Rz(yaw) Ry(pitch) Rx(roll), about z, the new y, the new x.",
    "Time: s since frame 0, at mid-exposure.",
)
_COVARIANCE = "Covariance: of [dt in world (m), dtheta in body (rad)]: t_true = t + dt, R_true = R Exp(dtheta)."
_ROS_COVARIANCE = "Covariance: of x, y, z (m) and rotations about the axes of world (rad), as ROS states it."
_UNITS = ("rad_s", "m_s", "deg", "rad", "px", "m", "s")  # endings of columns
_MOST_C3D_FRAMES = 65_535
_ARM_M = 1.0  # from the body's origin to each virtual point of a C3D file


@dataclass(frozen=True, slots=True)
class Exported:
    """A motion to write: n frames, with what the file states about it."""

    name: str
    about: Mapping[str, str]  # texts for the file's metadata
    causal: bool
    poses: PoseTrack
    columns: Mapping[str, Array]  # attitude.csv by column, as in the file; statuses as words
    measured_only: bool  # the format cannot mark a pose as predicted
    notes: list[str]  # what the format cannot carry, for the user

    @property
    def shown(self) -> Bools:
        """(n,): the frames whose pose is written."""
        return self.poses.has(PoseStatus.MEASURED) if self.measured_only else self.poses.known

    def kept(self) -> Bools:
        """`shown`, of a format without frames that have no such pose; notes these."""
        shown = self.shown
        missing = int(np.sum(~shown))
        if missing:
            why = "no measured pose, and the format marks none" if self.measured_only else "no pose"
            self.notes.append(f"{missing} of {len(shown)} frames not in the file: {why}")
        if not shown.any():
            kind = "measured pose" if self.measured_only else "pose"
            raise InputError(f"{self.name}: expected a frame with a {kind} to write, found none")
        return shown

    def stamps_ns(self) -> list[int]:
        """Times in whole ns. Raises InputError where a ROS time cannot hold them."""
        t = self.poses.t_s
        if len(t) and not (t.min() >= 0 and t.max() < 2**31):
            raise InputError(f"{self.name}: expected times from 0 to 2^31 s, which the format needs, found {t.min()} s")
        return [round(1e9 * x) for x in t.tolist()]


def export(results: Path | str, to: str, out: Path | str | None = None, *, causal: bool = False) -> Done[Path]:
    """Write the motion of a results folder in a format of `FORMATS`; the result is the file's path.

    out: the file, or the folder of a rosbag2; default: the name of the results in the working folder. causal: the poses
    as known at each instant, in place of the smoothed ones.

    >>> lab.export(results, "tum", results / "motion.tum").result.name
    'motion.tum'

    Raises InputError: no results, an unknown format, a package that is not installed, or a motion that it cannot hold.
    """
    results = Path(results)
    require_one_of("--to", to, FORMATS)
    folder = ResultFolder.of_run(results)
    wanted = FORMATS[to]
    path = Path(out) if out is not None else Path(f"{results.resolve().name}{wanted.suffix}")
    motion = _read(folder, causal, wanted)
    wanted.write(motion, path)
    return Done(path, (f"{to}: {path} ({int(motion.shown.sum())} poses)",), tuple(motion.notes))


def _read(results: ResultFolder, causal: bool, wanted: Format) -> Exported:
    which = columns.CAUSAL if causal else ""
    path = results.folder / f"attitude{which}.csv"
    poses = results.causal if causal else results.poses
    if poses is None:
        what = "expected attitude_causal.csv, which `beampose run` writes with a smoothing pass"
        raise InputError(f"{results.folder}: {what}")
    table = read_result_table(path, columns.ATTITUDE)
    words = np.array([*POSE_STATUSES, ""], dtype=object)
    values = {c: words[poses.status] if c in table.words else table.numbers[c] for c in columns.ATTITUDE}
    values |= {c: values[c].astype(np.int64) for c in columns.WHOLE}
    summary = results.summary
    inputs, rig = summary.get("inputs") or (), Path(str(summary.get("rig", ""))).name
    about = {
        "source": f"beampose {versions()['beampose']}, {path.name} of {summary.get('name', '')}",
        "verdict": str(summary.get("verdict", {}).get("status", "")),
        "rig": next((f"sha256 {i['sha256']}" for i in inputs if Path(str(i.get("path"))).name == rig), ""),
        "conventions": " ".join([*CONVENTIONS, *([wanted.covariance] if wanted.covariance else [])]),
    }
    return Exported(results.folder.resolve().name, about, causal, poses, values, wanted.measured_only, [])


# TUM: a line of t x y z qx qy qz qw for each pose.


def _write_tum(motion: Exported, path: Path) -> None:
    shown = motion.kept()
    lines = [f"# {name}: {text}" for name, text in motion.about.items()]
    lines += ["# t_s x_m y_m z_m qx qy qz qw"]
    rows = np.column_stack([motion.poses.t_s, _xyz_and_quaternion(motion.poses)])[shown]
    lines += [" ".join(map(repr, row)) for row in rows.tolist()]
    atomic_write_bytes(("\n".join(lines) + "\n").encode(), path)


def _xyz_and_quaternion(poses: PoseTrack) -> Array:
    """(n, 7): position, m, and quaternion in the order x, y, z, w."""
    pose = poses.world_from_body
    return np.concatenate([pose.translation, np.roll(pose.quaternion_wxyz, -1, axis=-1)], axis=-1)


# MCAP for Foxglove: transforms, and all numbers of each frame.


def _of_numbers(*names: str) -> dict[str, Any]:
    return {"type": "object", "properties": {name: {"type": "number"} for name in names}}


_TRANSFORM = {
    "title": "foxglove.FrameTransform",
    "type": "object",
    "properties": {
        "timestamp": {
            "type": "object",
            "title": "time",
            "properties": {"sec": {"type": "integer", "minimum": 0}, "nsec": {"type": "integer", "minimum": 0}},
        },
        "parent_frame_id": {"type": "string"},
        "child_frame_id": {"type": "string"},
        "translation": _of_numbers("x", "y", "z"),
        "rotation": _of_numbers("x", "y", "z", "w"),
    },
}


def _write_mcap(motion: Exported, path: Path) -> None:
    writing = needed("mcap", "--to mcap", "writer")
    properties: dict[str, Any] = {
        c: {"type": "string" if c == "status" else ["number", "null"]} for c in motion.columns
    }
    properties["covariance"] = {"type": ["array", "null"], "items": {"type": "number"}, "description": _COVARIANCE}
    row_schema = {"title": "beampose.Attitude", "type": "object", "properties": properties}
    content = io.BytesIO()
    writer = writing.Writer(content)
    writer.start()
    writer.add_metadata("beampose", dict(motion.about))
    channels = []
    for topic, schema in (("/tf", _TRANSFORM), ("/beampose/attitude", row_schema)):
        text = json.dumps(schema).encode()
        number = writer.register_schema(name=schema["title"], encoding="jsonschema", data=text)
        channels.append(writer.register_channel(topic=topic, message_encoding="json", schema_id=number))
    numbers = _xyz_and_quaternion(motion.poses).tolist()
    for i, stamp in enumerate(motion.stamps_ns()):
        known = bool(motion.poses.known[i])
        row = {c: plain_value(values[i]) for c, values in motion.columns.items()}
        covariance = motion.poses.covariance[i]
        row["covariance"] = covariance.ravel().tolist() if np.isfinite(covariance).all() else None
        messages: list[dict[str, Any] | None] = [_transform(numbers[i], stamp) if known else None, row]
        for channel, message in zip(channels, messages, strict=True):
            if message is not None:
                data = json.dumps(message, allow_nan=False).encode()
                writer.add_message(channel, log_time=stamp, publish_time=stamp, data=data)
    writer.finish()
    atomic_write_bytes(content.getvalue(), path)


def _transform(numbers: list[float], stamp_ns: int) -> dict[str, Any]:
    return {
        "timestamp": {"sec": stamp_ns // 10**9, "nsec": stamp_ns % 10**9},
        "parent_frame_id": "world",
        "child_frame_id": "body",
        "translation": dict(zip("xyz", numbers[:3], strict=True)),
        "rotation": dict(zip("xyzw", numbers[3:], strict=True)),
    }


# rosbag2: a folder with metadata.yaml and a database, without ROS.


def _write_rosbag2(motion: Exported, path: Path) -> None:
    bags = needed("rosbag2", "--to rosbag2", "rosbag2")
    types = needed("rosbag2", "--to rosbag2", "typesys")
    store = types.get_typestore(types.Stores.ROS2_HUMBLE)
    motion.kept()
    motion.notes.append("velocities and rates are not in the file")
    with atomic_folder(path, _is_ours) as work:
        inner = work / path.name  # the writer makes it, and names its database after it
        with bags.Writer(inner, version=9) as bag:
            for name, text in motion.about.items():
                bag.set_custom_data(f"beampose_{name}", text)
            topics = {
                kind: bag.add_connection(topic, kind, typestore=store)
                for topic, kind in (
                    ("/tf", "tf2_msgs/msg/TFMessage"),
                    ("/beampose/pose", "geometry_msgs/msg/PoseWithCovarianceStamped"),
                    ("/beampose/status", "std_msgs/msg/String"),
                )
            }
            for stamp, kind, message in _ros_messages(motion, store.types):
                bag.write(topics[kind], stamp, store.serialize_cdr(message, kind))
        for file in inner.iterdir():
            shutil.move(file, work / file.name)
        inner.rmdir()


def _is_ours(folder: Path) -> bool:
    """Whether a folder is a bag of this program: other bags are not replaced."""
    path = folder / "metadata.yaml"
    return path.is_file() and "beampose_conventions" in path.read_text("utf-8", "replace")


def _ros_messages(motion: Exported, types: Mapping[str, Any]) -> Iterator[tuple[int, str, Any]]:
    """Time (ns), type and message, frame by frame."""
    geometry = "geometry_msgs/msg/"
    poses, words = motion.poses, motion.columns["status"]
    # ROS turns about the axes of the parent frame: R Exp(dtheta) = Exp(R dtheta) R.
    to_ros = np.zeros((len(poses.frames), 6, 6))
    to_ros[:, :3, :3], to_ros[:, 3:, 3:] = np.eye(3), poses.world_from_body.rotation
    covariance = np.nan_to_num(to_ros @ poses.covariance @ np.swapaxes(to_ros, 1, 2))
    numbers = _xyz_and_quaternion(poses).tolist()
    for i, stamp in enumerate(motion.stamps_ns()):
        yield stamp, "std_msgs/msg/String", types["std_msgs/msg/String"](str(words[i]))
        if not poses.known[i]:
            continue
        time = types["builtin_interfaces/msg/Time"](stamp // 10**9, stamp % 10**9)
        header = types["std_msgs/msg/Header"](time, "world")
        turn = types[f"{geometry}Quaternion"](*numbers[i][3:])
        place = types[f"{geometry}Vector3"](*numbers[i][:3])
        moved = types[f"{geometry}TransformStamped"](header, "body", types[f"{geometry}Transform"](place, turn))
        yield stamp, "tf2_msgs/msg/TFMessage", types["tf2_msgs/msg/TFMessage"]([moved])
        pose = types[f"{geometry}Pose"](types[f"{geometry}Point"](*numbers[i][:3]), turn)
        with_covariance = types[f"{geometry}PoseWithCovariance"](pose, covariance[i].ravel())
        kind = f"{geometry}PoseWithCovarianceStamped"
        yield stamp, kind, types[kind](header, with_covariance)


# C3D: virtual points of the body at a constant rate, in mm and single precision.


def _write_c3d(motion: Exported, path: Path) -> None:
    ezc3d = needed("c3d", "--to c3d")
    poses = motion.poses
    motion.kept()
    place = poses.frames - poses.frames[0]
    count = int(place[-1]) + 1
    if count > _MOST_C3D_FRAMES:
        raise InputError(f"{motion.name}: expected at most {_MOST_C3D_FRAMES} frames for --to c3d, found {count}")
    rate = place[-1] / (poses.t_s[-1] - poses.t_s[0]) if count > 1 else 1.0
    late = np.abs(poses.t_s - poses.t_s[0] - place / rate).max()
    if late > 0.01 / rate:
        motion.notes.append(f"the file states a constant rate, from which times differ by up to {1e3 * late:.3g} ms")
    motion.notes.append("covariances, velocities and rates are not in the file; numbers have single precision")
    body = _ARM_M * np.concatenate([np.zeros((1, 3)), np.eye(3)])
    points = np.full((4, len(body), count), np.nan)
    points[3] = 1.0
    for k, point in enumerate(body):
        points[:3, k, place] = 1e3 * poses.world_from_body.apply(point).T
    residuals = np.where(np.isnan(points[:1]), -1.0, 0.0)
    sigmas = {name: np.zeros(count) for name in columns.POSE[10:]}
    for name, values in sigmas.items():
        values[place] = np.nan_to_num(motion.columns[name])
    state = np.full(count, -1.0)
    state[place] = poses.status
    file = ezc3d.c3d()
    parameters = file["parameters"]
    for group, labels, unit, says in (
        ("POINT", ("ORIGIN", "BODY_X", "BODY_Y", "BODY_Z"), ("mm",), [f"{_ARM_M:g} m along the body's axes"] * 4),
        (
            "ANALOG",
            ("STATUS", *(name.upper() for name in sigmas)),
            ("", *(_unit(name) for name in sigmas)),
            [", ".join(f"{i} {word}" for i, word in enumerate(POSE_STATUSES)), *["standard deviation"] * len(sigmas)],
        ),
    ):
        parameters[group]["LABELS"]["value"] = labels
        parameters[group]["UNITS"]["value"] = unit
        parameters[group]["DESCRIPTIONS"]["value"] = tuple(says)
        parameters[group]["RATE"]["value"] = [float(rate)]
    for name, text in motion.about.items():
        file.add_parameter("BEAMPOSE", name.upper(), [text[k : k + 120] for k in range(0, max(len(text), 1), 120)])
    file.add_parameter("BEAMPOSE", "FIRST_FRAME", [float(poses.frames[0])])
    file["data"]["points"], file["data"]["meta_points"]["residuals"] = points, residuals
    file["data"]["analogs"] = np.stack([state, *sigmas.values()])[None]
    with tempfile.TemporaryDirectory() as work:
        file.write(str(Path(work) / "motion.c3d"))
        atomic_write_bytes((Path(work) / "motion.c3d").read_bytes(), path)


# Tables with all columns: HDF5 and Parquet.


def _unit(column: str) -> str:
    """The unit that the name of a column ends in; empty where it has none."""
    unit = next((u for u in _UNITS if column.endswith(f"_{u}")), "")
    return unit.replace("_s", "/s")


def _write_hdf5(motion: Exported, path: Path) -> None:
    h5py = needed("hdf5", "--to hdf5")
    content = io.BytesIO()
    with h5py.File(content, "w") as file:
        file.attrs.update(motion.about)
        for name, values in motion.columns.items():
            typed = values.astype(h5py.string_dtype()) if name == "status" else values
            data = file.create_dataset(f"attitude/{name}", data=typed)
            data.attrs["unit"] = _unit(name)
        for name in ("covariance", *(() if motion.causal else ("systematic",))):
            data = file.create_dataset(name, data=getattr(motion.poses, name))
            data.attrs["unit"] = "m, rad"
            data.attrs["meaning"] = _COVARIANCE
    atomic_write_bytes(content.getvalue(), path)


def _write_parquet(motion: Exported, path: Path) -> None:
    pa, parquet = needed("parquet", "--to parquet"), needed("parquet", "--to parquet", "parquet")
    arrays, fields = [], []
    upper = {c: motion.poses.covariance[:, int(c[1]), int(c[2])] for c in columns.COVARIANCE[1:]}
    for name, values in {**motion.columns, **upper}.items():
        kind = pa.string() if name == "status" else pa.int64() if name in columns.WHOLE else pa.float64()
        arrays.append(pa.array(values, kind, from_pandas=True))
        fields.append(pa.field(name, kind, metadata={"unit": _unit(name)}))
    content = pa.BufferOutputStream()
    parquet.write_table(pa.table(arrays, schema=pa.schema(fields, metadata=dict(motion.about))), content)
    atomic_write_bytes(content.getvalue().to_pybytes(), path)


@dataclass(frozen=True, slots=True)
class Format:
    """A format: how it is written, the end of a file's name, what it says of covariances, and which poses it holds."""

    write: Callable[[Exported, Path], None]
    suffix: str
    covariance: str = ""
    measured_only: bool = False


FORMATS: Mapping[str, Format] = {
    "tum": Format(_write_tum, ".tum", measured_only=True),
    "mcap": Format(_write_mcap, ".mcap", _COVARIANCE),
    "rosbag2": Format(_write_rosbag2, "-rosbag2", _ROS_COVARIANCE),
    "c3d": Format(_write_c3d, ".c3d"),
    "hdf5": Format(_write_hdf5, ".h5", _COVARIANCE),
    "parquet": Format(_write_parquet, ".parquet", _COVARIANCE),
}
