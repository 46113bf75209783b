"""The smoothing pass: labels revised with the whole run known, and the motion estimated from all frames.

Rounds of: the most probable motion given the labels (tracking/smoothing/whole_run.py), then each frame's detections
assigned again from where all other frames put the vehicle (tracking/smoothing/reassociation.py), until no label
changes. The last round ends with the motion, so labels and poses belong together. Then each pose is compared with the
one of its own spots: where they contradict each other the frame is taken for a bend, and at last its own spots decide.
(What is written is tested once more, against spots and causal pose: lab/runs/verdict/frame_checks.py.)

Source: ours.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.compiled_projection import Views, project_all
from geometry.pose import Pose
from geometry.pose_solver.gauss_newton import SolveLimits, covariance_of
from tracking.rigid_body.adaptive_process_noise import jump_variance
from tracking.rigid_body.association import BLENDED, DetectionModel, ViewTable, distinct_spots
from tracking.rigid_body.clutter import RADIUS_PX
from tracking.rigid_body.hypotheses import CHECK_PX, FEW, MIN_CONFIRMING_SPOTS, SURE
from tracking.rigid_body.information import controlled, fit_alone, frame_information
from tracking.rigid_body.motion import process_noise
from tracking.rigid_body.static_points import learn as learn_static
from tracking.rigid_body.static_points import log_density as log_static_density
from tracking.rigid_body.static_points import no_places
from tracking.smoothing.backward import merged, track_backward
from tracking.smoothing.continuity import Surroundings, continued
from tracking.smoothing.error_scale import noise_scale, width_covariance, width_share
from tracking.smoothing.exposure import exposure_offsets, moved_by
from tracking.smoothing.fixed_interval import Reference, speeds
from tracking.smoothing.place_errors import place_errors
from tracking.smoothing.reassociation import AllDetections, clutter_density, labelled_points, reassociated
from tracking.smoothing.recording import TrackedRecording
from tracking.smoothing.smoothed import Smoothed
from tracking.smoothing.whole_run import DEEP, SmoothedMotion, WholeRun, estimate, straight_between

MOST_ROUNDS = 4
MOST_REPAIRS = 3  # times that frames whose pose contradicts their spots are taken for bends
UNLIKELY_AT_BEND = 5.0  # the same beside a bend, where one step more may be one (6 degrees of freedom: one in two)
CONTRADICTS = 60.0  # chi-square that a frame's spots lose at the smoothed pose, against their own (6 degrees: 5e-11)


def smooth(recording: TrackedRecording) -> Smoothed:
    """A run's labels and motion, given all of it.

    With `method: spots` the labels stay as that tracker gave them. Where nothing was measured nothing is known.
    """
    rec, parameters = recording, recording.parameters
    pass_ = _Pass(rec)
    pass_.estimate(deep=0)
    rounds = 1
    if rec.measured.any():
        # The first reference is a straight line over each gap: too far off for the few spots seen there, which wait
        # until they were held against it.
        gapless = bool(rec.measured.all())
        if parameters.method == "rigid":
            if pass_.look_back():
                pass_.estimate(deep=0)
            while rounds < MOST_ROUNDS and (pass_.relabel() or (rounds == 1 and not gapless)):
                rounds += 1
                pass_.estimate(deep=DEEP)
        elif not gapless:
            pass_.estimate(deep=DEEP)
        pass_.repair()
        if parameters.method == "rigid":
            pass_.continue_paths()
    return pass_.result(rounds)


class _Pass:
    """One run in work: T frames, n views."""

    def __init__(self, rec: TrackedRecording) -> None:
        model, parameters = rec.model, rec.parameters
        self.rec, self.model, self.parameters = rec, model, parameters
        self.views = model.numbers
        self.sights = ViewTable.of(rec.rig, model)
        self.causal = rec.assigned
        self.assigned = self.causal.copy()
        self.measured = rec.measured
        self.probability = np.where(self.causal >= 0, 1.0, np.nan)
        ref = straight_between(rec.poses, self.measured, np.cumsum(rec.dt_s))
        every = _all_detections(rec)
        self.calibration_cov, self.systematic = _calibration(rec, every, self.assigned, ref)
        self.share = width_share(self.views, every, self.assigned, self.calibration_cov, ref, self.measured)
        every = every._replace(cov=every.cov + width_covariance(every.size_px, self.share))
        self.scale = noise_scale(self.views, every, self.assigned, self.calibration_cov, ref, self.measured)
        self.every = every._replace(
            cov=every.cov * self.scale**2 + parameters.sigma_model_px**2 * np.eye(2),
            usual_px=_usual_sizes(every, self.assigned),
        )
        log_density: Array | None = None
        if not parameters.learn_jerk:
            by_hand = 2 * np.log(np.repeat([parameters.jerk_m_s3, parameters.jerk_rad_s3], 3))
            log_density = np.tile(by_hand, (len(rec), 1))
        self.certified = self.causal  # labels that a tracker gave, forward or backward
        self.found = self.measured  # frames that a tracker measured
        # Frames that a tracker measured with enough spots: where nothing checked a label it was beyond doubt.
        self.sure = self.measured & (distinct_spots(self.assigned >= 0, model.spot_of) >= FEW)
        self.trusted = _chained(self.measured, self.sure | self._controlled(ref)[0])  # their labels may be evidence
        self.motion = SmoothedMotion.begin(ref, rec.bent.copy(), log_density)
        self.doubtful = np.zeros(len(rec), dtype=bool)  # frames in which two poses were measured
        self.own = _Own.nothing(len(rec))

    def estimate(self, deep: int) -> None:
        """The motion given the labels."""
        rec = self.rec
        run = WholeRun(
            self.views, self.every, self.calibration_cov, rec.dt_s, rec.exposure_s, self.parameters.learn_jerk
        )
        self.motion = estimate(run, self.assigned, self.measured, self.motion, deep, self.trusted)
        self.own = _alone(rec, self.views, self.every, self.assigned, self.calibration_cov, self.motion.ref)
        self.own.measured &= ~self.doubtful
        self.measured = self.own.measured

    def _controlled(self, ref: Reference) -> tuple[Bools, Bools]:
        """(T,): frames whose labels check each other, all or enough for a pose; and their labels (T, n) that nothing
        checks.
        """
        labelled = np.zeros(self.assigned.shape, dtype=bool)
        checked = labelled.copy()
        for k in range(len(self.rec)):
            labelled[k], _, cov = labelled_points(self.every, k, self.assigned[k], self.calibration_cov)
            checked[k] = controlled(self.views, ref.R[k], ref.t[k], labelled[k], cov)
        count = distinct_spots(checked, self.model.spot_of)
        frames = (count >= FEW) | ((count > 0) & ~np.any(labelled & ~checked, axis=1))
        return frames, labelled & ~checked & frames[:, None]

    def relabel(self) -> bool:
        """Labels from where the other frames put the vehicle; whether any changed."""
        rec, ref, known = self.rec, self.motion.ref, self.motion.known
        self.every = self.every._replace(
            log_static=_log_static(self.views, self.sights, self.every, self.assigned, ref, known)
        )
        log_clutter = _log_clutter(rec, self.views, self.sights, self.every, self.assigned, ref, known)
        chances = DetectionModel(self.parameters.p_detect, self.parameters.p_blend)
        found, certain, sigma_px = reassociated(
            self.views, self.sights, chances, self.every, self.assigned, self.calibration_cov, ref, self.motion.pose_P,
            log_clutter, _bend_sigmas(ref, rec.dt_s),
        )  # fmt: skip
        before = self.assigned
        new = np.where((certain >= self.parameters.min_label_probability) & known[:, None], found, -1)
        self.assigned = new
        self.measured = _alone(rec, self.views, self.every, new, self.calibration_cov, ref).measured
        # Where the other frames do not check a label, those of its frame must, or a tracker that was sure of it.
        vague = sigma_px > CHECK_PX
        controlled_frames, loose = self._controlled(ref)
        clear = (new >= 0) & (certain >= SURE)
        beyond_doubt = self.sure | controlled_frames | (distinct_spots(clear, self.model.spot_of) >= FEW)
        new[(vague[:, None] & (loose | ~beyond_doubt[:, None])) & (new != self.certified)] = -1
        unchecked = vague & ~_chained(self.measured & self.found, beyond_doubt)
        count = distinct_spots(new >= 0, self.model.spot_of)
        lone = _lone_points(count)
        # So few spots fit false points by chance once in a long dark time; the next frame would show them again.
        whole = _alone(rec, self.views, self.every, new, self.calibration_cov, ref).measured
        lone |= vague & whole & (count <= FEW) & ~_beside(whole)
        new[lone] = -1
        self.probability = np.where((found >= 0) & ~lone[:, None], certain, np.nan)
        changed = bool(np.any(new != before))
        self.trusted = ~unchecked & ~self.doubtful
        self.measured = whole & ~lone & ~self.doubtful
        return changed

    def look_back(self) -> bool:
        """Labels of frames that the causal tracker did not measure for sure, from the frames after; whether any."""
        motion = self.motion
        sure = self.trusted & self.measured & (self.sure | self._controlled(motion.ref)[0]) & motion.known
        weak = ~sure
        if not weak.any() or not sure.any():
            return False
        back = track_backward(self.rec, motion.ref, motion.pose_P, motion.motion_P, weak, sure)
        new = merged(self.assigned, back, weak, self.model.spot_of)
        if np.array_equal(new, self.assigned) and not back.disagrees.any():
            return False
        self.assigned = self.certified = new
        self.found = self.found | back.measured
        self.measured = _alone(self.rec, self.views, self.every, new, self.calibration_cov, motion.ref).measured
        # Two directions of time that measured two poses: neither is believed.
        self.doubtful = back.disagrees
        self.measured &= ~self.doubtful
        self.sure |= back.measured & (distinct_spots(back.assigned >= 0, self.model.spot_of) >= FEW)
        self.sure &= ~self.doubtful
        self.trusted = _chained(self.measured, self.sure | self._controlled(motion.ref)[0])
        # The frames that were found now have no reference yet.
        poses = np.concatenate([motion.ref.R, motion.ref.t[:, None]], axis=1)
        found = sure | (back.measured & self.measured)
        for k in np.flatnonzero(found & ~sure):
            poses[k, :3], poses[k, 3] = back.R[k], back.t[k]
        ref = straight_between(poses, found, np.cumsum(self.rec.dt_s))
        self.motion = replace(motion, ref=ref)
        return True

    def repair(self) -> None:
        """Take frames whose pose contradicts their own spots for bends, and estimate again."""
        # A bend that was found one step too late leaves the frame before it with the covariance of a smooth path.
        beside = _beside(self.motion.bent) | self.motion.bent
        for _ in range(MOST_REPAIRS):
            limit = np.where(beside, UNLIKELY_AT_BEND, CONTRADICTS)
            wrong = self.own.measured & self.trusted & (self.own.excess > limit)
            if not wrong.any():
                return
            bent = self.motion.bent.copy()
            bent |= wrong
            bent[1:] |= wrong[:-1]
            if np.array_equal(bent, self.motion.bent):
                return
            self.motion = replace(self.motion, bent=bent)
            self.estimate(deep=DEEP)

    def continue_paths(self) -> None:
        """Labels of frames that do not give the pose, by the continuity of each spot's path."""
        motion = self.motion
        uv, J = project_all(self.views, motion.ref.R, motion.ref.t)
        spread = J @ motion.pose_P[:, None] @ np.swapaxes(J, -1, -2) + self.calibration_cov
        camera = self.sights.camera
        log_clutter = _log_clutter(
            self.rec, self.views, self.sights, self.every, self.assigned, motion.ref, self.own.measured
        )
        around = Surroundings(camera, uv, spread, log_clutter, motion.known & ~(self.own.measured & self.trusted))
        self.assigned, probability = continued(self.every, self.assigned, around)
        self.probability = np.where(np.isnan(probability), self.probability, probability)

    def result(self, rounds: int) -> Smoothed:
        """What the whole run says."""
        motion, own = self.motion, self.own
        ref, pose_P, motion_P = motion.ref, motion.pose_P.copy(), motion.motion_P.copy()
        R, t = ref.R.copy(), ref.t.copy()
        own.measured &= self.trusted
        wrong = own.measured & (own.excess > CONTRADICTS) & motion.known
        for k in np.flatnonzero(wrong):
            # Its own spots decide, with their own covariance; what the motion says there is not to be believed.
            R[k], t[k], pose_P[k] = own.R[k], own.t[k], own.covariance[k]
            d = Pose(own.R[k], own.t[k]).minus(Pose(ref.R[k], ref.t[k]))
            spread = np.diag((d / max(float(np.median(self.rec.dt_s[1:])), 1e-6)) ** 2)
            motion_P[k] = motion_P[k] + spread
        measured = own.measured & motion.known
        causal = self.causal
        assigned = self.assigned
        differ = (assigned % BLENDED != causal % BLENDED) & ~((assigned < 0) & (causal < 0))
        final = Reference(R, t, ref.m)
        places = self._place_errors(final, pose_P)
        # What was measured is the mean over the exposure; what is reported is the middle.
        jumps = motion.bent | np.append(motion.bent[1:], False)
        offsets = exposure_offsets(self.views, final, self.rec.exposure_s, motion.known & ~jumps)
        middle = Pose(R, t).plus(-moved_by(self.views, final, offsets))
        strength = np.full(2, np.nan)
        if motion.log_density is not None:
            half = 0.5 * np.median(motion.log_density, axis=0)
            strength = np.exp([half[:3].mean(), half[3:].mean()])
        return Smoothed(
            model=self.model,
            parameters=self.parameters,
            poses=middle,
            exposure_px=offsets,
            velocities=ref.m[:, :6],
            covariance=pose_P * places[1][:, None, None],
            place_share=places[0],
            systematic=self.systematic,
            motion_covariance=motion_P,
            known=motion.known,
            measured=measured,
            assigned=assigned,
            probability=self.probability,
            first=self.every.first,
            rms_px=_rms(self.views, self.every, assigned, final),
            jerk=strength,
            iterations=rounds,
            relabelled=int(np.count_nonzero(differ)),
            noise_scale=self.scale,
            width_share=self.share,
            calibration_cov=self.calibration_cov,
        )

    def _place_errors(self, ref: Reference, pose_P: Array) -> tuple[float, Array]:
        """The share of errors that stay in their place, and by how much (T,) the poses' covariances grow for it."""
        averaged = np.full(len(self.rec), np.nan)
        for k in np.flatnonzero(self.own.measured).tolist():
            averaged[k] = 6 / max(float(np.trace(np.linalg.solve(self.own.covariance[k], pose_P[k]))), 1e-9)
        usual = float(np.nanmedian(averaged)) if np.isfinite(averaged).any() else 1.0
        averaged = np.where(np.isfinite(averaged), averaged, usual)
        shape = (*self.assigned.shape, 2)
        residual, uv_px = np.full(shape, np.nan), np.full(shape, np.nan)
        expected, _ = project_all(self.views, ref.R, ref.t)
        explained = np.zeros(shape[1])
        for k in np.flatnonzero(self.own.measured).tolist():
            use, uv, cov = labelled_points(self.every, k, self.assigned[k], self.calibration_cov)
            use = use & np.isfinite(expected[k]).all(axis=-1)
            size = np.sqrt(0.5 * np.trace(cov[use], axis1=1, axis2=2))
            residual[k, use] = (uv[use] - expected[k, use]) / size[:, None]
            uv_px[k, use] = uv[use]
            explained[use] = 0.5 * np.trace(self.calibration_cov[use], axis1=1, axis2=2) / size**2
        found = place_errors(residual, uv_px, self.every.usual_px, averaged, explained)
        return found.share, found.factor(averaged)


def _chained(measured: Bools, controlled: Bools) -> Bools:
    """(T,): measured frames whose labels check each other, and those that an unbroken row of measured frames joins to
    one of them.
    """
    out = measured & controlled
    for order in (range(1, len(out)), range(len(out) - 2, -1, -1)):
        for k in order:
            out[k] |= measured[k] and out[k - order.step]
    return out


def _beside(measured: Bools) -> Bools:
    """(T,): frames next to a measured one."""
    out = np.zeros_like(measured)
    out[1:] |= measured[:-1]
    out[:-1] |= measured[1:]
    return out


class _Own:
    """Each frame by itself, T frames: what its own labelled spots say of the pose."""

    def __init__(self, R: Array, t: Array, covariance: Array, measured: Bools, excess: Array) -> None:
        self.R, self.t, self.covariance = R, t, covariance  # nan where not measured
        self.measured = measured  # (T,) the spots give the pose
        self.excess = excess  # (T,) chi-square of the spots at the smoothed pose, more than at their own

    @staticmethod
    def nothing(frames: int) -> _Own:
        """Of frames that were not looked at."""
        nan = np.nan
        return _Own(
            np.full((frames, 3, 3), nan), np.full((frames, 3), nan), np.full((frames, 6, 6), nan),
            np.zeros(frames, dtype=bool), np.zeros(frames),
        )  # fmt: skip


def _alone(
    rec: TrackedRecording, views: Views, every: AllDetections, assigned: Ints, calibration_cov: Array, ref: Reference
) -> _Own:
    """Each frame's own pose, and how far the reference's is from it."""
    frames = len(rec)
    limits = SolveLimits(rec.parameters.max_sigma_m, float(np.deg2rad(rec.parameters.max_sigma_deg)))
    out = _Own.nothing(frames)
    for k in range(frames):
        use, uv, cov = labelled_points(every, k, assigned[k], calibration_cov)
        if np.count_nonzero(use) < 3:
            continue
        R, t, L, chi2, count = fit_alone(views, ref.R[k], ref.t[k], use, uv, cov)
        covariance, full = covariance_of(L)
        if not full or count < 3:
            continue
        worst = [np.sqrt(np.linalg.eigvalsh(covariance[i, i])[-1]) for i in (slice(0, 3), slice(3, 6))]
        out.measured[k] = worst[0] <= limits.max_sigma_m and worst[1] <= limits.max_sigma_rad
        if out.measured[k]:
            out.R[k], out.t[k], out.covariance[k] = R, t, covariance
            out.excess[k] = frame_information(views, ref.R[k], ref.t[k], use, uv, cov)[2] - chi2
    return out


def _rms(views: Views, every: AllDetections, assigned: Ints, ref: Reference) -> Array:
    """(T,) root mean square residual of the reported poses against their own spots, per axis, px."""
    out = np.full(len(ref.t), np.nan)
    none = np.zeros((assigned.shape[1], 2, 2))
    uv_all, _ = project_all(views, ref.R, ref.t)
    for k in range(len(out)):
        use, uv, _ = labelled_points(every, k, assigned[k], none)
        if use.any():
            out[k] = np.sqrt(np.nanmean((uv - uv_all[k])[use] ** 2)) if np.isfinite(uv_all[k][use]).any() else np.nan
    return out


def _bend_sigmas(ref: Reference, dt: Array) -> Array:
    """(T, 6) sigmas of the pose, m and rad, that a bend in the step before a frame adds."""
    size = jump_variance(speeds(ref.m))
    step = np.maximum(dt, np.concatenate([dt[1:], dt[-1:]]))
    out = np.empty((len(dt), 6))
    for k in range(len(dt)):
        for i in range(2):
            add = process_noise(float(max(step[k], 1e-9)), 0.0, float(size[k, i]), 0.0)[0]
            out[k, 3 * i : 3 * i + 3] = np.sqrt(add)
    return out


def _usual_sizes(every: AllDetections, assigned: Ints) -> Array:
    """(n,) the median larger half axis of each view's labelled points, px; nan where none is known."""
    out = np.full(assigned.shape[1], np.nan)
    for i in range(assigned.shape[1]):
        k = np.flatnonzero(assigned[:, i] >= 0)
        sizes = every.size_px[every.begin[k] + assigned[k, i] % BLENDED]
        if np.isfinite(sizes).any():
            out[i] = np.nanmedian(sizes)
    return out


def _log_static(
    views: Views, sights: ViewTable, every: AllDetections, assigned: Ints, ref: Reference, known: Bools
) -> Array:
    """(m,) log density of points that stay in their place, at each detection, from the whole run."""
    frames = len(known)
    places = no_places(every.has_image.shape[1])
    expected, _ = project_all(views, ref.R, ref.t)
    rows = [slice(int(every.begin[k]), int(every.begin[k + 1])) for k in range(frames)]
    for k in np.flatnonzero(known):
        labels = np.where(assigned[k] >= 0, assigned[k] % BLENDED, -1)
        learn_static(
            places, every.uv[rows[k]], every.cov[rows[k]], every.first[k], every.has_image[k], labels, expected[k],
            sights.camera, 1.0,
        )  # fmt: skip
    parts = [log_static_density(places, every.uv[r], every.cov[r], every.first[k]) for k, r in enumerate(rows)]
    return np.concatenate([np.zeros(0), *parts])


def _lone_points(count: Ints) -> Bools:
    """(T,), of numbers of spots found in frames: those beside a dark one with a spot or two, where the other side is
    dark too, or shows many more.

    What is there is rather a false point or two than the last or first light: measured, all of some ten such labels in
    recordings with blackouts were wrong.
    """
    before, after = np.concatenate([[-1], count[:-1]]), np.concatenate([count[1:], [-1]])
    company = ((before > 0) & (before < count + 2)) | ((after > 0) & (after < count + 2))
    return (count > 0) & (count < MIN_CONFIRMING_SPOTS) & ((before == 0) | (after == 0)) & ~company


def _all_detections(rec: TrackedRecording) -> AllDetections:
    frames = [rec.detections(k) for k in range(len(rec))]
    counts = [len(f[0]) for f in frames]
    cameras = len(rec.model.camera_names)
    size = np.concatenate([np.zeros(0), *[f[2] for f in frames]])
    return AllDetections(
        uv=np.concatenate([np.zeros((0, 2)), *[f[0] for f in frames]]),
        cov=np.concatenate([np.zeros((0, 2, 2)), *[f[1] for f in frames]]),
        blend_px=np.where(np.isnan(size), 0.0, rec.parameters.blend_px),
        begin=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        first=np.array([f[3] for f in frames], dtype=np.int64).reshape(-1, cameras + 1),
        has_image=np.array([f[4] for f in frames], dtype=bool).reshape(-1, cameras),
        log_static=np.full(len(size), -np.inf),
        size_px=size,
        usual_px=np.full(len(rec.model), np.nan),
    )


def _calibration(rec: TrackedRecording, every: AllDetections, assigned: Ints, ref: Reference) -> tuple[Array, Array]:
    """What the calibration's errors do: to expected pixels (n, 2, 2), mean over the run, and to poses (T, 6, 6).

    The smoother weighs spots with their noise and the first of these, each spot by itself. The pose that such weights
    give moves with the calibration's errors by (J^T W J)^-1 J^T W: the same in every frame with these spots, so no
    averaging lessens it.
    """
    model = rec.model
    n = len(model)
    calibration_cov, systematic = np.zeros((n, 2, 2)), np.zeros((1, 6, 6))
    if rec.calibration is None:
        return calibration_cov, systematic
    points = [labelled_points(every, k, assigned[k], np.zeros_like(calibration_cov)) for k in range(len(rec))]
    common: list[Array | None] = [None] * len(rec)
    for block in np.array_split(np.flatnonzero(rec.measured), len(rec) // 256 + 1):
        for k, C in zip(block, rec.calibration.at(Pose(ref.R[block], ref.t[block])), strict=True):
            common[k] = C
    J_all = project_all(model.numbers, ref.R, ref.t)[1]
    gains: list[tuple[Ints, Array] | None] = [None] * len(rec)
    for second in (False, True):
        total, count = np.zeros((n, 2, 2)), 0
        for k in np.flatnonzero(rec.measured):
            use, _, cov = points[k]
            rows, C = np.flatnonzero(use), common[k]
            assert C is not None
            if len(rows) < 3:
                continue
            J, W = J_all[k][rows], np.linalg.inv(cov[rows] + calibration_cov[rows])
            JW = np.swapaxes(J, 1, 2) @ W  # (m, 6, 2)
            covariance, full = covariance_of(np.sum(JW @ J, axis=0))
            if not full:
                continue
            G = covariance @ np.concatenate(list(JW), axis=1)  # (6, 2m)
            gains[k] = rows, G
            if not second:
                both = np.stack([2 * rows, 2 * rows + 1], axis=-1).ravel()
                left = np.eye(2 * n)
                left[:, both] -= J_all[k].reshape(2 * n, 6) @ G
                joint = (left @ C @ left.T).reshape(n, 2, n, 2)
                total += joint[np.arange(n), :, np.arange(n)]
                count += 1
        if not second:
            calibration_cov = total / max(count, 1)
    systematic = np.zeros((len(rec), 6, 6))
    latest = np.zeros((6, 6))
    for at, (gain, C) in enumerate(zip(gains, common, strict=True)):
        if gain is not None and C is not None:
            rows, G = gain
            both = np.stack([2 * rows, 2 * rows + 1], axis=-1).ravel()
            latest = G @ C[np.ix_(both, both)] @ G.T
        systematic[at] = latest
    return calibration_cov, systematic


def _log_clutter(
    rec: TrackedRecording,
    views: Views,
    sights: ViewTable,
    every: AllDetections,
    assigned: Ints,
    ref: Reference,
    known: Bools,
) -> Array:
    """(T, n) log density of false points: as counted near spots over the run, or a frame's whole picture's if more."""
    near = clutter_density(views, sights, every, assigned, ref, known, RADIUS_PX)
    model = rec.model
    area = np.array([np.prod(model.image_size_px[model.camera_of == c][:1]) for c in range(len(near))])
    density = np.maximum(np.maximum(near, np.diff(every.first, axis=1) / area), rec.parameters.labels.clutter_per_px2)
    return np.ascontiguousarray(np.log(density)[:, model.camera_of])
