"""Runs processed and simulated from Python."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import pandas as pd

from lab.api.results import Results
from lab.files.text.dataclass_fields import with_overrides
from lab.progress import Progress
from lab.runs.process import process_run
from lab.simulate.scenarios import SCENARIOS
from lab.simulate.write import simulate
from tracking.parameters import TrackerParameters


def process(
    run_folder: Path | str,
    out: Path | str | None = None,
    *,
    causal: bool = False,
    progress: Progress | None = None,
    **settings: Any,
) -> Results:
    """Process a run folder as `beampose run` does, and return its results.

    out: the results folder, which is replaced; None: a temporary folder that lasts as long as the returned object.
    causal: without the smoothing pass. settings: tracker parameters in place of those of run.yaml; of inner blocks as
    `**{"detect.threshold_sigma": 5}`. progress: called with frames done, frames in all (or None) and the stage.

    >>> run = lab.process(run_folder, causal=True, r1_px=12)
    >>> run.summary["parameters"]["tracker"]["r1_px"]
    12.0

    Raises:
        InputError: the run folder or a setting is wrong.
        CalibrationError: the rig's calibration must not be used.
        RunError: the run could not be processed.
    """
    with_overrides(TrackerParameters(), settings, "settings")  # a mistake is named in terms of this call
    keep = tempfile.TemporaryDirectory(prefix="beampose-") if out is None else None
    folder = Path(keep.name) / "results" if keep is not None else Path(str(out))
    process_run(Path(run_folder), folder, overrides=settings, causal=causal, progress=progress)
    return Results(folder, Path(run_folder).resolve(), keep)


def simulate_run(
    scenario: str,
    out: Path | str,
    *,
    seed: int = 0,
    frames: int | None = None,
    points: bool = False,
    noise_px: float = 0.1,
    scale: float = 1.0,
    video: bool = False,
    rig: Path | str | None = None,
    trajectory: Path | str | None = None,
    rate_hz: float | None = None,
    exposure_s: float | None = None,
    light: str | None = None,
) -> Path:
    """Write a simulated recording with its truth into a new run folder, as `beampose simulate` does; returns it.

    scenario: a name of `lab.scenarios()`. frames: default: those of the scenario. points: no pictures, but a
    detections.csv with a noise of `noise_px`. scale: 0.5: pictures half as wide. video: a video per camera. rig: a
    rig.yaml of one's own; the motion is moved into its view. trajectory: a table of poses (columns of truth/pose.csv)
    instead of the scenario's motion. rate_hz, exposure_s, light: instead of the scenario's.

    >>> made = lab.simulate_run("sharp-turns", new_folder, frames=3, points=True)
    >>> sorted(path.name for path in made.iterdir())
    ['detections.csv', 'rig.yaml', 'run.yaml', 'truth']

    Raises:
        InputError: an argument is not valid, or the folder exists.
    """
    return simulate(
        scenario,
        Path(out),
        seed=seed,
        frames=frames,
        detections_only=points,
        noise_px=noise_px,
        picture_scale=scale,
        video=video,
        rig=None if rig is None else Path(rig),
        trajectory=None if trajectory is None else Path(trajectory),
        frame_rate_hz=rate_hz,
        exposure_s=exposure_s,
        light=light,
    )


def scenarios() -> pd.Series:
    """The scenarios of the simulator: what each is, by name.

    >>> "sharp-turns" in lab.scenarios()
    True
    """
    return pd.Series({s.name: s.summary for s in SCENARIOS.values()}, name="scenario")
