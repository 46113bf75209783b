"""The second look at a run: labels anew from both sides, and the motion given all frames.

Rounds of: evidence of the labelled spots; the jerk's strength by maximum likelihood; fixed-interval smoothing; and each
frame's detections assigned anew from where all other frames say that the vehicle was. What the causal pass lost or left
open is so found from the side on which it is known. Source: ours; see fixed_interval.py and relabel.py.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.ndimage import maximum_filter1d
from scipy.optimize import minimize

from geometry.arrays import Array, Bools, Ints
from geometry.pose import Pose
from geometry.projection import Views, project_all
from geometry.solve import SolveLimits, covariance_of, fit_pose
from tracking.association import BLENDED, Chances, Sights
from tracking.fixed_interval import Evidence, Reference, log_likelihood, shifted, smoothed, told_by_the_others
from tracking.hypotheses import PROOF
from tracking.information import fit_alone
from tracking.misfit import DEADBAND
from tracking.recording import Recording
from tracking.relabel import AllDetections, clutter_density, evidence_of, labelled_points, relabelled
from tracking.rigid_tracker import LOST_SIGMA_M, LOST_SIGMA_RAD
from tracking.smoothed import Smoothed
from tracking.surroundings import RADIUS_PX
from tracking.temper import JUMP_OF_SPEED, LEAST_JUMP, STEADIES_WITHIN_S

MOST_ROUNDS = 5
MOST_STEPS = 8  # of Gauss-Newton per round
SHOCK = 45.0  # chi-square of 6 degrees (p = 5e-8): a jump of the velocities beyond what the motion allows
APART = 2  # frames: of shocks so near each other the largest is looked at first
SMALL_STEP = 0.02  # sigmas: a step of Gauss-Newton that is nothing any more
LONGEST_STEP = 0.3  # m and rad, of the reference: beyond it nothing is linear
# m/s^3 or rad/s^3 per sqrt(Hz). The lower end is for a vehicle that stands for a minute: 1e-4 is 2e-3 rad in 6 s.
RANGE = (1e-7, 1e5)
MOST_FRAMES_FOR_JERK = 3000  # the likelihood is sharp enough by then
MOST_FRAMES_BETWEEN = 1000  # the same of the other one, which takes five times as long
FINER = np.log(3.0)  # so much smaller than the likeliest the other one usually is: where to begin
P_DARK = 0.05  # probability of a bend in each frame that does not show the pose
DEEP = 12  # frames: so far from any measured one a few spots are not taken for evidence
SPEED_WINDOW_S = 0.5  # a bend's size is judged by the fastest motion within this time of it


def smooth(recording: Recording) -> Smoothed:
    """A run's labels and motion, given all of it.

    With `method: spots` the labels stay as that tracker gave them. Where nothing was measured nothing is known.
    """
    rec, model, parameters = recording, recording.model, recording.parameters
    views = model.numbers
    sights = Sights.of(rec.rig, model)
    chances = Chances(parameters.p_detect, parameters.p_blend)
    causal, measured = rec.assigned, rec.measured
    assigned, probability = causal.copy(), np.where(causal >= 0, 1.0, np.nan)
    every = _all_detections(rec)
    ref = _first_reference(rec)
    extra, systematic = _calibration(rec, every, assigned, ref)
    scale = _noise_scale(views, every, assigned, extra, ref, measured)
    every = every._replace(cov=every.cov * scale**2 + parameters.sigma_model_px**2 * np.eye(2))
    set_by_hand = np.log([[parameters.jerk_m_s3, parameters.jerk_rad_s3]] * 2)
    jerk: Array | None = None if parameters.learn_jerk else set_by_hand
    bent, gapless = rec.bent.copy(), bool(measured.all())
    rounds, relabels = 0, parameters.method == "rigid"
    while True:
        rounds += 1
        # The first reference is a straight line over each gap: too far off for the few spots seen there.
        deep = 0 if rounds == 1 else DEEP
        ref, pose_P, motion_P, jerk, known = _motion(
            views, every, assigned, extra, ref, rec, measured, bent, deep, jerk, parameters.learn_jerk
        )
        if rounds == MOST_ROUNDS or (not relabels and (rounds > 1 or gapless)):
            break
        if not relabels:
            continue
        log_clutter = _log_clutter(rec, views, sights, every, assigned, ref, known)
        found, certain = relabelled(views, sights, chances, every, assigned, extra, ref, pose_P, log_clutter)
        new = np.where((certain >= parameters.min_label_probability) & known[:, None], found, -1)
        lone = _lone_points(new)
        new[lone] = -1
        probability = np.where((found >= 0) & ~lone[:, None], certain, np.nan)
        changed = int(np.count_nonzero(new != assigned))
        assigned = new
        measured, rms = _alone(rec, views, every, assigned, extra, ref)
        if changed == 0 and (rounds > 1 or gapless):
            break
    measured, rms = _alone(rec, views, every, assigned, extra, ref)
    differ = (assigned % BLENDED != causal % BLENDED) & ~((assigned < 0) & (causal < 0))
    return Smoothed(
        model=model,
        parameters=parameters,
        poses=Pose(ref.R, ref.t),
        velocities=ref.m[:, :6],
        covariance=pose_P,
        systematic=systematic,
        motion_covariance=motion_P,
        known=known,
        measured=measured & known,
        assigned=assigned,
        probability=probability,
        first=every.first,
        rms_px=rms,
        jerk=np.exp(jerk[0]),
        iterations=rounds,
        relabelled=int(np.count_nonzero(differ)),
        noise_scale=scale,
        extra=extra,
    )


def _lone_points(assigned: Ints) -> Bools:
    """(T,): frames beside a dark one with a spot or two, where the other side is dark too, or shows many more.

    What is there is rather a false point or two than the last or first light: measured, all of some ten such labels in
    recordings with blackouts were wrong.
    """
    count = np.count_nonzero(assigned >= 0, axis=1)
    before, after = np.concatenate([[-1], count[:-1]]), np.concatenate([count[1:], [-1]])
    company = ((before > 0) & (before < count + 2)) | ((after > 0) & (after < count + 2))
    return (count > 0) & (count < PROOF) & ((before == 0) | (after == 0)) & ~company


def _all_detections(rec: Recording) -> AllDetections:
    frames = [rec.detections(k) for k in range(len(rec))]
    counts = [len(f[0]) for f in frames]
    cameras = len(rec.model.camera_names)
    blend = np.concatenate([np.zeros(0), *[np.where(f[2], rec.parameters.blend_px, 0.0) for f in frames]])
    return AllDetections(
        uv=np.concatenate([np.zeros((0, 2)), *[f[0] for f in frames]]),
        cov=np.concatenate([np.zeros((0, 2, 2)), *[f[1] for f in frames]]),
        blend_px=blend,
        begin=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        first=np.array([f[3] for f in frames], dtype=np.int64).reshape(-1, cameras + 1),
        has_image=np.array([f[4] for f in frames], dtype=bool).reshape(-1, cameras),
    )


def _first_reference(rec: Recording) -> Reference:
    """The measured poses, what lies between two of them on the straight way, with the velocities of differences."""
    poses, t_s = rec.poses, np.cumsum(rec.dt_s)
    at = np.flatnonzero(rec.measured & np.isfinite(poses[:, 3, 0]))
    frames = len(rec)
    if not len(at):
        centre = np.concatenate([np.eye(3), np.zeros((1, 3))])
        return Reference(np.tile(centre[:3], (frames, 1, 1)), np.tile(centre[3], (frames, 1)), np.zeros((frames, 12)))
    right = np.clip(np.searchsorted(at, np.arange(frames)), 0, len(at) - 1)
    left = np.where(at[right] > np.arange(frames), np.maximum(right - 1, 0), right)
    a, b = at[left], at[right]
    length = t_s[b] - t_s[a]
    share = np.where(length > 0, (t_s - t_s[a]) / np.where(length > 0, length, 1.0), 0.0)
    share = np.clip(share, 0.0, 1.0)  # before the first and after the last: that pose
    before, after = Pose(poses[a, :3], poses[a, 3]), Pose(poses[b, :3], poses[b, 3])
    between = before.plus(after.minus(before) * share[:, None])
    R, t = np.ascontiguousarray(between.rotation), np.ascontiguousarray(between.translation)
    m = np.zeros((frames, 12))
    if frames > 2:
        step = Pose(R[2:], t[2:]).minus(Pose(R[:-2], t[:-2]))
        time = (t_s[2:] - t_s[:-2])[:, None]
        m[1:-1, :6] = step / np.where(time > 0, time, 1.0)
        m[0], m[-1] = m[1], m[-2]
    return Reference(R, t, m)


def _calibration(rec: Recording, every: AllDetections, assigned: Ints, ref: Reference) -> tuple[Array, Array]:
    """What the calibration's errors do: to expected pixels (n, 2, 2), mean over the run, and to poses (T, 6, 6)."""
    n = len(rec.model)
    extra, systematic = np.zeros((n, 2, 2)), np.zeros((1, 6, 6))
    if rec.calibration is None:
        return extra, systematic
    systematic = np.zeros((len(rec), 6, 6))
    count, latest = 0, np.zeros((6, 6))
    for k in range(len(rec)):
        use, uv, cov = labelled_points(every, k, assigned[k], np.zeros_like(extra))
        rows = np.flatnonzero(use)
        if rec.measured[k]:
            fit = fit_pose(rec.model, rows, uv[rows], cov[rows], Pose(ref.R[k], ref.t[k]), calibration=rec.calibration)
            if fit is not None and fit.observable:
                latest = fit.systematic
                extra += fit.calibration_px()
                count += 1
        systematic[k] = latest
    return extra / max(count, 1), systematic


def _noise_scale(
    views: Views, every: AllDetections, assigned: Ints, extra: Array, ref: Reference, measured: Bools
) -> float:
    """How much larger than claimed the spots' errors are: of the frames' own fits, deaf to the worst; 1 if honest."""
    shares = []
    for k in np.flatnonzero(measured).tolist():
        use, uv, cov = labelled_points(every, k, assigned[k], extra)
        _, _, _, chi2, count = fit_alone(views, ref.R[k], ref.t[k], use, uv, cov)
        if count > 3:
            shares.append(chi2 / (2 * count - 6))
    if not shares:
        return 1.0
    mean = float(np.mean(np.minimum(shares, 3 * np.median(shares))))
    return float(np.sqrt(mean)) if mean > DEADBAND else 1.0


def _evidence(
    views: Views,
    every: AllDetections,
    assigned: Ints,
    extra: Array,
    ref: Reference,
    rec: Recording,
    measured: Bools,
    bent: Bools,
    deep: int,
) -> Evidence:
    """The frames' information at a reference, and where the motion may have bent."""
    L, g, _, _ = evidence_of(views, every, assigned, extra, ref)
    # Deep in a gap a frame's few spots leave some direction open, and the reference may be so far off along it that
    # what is straight there is not here: they are not taken.
    far = ~np.asarray(maximum_filter1d(measured.astype(np.int8), 2 * deep + 1, mode="constant"), dtype=bool)
    L[far], g[far] = 0.0, 0.0
    if rec.exposure_s > 0:
        for k in np.flatnonzero(bent[1:] & measured[1:] & measured[:-1]):
            # The light of an exposure in which the velocities jump lies beside the corner, by up to an eighth of the
            # exposure's share of the jump: the same for all spots, as if the vehicle were there.
            b = (ref.m[k + 1, :6] - ref.m[k, :6]) * rec.exposure_s / 8
            Lb = L[k] @ b
            share = 1 / (1 + b @ Lb)
            g[k] -= Lb * (b @ g[k]) * share
            L[k] -= np.outer(Lb, Lb) * share
    dt = rec.dt_s
    usual = float(np.median(dt[dt > 0])) if np.any(dt > 0) else SPEED_WINDOW_S
    window = max(1, min(round(SPEED_WINDOW_S / usual), len(dt)))
    speed = np.stack([np.linalg.norm(ref.m[:, :3], axis=1), np.linalg.norm(ref.m[:, 3:6], axis=1)], axis=1)
    fastest = _running_maximum(np.where(measured[:, None], speed, 0.0), window)
    size = (LEAST_JUMP + JUMP_OF_SPEED * fastest) ** 2
    # After a dark stretch the first light does not tell when it bent, and the second not whether it did so between.
    dark = ~measured
    dark[1:] |= ~measured[:-1]
    dark[2:] |= ~measured[:-2]
    chance = np.where(dark, P_DARK, 0.0)
    for k in np.flatnonzero(bent):
        first = k
        while first > 1 and not measured[first - 1]:
            first -= 1
        # In one of the steps since the frame that was last measured, nobody knows which.
        chance[first : k + 1] = np.maximum(chance[first : k + 1], 1.0 / (k + 1 - first))
    jump = chance[:, None] * size
    return Evidence(L, g, dt, jump, jump / STEADIES_WITHIN_S**2, _before_the_first(ref, dt, bool(measured[0])))


def _before_the_first(ref: Reference, dt: Array, measured: bool) -> Array:
    """(18,) variances of the first frame's deviation: wide against what the run shows, but not so wide that rounding
    would eat what is left after the smoothing.
    """
    speed = np.abs(ref.m[:, :6]).reshape(-1, 2, 3).max(axis=(0, 2), initial=0.0)
    change = np.abs(np.diff(ref.m[:, :6], axis=0)) / np.maximum(dt[1:, None], 1e-9)
    acceleration = change.reshape(-1, 2, 3).max(axis=(0, 2), initial=0.0)
    pose = [0.1, 0.1] if measured else [1.0, 1.0]
    return np.repeat([*pose, *(2 * speed + 0.1), *(2 * acceleration + 1.0)], 3) ** 2


def _running_maximum(values: Array, half: int) -> Array:
    """The largest of values (T, k) within half frames of each."""
    return np.asarray(maximum_filter1d(values, 2 * half + 1, axis=0, mode="nearest"))


def _motion(
    views: Views,
    every: AllDetections,
    assigned: Ints,
    extra: Array,
    ref: Reference,
    rec: Recording,
    measured: Bools,
    bent: Bools,
    deep: int,
    jerk: Array | None,
    learn: bool,
) -> tuple[Reference, Array, Array, Array, Bools]:
    """Gauss-Newton on the whole run: the motion, covariances of poses and velocities, jerk, and what is known.

    jerk (2, 2): logarithms of translation's and rotation's, first for looking ahead, then for filling in. The first is
    the likeliest (of each frame given those before it), the second that under which each frame is best told by all
    others: a motion without jerk at high frequencies, as of all heavy things, is smoother than white jerk of the
    likeliest strength. Measured on sinuous motions: errors 0.75 to 0.9 of those with the first alone; but at a run's
    ends the second looks too far, and was off by 4 sigma. bent (T,): where the velocities jumped; what the smoothing
    finds of them is added to it.
    """
    frames = len(rec)
    strong = jerk is None  # to be estimated (anew)
    pose_P = np.zeros((frames, 6, 6))
    for step in range(MOST_STEPS):
        ev = _evidence(views, every, assigned, extra, ref, rec, measured, bent, deep)
        if strong:
            ahead = _likeliest(log_likelihood, ref, ev, None if jerk is None else jerk[0], MOST_FRAMES_FOR_JERK)
            jerk = np.stack([ahead, ahead])
        assert jerk is not None
        if learn and step > 0 and not strong and np.array_equal(jerk[0], jerk[1]):
            between = _likeliest(told_by_the_others, ref, ev, jerk[0] - FINER, MOST_FRAMES_BETWEEN)
            jerk = np.stack([jerk[0], np.minimum(between, jerk[0] - 1e-6)])
        if np.array_equal(jerk[0], jerk[1]):
            density = np.broadcast_to(np.exp(2 * jerk[0]), (frames, 2)).copy()
        else:
            density = _by_frame(jerk[0], jerk[1], ev, pose_P, measured)
        x, pose_P, motion_P, shock = smoothed(ref, ev, density)
        sd = np.sqrt(np.maximum(np.diagonal(pose_P, axis1=1, axis2=2), 1e-30))
        known = (sd[:, :3].max(axis=1) < LOST_SIGMA_M) & (sd[:, 3:].max(axis=1) < LOST_SIGMA_RAD)
        # A frame of which nothing is known stays where it is: far moves are not linear, and it has no say.
        long = np.abs(x[:, :6]).max(axis=1) > LONGEST_STEP
        x[~known & long] = 0.0
        ref = shifted(ref, x)
        one_jerk = np.array_equal(jerk[0], jerk[1])
        if one_jerk:  # under the other every turn is a shock
            more = _new_bends(shock, bent, measured)
            bent |= more
            strong = learn and bool(more.any() or (strong and step == 0))
        settled = np.all(np.abs(x[known, :6]) < SMALL_STEP * sd[known])
        if step > 0 and settled and not strong and not (learn and one_jerk):
            break
    assert jerk is not None
    return ref, pose_P, motion_P, jerk, known & bool(measured.any())


def _new_bends(shock: Array, bent: Bools, measured: Bools) -> Bools:
    """(T,): steps in which the velocities jumped although nobody said so: the largest shock of their surroundings."""
    peak = shock >= maximum_filter1d(shock, 2 * APART + 1, mode="nearest")
    lit = measured.copy()
    lit[1:] &= measured[:-1]
    return np.asarray(peak & (shock > SHOCK) & lit & ~bent)


def _likeliest(
    criterion: Callable[[Reference, Evidence, Array], float],
    ref: Reference,
    ev: Evidence,
    before: Array | None,
    most_frames: int,
) -> Array:
    """Logarithms of the jerk of translation and rotation for which the criterion is largest.

    before: where to begin; None: nobody knows. Of a long run so many frames from its middle.
    """
    frames = len(ev.dt)
    middle = slice(max(0, (frames - most_frames) // 2), (frames + most_frames) // 2)
    ref = Reference(*(a[middle] for a in ref))
    ev = Evidence(
        ev.information[middle], ev.vector[middle], ev.dt[middle], ev.jump[middle], ev.unsteady[middle], ev.first
    )

    def cost(log_jerk: Array) -> float:
        density = np.exp(2 * np.clip(log_jerk, *np.log(RANGE)))
        value = -criterion(ref, ev, np.broadcast_to(density, (len(ev.dt), 2)).copy())
        return value if np.isfinite(value) else 1e300

    if before is None:
        steps = np.log(10.0) * np.arange(-2.0, 4.0)
        grid = [np.array([a, a + b]) for a in steps for b in np.log([0.5, 3.0, 20.0])]
        before = min(grid, key=cost)
    simplex = before + 0.7 * np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    found = minimize(
        cost,
        before,
        method="Nelder-Mead",
        options={"xatol": 0.1, "fatol": 0.1, "maxiter": 40, "initial_simplex": simplex},
    )
    return np.clip(np.asarray(found.x, dtype=float), *np.log(RANGE))


def _by_frame(ahead: Array, between: Array, ev: Evidence, pose_P: Array, measured: Bools) -> Array:
    """Spectral densities (T, 2): those for looking ahead near the run's ends and gaps, else those for filling in.

    ahead, between (2,): logarithms of the jerk. Near is within the smoother's memory: twice as many frames as it makes
    a mean of.
    """
    share = float(np.median(np.einsum("kij,kji->k", pose_P, ev.information)[measured])) / 6 if measured.any() else 1.0
    memory = int(np.clip(np.ceil(2 / max(share, 1e-3)), 3, 200))
    edge = np.concatenate([[True], ~measured, [True]])
    near = np.asarray(maximum_filter1d(edge.astype(np.int8), 2 * memory + 1, mode="nearest"), dtype=bool)[1:-1]
    return np.exp(2 * np.where(near[:, None], ahead, between))


def _log_clutter(
    rec: Recording, views: Views, sights: Sights, every: AllDetections, assigned: Ints, ref: Reference, known: Bools
) -> Array:
    """(T, n) log density of false points: as counted near spots over the run, or a frame's whole picture's if more."""
    near = clutter_density(views, sights, every, assigned, ref, known, RADIUS_PX)
    model = rec.model
    area = np.array([np.prod(model.image_size_px[model.camera_of == c][:1]) for c in range(len(near))])
    density = np.maximum(np.maximum(near, np.diff(every.first, axis=1) / area), rec.parameters.labels.clutter_per_px2)
    return np.ascontiguousarray(np.log(density)[:, model.camera_of])


def _alone(
    rec: Recording, views: Views, every: AllDetections, assigned: Ints, extra: Array, ref: Reference
) -> tuple[Bools, Array]:
    """Of each frame by itself: whether its spots give the pose, and their root mean square residual, px."""
    frames = len(rec)
    limits = SolveLimits(rec.parameters.max_sigma_m, float(np.deg2rad(rec.parameters.max_sigma_deg)))
    measured, rms = np.zeros(frames, dtype=bool), np.full(frames, np.nan)
    for k in range(frames):
        use, uv, cov = labelled_points(every, k, assigned[k], np.zeros_like(extra))
        if np.count_nonzero(use) < 3:
            continue
        R, t, L, _, _ = fit_alone(views, ref.R[k], ref.t[k], use, uv, cov)
        alone, full = covariance_of(L)
        if full:
            worst = [np.sqrt(np.linalg.eigvalsh(alone[i, i])[-1]) for i in (slice(0, 3), slice(3, 6))]
            measured[k] = worst[0] <= limits.max_sigma_m and worst[1] <= limits.max_sigma_rad
        residual = (uv - project_all(views, R[None], t[None])[0][0])[use]
        rms[k] = np.sqrt(np.nanmean(residual**2))
    return measured, rms
