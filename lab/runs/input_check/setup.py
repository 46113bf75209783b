"""`beampose check`: mistakes that the files or the recording show, and those that no recording would show."""

from __future__ import annotations

import numpy as np

from geometry.pose_prior import PosePrior
from geometry.rig import Rig
from lab.files.run.run_file import DetectionsTable, Run
from lab.findings.finding import Level
from lab.number_format import format_number
from lab.runs.frames.even_sampler import EvenSampler
from lab.runs.frames.frames import FrameSet, pictures_at
from lab.runs.input_check.findings import Findings
from lab.runs.setup_check.check import FRAMES, mistakes_by_themselves, rates_of_videos, recorded_mistakes
from tracking.detections import Detections
from tracking.parameters import LabelParameters
from tracking.setup_mistakes.invisible import Invisible, invisible_mistakes
from tracking.setup_mistakes.mistake import SHOWN_BY, Block


def check_rig(
    findings: Findings, rig: Rig, prior: PosePrior | None, parameters: LabelParameters, with_truth: bool = False
) -> None:
    """Numbers that no lab has, and mistakes that the symmetry of the rig hides unless there are true poses."""
    impossible = mistakes_by_themselves(rig, prior)
    findings.problems += [f"{f.what}; {f.why}. {f.remedy} ({f.code})" for f in impossible]
    if impossible:
        return
    kinds: dict[str, list[Invisible]] = {}
    only_names = []
    for one in invisible_mistakes(rig, prior, parameters):
        if one.is_harmless:
            only_names.append(one.mistake.what.removesuffix(" are exchanged"))
        else:
            kinds.setdefault(one.mistake.kind, []).append(one)
    if only_names:
        findings.facts.append(
            f"Exchanged names of {', of '.join(only_names)}, or of two spots of a screen: no recording shows them; the"
            " poses are the same"
        )
    if with_truth:
        return
    for kind, those in kinds.items():
        what = "; or ".join(
            f"{one.mistake.what} (poses wrong by {format_number(one.off_m)} m, {format_number(one.off_deg)} deg)"
            for one in those
        )
        findings.remarks.append(
            f"no recording with this rig would show, because it is symmetric, that {what}. To exclude it,"
            f" {SHOWN_BY[kind]}; or give the pose of a frame, measured otherwise, in truth/pose.csv"
        )


def check_recording(findings: Findings, run: Run, sampler: EvenSampler[FrameSet]) -> None:
    """Mistakes that a sample of the recording shows."""
    for f in (*recorded_mistakes(run, _blocks(run, sampler)), *rates_of_videos(run)):
        text = f"{f.what}; {f.why}. {f.remedy} ({f.code})"
        (findings.problems if f.level is Level.FAIL else findings.remarks).append(text)


def _blocks(run: Run, sampler: EvenSampler[FrameSet]) -> list[Block]:
    """The points of sampled frames; those of pictures are detected."""
    blocks = sampler.blocks
    filmed = [name for name, source in run.cameras.items() if not isinstance(source, DetectionsTable)]
    if filmed and blocks:
        chosen = np.unique(np.linspace(0, len(blocks) - 1, FRAMES).round().astype(int))
        blocks = [blocks[i] for i in chosen]
    numbers = [frame.frame for block in blocks for frame in block]
    found = _detected(run, filmed, numbers) if filmed else {}
    return [[_points(frame) | found.get(frame.frame, {}) for frame in block] for block in blocks]


def _points(frame: FrameSet) -> dict[str, Detections]:
    return {name: points for name, points in frame.images.items() if isinstance(points, Detections)}


def _detected(run: Run, cameras: list[str], frames: list[int]) -> dict[int, dict[str, Detections]]:
    """The points in some pictures, by frame and camera."""
    from lab.runs.frames.pipeline import Pipeline  # with the tracker and the detection: only for pictures

    pipeline = Pipeline.of(run)
    out: dict[int, dict[str, Detections]] = {}
    for camera in cameras:
        for frame, picture in pictures_at(run, camera, frames).items():
            if isinstance(picture, np.ndarray):
                out.setdefault(frame, {})[camera] = pipeline.spots_in(camera, picture)
    return out
