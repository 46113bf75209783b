"""Report of a rig calibration: sections on screens, beams, cameras and the correlations of their errors."""

from __future__ import annotations

import numpy as np

from calibration.rig.joint import Joint
from calibration.terms.rig_blocks import POSES, STAND, lines_in, stacks_of
from calibration.terms.surveyed import pose_of
from geometry.arrays import Array
from geometry.pose import ypr_sigmas
from geometry.rig import Rig
from geometry.uncertainty.rig_uncertainty import split_name
from lab.calibrate.rig.rig_findings import RigResult
from lab.report.calibration.calibration_maps import correlation_matrix, flatness_map
from lab.report.calibration.calibration_page import (
    PageDrawing,
    PageTable,
    Section,
)
from lab.report.calibration.calibration_scene import rig_things, scene_views

ARCSEC = np.deg2rad(1 / 3600)
_GAUGE_SIGMA = 3e-6  # m, rad: parameters with smaller sigmas are fixed by convention, not measured


def screens_section(o: RigResult) -> Section | None:
    """Section on the poses and the flatness of the screens; None if the project has no screens."""
    joint = o.steps.joint
    drawings, rows = [], []
    sigmas = dict(zip(joint.covariance.names, np.sqrt(np.diagonal(joint.covariance.matrix)), strict=True))
    for (name, screen), result in zip(joint.rig.screens.items(), o.steps.screens.screens, strict=True):
        if result.flatness is not None and len(result.xyz):
            chosen = result.flatness.chosen
            sigma = float(np.median(chosen.sigma_m[chosen.used]))
            drawings.append(
                PageDrawing(
                    flatness_map(
                        result.xyz[:, :2],
                        result.xyz[:, 2],
                        f"Screen {name}: height of the control points over its plane",
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
        "Poses of the screens. The origin and the axes within the plane are a convention and have no error; the sigmas"
        " are those of the distance along the normal and of the tilt."
    )
    return Section("Screens", words, drawings, PageTable(heads, rows))


def beams_section(o: RigResult, nominal: Rig) -> Section:
    """Section on the beams, compared with the nominal ones, and on the pose of the stand."""
    joint = o.steps.joint
    direction, offset = beam_sigmas(joint)
    off = lines_in(joint.values).minus(lines_in(stacks_of(nominal)))
    rows = [
        (
            name,
            ", ".join(f"{v:.6f}" for v in joint.rig.beams[name].direction),
            ", ".join(f"{1e3 * v:.2f}" for v in joint.rig.beams[name].point),
            float(direction[i] / ARCSEC),
            float(1e3 * offset[i]),
            float(np.rad2deg(np.linalg.norm(off[i, :2])) * 60),
            float(1e3 * np.linalg.norm(off[i, 2:])),
        )
        for i, name in enumerate(joint.rig.beams)
    ]
    heads = (
        "beam", "direction", "offset (mm)", "sigma direction (arcsec)", "sigma offset (mm)", "off nominal (arcmin)",
        "off nominal (mm)",
    )  # fmt: skip
    pose, unknowns = pose_of(joint.values, STAND)[0], joint.unknowns
    words = ["Each laser in the body frame, the frame of the stand's carriage as its poses were recorded."]
    if STAND in unknowns.start:
        at = unknowns.places(STAND, 0)
        C = joint.all_covariance[np.ix_(at, at)]
        mm = ", ".join(
            f"{1e3 * t:.2f} ± {1e3 * s:.2f}" for t, s in zip(pose.translation, np.sqrt(np.diagonal(C)[:3]), strict=True)
        )
        deg = ", ".join(
            f"{v:.4f} ± {s:.4f}" for v, s in zip(np.rad2deg(pose.ypr), np.rad2deg(ypr_sigmas(pose, C)), strict=True)
        )
        words.append(f"Pose of the stand in the world: x, y, z {mm} mm; yaw, pitch, roll {deg} deg.")
    return Section("Beams", words, (), PageTable(heads, rows))


def cameras_section(o: RigResult) -> Section:
    """Section on the poses of the cameras and the change of their focal lengths."""
    joint = o.steps.joint
    sigmas = dict(zip(joint.covariance.names, np.sqrt(np.diagonal(joint.covariance.matrix)), strict=True))
    before = o.steps.measured.network.rig
    rows = []
    for i, (name, camera) in enumerate(joint.rig.cameras.items()):
        at = joint.unknowns.places("cameras", i)
        C = joint.all_covariance[np.ix_(at, at)]
        # Camera centre in world: -R^T t. Errors of t act through R^T, those of the attitude through d(centre)/d(theta).
        R, t = camera.camera_from_world.rotation, camera.camera_from_world.translation
        J = np.concatenate([-R.T, _centre_jacobian(R, t)], axis=1)
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
    heads = ("camera", "position (m)", "sigma of position (mm)", "sigma of attitude (deg)", "fx (px)",
             "sigma of fx (px)", "change of fx since the lens calibration (px)")  # fmt: skip
    words = (
        "The errors of a camera's lens and pose are correlated: a longer focal length has nearly the same effect as a"
        " more distant camera. rig.yaml holds the joint covariance."
    )
    return Section("Cameras", words, (), PageTable(heads, rows))


def _centre_jacobian(R: Array, t: Array) -> Array:
    """d(centre)/d(theta) (3, 3) for camera_from_world R Exp(theta), t: the centre is -(R Exp(theta))^T t."""
    c = -R.T @ t
    # Exp(-theta) c = c - theta x c
    return np.array([[0, -c[2], c[1]], [c[2], 0, -c[0]], [-c[1], c[0], 0]])


def correlations_section(o: RigResult) -> Section:
    """Section on the correlations of the parameters."""
    C = o.steps.joint.covariance
    sigma = np.sqrt(np.diagonal(C.matrix))
    shown = [
        i
        for i, n in enumerate(C.names)
        if split_name(n)[0] == "beams"
        or (sigma[i] > _GAUGE_SIGMA and not split_name(n)[2].startswith(("k", "p1", "p2", "s", "tau")))
    ]
    shown.sort(key=lambda i: ("beams", "screens", "cameras").index(split_name(C.names[i])[0]))
    names = [_short_name(C.names[i]) for i in shown]
    picture = correlation_matrix(names, C.matrix[np.ix_(shown, shown)], "Correlations of the rig's parameters")
    words = "Correlated errors partly cancel in the pose: without the correlations its sigma would be too large."
    return Section("Correlations", words, [PageDrawing(picture, wide=True)])


def _short_name(name: str) -> str:
    """`camera left fx` for `cameras_section.left.fx`."""
    kind, thing, parameter = split_name(name)
    bare = parameter.removesuffix("_per_m").removesuffix("_rad").removesuffix("_m")
    return f"{kind.removesuffix('s')} {thing} {bare}"


def lab_section(o: RigResult) -> Section:
    """Section with three views of the lab."""
    joint = o.steps.joint
    body = (
        o.expected.world_from_body
        if o.expected is not None
        else pose_of(joint.values, STAND)[0] @ pose_of(joint.values, POSES)[0]
    )
    return Section(
        "The lab",
        "Calibrated cameras, screens and beams, with the vehicle in the middle of the stand's positions.",
        [PageDrawing(view) for view in scene_views(rig_things(joint.rig, body))],
    )


def beam_sigmas(joint: Joint) -> tuple[Array, Array]:
    """Sigmas of each beam's direction (rad) and offset (m), RMS over the two axes across the beam."""
    variances = np.array(
        [np.diagonal(joint.all_covariance)[joint.unknowns.places("beams", i)] for i in range(len(joint.rig.beams))]
    )
    return np.sqrt(variances[:, :2].mean(axis=1)), np.sqrt(variances[:, 2:].mean(axis=1))
