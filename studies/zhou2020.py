"""`beampose study zhou2020`: binocular poses over distance, detectors and stereo fits, beside the published figures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geometry import rotations
from geometry.arrays import Array
from geometry.pose import Pose
from geometry.pose_solver.gauss_newton import PoseFit
from geometry.rotations import ypr_from_matrix
from lab.report.page import Section
from lab.report.plot import svg
from lab.targets.stereo.simulated_recording import drogue_markers, occluded, render, scene, simulated_pair, true_pixels
from studies.comparison import Comparison, ComparisonRow
from studies.learned_detector.samples import draw_sample
from tracking.binocular.acquisition import mirrored
from tracking.binocular.joint_fit import (
    MarkerObservations,
    bound,
    fit_pose,
    linear_points,
    pose_of_points,
    triangulate,
    undistorted_pixels,
)
from tracking.binocular.marker_model import MarkerModel, SegmentationParameters, StereoPair, project, project_markers
from tracking.binocular.segmentation import ColourRange, marker_candidates, prepared
from tracking.learned_detector.detector import find_drogues

# Monte Carlo of the binocular measurement: distances from 5 to 30 m, and the pose of seven markers at 10 m.
#
# The camera of Zhou (2020): the field of 46 m at 40 m on 1080 lines is a focal length of 939 px. The baseline is not
# printed and cannot be computed from what is; 0.5 m is ours.

FOCAL_PX, SIZE_PX, BASELINE_M = 939.0, (1920, 1080), 0.5
METHODS = ("paper's method", "single points", "joint fit")  # equations (7) to (9); most likely points; all markers


@dataclass(frozen=True, slots=True)
class DistanceErrors:
    """Errors of the distance of marker 1 from the left camera, m, by method (METHODS), over many trials."""

    distance_m: float
    errors: Array  # (trials, 3)
    bounds: Array  # (trials, 2): the smallest sigma of an unbiased estimate, from one marker and from all

    @property
    def bias(self) -> Array:
        """(3,), m."""
        return np.asarray(self.errors.mean(axis=0))

    @property
    def rms(self) -> Array:
        """(3,), m."""
        return np.asarray(np.sqrt((self.errors**2).mean(axis=0)))

    @property
    def bound(self) -> Array:
        """(3,), m: RMS of the bounds, of the information that each method uses."""
        one, every = np.sqrt((self.bounds**2).mean(axis=0))
        return np.array([one, one, every])


def distance_errors(
    distance_m: float, trials: int, noise_px: float, rng: np.random.Generator, known: StereoPair | None = None
) -> DistanceErrors:
    """Trials at a distance, with Gaussian noise (1 sigma) of the centroids; known: the calibration of the true pair."""
    true, model = simulated_pair(FOCAL_PX, SIZE_PX, BASELINE_M), drogue_markers()
    pair = true if known is None else StereoPair(known.cameras)
    cov = np.broadcast_to(noise_px**2 * np.eye(2), (2, len(model), 2, 2))
    seen = np.ones((2, len(model)), dtype=bool)
    errors, bounds = [], []
    for _ in range(trials):
        pose = random_pose(distance_m, rng)
        marker = pose.apply(model.positions[0])
        uv = project_markers(true, model, pose)[0] + rng.normal(0, noise_px, (2, len(model), 2))
        flat = np.stack([undistorted_pixels(c, u[:1]) for c, u in zip(pair.cameras, uv, strict=True)])
        points = triangulate(pair, uv, cov)
        fit = least_misfit(pair, model, MarkerObservations(uv, cov), pose)
        found = (linear_points(pair, flat)[0], points.points[0], fit.world_from_body.apply(model.positions[0]))
        far = float(np.linalg.norm(marker))
        errors.append([float(np.linalg.norm(x)) - far for x in found])
        sight = marker / far
        by_point = project(true, marker[None])[1].reshape(4, 3) / noise_px
        single = np.linalg.inv(by_point.T @ by_point)
        by_pose = np.concatenate([sight, np.cross(model.positions[0], pose.rotation.T @ sight)])
        every = by_pose @ bound(true, model, pose, cov, seen) @ by_pose
        bounds.append([float(np.sqrt(sight @ single @ sight)), float(np.sqrt(every))])
    return DistanceErrors(distance_m, np.array(errors), np.array(bounds))


def least_misfit(pair: StereoPair, model: MarkerModel, observed: MarkerObservations, true: Pose) -> PoseFit:
    """The joint fit of labelled markers: the better one of the two attitudes that a flat target far away has."""
    fits = [fit_pose(pair, model, observed, start) for start in (true, mirrored(pair, model, true))]
    return min((fit for fit in fits if fit is not None), key=lambda fit: fit.chi2)


def random_pose(distance_m: float, rng: np.random.Generator) -> Pose:
    """A drogue near the middle of both pictures, turned by up to about 30 deg, facing the cameras."""
    place = np.array([0.25, 0.0, 0.0]) + distance_m * np.array([*rng.uniform(-0.08, 0.08, 2), 1.0])
    return Pose(rotations.exp(rng.normal(0, 0.25, 3)), place)


@dataclass(frozen=True, slots=True)
class PoseErrors:
    """Errors of the pose of seven markers over many trials."""

    horn: Array  # (trials, 6), section 1 of the file contract: the paper's method
    joint: Array  # (trials, 6): the joint fit
    bounds: Array  # (trials, 6): smallest sigmas of an unbiased estimate
    nees: Array  # (trials,) of the joint fit

    def ratios(self) -> Array:
        """(2,): RMS over its bound, of position and rotation of the joint fit."""
        error, smallest = (np.sqrt((a**2).mean(axis=0)) for a in (self.joint, self.bounds))
        return np.array([np.linalg.norm(error[s]) / np.linalg.norm(smallest[s]) for s in (slice(0, 3), slice(3, 6))])


def pose_errors(trials: int, noise_px: float, rng: np.random.Generator) -> PoseErrors:
    """Trials of seven markers (rim of 0.3 m) at 10 m, with a focal length of 1500 px."""
    pair, model = simulated_pair(1500.0, (1280, 1024), BASELINE_M), drogue_markers()
    cov = np.broadcast_to(noise_px**2 * np.eye(2), (2, len(model), 2, 2))
    seen = np.ones((2, len(model)), dtype=bool)
    rows: list[tuple[Array, Array, Array, float]] = []
    for _ in range(trials):
        pose = random_pose(10.0, rng)
        uv = project_markers(pair, model, pose)[0] + rng.normal(0, noise_px, (2, len(model), 2))
        flat = np.stack([undistorted_pixels(c, u) for c, u in zip(pair.cameras, uv, strict=True)])
        horn = pose_of_points(model.positions, linear_points(pair, flat))
        fit = least_misfit(pair, model, MarkerObservations(uv, cov), pose)
        delta = pose.minus(fit.world_from_body)
        sigmas = np.sqrt(np.diagonal(bound(pair, model, pose, cov, seen)))
        rows.append((pose.minus(horn), delta, sigmas, float(delta @ np.linalg.solve(fit.covariance, delta))))
    horns, joints, bounds, nees = zip(*rows, strict=True)
    return PoseErrors(np.array(horns), np.array(joints), np.array(bounds), np.array(nees))


# Rows of `beampose study zhou2020` on the learned detector.


FRAMES = 60
DETECTOR_SIZE_PX, DIAMETERS_PX = (640, 480), (9.0, 200.0)
_RIGHT = 0.25  # of the diameter


def detector_rows(seed: int, columns: int = 1) -> tuple[ComparisonRow, ...]:
    """Share of rendered drogues that are the best candidate, and the error of their centre, before unseen backgrounds.

    columns: number of methods of the study; the figures stand in the last one.
    """
    rng = np.random.default_rng([seed, 42])
    errors = []
    for _ in range(FRAMES):
        sample = draw_sample(rng, DETECTOR_SIZE_PX, DIAMETERS_PX, unseen=True, empty=False)
        best = next(iter(find_drogues(sample.image, *DIAMETERS_PX)), None)
        away = np.inf if best is None else np.hypot(best.u_px - sample.centre_px[0], best.v_px - sample.centre_px[1])
        errors.append(away / sample.diameter_px)
    error = np.array(errors)
    found = error < _RIGHT
    note = f"{FRAMES} rendered pictures, diameter 9 to 200 px, backgrounds that training does not show"
    empty = (None,) * (columns - 1)
    return (
        ComparisonRow("learned detector: found first", "%", None, (*empty, 100 * float(found.mean())), note),
        ComparisonRow(
            "learned detector: centre, median error over the diameter", "%", None,
            (*empty, 100 * float(np.median(error[found])) if found.any() else None), note,
        ),
    )  # fmt: skip


# Zhou, Xu & Jia (2020), section 5: table 3 (distances) and the pose, beside ours.


NOISE_PX, TRIALS, PICTURES = 0.1, 40, 6
# Table 3: true and measured distances of two markers, m.
TABLE_3 = (
    (5.0, 5.04, 5.03), (10.0, 10.07, 10.08), (15.0, 15.13, 15.10), (20.0, 20.18, 20.17), (25.0, 25.23, 25.22),
    (30.0, 30.31, 30.31),
)  # fmt: skip
# The rotation matrix below table 2. Its entry (2, 3) is printed as 0; -0.17 makes the matrix orthogonal to 0.005.
PRINTED_ROTATION = np.array([[0.92, -0.13, -0.38], [-0.21, -0.96, -0.17], [-0.34, 0.23, -0.91]])
PRINTED_ANGLES = (-12.63, 20.18, -14.20)  # deg: about z, y, x, the last one folded into -90 to 90 by an arc tangent


def compare_zhou2020(seed: int = 1, trials: int = TRIALS) -> Comparison:
    """Distances, pose, centroids and the printed angles."""
    rng = np.random.default_rng([seed, 2020])
    distances = [distance_errors(row[0], trials, NOISE_PX, rng) for row in TABLE_3]
    poses = pose_errors(4 * trials, NOISE_PX, rng)
    rows = [*_distance_rows(distances), *_pose_rows(poses), *_centroid_rows(seed), *_angle_rows()]
    rows += detector_rows(seed, len(METHODS))
    return Comparison(
        title="Zhou, Xu & Jia (2020), section 5: binocular drogue pose",
        setting=f"f {FOCAL_PX:g} px (from the printed field of view) · baseline {BASELINE_M:g} m (not printed) ·"
        f" {NOISE_PX:g} px noise of a centroid · {trials} trials at each distance · seed {seed}",
        methods=METHODS,
        rows=tuple(rows),
        explanation="Paper's method: equations (7) to (9) with the rows of v corrected, Horn's quaternion, centroids of"
        " contours. Single points: the most likely place of each marker. Joint fit: the pose that explains all markers"
        " in both pictures. The paper's column is the mean error of its two markers in table 3, which grows by 0.6 to"
        " 1.0 % of the distance: an error of its calibration, not noise.",
        figures=(_figure(distances),),
        source="Zhou Q., Xu Y., Jia E., Navigation Positioning and Timing 7(1), 40 (2020),"
        " doi 10.19306/j.cnki.2095-8110.2020.01.006.",
    )


def _distance_rows(distances: list[DistanceErrors]) -> list[ComparisonRow]:
    rows = []
    for (true, one, two), e in zip(TABLE_3, distances, strict=True):
        paper = (one + two) / 2 - true
        bias, rms, ratio = (tuple(float(v) for v in a) for a in (100 * e.bias / true, e.rms, e.rms / e.bound))
        name, mean_of_two = f"distance error at {true:g} m", "paper: mean of two markers"
        rows.append(ComparisonRow(f"{name}, RMS", "m", paper, rms, mean_of_two))
        rows.append(ComparisonRow(f"{name}, mean", "%", 100 * paper / true, bias, "of the distance"))
        rows.append(ComparisonRow(f"{name}, RMS over bound", "", None, ratio, "bound: Cramer-Rao"))
    return rows


def _pose_rows(p: PoseErrors) -> list[ComparisonRow]:
    horn, joint = (np.sqrt((d**2).mean(axis=0)) for d in (p.horn, p.joint))
    shift = [1000 * float(np.linalg.norm(d[:3])) for d in (horn, joint)]
    turn = [float(np.rad2deg(np.linalg.norm(d[3:]))) for d in (horn, joint)]
    where = "10 m, f 1500 px, rim of 0.3 m"
    return [
        ComparisonRow("seven markers: position, RMS", "mm", None, (shift[0], None, shift[1]), where),
        ComparisonRow("seven markers: rotation, RMS", "deg", None, (turn[0], None, turn[1]), where),
        ComparisonRow("seven markers: position over bound", "", None, (None, None, float(p.ratios()[0])), where),
        ComparisonRow("seven markers: rotation over bound", "", None, (None, None, float(p.ratios()[1])), where),
        ComparisonRow("seven markers: NEES / 6", "", None, (None, None, float(p.nees.mean() / 6)), "1 expected"),
    ]


def _centroid_rows(seed: int) -> list[ComparisonRow]:
    """Errors of the paper's contour centroids and of ours in simulated pictures of the drogue."""
    contour, coverage = centroid_errors(seed)
    note_ = "simulated pictures, markers of about 3 px radius"
    return [ComparisonRow("centroid of a marker, RMS", "px", None, (contour, None, coverage), note_)]


def centroid_errors(seed: int) -> tuple[float, float]:
    """RMS per coordinate, px, of contour and coverage centroids of the markers in simulated pictures."""
    view = scene(seed, 60, (640, 480), 1100.0)
    rng = np.random.default_rng([seed, 3])
    true, hidden, red = true_pixels(view), occluded(view), ColourRange("red", (340.0, 20.0))
    errors: tuple[list[Array], list[Array]] = ([], [])
    for i in np.linspace(0, len(view.t_s) - 1, PICTURES).astype(int).tolist():
        pictures_ = [render(view, i, c, rng) for c in (0, 1)]
        seen = prepared(pictures_[0], pictures_[1], SegmentationParameters())
        for kind, out in zip(("contour", "coverage"), errors, strict=True):
            p = SegmentationParameters(centroid="contour" if kind == "contour" else "coverage")
            for c, picture in enumerate(pictures_):
                ready = seen[c]
                assert ready is not None
                found = marker_candidates(picture, ready, (red,), p).uv_px
                apart = found[:, None] - true[i, c][None]
                far = np.linalg.norm(apart, axis=-1)
                out += [apart[far[:, k].argmin(), k] for k in range(7)
                        if len(found) and not hidden[i, c, k] and far[:, k].min() < 2]  # fmt: skip
    contour, coverage = (float(np.sqrt(np.mean(np.array(e) ** 2))) for e in errors)
    return contour, coverage


def _angle_rows() -> list[ComparisonRow]:
    """The printed rotation matrix as angles: the third one is an arc tangent without its quadrant."""
    angles = np.rad2deg(ypr_from_matrix(PRINTED_ROTATION)).tolist()
    names = ("roll (about z)", "pitch (about y)", "yaw (about x)")
    return [
        ComparisonRow(
            f"printed rotation matrix: {name}", "deg", paper, (None, None, ours), "R23 as -0.17; ours by atan2"
        )
        for name, paper, ours in zip(names, PRINTED_ANGLES, angles, strict=True)
    ]


def _figure(distances: list[DistanceErrors]) -> Section:
    d = np.array([e.distance_m for e in distances])
    paper = np.array([(one + two) / 2 - true for true, one, two in TABLE_3])
    rms, bound = np.array([e.rms for e in distances]), np.array([e.bound for e in distances])
    curves = (
        ("paper, table 3", paper, svg.VERMILLION, ""),
        ("single points", rms[:, 1], svg.ORANGE, ""),
        ("their bound", bound[:, 1], svg.ORANGE, "5 4"),
        ("joint fit", rms[:, 2], svg.BLUE, ""),
        ("its bound", bound[:, 2], svg.GREEN, "5 4"),
    )
    p = svg.plot_area((0.0, 32.0), (0.0, 1.08 * float(max(c[1].max() for c in curves))), height=300)
    out = svg.axes(p, "Error of a distance", "distance (m)", "error (m)")
    for i, (name, y, colour, dash) in enumerate(curves):
        at = p.at(np.stack([d, y], axis=1))
        style = f' stroke-dasharray="{dash}"' if dash else ""
        out.append(
            f'<path d="{svg.line_path(at[:, 0], at[:, 1])}" fill="none" stroke="{colour}" stroke-width="1.6"{style}/>'
        )
        if not dash:
            out.append(f'<path d="{svg.dots(at, 3.0)}" fill="{colour}"/>')
        out.append(svg.text(p.box[0] + 10, p.box[1] + 16 + 15 * i, name, "", f"fill:{colour};font-weight:600"))
    out.append(svg.note(p, f"{len(drogue_markers())} markers, {NOISE_PX:g} px noise"))
    drawing = svg.svg_of(p, "Error of a distance", [*out, svg.frame(p)])
    words = (
        "The paper's errors (mean of two markers), the RMS errors of single points and of the joint fit, and the"
        " smallest possible RMS from the same information."
    )
    return Section("Distances (table 3)", words, [drawing])
