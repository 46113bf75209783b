"""Makes the sample runs: `python sample_runs/make.py [NAME ...] --out FOLDER`.

Each is one call of the simulator, as `beampose simulate` makes it. With the versions of numpy and OpenCV in
requirements.lock the bytes are those of this folder.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any

from lab.calibrate.rig.rig import RIG, calibrate_rig
from lab.simulate.campaign import PROJECT, simulate_calibration
from lab.simulate.write import simulate

# Light "quiet" (unlit room, low-noise sensor) keeps the files small: most pixels show the black level. A picture of
# the light "lab" is thirty times as large, so of that kind there are few, and at half the size.
SAMPLES: dict[str, dict[str, Any]] = {
    "huo2015": {"scenario": "huo2015", "seed": 19, "frames": 220, "light": "quiet"},
    "sharp-turns": {"scenario": "sharp-turns", "seed": 1, "frames": 30, "scale": 0.5},
    "damaged": {"scenario": "damaged", "seed": 2, "frames": 80, "light": "quiet", "scale": 0.5},
    "turntable-video": {
        "scenario": "turntable", "seed": 3, "frames": 240, "light": "quiet", "scale": 0.5, "video": True,
    },
    "four-skew-beams": {"scenario": "four-skew-beams", "seed": 4, "frames": 300, "points": True},
    "calibrated": {"scenario": "huo2015", "seed": 6, "frames": 300, "points": True},
}  # fmt: skip
CALIBRATION, CALIBRATION_SEED = "calibration", 6  # the campaign; the run `calibrated` is of its true rig
HERE = Path(__file__).resolve().parent


def make(name: str, folder: Path) -> Path:
    """Write one sample run, or the calibration, into a new folder."""
    if name == CALIBRATION:
        return simulate_calibration(folder, seed=CALIBRATION_SEED)
    if name != "calibrated":
        return simulate(out=folder, **SAMPLES[name])
    # A recording of the rig as it truly is, given what the calibration knows of it.
    with tempfile.TemporaryDirectory() as work:
        campaign = HERE / CALIBRATION
        calibrate_rig(campaign / PROJECT, Path(work) / "rig")
        known = Path(work) / "rig" / RIG
        return simulate(out=folder, rig=campaign / "truth" / RIG, known_rig=known, **SAMPLES[name])


def main() -> None:
    """Make the samples that are named, or all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(SAMPLES)}; all where none is given")
    parser.add_argument("--out", type=Path, required=True, help="folder that gets a new folder for each sample")
    arguments = parser.parse_args()
    known = (CALIBRATION, *SAMPLES)
    unknown = [name for name in arguments.names if name not in known]
    if unknown:
        parser.error(f"expected one of {', '.join(known)}, got {unknown[0]!r}")
    for name in arguments.names or known:
        print(make(name, arguments.out / name))


if __name__ == "__main__":
    main()
