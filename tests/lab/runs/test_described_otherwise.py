"""A recording that is described in another frame, unit or order gives the same motion, with the same uncertainty."""

from __future__ import annotations

import csv
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from geometry.pose import Pose
from geometry.rig import Rig
from lab.files.rig.rig_file import load_rig, save_rig
from lab.files.run.results import read_poses
from lab.runs.process import process_run
from lab.simulate.write import simulate
from tests.lab.tables import rows_of

FRAMES = 30
HERE = Pose.identity()
OTHER_AXES = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])  # the motion model has a noise for each axis
ELSEWHERE = Pose(OTHER_AXES, np.array([3.0, -20.0, 5.0]))


@dataclass(frozen=True)
class Description:
    """Another description of the rig and of the points of a recording, and what it makes of the poses."""

    rig: Rig
    prior: Pose
    within_m: float = 1.0
    pixels: float = 1.0  # of the new pictures for each of the given ones
    reverse: bool = False  # the points of a frame
    motion: Pose = HERE  # world' from world
    body: Pose = HERE  # body from body'
    metres: float = 1.0


def with_poses(rig: Rig, world: Pose, metres: float = 1.0) -> Rig:
    """The rig in another world, in which all lengths have another unit."""

    def longer(pose: Pose) -> Pose:
        return Pose(pose.rotation, metres * pose.translation)

    return replace(
        rig,
        cameras={
            n: replace(c, camera_from_world=longer(c.camera_from_world @ world.inverse()))
            for n, c in rig.cameras.items()
        },
        screens={n: replace(s, world_from_screen=longer(world @ s.world_from_screen)) for n, s in rig.screens.items()},
        beams={n: replace(b, point=metres * b.point) for n, b in rig.beams.items()},
    )


def in_another_world(rig: Rig) -> Description:
    return Description(with_poses(rig, ELSEWHERE), ELSEWHERE, motion=ELSEWHERE)


def of_another_body(rig: Rig) -> Description:
    body = Pose(OTHER_AXES, np.zeros(3))
    new_from_old = body.inverse()
    beams = {
        n: replace(b, direction=new_from_old.rotation @ b.direction, point=new_from_old.apply(b.point))
        for n, b in rig.beams.items()
    }
    return Description(replace(rig, beams=beams), body, body=body)


def in_another_unit(rig: Rig) -> Description:
    return Description(with_poses(rig, HERE, 1.5), HERE, 1.5, metres=1.5)


def in_another_order(rig: Rig) -> Description:
    def reverse(things):
        return dict(reversed(things.items()))

    parts = {kind: reverse(getattr(rig, kind)) for kind in ("cameras", "screens", "beams", "spots")}
    return Description(replace(rig, **parts), HERE, reverse=True)


def with_smaller_pixels(rig: Rig) -> Description:
    times = np.array([[2.0, 1, 2], [1, 2, 2], [1, 1, 1]])
    shift = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])  # pixel 0 has its centre at 0, and becomes pixels 0 and 1
    cameras = {
        n: replace(
            c,
            matrix=c.matrix * times + shift,
            image_size_px=(2 * c.image_size_px[0], 2 * c.image_size_px[1]),
            noise=None,
        )
        for n, c in rig.cameras.items()
    }
    return Description(replace(rig, cameras=cameras), HERE, pixels=2.0)


@pytest.fixture(scope="module")
def given(tmp_path_factory):
    folder = tmp_path_factory.mktemp("given")
    run = simulate("smooth", folder / "run", seed=7, frames=FRAMES, points=True)
    process_run(run, folder / "out")
    return run, read_poses(folder / "out")


def written(run: Path, new: Description, folder: Path) -> Path:
    """The run folder of a description."""
    folder.mkdir()
    save_rig(new.rig, folder / "rig.yaml")
    content = yaml.safe_load((run / "run.yaml").read_text())
    content["prior"] |= {
        "position_m": new.prior.translation.tolist(),
        "yaw_pitch_roll_deg": np.rad2deg(new.prior.ypr).tolist(),
        "within_m": new.within_m,
    }
    (folder / "run.yaml").write_text(yaml.safe_dump(content))
    rows = rows_of(run / "detections.csv")
    for row in rows:
        for name, offset in (("u_px", 0.5), ("v_px", 0.5), ("sigma_u_px", 0.0), ("sigma_v_px", 0.0)):
            row[name] = repr(new.pixels * float(row[name]) + (offset if new.pixels != 1 else 0.0))
    if new.reverse:
        rows.sort(key=lambda row: int(row["frame"]))
        at = [int(row["frame"]) for row in rows]
        rows = [row for frame in dict.fromkeys(at) for row in reversed([r for r in rows if int(r["frame"]) == frame])]
    with (folder / "detections.csv").open("w", newline="") as file:
        table = csv.DictWriter(file, list(rows[0]))
        table.writeheader()
        table.writerows(rows)
    return folder


@pytest.mark.parametrize(
    "describe", [in_another_world, of_another_body, in_another_unit, in_another_order, with_smaller_pixels]
)
def test_the_same_recording_described_otherwise_gives_the_same_motion(given, tmp_path, describe):
    run, known = given
    new = describe(load_rig(run / "rig.yaml"))
    process_run(written(run, new, tmp_path / "run"), tmp_path / "out")
    found = read_poses(tmp_path / "out")
    expected = new.motion @ known.world_from_body @ new.body
    np.testing.assert_array_equal(found.frames, known.frames)
    sigma = np.sqrt(np.trace(known.covariance[:, :3, :3], axis1=1, axis2=2))
    turn = np.sqrt(np.trace(known.covariance[:, 3:, 3:], axis1=1, axis2=2))
    off = np.linalg.norm(found.world_from_body.translation - new.metres * expected.translation, axis=-1)
    assert np.all(off < 0.05 * new.metres * sigma)
    turned = (found.world_from_body.inverse() @ Pose(expected.rotation, expected.translation)).rotation
    angle = np.arccos(np.clip((np.trace(turned, axis1=-2, axis2=-1) - 1) / 2, -1, 1))
    assert np.all(angle < 0.05 * turn)
    stated = np.sqrt(np.trace(found.covariance[:, 3:, 3:], axis1=1, axis2=2))
    np.testing.assert_allclose(stated, turn, rtol=0.02)
    about = known.rate_rad_s @ new.body.rotation  # about the axes of the other body
    assert np.all(np.abs(found.rate_rad_s - about) < 0.05 * np.linalg.norm(known.sigma_rate_rad_s, axis=-1)[:, None])
