"""Two cameras and their relative pose from photographs of one board, with the joint covariance.

Each camera is calibrated by itself first (lens model, outliers, findings). Then one adjustment of all corners of both
cameras gives both lenses and the relative pose: photographs of one instant share the pose of the board. The world is
the frame of the left camera. Source: ours, on the terms of the rig calibration (calibration/terms/corners.py).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calibration.least_squares.adjustment import (
    Adjusted,
    AdjustmentError,
    Limits,
    Part,
    Poses,
    Term,
    Values,
    Vectors,
    solve,
)
from calibration.lens.board_shape import HALF_SIGNIFICANT
from calibration.lens.fit.lens_adjustment import coefficient_prior
from calibration.lens.fit.view_equations import BEND_PROBABLE, ViewEquations
from calibration.lens.intrinsics import Intrinsics
from calibration.terms.corners import CornerTerm
from calibration.terms.surveyed import array_of, pose_of
from geometry.arrays import Array, Bools, Ints
from geometry.camera import FISHEYE, PERSPECTIVE, Camera, camera_matrix
from geometry.pose import Pose
from geometry.uncertainty.rig_uncertainty import POSE, RigCovariance

FEWEST_PAIRS = 3
PAIR_GATE = 3.0  # residuals of a pair over those of the median pair, above which the board moved between the exposures
_ROUNDS = 4  # of solving and separating pairs
# Coefficients that the photographs hardly determine converge slowly; a fiftieth of a sigma is negligible.
_LIMITS = Limits(steps=200, small_step_sigmas=0.02)


_NEXT = (
    "photograph 15 pairs or more, the board at rest and in both pictures, near and far, tilted by 20 to 45 deg to all"
    " sides"
)


class PairError(ValueError):
    """The photographs do not determine the pair; the message gives the cause and the remedy."""


@dataclass(frozen=True, slots=True)
class CalibratedPair:
    """The result: two cameras in the frame of the left one."""

    cameras: tuple[Camera, Camera]
    covariance: RigCovariance  # of the lenses and of the right camera's pose
    single: tuple[Intrinsics, Intrinsics]  # each camera by itself
    rms_px: tuple[float, float]  # of the joint residuals, per coordinate
    misfit: float  # joint residuals over those of the cameras by themselves; 1 if the pairs fit together
    keys: tuple[int, ...]  # numbers of the photographs that show the board in both cameras
    separated: tuple[int, ...]  # of these, those whose board moved between the exposures
    pair_rms_px: Array  # (pairs,): of both cameras together

    @property
    def baseline_m(self) -> float:
        """Distance of the projection centres."""
        return float(np.linalg.norm(self.cameras[1].camera_from_world.inverse().translation))


def calibrate_pair(
    names: tuple[str, str], single: tuple[Intrinsics, Intrinsics], numbers: tuple[Sequence[int], Sequence[int]]
) -> CalibratedPair:
    """The pair of two calibrated cameras. numbers: of each camera's views; equal numbers are one instant.

    Raises PairError: too few photographs show the board in both cameras, or the adjustment does not converge.
    """
    shared = sorted(set(numbers[0]) & set(numbers[1]))
    if len(shared) < FEWEST_PAIRS:
        raise PairError(
            f"expected {FEWEST_PAIRS} pairs of photographs or more with the board in both cameras, got {len(shared)};"
            f" photographs of one instant need the same number in their names; {_NEXT}"
        )
    separated: set[int] = set()
    for _ in range(_ROUNDS):
        problem = _Problem.of(single, numbers, separated)
        try:
            adjusted = problem.solved()
        except AdjustmentError as error:
            raise PairError(f"the photographs do not determine the pair: {error}; {_NEXT}") from None
        rms = problem.pair_rms(adjusted, shared)
        usual = float(np.nanmedian(rms))
        together = [key for key in shared if key not in separated]
        moved = [key for key, r in zip(shared, rms, strict=True) if key in together and r > PAIR_GATE * usual]
        if not moved or len(together) - len(moved) < FEWEST_PAIRS:
            break
        separated |= set(moved)
    return _result(names, single, problem, adjusted, shared, separated, rms)


@dataclass(frozen=True, slots=True)
class _Problem:
    """The unknowns at their start and the term of all corners."""

    values: Values
    term: CornerTerm
    placement_keys: tuple[tuple[int, int], ...]  # number of the photograph, and 0, or 1 + camera where it stands alone
    single: tuple[Intrinsics, Intrinsics]

    @staticmethod
    def of(
        single: tuple[Intrinsics, Intrinsics], numbers: tuple[Sequence[int], Sequence[int]], separated: set[int]
    ) -> _Problem:
        """The problem with the pairs in `separated` as photographs of two instants."""
        place: dict[tuple[int, int], int] = {}
        boards: list[Pose] = []
        right_from_left = _relative_pose(single, numbers)
        rows = []
        for c, one in enumerate(single):
            to_world = Pose.identity() if c == 0 else right_from_left.inverse()
            view_place = np.full(one.table.views, -1)
            counts = one.table.counts(one.fit.used)
            for view, number in enumerate(numbers[c]):
                if not counts[view]:
                    continue
                key = (number, 1 + c if number in separated else 0)
                if key not in place:
                    place[key] = len(boards)
                    boards.append(to_world @ one.fit.poses[view])
                view_place[view] = place[key]
            rows.append(view_place[one.table.view])
        left = single[0].fit
        values: Values = {
            "intrinsics": Vectors(np.stack([s.fit.lens for s in single])),
            "cameras": Poses.of([Pose.identity(), right_from_left]),
            "boards": Poses.of(boards),
            "warp": Vectors(left.warp[None]),
            "stretch": Vectors(left.stretch[None]),
            "print": Vectors(_printed(single)),
            "radius": Vectors(np.array([[np.mean([s.fit.radius_m for s in single])]])),
        }
        return _Problem(values, _term(single, rows), tuple(place), single)

    def solved(self) -> Adjusted:
        """Both lenses, the pose of the right camera, all boards, and the bend where it is significant."""
        free: dict[str, bool | Bools] = {
            "intrinsics": np.stack([s.model.free for s in self.single]),
            "cameras": np.repeat([[False], [True]], 6, axis=1),
            "boards": True,
            "warp": self.bent,
        }
        return solve(self.values, [self.term, *self.priors()], free, _LIMITS)

    def priors(self) -> list[Term]:
        """The weak priors on the coefficients of both lenses."""
        both = enumerate(self.single)
        return [p for c, s in both for p in coefficient_prior(s.table, s.fit.used, s.model, s.fit.values, c)]

    def equations(self, adjusted: Adjusted, misfit: float, bent: bool) -> ViewEquations:
        """Of each instant, on both lenses, the right camera's pose and, if `bent`, the bend of the board.

        misfit: factor on the sigmas of the corners.
        """
        lenses = [s.model.free for s in self.single]
        starts = np.cumsum([0, *(int(free.sum()) for free in lenses)])

        def parts_of(term: Term) -> dict[str, Part]:
            return {p.stack: p for p in term.linearise(adjusted.values).parts}

        def rows(parts: Mapping[str, Part]) -> Array:
            """Derivatives (N, 2, q), or of a prior (n, 1, q)."""
            by_lens = parts["intrinsics"]
            out = np.zeros((*by_lens.jacobian.shape[:2], starts[2] + 6))
            for c, free in enumerate(lenses):
                mine = by_lens.index == c
                out[mine, :, starts[c] : starts[c + 1]] = by_lens.jacobian[mine][..., free]
            if "cameras" in parts:
                out[..., starts[2] :] = np.where((by_lens.index == 1)[:, None, None], parts["cameras"].jacobian, 0.0)
            bend = parts["warp"].jacobian if "warp" in parts else np.zeros((*out.shape[:2], 3))
            return np.concatenate([out, bend], axis=2) if bent else out

        of_corners = parts_of(self.term)
        shared = rows(of_corners)
        known = [rows(parts_of(prior)).reshape(-1, shared.shape[-1]) for prior in self.priors()]
        return ViewEquations.of_rows(
            shared / misfit,
            of_corners["boards"].jacobian / misfit,
            adjusted.residuals[0] / misfit,
            self.term.placement,
            np.unique(self.term.placement),
            np.concatenate([*known, np.zeros((0, shared.shape[-1]))]),
            int(starts[2]) + 6,
            self.places,
        )

    @property
    def places(self) -> Array:
        """(N, 3): of the corners on the board, in spacings, those of the second camera far from those of the first."""
        apart = 1e6 * self.term.camera[:, None]  # spacings: errors in two cameras are independent
        return np.concatenate([self.term.points[:, :2] / self.single[0].table.spacing_m, apart], axis=1)

    @property
    def bent(self) -> bool:
        """Whether the bend of the board is solved for: a camera by itself shows it, or each of them supports it."""
        tests = [s.warp for s in self.single if s.warp is not None]
        each = len(tests) == 2 and all(t.p_value < HALF_SIGNIFICANT for t in tests)
        return any(t.corrected for t in tests) or each

    def pair_rms(self, adjusted: Adjusted, shared: Sequence[int]) -> Array:
        """RMS (pairs,), in px, of the residuals of each pair that shares a board; nan for separated ones."""
        r = adjusted.residuals[0] * self.term.sigma_px[:, None]
        out = np.full(len(shared), np.nan)
        for i, number in enumerate(shared):
            if (number, 0) in self.placement_keys:
                own = self.term.placement == self.placement_keys.index((number, 0))
                out[i] = np.sqrt(np.mean(r[own] ** 2))
        return out


def _printed(single: tuple[Intrinsics, Intrinsics]) -> Array:
    """Displacements (P, 3), m, of the board's points: the mean of the cameras that found them significant."""
    solved = [s.fit.printed for s in single if s.board is not None and s.board.points.corrected]
    return np.mean(solved, axis=0) if solved else np.zeros_like(single[0].fit.printed)


def _term(single: tuple[Intrinsics, Intrinsics], placements: Sequence[Ints]) -> CornerTerm:
    used = [s.fit.used & (p >= 0) for s, p in zip(single, placements, strict=True)]
    tables = [s.table for s in single]
    points = np.concatenate([t.points[u] for t, u in zip(tables, used, strict=True)])
    counts = [int(u.sum()) for u in used]
    total = sum(counts)
    return CornerTerm(
        pixels=np.concatenate([t.pixels[u] for t, u in zip(tables, used, strict=True)]),
        points=points,
        from_middle=points[:, :2] - tables[0].middle[:2],
        camera=np.repeat(np.arange(2), counts),
        placement=np.concatenate([p[u] for p, u in zip(placements, used, strict=True)]).astype(np.int64),
        board=np.zeros(total, dtype=np.int64),
        sigma_px=np.concatenate([s.fit.sigma_px * s.table.noise[u] for s, u in zip(single, used, strict=True)]),
        fisheye=np.array([s.model.fisheye for s in single]),
        point=np.concatenate([t.point[u] for t, u in zip(tables, used, strict=True)]),
    )


def _relative_pose(single: tuple[Intrinsics, Intrinsics], numbers: tuple[Sequence[int], Sequence[int]]) -> Pose:
    """right_from_left: of the shared photographs' relative poses, the one nearest to all others."""
    poses = []
    for number in sorted(set(numbers[0]) & set(numbers[1])):
        left, right = (s.fit.poses[list(n).index(number)] for s, n in zip(single, numbers, strict=True))
        if np.isfinite(left.translation).all() and np.isfinite(right.translation).all():
            poses.append(right @ left.inverse())
    if not poses:
        raise PairError(f"no photograph has a pose of the board in both cameras; {_NEXT}, and sharp")
    scale = float(np.median([np.linalg.norm(p.translation) for p in poses])) + 1e-9
    apart = [sum(min(float(np.linalg.norm(a.minus(b) / ([scale] * 3 + [1.0] * 3))), 1.0) for b in poses) for a in poses]
    return poses[int(np.argmin(apart))]


def _result(
    names: tuple[str, str],
    single: tuple[Intrinsics, Intrinsics],
    problem: _Problem,
    adjusted: Adjusted,
    shared: Sequence[int],
    separated: set[int],
    pair_rms: Array,
) -> CalibratedPair:
    lenses, poses = array_of(adjusted.values, "intrinsics"), pose_of(adjusted.values, "cameras")
    cameras = []
    for c, (name, s) in enumerate(zip(names, single, strict=True)):
        K = camera_matrix(lenses[c, :4])
        distortion = tuple(float(v) for v in lenses[c, 4 : 4 + s.model.coefficients])
        lens = FISHEYE if s.model.fisheye else PERSPECTIVE
        cameras.append(Camera(name, "", s.table.image_size_px, K, distortion, poses[c], lens=lens))
    r = adjusted.residuals[0]
    rms = [float(np.sqrt(np.mean((r * problem.term.sigma_px[:, None])[problem.term.camera == c] ** 2))) for c in (0, 1)]
    misfit = float(np.sqrt(adjusted.chi2 / max(adjusted.dof, 1)))
    return CalibratedPair(
        cameras=(cameras[0], cameras[1]),
        covariance=_covariance(names, problem, adjusted, misfit),
        single=single,
        rms_px=(rms[0], rms[1]),
        misfit=misfit,
        keys=tuple(shared),
        separated=tuple(sorted(separated)),
        pair_rms_px=pair_rms,
    )


def _covariance(names: tuple[str, str], problem: _Problem, adjusted: Adjusted, misfit: float) -> RigCovariance:
    """Of both lenses and the right camera's pose, raised where the residuals are larger than those of single cameras.

    The scatter between photographs and the errors of the lens models raise it as they do for a single camera.
    """
    single, scale = problem.single, max(misfit, 1.0)
    equations = problem.equations(adjusted, scale, problem.bent)
    spreads = [equations.scatter(), *(s.scatter for s in single)]
    spread = max(spreads, key=lambda s: s.factor if s.is_significant else 0.0)
    whole = equations.scattered_covariance(spread)[: equations.lens, : equations.lens]
    shapes = [s.board for s in single if s.board is not None]
    if not problem.bent and any(b.warp.p_value < BEND_PROBABLE and not b.points.corrected for b in shapes):
        change = problem.equations(adjusted, scale, True).solution()[0][: equations.lens]
        whole = whole + np.outer(change, change)
    labels = [f"cameras.{n}.{p}" for n, s in zip(names, single, strict=True) for p in s.parameters]
    labels += [f"cameras.{names[1]}.{p}" for p in POSE]
    raised = max(s.model_uncertainty.factor for s in single)
    return RigCovariance(tuple(labels), whole * raised**2)
