"""The check of the set-up as findings: mistakes that a recording shows, or that the numbers of the files show."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from geometry.arrays import evenly_spaced
from geometry.camera import Camera
from geometry.pose_prior import PosePrior
from geometry.rig import Rig
from geometry.rotations import angle
from lab.files.run.run_file import Run, VideoFile
from lab.findings.finding import Finding, Level, finding, sentence, verdict
from lab.number_format import format_number
from lab.pictures.source import video_at
from lab.runs.frames.frames import WRITTEN_BY_DEFAULT, FrameSet
from lab.runs.model_check.frame_sampler import BLOCK, EvenSampler, FrameSampler
from lab.runs.verdict.run_statistics import RunStatistics
from tracking.detections import Detections
from tracking.setup_mistakes.evidence import (
    ENOUGH,
    LEAST_FITTING,
    LEAST_LABELLED,
    LEAST_POINTS,
    Comparison,
    Frames,
    Invisible,
    compare,
    invisible_mistakes,
)
from tracking.setup_mistakes.possible import HERE, SHOWN_BY, Block, possible_mistakes

UNUSED = "BP-M07"  # code of the finding on a camera of which no point is labelled
FRAMES = 2 * ENOUGH  # of a recording, with which mistakes are tested at most
MOST_KEPT = 90  # frames from which they are chosen
FEWEST, PART = 10, 0.6  # points, and the share of width and height that they do not exceed in part of a picture
SAME_RATE = 0.02  # relative difference of frame rates, above which they are not the same
LEAST_SHOWN = 10  # numbers of the rig that a recording must show: four spots at rest agree with many rigs
_WIDEN = "Correct position_m and yaw_pitch_roll_deg of the prior, or make within_m and within_deg larger."
DOUBTFUL = 2  # pictures of a camera without any of its spots, from which on a run that passes is tested, too


@dataclass(slots=True)
class SampledFrames:
    """Sampled frames: blocks at even distances, and those in which points move most."""

    even: EvenSampler[FrameSet] = field(default_factory=lambda: EvenSampler(MOST_KEPT))
    moving: list[tuple[float, int, list[FrameSet]]] = field(default_factory=list)
    _last: list[tuple[float, FrameSet]] = field(default_factory=list)  # how far points have moved, and the frame

    def add(self, number: int, points: Mapping[str, object]) -> None:
        """Add the next frame; pictures that are not points have no motion."""
        here = FrameSet(number, {name: found for name, found in points.items() if isinstance(found, Detections)})
        px = _moved_px(points_in(here), points_in(self._last[-1][1])) if self._last else 0.0
        if not self._last:  # the first frame, to which the prior refers, has a block of its own
            self.even.add(FrameSet(number - 1, {}))
        self.even.add(here)
        self._last = [*self._last[1 - BLOCK :], (px, here)]
        if len(self._last) == BLOCK and (most := max(step for step, _ in self._last[1:])) > 0:
            self.moving.append((most, number, [frame for _, frame in self._last]))
            self.moving = sorted(self.moving, key=lambda one: -one[0])[:FRAMES]

    @property
    def frames(self) -> list[list[FrameSet]]:
        """The blocks, in the order of the recording."""
        blocks = {block[HERE].frame: block for block in [*self.even.blocks, *(one[2] for one in self.moving)]}
        return [blocks[number] for number in sorted(blocks)]

    @property
    def blocks(self) -> list[Block]:
        """The points of the frames."""
        return [[points_in(frame) for frame in block] for block in self.frames]


def points_in(frame: FrameSet) -> dict[str, Detections]:
    """The points of a frame by camera."""
    return {name: found for name, found in frame.images.items() if isinstance(found, Detections)}


def frames_of(blocks: Sequence[Block], prior: PosePrior | None, min_spots: int) -> Frames | None:
    """The frames to be tested: the first, those in which points move most, and others; None without enough points.

    Where a vehicle rests between steps, only the few frames of the steps show that pictures are numbered wrongly.
    """
    counts = np.array([sum(map(len, block[HERE].values())) for block in blocks])
    rows = np.flatnonzero(counts >= min_spots)
    if not len(rows):
        return None
    full = rows[counts[rows] >= np.median(counts[rows])]
    steps = [max(_moved_px(b[HERE], b[0]), _moved_px(b[-1], b[HERE])) for b in blocks]
    moved = full[np.argsort([-steps[i] for i in full], kind="stable")]
    chosen: list[int] = []
    for count in (ENOUGH, FRAMES):
        even = evenly_spaced(full, count)
        chosen = list(dict.fromkeys([*chosen, *rows[rows == 0], *moved[: count // 2], *even]))[:count]
    return Frames([blocks[i] for i in chosen], prior, at_start=bool(chosen[0] == 0))


def _moved_px(here: Mapping[str, Detections], before: Mapping[str, Detections]) -> float:
    """How far a quarter of the points of a camera have moved at most, px; other points may be false."""
    pairs = ((found, before[name]) for name, found in here.items() if name in before)
    away = (np.linalg.norm(a.uv_px[:, None] - b.uv_px, axis=-1).min(axis=1) for a, b in pairs if len(a) and len(b))
    # As np.quantile, which takes .05 ms.
    return max((float(np.interp((len(d) - 1) / 4, np.arange(len(d)), np.sort(d))) for d in away), default=0.0)


def compared_with_mistakes(run: Run, blocks: Sequence[Block]) -> Comparison | None:
    """How well the rig and its possible mistakes explain sampled frames of a recording; None without such frames."""
    frames = frames_of(blocks, run.prior, run.tracker.labels.min_spots)
    return None if frames is None else compare(run.rig, frames, run.tracker.labels, run.covariance)


def recorded_mistakes(run: Run, blocks: Sequence[Block], *, explained: bool = False) -> tuple[Finding, ...]:
    """Findings on mistakes that sampled frames of a recording show.

    explained: whether the rig leaves nothing but random errors of the recording: sigmas of points are then too small.
    """
    compared = compared_with_mistakes(run, blocks)
    if compared is None:
        return ()
    found, given = findings_of(compared, run.rig), compared.given
    if compared.found or given.good or explained:
        return found
    points = dict(zip(run.rig.cameras, given.points.sum(axis=0), strict=True))
    if not given.fits.any() and not all(points[name] for name in run.cameras):
        return ()  # no pose can be expected: a camera shows no point
    seen = [n for n, count in points.items() if count >= LEAST_POINTS * len(given.fits)]
    lenses = same_lenses(run.rig, seen) if given.fits.mean() < LEAST_FITTING else ()
    labelled = (given.fits[:, None] & (given.labelled > 0)).mean(axis=0)
    left = [n for n, share in zip(run.rig.cameras, labelled, strict=True) if share < LEAST_LABELLED and n in seen]
    return (*found, *lenses, *_parts_of_pictures(run.rig, left, blocks))


def _parts_of_pictures(rig: Rig, names: Sequence[str], blocks: Sequence[Block]) -> tuple[Finding, ...]:
    """Findings on cameras whose points all lie in the upper left part of the picture, as in cropped pictures.

    Of a recording that nothing explains: the corner of the crop is not known, so that it cannot be undone.
    names: of the cameras whose points few frames explain.
    """
    out = []
    for name in names:
        camera = rig.cameras[name]
        parts = [block[HERE][name].uv_px for block in blocks if name in block[HERE]]
        uv = np.concatenate(parts) if parts else np.zeros((0, 2))
        if len(uv) < FEWEST or np.any(uv.max(axis=0) > PART * np.array(camera.image_size_px)):
            continue
        (u, v), (width, height) = uv.max(axis=0), camera.image_size_px
        out.append(
            finding(
                "BP-M08",
                Level.WARN,
                f"all points of camera `{name}` lie in the upper left part of its picture (u up to {u:.0f} of {width},"
                f" v up to {v:.0f} of {height}), and the recording does not fit: the pictures may be cropped, or of a"
                " lower resolution than for the calibration",
                why="pixels of another picture are other directions",
                remedy="Compare the size of the pictures with image_size_px and with that of the calibration.",
            )
        )
    return tuple(out)


def mistakes_of_run(
    run: Run,
    statistics: RunStatistics,
    pictures: SampledFrames,
    sampler: FrameSampler,
    *,
    passes: bool,
    explained: bool = False,
) -> tuple[Finding, ...]:
    """Findings on mistakes in the set-up of a run that has been processed.

    passes: whether nothing else is to be reported: the rig then explains the recording. It is tested only where the
    poses hardly use a camera, and for mistakes that its symmetry hides. explained: as in `recorded_mistakes`.
    """
    of_files = (*mistakes_by_themselves(run.rig, run.prior), *rates_of_videos(run))
    if away := away_from_prior(run, statistics):
        of_files = (*of_files, *away)
        if passes:  # the poses do not rest on the prior: other mistakes are tested without it
            run = replace(run, prior=None)
    cameras, unused = statistics.cameras, unused_cameras(statistics)
    if verdict(of_files) is Level.FAIL:
        return of_files
    tested = not passes or unused or has_doubtful_pictures(statistics)
    found = recorded_mistakes(run, pictures.blocks, explained=explained) if tested else ()
    # Where the poses put no spot into a camera's pictures, its points are false ones.
    unused = [n for n in unused if cameras[n].expected or not statistics.measured]
    if passes and not unused and verdict(found) is not Level.FAIL:
        return (*hidden_by_symmetry(run, statistics, sampler), *of_files)
    # Of a run, all pictures show whether a camera is used, not only the sampled ones; without any pose none is.
    others = [f for f in found if f.code != UNUSED]
    if verdict(found) is Level.FAIL or not statistics.measured:
        return (*others, *of_files)
    unlabelled = [unused_finding(n, cameras[n].points, cameras[n].pictures) for n in unused]
    return (*unlabelled, *others, *of_files)


def away_from_prior(run: Run, statistics: RunStatistics) -> tuple[Finding, ...]:
    """The finding on a first frame whose measured pose is outside the prior that run.yaml states."""
    pose = statistics.first_pose
    at_start = statistics.first_measured == statistics.first_frame
    if run.prior is None or pose is None or not at_start or run.prior.contains(pose):
        return ()
    away_m = float(np.abs(pose.translation - run.prior.centre.translation).max())
    turned_deg = np.rad2deg(angle(run.prior.centre.rotation.T @ pose.rotation))
    what = (
        f"the first frame's pose is outside the prior of run.yaml: a coordinate is {away_m:.3g} m from position_m"
        f" (within_m: {run.prior.within_m:g}), the attitude {turned_deg:.3g} deg from that of the prior (within_deg:"
        f" {np.rad2deg(run.prior.within_rad):g})"
    )
    return (finding("BP-M08", Level.WARN, what, why="one of them is wrong", remedy=_WIDEN),)


def unused_cameras(statistics: RunStatistics) -> list[str]:
    """Cameras with points in their pictures, of which no point is labelled."""
    cameras = statistics.cameras.items()
    return [n for n, c in cameras if c.points >= LEAST_POINTS * max(c.pictures, 1) and not c.found]


def has_doubtful_pictures(statistics: RunStatistics) -> bool:
    """Whether a camera has pictures in which none of its spots is found where the poses put it."""
    return any(c.unlabelled + len(c.moved) >= DOUBTFUL for c in statistics.cameras.values())


def hidden_by_symmetry(run: Run, statistics: RunStatistics, sampler: FrameSampler) -> tuple[Finding, ...]:
    """Findings on mistakes with which another first pose within the prior explains a run without truth as well.

    sampler: of the run's frames. Where the rig has a covariance, it may be another one within that.
    """
    if statistics.first_pose is None or (run.folder / "truth" / "pose.csv").exists():
        return ()
    prior, parameters = PosePrior.everywhere(run.rig) if run.prior is None else run.prior, run.tracker.labels
    if run.covariance is not None and (recording := sampler.recording()) is not None:
        from lab.runs.model_check.symmetry import Recorded  # with the refinement: only with a covariance

        given = Recorded.of(run.rig, run.covariance, prior, parameters, recording)
        hidden = [one for one, _ in given.hidden(least=LEAST_SHOWN)]
    else:
        every = invisible_mistakes(run.rig, prior, parameters, statistics.first_pose)
        hidden = [one for one in every if not one.is_harmless]
    return tuple(not_shown(one, "the recording") for one in hidden)


def not_shown(one: Invisible, recording: str) -> Finding:
    """The finding on a mistake that a recording does not show."""
    return finding(
        "BP-M10",
        Level.WARN,
        f"{recording} does not show whether {one.mistake.what}; the first poses would then be wrong by"
        f" {format_number(one.off_m)} m, {format_number(one.off_deg)} deg",
        remedy=f"To exclude it, {SHOWN_BY[one.mistake.kind]}; then make the prior in run.yaml so narrow that it"
        " excludes the other first pose, or give one known pose in truth/pose.csv.",
    )


def rates_of_videos(run: Run) -> tuple[Finding, ...]:
    """Findings on videos whose header states another frame rate than the run, unless the run has timestamps.

    A header of 25 or 30 pictures per second says little: programs write it where nobody states a rate.
    """
    if run.times.frames is not None:
        return ()
    rates = {n: video_at(source.path).rate_hz for n, source in run.cameras.items() if isinstance(source, VideoFile)}
    return tuple(
        finding(
            "BP-M08",
            Level.WARN,
            f"the header of the video of camera `{name}` states {rate:.6g} pictures per second, run.yaml"
            f" {run.frame_rate_hz:.6g}",
            why="velocities and times scale with the frame rate",
            remedy="Correct frame_rate_hz in run.yaml; where the header is wrong, give the times in a table"
            " `timestamps`.",
        )
        for name, rate in rates.items()
        if rate is not None and rate not in WRITTEN_BY_DEFAULT and abs(rate / run.frame_rate_hz - 1) > SAME_RATE
    )


def same_lenses(rig: Rig, names: Sequence[str]) -> tuple[Finding, ...]:
    """Findings on cameras with the same lens to the last digit, of a recording that the rig does not explain.

    names: of the cameras with points.
    """
    groups: dict[tuple[object, ...], list[str]] = {}
    for name in names:
        groups.setdefault(_lens(rig.cameras[name]), []).append(f"`{name}`")
    alike = (f"{', '.join(same[:-1])} and {same[-1]}" for same in groups.values() if len(same) > 1)
    return tuple(
        finding(
            "BP-M08",
            Level.WARN,
            f"cameras {cameras} have the same lens to the last digit, and the recording does not fit: one of them may"
            " have the wrong camera.yaml",
            why="two calibrations never agree to the last digit",
            remedy=f"Compare camera_matrix and distortion of {cameras} with their camera.yaml.",
        )
        for cameras in alike
    )


def _lens(camera: Camera) -> tuple[object, ...]:
    return (camera.matrix.tobytes(), camera.distortion, camera.lens)


def mistakes_by_themselves(rig: Rig, prior: PosePrior | None) -> tuple[Finding, ...]:
    """Findings on numbers of the files that cannot be those of a lab."""
    return tuple(
        finding("BP-M06", Level.FAIL, m.what, why="no lab has such numbers", remedy=sentence(m.remedy))
        for m in possible_mistakes(rig, prior)
        if m.by_itself
    )


def findings_of(compared: Comparison, rig: Rig) -> tuple[Finding, ...]:
    """Findings on mistakes that explain frames better, or on cameras whose points the rig does not explain."""
    given = compared.given
    if compared.found:
        best = compared.found[0][1]
        count = len(best.fits)
        why = (
            f"without this mistake {best.labelled.sum()} of {best.points.sum()} points in {count} sampled frames fit a"
            f" pose; with the files as given {given.labelled[given.fits].sum()}. The poses are wrong, or do not use"
            " this camera"
        )
        what = ", or ".join(m.what for m, _ in compared.found)
        remedies = dict.fromkeys(m.remedy for m, _ in compared.found)
        return (finding("BP-M06", Level.FAIL, what, why=why, remedy=sentence("; or ".join(remedies))),)
    if given.good:
        return ()
    names, points, expected = list(rig.cameras), given.points.sum(axis=0), given.expected.sum(axis=0)
    few = [c for c in given.with_few_labels() if expected[c] or not given.fits.any()]
    return tuple(unused_finding(names[c], int(points[c]), len(given.fits)) for c in few)


def unused_finding(camera: str, points: int, pictures: int) -> Finding:
    """The finding on a camera of which no point is ever labelled."""
    what = f"camera `{camera}`: none of its {points} points in {pictures} pictures is the spot of a pose"
    return finding(UNUSED, Level.WARN, what)
