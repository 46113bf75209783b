"""The smoothing pass: labels revised and motion estimated with the whole run known.

1. Estimate the most probable motion given the causal labels (motion/whole_run.py).
2. Track stretches of doubtful frames backward in time (recording.py).
3. Assign each frame's detections again from the motion that all other frames give (labels/reassociation.py), and
   estimate the motion again, until no label changes. The last of these rounds ends with the motion, so that labels and
   poses belong together.
4. Compare each pose with that of the frame's own spots. Where they contradict each other a velocity jump is assumed and
   the motion estimated again; if the contradiction remains, the frame's own spots decide.
5. Add labels by continuity where the pose is uncertain (labels/continuity.py).

lab/runs/verdict/run_statistics.py tests the result once more, against the spots and the causal pose. Source: ours.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from geometry.arrays import Array, Bools, Ints
from geometry.compiled_projection import project_all, project_with_covariances
from geometry.pose import Pose
from geometry.pose_solver.gauss_newton import SolveLimits
from tracking.rigid_body.association.frame_detections import BLENDED, DetectionModel, ViewTable, distinct_spots
from tracking.rigid_body.hypotheses.hypothesis_set import MAX_CHECKING_SIGMA_PX, MIN_REDUNDANT_SPOTS, SURE_PROBABILITY
from tracking.rigid_body.models.information import run_shifts
from tracking.smoothing.error_scale import ErrorScale, usual_sizes, well_known
from tracking.smoothing.labels.continuity import continued, transfers_between_cameras
from tracking.smoothing.labels.neighbouring_frames import (
    connected,
    contradicted_gaps,
    isolated,
    labelled_once,
    merged_with_hidden,
    next_to,
)
from tracking.smoothing.labels.reassociation import RunObservation, reassociated, run_log_clutter, run_log_static
from tracking.smoothing.labels.view_path import PathContext
from tracking.smoothing.motion.clocks import NARROWER, TURN_SIGMAS, clock_sigmas, clock_step
from tracking.smoothing.motion.process_noise import corner_offsets, jump_sigmas
from tracking.smoothing.motion.run_detections import (
    Reference,
    RunDetections,
    SmoothedMotion,
    WholeRun,
    controlled_labels,
    moved_detections,
    straight_between,
)
from tracking.smoothing.motion.timed_run import estimate_timed
from tracking.smoothing.motion.whole_run import MAX_DISTANCE, estimate
from tracking.smoothing.place_errors import place_errors, scaled_shares, with_places
from tracking.smoothing.recording import FoundClocks, TrackedRecording, merged, track_backward
from tracking.smoothing.rig_errors import RigErrors
from tracking.smoothing.single_frame_poses import SingleFramePoses, rms_residuals, single_frame_poses
from tracking.smoothing.smoothed import ReportedSpots, Smoothed
from tracking.smoothing.systematic_errors import calibration_errors, exposure_offsets, exposure_sigmas, pose_shift

MAX_ROUNDS = 4  # of motion and labels
VAGUE_SIGMA_PX = 1.0  # a spot predicted worse than this may be labelled by its path although the pose is measured
MAX_REPAIRS = 3  # times that velocity jumps are added where poses contradict their spots
# Excess chi-square (6 degrees of freedom) of a frame's spots at the smoothed pose over that at their own pose, above
# which the two contradict each other (p = 5e-11). The second limit, which half of all frames exceed by chance, holds
# next to a velocity jump, which may in truth be one step farther.
CONTRADICTION_CHI2, CONTRADICTION_NEXT_TO_JUMP_CHI2 = 60.0, 5.0


def smooth(recording: TrackedRecording) -> Smoothed:
    """Labels and motion of a run, given all of its frames.

    With `method: spots` the labels stay as that tracker gave them. Without any measured pose nothing is known. Raises
    FloatingPointError: The first estimate of the motion is not finite.
    """
    rec, parameters = recording, recording.parameters
    smoother = _Smoother(rec)
    smoother.estimate(max_distance=0)
    rounds = 1
    if rec.measured.any():
        # The first reference is a straight line over each gap: too far off for the few spots in the gap, which are used
        # only after they have been compared with the smoothed motion.
        gapless = bool(rec.measured.all())
        if parameters.method == "rigid":
            opened = smoother.leave_contradicted_start_open()
            if smoother.label_backward() or opened:
                smoother.estimate(max_distance=0)
            while rounds < MAX_ROUNDS and (smoother.reassociate() or (rounds == 1 and not gapless)):
                rounds += 1
                smoother.estimate(max_distance=MAX_DISTANCE)
        elif not gapless:
            smoother.estimate(max_distance=MAX_DISTANCE)
        smoother.add_jumps_at_contradictions()
        # Labels need a pose, except where the paths of spots continue.
        smoother.assigned = np.where(smoother.motion.known[:, None], smoother.assigned, -1)
        if parameters.method == "rigid":
            smoother.continue_paths()
    return smoother.result(rounds)


class _Smoother:
    """State of the smoothing pass over one run: T frames, n views."""

    def __init__(self, rec: TrackedRecording) -> None:
        model, parameters = rec.model, rec.parameters
        self.rec, self.model, self.parameters = rec, model, parameters
        self.views = model.numbers
        self.view_table = ViewTable.of(rec.rig, model)
        self.limits = SolveLimits(parameters.max_sigma_m, float(np.deg2rad(parameters.max_sigma_deg)))
        self.causal = rec.assigned
        self.assigned = self.causal.copy()
        self.measured = rec.measured  # (T,) the frame's spots determine its pose
        self.probability = np.where(self.causal >= 0, 1.0, np.nan)
        ref = straight_between(rec.poses, self.measured, np.cumsum(rec.dt_s))
        self.delays = rec.delays()
        self.correction_s = np.zeros(0 if rec.clocks is None else len(rec.clocks.numbers))
        self.unsettled = False  # the steps of the clocks do not end
        # A sigma of the clocks' present offsets, with which turns are found.
        self.far_s = 0.0 if rec.clocks is None else rec.clocks.largest_offset_s(rec.clocks.sigma_s)
        # (T,) frames with pictures of other instants: beside a velocity jump they have no pose of their own.
        self.timed = np.zeros(len(rec), dtype=bool)
        if self.delays is not None:
            self.timed = np.asarray(self.delays.clocks[..., :2].any(axis=(1, 2)))
        seen = rec.run_detections()
        seen = seen._replace(usual_size_px=usual_sizes(seen, self.assigned))
        self.calibration_cov, self.systematic, self.noise_share = calibration_errors(rec, seen, self.assigned, ref)
        place_px2 = rec.place_px2()
        every, steady, labels = seen, self.measured, self.assigned
        first = SmoothedMotion.begin(ref, rec.jumped.copy(), None)
        if self.delays is not None:
            every, first, steady = self._first_motion(seen, first)
            ref, labels = first.ref, well_known(every, seen, labels)
        own, unknown = seen._replace(uv=every.uv), np.zeros_like(self.calibration_cov)
        self.rig_errors: RigErrors | None = None
        if rec.calibration is not None and steady.any():
            self.rig_errors = RigErrors.shown(rec.calibration, self.views, own, labels, place_px2, ref, steady)
            own, unknown = self.rig_errors.taken_from(self.views, own, labels, ref)
        self.errors = ErrorScale.of(model, own, place_px2, labels, unknown, ref, steady, every.cov - seen.cov)
        # Where the pictures show the points, and where these would have been at the instants of the frames.
        self.seen = self.detections = seen._replace(
            cov=self.errors.of_run(seen, place_px2) + parameters.sigma_model_px**2 * np.eye(2)
        )
        log_density = first.log_density
        if not parameters.learn_jerk:
            by_hand = 2 * np.log(np.repeat([parameters.jerk_m_s3, parameters.jerk_rad_s3], 3))
            log_density = np.tile(by_hand, (len(rec), 1))
        self.tracker_labels = self.causal  # (T, n) given by a tracker, forward or backward
        self.tracker_measured = self.measured  # (T,) measured by a tracker
        # (T,) measured by a tracker with enough spots: it has left open what nothing checked.
        self.sure = self.measured & (distinct_spots(self.assigned >= 0, model.spot_of) >= MIN_REDUNDANT_SPOTS)
        self.trusted = connected(self.measured, self.sure | self._controlled(ref)[0])  # (T,) labels that may be used
        self.motion = replace(first.without_covariances(), log_density=log_density)
        self.conflicting = np.zeros(len(rec), dtype=bool)  # (T,) forward and backward poses differ
        self.own = SingleFramePoses.unknown(0)  # at the last estimate

    def _first_motion(self, seen: RunDetections, begin: SmoothedMotion) -> tuple[RunDetections, SmoothedMotion, Bools]:
        """The detections at the instants of their frames, by the motion with the stated sigmas; that motion; steady
        frames.

        Differences of the causal poses would do for neither: between two pictures of one frame they are off by a third
        of the noise, and by pixels at a velocity jump. Steady frames (T,) are measured and not next to a jump.
        """
        rec = self.rec
        run = WholeRun(self.views, seen, self.calibration_cov, rec.dt_s, rec.exposure_s, True, self.delays)
        motion = estimate_timed(run, self.assigned, self.measured, begin, 0, self.measured)
        turns = motion.jumped | np.append(motion.jumped[1:], False)
        steady = self.measured & ~turns
        return self._at_frames(seen, motion), motion, steady if steady.any() else self.measured

    def _at_frames(self, seen: RunDetections, motion: SmoothedMotion) -> RunDetections:
        """The detections where they would have been at the instants of their frames, given the estimated motion."""
        if self.delays is None or motion.between is None:
            return seen
        uv, cov = moved_detections(self.views, self.view_table.camera, seen, self.delays, self.assigned, motion.between)
        return seen._replace(uv=uv, cov=cov)

    def estimate(self, max_distance: int) -> None:
        """Estimate the motion given the labels, and the clocks that are not known."""
        self.own, clocks, step = SingleFramePoses.unknown(0), self.rec.clocks, 0
        self._estimate_motion(max_distance)
        while clocks is not None and (found := self.motion.clocks) is not None:
            change = clock_step(found, clocks.sigma_s, step)
            step += 1
            if change is None:
                self.unsettled, change = True, clocks.mean_s - self.correction_s
                self.far_s = clocks.largest_offset_s(clocks.sigma_s)
            elif not change.any():
                before, after_s = self.far_s, TURN_SIGMAS * np.sqrt(np.diagonal(found.noise))
                self.far_s, step = min(clocks.largest_offset_s(after_s), before), 0
                if not self.motion.turns or self.far_s >= NARROWER * before:
                    break
            self.correction_s = self.correction_s + change
            self.delays = self.rec.delays(self.correction_s)
            self._estimate_motion(max_distance)
        self.detections = self._at_frames(self.seen, self.motion)
        own = self._single_frame_poses(self.assigned)
        self.measured = own.measured & ~self.conflicting
        self.own = replace(own, measured=self.measured)

    def _estimate_motion(self, max_distance: int) -> None:
        """Estimate the motion given the labels and the clocks."""
        rec = self.rec
        unknown = rec.unknown_clocks(self.correction_s, self.unsettled, self.far_s)
        run = WholeRun(
            self.views, self.seen, self.calibration_cov, rec.dt_s, rec.exposure_s, self.parameters.learn_jerk,
            self.delays, unknown,
        )  # fmt: skip
        estimated = estimate if self.delays is None else estimate_timed
        # A long run's memory is largest here.
        self.motion = self.motion.without_covariances()
        self.motion = estimated(run, self.assigned, self.measured, self.motion, max_distance, self.trusted)

    def _single_frame_poses(self, assigned: Ints) -> SingleFramePoses:
        motion, rec = self.motion, self.rec
        beside = corner_offsets(motion.ref, motion.jumped, rec.exposure_s, rec.dt_s)
        return single_frame_poses(
            self.views, self.detections, assigned, self.calibration_cov, motion.ref, self.limits, beside
        )

    def _redundant(self, chosen: Bools) -> Bools:
        """(T,): frames with at least MIN_REDUNDANT_SPOTS spots among the chosen views (T, n)."""
        return np.asarray(distinct_spots(chosen, self.model.spot_of) >= MIN_REDUNDANT_SPOTS)

    def _controlled(self, ref: Reference) -> tuple[Bools, Bools]:
        """Frames (T,) whose labels control each other, all or enough for a pose; and their other labels (T, n)."""
        labelled, checked = controlled_labels(self.views, self.detections, self.assigned, self.calibration_cov, ref)
        count = distinct_spots(checked, self.model.spot_of)
        frames = (count >= MIN_REDUNDANT_SPOTS) | ((count > 0) & ~np.any(labelled & ~checked, axis=1))
        return frames, labelled & ~checked & frames[:, None]

    def reassociate(self) -> bool:
        """Label each frame from the motion that the other frames give; whether any label changed."""
        ref, known = self.motion.ref, self.motion.known
        detection_model = DetectionModel(self.parameters.p_detect, self.parameters.p_blend)
        run = RunObservation(
            self.views, self.view_table, detection_model, self.calibration_cov, self.detections, self._log_static(known)
        )
        found, probability, sigma_px = reassociated(
            run, self.assigned, ref, self.motion.pose_P, self.motion.weight, self._log_clutter(known),
            jump_sigmas(ref, self.rec.dt_s),
        )  # fmt: skip
        before, likely = self.assigned, probability >= self.parameters.min_label_probability
        expected, _ = project_all(self.views, ref.R, ref.t)
        new = np.where(likely & known[:, None], found, -1)
        self.assigned = new = merged_with_hidden(new, expected, self.view_table.camera, self.parameters.blend_px)
        self.measured = self._single_frame_poses(new).measured
        # Where the other frames do not check a label, those of its frame must, or a tracker that was sure of it.
        vague = sigma_px > MAX_CHECKING_SIGMA_PX
        controlled, uncontrolled_labels = self._controlled(ref)
        confirmed = self.sure | controlled | self._redundant((new >= 0) & (probability >= SURE_PROBABILITY))
        left_open = vague[:, None] & (uncontrolled_labels | ~confirmed[:, None]) & (new != self.tracker_labels)
        new[left_open] = -1
        unchecked = vague & ~connected(self.measured & self.tracker_measured, confirmed)
        count = distinct_spots(new >= 0, self.model.spot_of)
        dropped = isolated(count)
        # In a long occlusion so few false points fit a pose once by chance; spots would be there in the next frame too.
        measured = self._single_frame_poses(new).measured if left_open.any() else self.measured
        # Nor does another such frame beside it count, of labels that their spots have in one picture only.
        labelled, lasting = new >= 0, measured
        single = labelled_once(labelled, self.seen.has_image[:, self.model.camera_of])
        if single[vague & measured].any():
            lasting = self._single_frame_poses(np.where(single, -1, new)).measured
        once = vague & measured & ~next_to(lasting)
        dropped |= once & (count <= MIN_REDUNDANT_SPOTS)
        # And one beside spots that one camera always shows, which do not determine the pose without it.
        alone = labelled & ~next_to(labelled)
        alone &= (once & (distinct_spots(alone, self.model.spot_of) <= MIN_REDUNDANT_SPOTS))[:, None]
        measured &= ~alone.any(axis=1)
        new[dropped[:, None] | alone] = -1
        self.probability = np.where((found >= 0) & ~dropped[:, None] & ~alone, probability, np.nan)
        changed = bool(np.any(new != before))
        self.trusted = ~unchecked & ~self.conflicting
        self.measured = measured & ~dropped & ~self.conflicting
        return changed

    def leave_contradicted_start_open(self) -> bool:
        """Remove the labels of the first measured frame if only a jump connects them with the next; whether it does.

        Nothing else supports them: labels of a fan that are one spot off are such a jump.
        """
        start = int(np.argmax(self.measured))
        jumped = self.motion.jumped.copy()
        if not self.measured[start] or not jumped[start + 1 : start + 2].any():
            return False
        jumped[start + 1] = False
        for mask in (self.measured, self.sure, self.trusted, self.rec.measured):  # of the causal tracker: the last
            mask[start] = False
        self.assigned[start] = -1
        self.motion = replace(self.motion, jumped=jumped)
        return True

    def label_backward(self) -> bool:
        """Label frames that the causal tracker did not measure with certainty from later ones; whether any changed."""
        motion = self.motion
        sure = self.trusted & self.measured & (self.sure | self._controlled(motion.ref)[0]) & motion.known
        weak = ~sure
        if not weak.any() or not sure.any():
            return False
        back = track_backward(self.rec, motion, weak, sure)
        new = merged(self.assigned, back, weak, self.model.spot_of)
        if np.array_equal(new, self.assigned) and not back.disagrees.any():
            return False
        self.assigned = self.tracker_labels = new
        self.tracker_measured = self.tracker_measured | back.measured
        # Where the two directions of time have measured two different poses, neither is used.
        self.conflicting = back.disagrees
        self.measured = self._single_frame_poses(new).measured & ~self.conflicting
        self.sure |= back.measured & self._redundant(back.assigned >= 0)
        self.sure &= ~self.conflicting
        self.trusted = connected(self.measured, self.sure | self._controlled(motion.ref)[0])
        # The frames that were found now need a reference.
        poses = np.concatenate([motion.ref.R, motion.ref.t[:, None]], axis=1)
        found = sure | (back.measured & self.measured)
        for k in np.flatnonzero(found & ~sure):
            poses[k, :3], poses[k, 3] = back.R[k], back.t[k]
        self.motion = replace(motion, ref=straight_between(poses, found, np.cumsum(self.rec.dt_s)))
        return True

    def add_jumps_at_contradictions(self) -> None:
        """Assume velocity jumps where the pose contradicts the frame's own spots, and estimate the motion again."""
        # A jump that was detected one step too late leaves the frame before it with the covariance of a smooth path.
        beside = next_to(self.motion.jumped) | self.motion.jumped
        for _ in range(MAX_REPAIRS if self.delays is None else 0):
            limit = np.where(beside, CONTRADICTION_NEXT_TO_JUMP_CHI2, CONTRADICTION_CHI2)
            wrong = self.own.measured & self.trusted & (self.own.excess > limit)
            if not wrong.any():
                return
            jumped = self.motion.jumped.copy()
            jumped |= wrong
            jumped[1:] |= wrong[:-1]
            if np.array_equal(jumped, self.motion.jumped):
                return
            self.motion = replace(self.motion, jumped=jumped)
            self.estimate(max_distance=MAX_DISTANCE)

    def _log_clutter(self, known: Bools) -> Array:
        return run_log_clutter(
            self.model, self.view_table, self.detections, self.assigned, self.motion.ref, known,
            self.parameters.labels.clutter_per_px2,
        )  # fmt: skip

    def _log_static(self, known: Bools) -> Array:
        noise_px2 = 0.5 * np.trace(self.rec.run_detections().cov, axis1=1, axis2=2) - self.rec.place_px2()
        return run_log_static(
            self.views, self.view_table.camera, self.detections, noise_px2, self.assigned, self.motion.ref, known
        )

    def continue_paths(self) -> None:
        """Label spots by the continuity of their paths where the pose is uncertain."""
        motion = self.motion
        uv, cov = project_with_covariances(self.views, motion.ref.R, motion.ref.t, motion.pose_P)
        cov += self.calibration_cov
        # In a gap a spot that rests far from its vague place would count as static.
        log_clutter, log_static = self._log_clutter(self.own.measured), self._log_static(self.own.measured)
        known, sure = motion.known[:, None], (self.own.measured & self.trusted)[:, None]
        vague = np.trace(cov, axis1=2, axis2=3) > VAGUE_SIGMA_PX**2
        uv = np.where(known[..., None], uv, np.nan)
        context = PathContext(self.view_table.camera, uv, cov, log_clutter, log_static, ~known | ~sure | vague)
        transfers = transfers_between_cameras(self.rec.rig, self.model.views)
        self.assigned, probability = continued(self.detections, self.assigned, context, transfers)
        self.probability = np.where(np.isnan(probability), self.probability, probability)

    def result(self, rounds: int) -> Smoothed:
        """The answer for the whole run."""
        motion, causal, assigned = self.motion, self.causal, self.assigned
        self.own = replace(self.own, measured=self.own.measured & self.trusted)
        final, pose_P, motion_P = self._with_own_poses()
        uv, cov = project_with_covariances(self.views, final.R, final.t, pose_P)
        expected, measured = (uv, cov + self.calibration_cov), self.own.measured & motion.known
        lost = contradicted_gaps(self.detections, assigned, self.view_table.camera, expected, measured)
        known = motion.known & ~lost
        differ = (assigned % BLENDED != causal % BLENDED) & ~((assigned < 0) & (causal < 0))
        place_share, place_factor, covariance = self._place_errors(final, pose_P)
        # Measured is the mean over the exposure; reported is the pose at its middle.
        jumps = motion.jumped | np.append(motion.jumped[1:], False)
        offsets = exposure_offsets(self.views, final, self.rec.exposure_s, motion.known & ~jumps)
        of_spots, of_poses = exposure_sigmas(final, motion.jumped, self.rec.exposure_s, self.rec.dt_s)
        covariance = covariance + of_poses[:, :, None] ** 2 * np.eye(6)
        rest = [1 - (1 - place_share) / place_factor, of_poses, np.zeros((len(covariance), 21))]
        clocks: FoundClocks | None = None
        if motion.clocks is not None and self.rec.clocks is not None:
            # Errors of places do not average out for the clocks either.
            excess = float(np.median(place_factor[motion.known])) if motion.known.any() else 1.0
            clock_cov = motion.clocks.with_excess(excess, self.rec.clocks.sigma_s) + motion.clocks.systematic
            clocks = FoundClocks(self.correction_s, clock_cov)
            spread = motion.clocks.motion @ clock_cov @ np.swapaxes(motion.clocks.motion, 1, 2)
            beyond = clock_sigmas(final, self.rec.clocks.offset_sigma_s(clock_cov), self.rec.dt_s)
            spread[:, np.arange(6), np.arange(6)] += beyond**2
            covariance, motion_P = covariance + spread[:, :6, :6], motion_P + spread[:, 6:, 6:]
            rest[2] = spread[:, *np.triu_indices(6)]
        jerk = np.full(2, np.nan)
        if motion.log_density is not None:
            half = 0.5 * np.median(motion.log_density, axis=0)
            jerk = np.exp([half[:3].mean(), half[3:].mean()])
        poses = Pose(final.R, final.t).plus(-pose_shift(self.views, final, offsets))
        shifts: Array | None = None
        if self.delays is not None:
            shifts = run_shifts(self.views, self.view_table.camera, self.delays.clocks, final.R, final.t, final.m)
            # A spot on the other side of a velocity jump has moved as the motion there.
            k, view = np.nonzero(assigned >= 0)
            rows = self.detections.begin[k] + assigned[k, view] % BLENDED
            shifts[k, view] = self.seen.uv[rows] - self.detections.uv[rows]
        spots = ReportedSpots.of(
            self.model, self.parameters, poses, covariance + self.systematic, self.calibration_cov,
            (self.rec.run_detections(), self.rec.place_px2()), (assigned, self.errors), (offsets, of_spots), shifts,
        )  # fmt: skip
        return Smoothed(
            model=self.model,
            parameters=self.parameters,
            poses=poses,
            spots=spots,
            shift_px=shifts,
            clocks=clocks,
            velocities=final.m[:, :6],
            covariance=covariance,
            place_share=place_share,
            rest_parts=np.column_stack(rest),
            systematic=self.systematic,
            motion_covariance=motion_P,
            known=known,
            measured=measured,
            assigned=assigned,
            probability=self.probability,
            first=self.detections.first,
            rms_px=rms_residuals(self.views, self.detections, assigned, final),
            jerk=jerk,
            iterations=rounds,
            relabelled=int(np.count_nonzero(differ)),
            errors=self.errors,
        )

    def _with_own_poses(self) -> tuple[Reference, Array, Array]:
        """The motion with covariances of poses and velocities, where remaining contradictions are resolved.

        A frame whose pose still contradicts its spots gets their pose and its covariance, and a velocity covariance
        that covers the contradiction.
        """
        motion, own = self.motion, self.own
        ref = motion.ref
        R, t, pose_P, motion_P = (a.copy() for a in (ref.R, ref.t, motion.pose_P, motion.motion_P))
        for k in np.flatnonzero(own.measured & (own.excess > CONTRADICTION_CHI2) & motion.known & ~self.timed):
            R[k], t[k], pose_P[k] = own.R[k], own.t[k], own.covariance[k]
            d = Pose(own.R[k], own.t[k]).minus(Pose(ref.R[k], ref.t[k]))
            spread = np.diag((d / max(float(np.median(self.rec.dt_s[1:])), 1e-6)) ** 2)
            motion_P[k] = motion_P[k] + spread
        return Reference(R, t, ref.m), pose_P, motion_P

    def _place_errors(self, ref: Reference, pose_P: Array) -> tuple[float, Array, Array]:
        """Share of the errors that belong to places, their factor (T,) on the covariances, and these (T, 6, 6)."""
        frames, detections = np.flatnonzero(self.own.measured), self.detections
        averaged, (residual, uv_px) = np.full(len(self.rec), np.nan), np.full((2, *self.assigned.shape, 2), np.nan)
        ratio = np.trace(np.linalg.solve(self.own.covariance[frames], pose_P[frames]), axis1=1, axis2=2)
        averaged[frames] = 6 / np.maximum(ratio, 1e-9)
        averaged = np.where(np.isfinite(averaged), averaged, np.nanmedian(averaged) if len(frames) else 1.0)
        (expected, J), assigned = project_all(self.views, ref.R[frames], ref.t[frames]), self.assigned[frames]
        use = (assigned >= 0) & (assigned < BLENDED) & np.isfinite(expected).all(axis=-1)
        k, view = np.nonzero(use)
        rows = detections.begin[frames[k]] + assigned[use]
        stated, left, taken = detections.cov[rows], detections.uv[rows] - expected[use], np.zeros(self.assigned.shape)
        size = np.sqrt(0.5 * np.trace(stated, axis1=1, axis2=2))
        if (rig := self.rig_errors) is not None:
            shift, unknown = rig.in_residuals(self.views, detections, self.assigned, frames, ref, self.calibration_cov)
            left = left - shift[use]
            taken[frames[k], view] = 0.5 * np.trace(unknown[use], axis1=1, axis2=2) / size**2
        residual[frames[k], view] = left / size[:, None]
        uv_px[frames[k], view] = detections.uv[rows]
        shares = self.errors.place_px2(detections, self.rec.place_px2())[rows] / size**2
        width_px, share = self.detections.usual_size_px, float(np.mean(shares)) if len(shares) else 0.0
        found = place_errors(residual, uv_px, width_px, averaged, taken, share)
        own = scaled_shares(shares, share, found.share) * found.more[frames[k], view] * averaged[frames[k]]
        covariance = pose_P * found.factor[:, None, None]
        covariance[frames] = with_places(pose_P[frames], J, stated + self.calibration_cov[view], (k, view), own)
        return found.share, found.factor, covariance * self.noise_share[:, None, None]
