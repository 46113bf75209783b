"""The report of a joint calibration of a rig."""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from calibration.joint import DOTS, FRAMES, LOST, SPOTS, Joint
from calibration.joint_findings import in_degrees, in_mm
from calibration.measurement_groups import LEAST_REDUNDANCY
from calibration.rig_stacks import POSES, STAND, lines_in, stacks_of
from calibration.surveyed import pose_of
from geometry.arrays import Array, Bools, Ints
from geometry.pose import ypr_sigmas
from geometry.rig import Rig
from geometry.rig_parameters import split
from lab.calibrate.recordings import Recordings
from lab.calibrate.rig_outcome import Outcome
from lab.report.calibration_charts import residual_histogram
from lab.report.calibration_drawings import residual_field
from lab.report.calibration_maps import correlation_matrix, flatness_map
from lab.report.calibration_page import (
    CalibrationReport,
    Drawing,
    Section,
    Table,
    provenance,
    write_calibration_report,
)
from lab.report.calibration_scene import rig_things, scene_views
from lab.report.svg import short

_ARCSEC = np.deg2rad(1 / 3600)
_WORST = 10  # held-out positions in the table
_GAUGE = 3e-6  # m, rad: sigmas below it are of axes that were chosen, not measured


def write_page(
    outcome: Outcome, drawing: Rig, recordings: Recordings, inputs: Sequence[Path], day: datetime.date, folder: Path
) -> Path:
    """Write report.html. drawing: the rig with nominal beams."""
    sections = [
        _expected(outcome),
        _shares(outcome),
        _held_out(outcome, recordings.names),
        _groups(outcome),
        _residuals(outcome),
        _screens(outcome),
        _beams(outcome, drawing),
        _cameras(outcome),
        _correlations(outcome),
        _lab(outcome),
    ]
    report = CalibrationReport(
        "Rig",
        outcome.name,
        outcome.level,
        outcome.findings,
        _key_figures(outcome),
        [s for s in sections if s is not None],
        provenance(inputs, day),
    )
    return write_calibration_report(report, folder)


def _key_figures(o: Outcome) -> list[tuple[str, str, str]]:
    joint, out = o.steps.joint, []
    if o.expected is not None:
        e = o.expected
        out.append(
            ("attitude, one frame", f"{in_degrees(e.total):.2g} deg", "1 sigma per axis, expected in the middle")
        )
        out.append(("position, one frame", f"{in_mm(e.total):.2g} mm", "1 sigma per axis, expected in the middle"))
        words = f"{in_degrees(e.systematic):.2g} deg · {in_mm(e.systematic):.2g} mm"
        out.append(("of it calibration", words, "no averaging lessens it"))
    if o.held_out is not None:
        h = o.held_out
        words = f"{np.rad2deg(h.attitude_rms):.2g} deg · {1e3 * h.position_rms:.2g} mm"
        out.append(("held-out positions", words, f"RMS per axis, {h.ratio:.2f} times what is expected"))
    spots = joint.every[SPOTS].linearise(joint.values).residuals
    px = _spot_pixels(o, spots)[joint.kept[SPOTS]]
    out.append(("spots", f"{short(float(np.sqrt(np.mean(px**2))), 3)} px", "RMS residual per axis"))
    if DOTS in joint.every:
        s = o.steps.measured.network.sightings
        px = joint.every[DOTS].linearise(joint.values).residuals * s.sigma_px[:, None]
        rms = float(np.sqrt(np.mean(px[joint.kept[DOTS]] ** 2)))
        out.append(("dots", f"{short(rms, 3)} px", "RMS residual per axis"))
    sigma = _beam_sigmas(joint)[0] / _ARCSEC
    out.append(("beam directions", f"{short(float(np.sqrt(np.mean(sigma**2))), 3)} arcsec", "1 sigma per axis"))
    return out


def _expected(o: Outcome) -> Section | None:
    e = o.expected
    if e is None:
        return None
    rows = []
    for name, C in (
        ("all", e.total),
        ("noise of the spots in that frame", e.noise),
        ("calibration", e.systematic),
    ):
        mm = 1e3 * np.sqrt(np.maximum(np.diagonal(C)[:3], 0))
        ypr = np.rad2deg(ypr_sigmas(e.world_from_body, C))
        rows.append((name, *(float(v) for v in ypr), *(float(v) for v in mm)))
    heads = ("part", "yaw (deg)", "pitch (deg)", "roll (deg)", "x (mm)", "y (mm)", "z (mm)")
    words = [
        f"1 sigma of a pose measured from one frame in the middle of the stand's positions, {e.views} spots in the"
        " pictures.",
        "The noise differs from frame to frame and averages out. The calibration's part is the same in every frame: no"
        " averaging lessens it; between two poses that are near to each other it cancels.",
    ]
    return Section("What one frame will tell", words, (), Table(heads, rows))


def _shares(o: Outcome) -> Section | None:
    e = o.expected
    if e is None:
        return None
    total = float(np.trace(e.systematic[3:, 3:])), float(np.trace(e.systematic[:3, :3]))
    rows = [
        (
            name,
            f"{in_degrees(C):.5f}",
            f"{in_mm(C):.4f}",
            f"{100 * float(np.trace(C[3:, 3:])) / total[0]:.1f}",
            f"{100 * float(np.trace(C[:3, :3])) / total[1]:.1f}",
        )
        for name, C in e.shares.items()
        if name not in (FRAMES, LOST)
    ]
    rows.sort(key=lambda r: -float(r[3]))
    heads = ("errors of", "attitude (deg)", "position (mm)", "% of attitude variance", "% of position variance")
    words = [
        "Whose errors make the calibration's part: each kind of measurement carried through the joint adjustment to the"
        " pose. The variances add up to the whole.",
        f"Improve {rows[0][0]} first: better sigmas there, or more of them." if rows else "",
    ]
    return Section("What contributes most", words, (), Table(heads, rows))


def _held_out(o: Outcome, positions: Sequence[str]) -> Section | None:
    h = o.held_out
    if h is None:
        return None
    deg, mm = np.rad2deg(h.errors[:, 3:]), 1e3 * h.errors[:, :3]
    rows = [
        (positions[k], *(f"{v:.4f}" for v in deg[i]), *(f"{v:.3f}" for v in mm[i]), f"{h.sigmas[i]:.2f}")
        for i, k in enumerate(h.positions)
    ]
    rows = sorted(rows, key=lambda r: -float(r[-1]))[:_WORST]
    heads = (
        "position", "about x (deg)", "about y (deg)", "about z (deg)", "x (mm)", "y (mm)", "z (mm)",
        "misfit / expected",
    )  # fmt: skip
    drawings = [
        Drawing(residual_histogram(deg, "Attitude of held-out positions, per axis", "deg")),
        Drawing(residual_histogram(mm, "Position of held-out positions, per axis", "mm")),
    ]
    words = (
        "Each fifth of the positions was measured with a calibration that had not seen its spots, and compared with the"
        " stand's record: what a user's own recording will meet, the stand's errors included. The table has the worst"
        f" {min(_WORST, len(rows))}; x, y, z are the body's axes in the attitude, the world's in the position."
    )
    return Section("Positions held out", words, drawings, Table(heads, rows))


def _groups(o: Outcome) -> Section:
    joint = o.steps.joint
    rows = []
    for name, g in joint.groups.items():
        if name in (FRAMES, LOST):
            continue
        kept = joint.kept.get(name)
        left_out = 0 if kept is None else int(np.sum(~kept))
        tested = g.redundancy > LEAST_REDUNDANCY
        p = f"{g.p:.2g}" if tested else "–"
        rows.append(
            (
                name,
                g.numbers,
                f"{g.redundancy:.0f}",
                f"{g.scale:.2f}" if tested else "–",
                p,
                left_out,
                f"{joint.scales.get(name, 1.0):.2f}",
            )
        )
    heads = ("kind", "numbers", "redundant", "misfit / sigma", "p", "left out", "sigmas widened by")
    words = [
        "How far each kind of measurement lies from what all the others say, in its own sigmas: 1 is right. Numbers"
        " that are not redundant fix what nothing else knows, and cannot be tested.",
        "Where a kind misfits beyond chance (p below 0.001) its sigmas were widened until it fits.",
    ]
    return Section("How the measurements fit together", words, (), Table(heads, rows))


def _residuals(o: Outcome) -> Section:
    joint, measured = o.steps.joint, o.steps.measured
    cameras = list(joint.rig.cameras)
    views = joint.rig.views()
    drawings = []
    spots = joint.every[SPOTS].linearise(joint.values).residuals
    px = -_spot_pixels(o, spots)
    camera_of = np.array([cameras.index(views[v][0]) for v in measured.spots.view], dtype=np.int64)
    drawings += _fields(o, "spots", measured.spots.pixels, px, camera_of, joint.kept[SPOTS])
    if DOTS in joint.every:
        s = measured.network.sightings
        r = joint.every[DOTS].linearise(joint.values).residuals
        drawings += _fields(o, "dots", s.pixels, -r * s.sigma_px[:, None], s.camera_of, joint.kept[DOTS])
    drawings.append(
        Drawing(residual_histogram(spots[joint.kept[SPOTS]], "Spots: residuals in sigmas", "sigma", sigma=1.0))
    )
    words = (
        "Found less predicted, of what was kept. Arrows that turn slowly with the place tell of a lens or a screen; all"
        " of one position alike, of the stand. residuals.csv has every one."
    )
    return Section("Residuals", words, drawings)


def _fields(o: Outcome, what: str, pixels: Array, residuals: Array, camera_of: Ints, kept: Bools) -> list[Drawing]:
    out = []
    for c, (name, camera) in enumerate(o.steps.joint.rig.cameras.items()):
        here = (camera_of == c) & kept
        if here.any():
            title = f"Camera {name}: {what}, found − predicted"
            out.append(Drawing(residual_field(camera.image_size_px, pixels[here], residuals[here], title, things=what)))
    return out


def _screens(o: Outcome) -> Section | None:
    joint = o.steps.joint
    drawings, rows = [], []
    sigmas = dict(zip(joint.covariance.names, np.sqrt(np.diagonal(joint.covariance.matrix)), strict=True))
    for (name, screen), result in zip(joint.rig.screens.items(), o.steps.screens.screens, strict=True):
        if result.flatness is not None and len(result.xyz):
            chosen = result.flatness.chosen
            sigma = float(np.median(chosen.sigma_m[chosen.used]))
            drawings.append(
                Drawing(
                    flatness_map(
                        result.xyz[:, :2],
                        result.xyz[:, 2],
                        f"Screen {name}: height of the dots over its plane",
                        size_m=screen.size_m,
                        bow=screen.bow if any(screen.bow) else None,
                        sigma_m=sigma,
                    )
                )
            )
        normal = screen.world_from_screen.rotation[:, 2]
        along = tilt = 0.0
        if "screens" in joint.unknowns.start:
            at = joint.unknowns.places("screens", list(joint.rig.screens).index(name))
            C = joint.all_covariance[np.ix_(at, at)]
            along = float(np.sqrt(np.maximum(normal @ C[:3, :3] @ normal, 0.0)))
            tilt = float(np.sqrt(np.maximum(C[3, 3] + C[4, 4], 0.0) / 2))
        bow = float(sigmas.get(f"screens.{name}.bow_xx_per_m", 0.0))
        rows.append(
            (name, ", ".join(f"{v:.4f}" for v in screen.world_from_screen.translation), 1e3 * along,
             float(np.rad2deg(tilt)), "bent" if any(screen.bow) else "flat", float(1e3 * bow) if bow else None)
        )  # fmt: skip
    heads = ("screen", "origin (m)", "sigma along its normal (mm)", "sigma of its tilt (deg)", "surface",
             "sigma of the bow (1/km)")  # fmt: skip
    words = (
        "Where the screens are. Origin and axes within a plane are a choice, no measurement; what counts is how far and"
        " how tilted it is."
    )
    return Section("Screens", words, drawings, Table(heads, rows))


def _beams(o: Outcome, drawing: Rig) -> Section:
    joint = o.steps.joint
    direction, offset = _beam_sigmas(joint)
    away = lines_in(joint.values).minus(lines_in(stacks_of(drawing)))
    rows = [
        (
            name,
            ", ".join(f"{v:.6f}" for v in joint.rig.beams[name].direction),
            ", ".join(f"{1e3 * v:.2f}" for v in joint.rig.beams[name].point),
            float(direction[i] / _ARCSEC),
            float(1e3 * offset[i]),
            float(np.rad2deg(np.linalg.norm(away[i, :2])) * 60),
            float(1e3 * np.linalg.norm(away[i, 2:])),
        )
        for i, name in enumerate(joint.rig.beams)
    ]
    heads = (
        "beam", "direction", "offset (mm)", "sigma direction (arcsec)", "sigma offset (mm)", "from drawing (arcmin)",
        "from drawing (mm)",
    )  # fmt: skip
    pose, place = pose_of(joint.values, STAND)[0], joint.unknowns
    words = ["Each laser in the body frame, which is the stand's carriage as its positions were recorded."]
    if STAND in place.start:
        rows_of = place.places(STAND, 0)
        C = joint.all_covariance[np.ix_(rows_of, rows_of)]
        mm = ", ".join(
            f"{1e3 * t:.2f} ± {1e3 * s:.2f}" for t, s in zip(pose.translation, np.sqrt(np.diagonal(C)[:3]), strict=True)
        )
        deg = ", ".join(
            f"{v:.4f} ± {s:.4f}" for v, s in zip(np.rad2deg(pose.ypr), np.rad2deg(ypr_sigmas(pose, C)), strict=True)
        )
        words.append(f"The stand in the world: x, y, z {mm} mm; yaw, pitch, roll {deg} deg.")
    return Section("Beams", words, (), Table(heads, rows))


def _cameras(o: Outcome) -> Section:
    joint = o.steps.joint
    sigmas = dict(zip(joint.covariance.names, np.sqrt(np.diagonal(joint.covariance.matrix)), strict=True))
    before = o.steps.measured.network.rig
    rows = []
    for i, (name, camera) in enumerate(joint.rig.cameras.items()):
        at = joint.unknowns.places("cameras", i)
        C = joint.all_covariance[np.ix_(at, at)]
        # Where it stands: x_w = R^T (x_c - t); errors of t come through R^T, those of the attitude by the lever.
        R, t = camera.camera_from_world.rotation, camera.camera_from_world.translation
        J = np.concatenate([-R.T, _lever(R, t)], axis=1)
        place = np.sqrt(np.mean(np.maximum(np.diagonal(J @ C @ J.T), 0.0)))
        centre = camera.camera_from_world.inverse().translation
        rows.append(
            (
                name,
                ", ".join(f"{v:.4f}" for v in centre),
                float(1e3 * place),
                float(np.rad2deg(np.sqrt(np.mean(np.diagonal(C)[3:])))),
                float(camera.matrix[0, 0]),
                float(sigmas.get(f"cameras.{name}.fx", 0.0)),
                float(camera.matrix[0, 0] - before.cameras[name].matrix[0, 0]),
            )
        )
    heads = ("camera", "stands at (m)", "sigma of that (mm)", "sigma of its attitude (deg)", "fx (px)",
             "sigma (px)", "moved from its lens calibration (px)")  # fmt: skip
    words = (
        "Lens and place of a camera are known better together than each alone: a focal length that is too long looks"
        " like a camera that stands farther off. rig.yaml holds the joint covariance."
    )
    return Section("Cameras", words, (), Table(heads, rows))


def _lever(R: Array, t: Array) -> Array:
    """d(centre)/d(theta) (3, 3) for camera_from_world R Exp(theta), t: the centre is -(R Exp(theta))^T t."""
    c = -R.T @ t
    # Exp(-theta) c = c - theta x c
    return np.array([[0, -c[2], c[1]], [c[2], 0, -c[0]], [-c[1], c[0], 0]])


def _correlations(o: Outcome) -> Section:
    C = o.steps.joint.covariance
    sigma = np.sqrt(np.diagonal(C.matrix))
    shown = [
        i
        for i, n in enumerate(C.names)
        if split(n)[0] == "beams" or (sigma[i] > _GAUGE and not split(n)[2].startswith(("k", "p1", "p2", "s", "tau")))
    ]
    shown.sort(key=lambda i: ("beams", "screens", "cameras").index(split(C.names[i])[0]))
    names = [_short_name(C.names[i]) for i in shown]
    picture = correlation_matrix(names, C.matrix[np.ix_(shown, shown)], "Correlations of the rig's numbers")
    words = "Errors that go together. Taken one by one they would promise a worse attitude than the rig gives."
    return Section("Correlations", words, [Drawing(picture, wide=True)])


def _short_name(name: str) -> str:
    """`camera left fx` of `cameras.left.fx`."""
    kind, thing, parameter = split(name)
    bare = parameter.removesuffix("_per_m").removesuffix("_rad").removesuffix("_m")
    return f"{kind.removesuffix('s')} {thing} {bare}"


def _lab(o: Outcome) -> Section:
    joint = o.steps.joint
    body = (
        o.expected.world_from_body
        if o.expected is not None
        else pose_of(joint.values, STAND)[0] @ pose_of(joint.values, POSES)[0]
    )
    return Section(
        "The lab",
        "Cameras, screens and beams as found; the vehicle stands in the middle of the stand's positions.",
        [Drawing(view) for view in scene_views(rig_things(joint.rig, body))],
    )


def _spot_pixels(o: Outcome, residuals: Array) -> Array:
    """Residuals of spots (N, 2) in px, from those in sigmas."""
    roots = np.linalg.cholesky(o.steps.measured.spots.covariance)
    return np.asarray((roots @ residuals[..., None])[..., 0])


def _beam_sigmas(joint: Joint) -> tuple[Array, Array]:
    """Of each beam: direction (rad) and offset (m), RMS of the two axes across it."""
    variances = np.array(
        [np.diagonal(joint.all_covariance)[joint.unknowns.places("beams", i)] for i in range(len(joint.rig.beams))]
    )
    return np.sqrt(variances[:, :2].mean(axis=1)), np.sqrt(variances[:, 2:].mean(axis=1))
