"""The check of the set-up as findings: mistakes that a recording shows, or that the numbers of the files show."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from calibration.findings import Finding, Level
from geometry.pose_prior import PosePrior
from geometry.rig import Rig
from lab.files.run.run_file import Run
from lab.runs.even_sampler import EvenSampler
from lab.runs.verdict.run_statistics import RunStatistics
from tracking.detections import Detections
from tracking.setup_mistakes.evidence import LEAST_POINTS, Comparison, Frames, compare
from tracking.setup_mistakes.mistake import HERE, Block
from tracking.setup_mistakes.possible import possible_mistakes

FRAMES = 6  # of a recording, with which mistakes are tested
MOST_KEPT = 90  # frames from which they are chosen
MISTAKE, UNUSED = "BP-M06", "BP-M07"  # codes
Pictures = EvenSampler[Mapping[str, Detections]]  # the points of each frame, by camera


def pictures_sampler() -> Pictures:
    """An empty sampler of the points of a recording."""
    return EvenSampler(MOST_KEPT)


def frames_of(blocks: Sequence[Block], prior: PosePrior | None, min_spots: int) -> Frames | None:
    """The frames to be tested: the first, and others with many points; None where none has enough points."""
    counts = np.array([sum(map(len, block[HERE].values())) for block in blocks])
    rows = np.flatnonzero(counts >= min_spots)
    if not len(rows):
        return None
    full = rows[counts[rows] >= np.median(counts[rows])]
    chosen = full[np.unique(np.linspace(0, len(full) - 1, FRAMES).round().astype(int))]
    if rows[0] == 0:
        chosen = np.unique([0, *chosen])[:FRAMES]
    return Frames([blocks[i] for i in chosen], prior, at_start=bool(chosen[0] == 0))


def recorded_mistakes(run: Run, blocks: Sequence[Block]) -> tuple[Finding, ...]:
    """Findings on mistakes that sampled frames of a recording show."""
    frames = frames_of(blocks, run.prior, run.tracker.labels.min_spots)
    if frames is None:
        return ()
    return _findings(compare(run.rig, frames, run.tracker.labels, run.covariance), run.rig)


def mistakes_of_run(run: Run, statistics: RunStatistics, pictures: Pictures, *, passes: bool) -> tuple[Finding, ...]:
    """Findings on mistakes in the set-up of a run that has been processed.

    passes: whether nothing else is to be reported: the rig then explains the recording, and only cameras that the poses
    do not use are tested.
    """
    by_themselves = mistakes_by_themselves(run.rig, run.prior)
    unused = [n for n, c in statistics.cameras.items() if c.points >= LEAST_POINTS * max(c.pictures, 1) and not c.found]
    if by_themselves or (passes and not unused):
        return by_themselves
    found = recorded_mistakes(run, pictures.blocks)
    named = tuple(f for f in found if f.code == MISTAKE)
    if named or not statistics.measured:
        return named
    return tuple(unused_finding(n, statistics.cameras[n].points, statistics.cameras[n].pictures) for n in unused)


def mistakes_by_themselves(rig: Rig, prior: PosePrior | None) -> tuple[Finding, ...]:
    """Findings on numbers of the files that cannot be those of a lab."""
    return tuple(
        Finding(Level.FAIL, m.what, "no lab has such numbers", _sentence(m.remedy), MISTAKE)
        for m in possible_mistakes(rig, prior)
        if m.by_itself
    )


def _findings(compared: Comparison, rig: Rig) -> tuple[Finding, ...]:
    given = compared.given
    if compared.found:
        best = compared.found[0][1]
        count = len(best.fits)
        why = (
            f"without this mistake {best.labelled.sum()} of {best.points.sum()} points in {count} sampled frames fit a"
            f" pose; with the files as given {given.labelled[given.fits].sum()}. The poses are wrong, or do not use this"
            " camera"
        )
        what = ", or ".join(m.what for m, _ in compared.found)
        remedies = dict.fromkeys(m.remedy for m, _ in compared.found)
        return (Finding(Level.FAIL, what, why, _sentence("; or ".join(remedies)), MISTAKE),)
    names, points = list(rig.cameras), given.points.sum(axis=0)
    return tuple(unused_finding(names[c], int(points[c]), len(given.fits)) for c in given.with_few_labels())


def unused_finding(camera: str, points: int, pictures: int) -> Finding:
    """The finding on a camera of which no point is ever labelled."""
    return Finding(
        Level.WARN,
        f"camera `{camera}`: none of its {points} points in {pictures} pictures is the spot of a pose",
        "the poses do not use this camera, and none of the usual mistakes explains it",
        f"Check that the pictures and camera_matrix, camera_from_world and the screen of `{camera}` belong together"
        " (`beampose calibrate check`), or leave the camera out.",
        UNUSED,
    )


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:]}."
