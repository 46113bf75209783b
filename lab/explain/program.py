"""Explanations of errors (BP-E), of `beampose doctor` (BP-D) and of `beampose plan` (BP-P)."""

from __future__ import annotations

from lab.explain.explanation import Explanation, Explanations

ERRORS: Explanations = {
    "BP-E01": Explanation(
        "A run could not be processed (exit status 1)",
        "The command ended with an error during its work. Earlier results are unchanged.",
        "Read the line on standard error: it names the file and the remedy.",
    ),
    "BP-E02": Explanation(
        "Wrong command, file or configuration (exit status 2)",
        "An argument or a file is not as expected. Nothing was written.",
        "Correct what the line names (file, field, expected, found). `beampose check` lists all mistakes of a run"
        " folder or rig.yaml at once.",
    ),
    "BP-E03": Explanation(
        "The calibration must not be used (exit status 3)",
        "The verdict of the calibration is FAIL, or its expiry date is before the recording.",
        "Calibrate again (`beampose calibrate rig`), or confirm the calibration (`beampose calibrate check`) and"
        " set a new date in rig.yaml.",
    ),
    "BP-E04": Explanation(
        "Processed, but a quality gate failed (exit status 4)",
        "The results are complete, but must not be used as they are. The verdict in summary.json and in the"
        " report lists the reasons with codes BP-V01 to BP-V17.",
        "Act on the first reason of the verdict.",
    ),
}

DOCTOR: Explanations = {
    "BP-D01": Explanation(
        "Versions",
        "A library is missing or older than beampose needs, or beampose runs from a folder without being installed.",
        "Install beampose again with pip, or run `make setup`.",
    ),
    "BP-D02": Explanation(
        "A library cannot be loaded",
        "A library is installed, but its code does not load: a damaged installation or a missing system library.",
        "Install it again with `pip install --force-reinstall`.",
    ),
    "BP-D03": Explanation(
        "Several OpenCV packages",
        "Packages such as opencv-python and opencv-python-headless share one folder and overwrite each other's"
        " files. Which version works is a matter of chance.",
        "Uninstall all of them, then install opencv-python-headless.",
    ),
    "BP-D04": Explanation(
        "Picture formats",
        "OpenCV cannot write and read back a picture format that beampose uses.",
        "Install opencv-python-headless from PyPI again.",
    ),
    "BP-D05": Explanation(
        "Video formats",
        "OpenCV cannot write and read back a video format. Recordings in this format cannot be processed.",
        "Install opencv-python-headless from PyPI, or convert videos to folders of pictures.",
    ),
    "BP-D06": Explanation(
        "Environment variables",
        "A variable of the environment changes how OpenCV reads pictures, or switches the compilation off, which"
        " is a hundred times slower.",
        "Unset it, unless it is meant.",
    ),
    "BP-D07": Explanation(
        "Compiled code",
        "Code is compiled at its first use and then kept. It is not there yet, or no folder is writable for you"
        " alone, so that each run compiles again.",
        "Run `python -m lab.runs.warm_up`; make ~/.cache or the temporary folder writable.",
    ),
    "BP-D08": Explanation(
        "Disk space",
        "Little space is left on a disk that runs write to. A full disk ends a run with an error; earlier results"
        " are kept.",
        "Free some space, or use another disk (--out, TMPDIR).",
    ),
    "BP-D09": Explanation(
        "Age of a calibration",
        "A calibration has failed, has expired or will soon, is old, or states no date.",
        "Confirm it with `beampose calibrate check`, or calibrate again.",
    ),
    "BP-D10": Explanation(
        "A calibration file cannot be read",
        "The file is missing or has a mistake.",
        "Correct what the line names; `beampose check` lists all mistakes of a rig.yaml.",
    ),
    "BP-D11": Explanation(
        "File names",
        "The system does not use UTF-8 for file names.",
        "Set a UTF-8 locale, such as C.UTF-8.",
    ),
    "BP-D12": Explanation(
        "open3d",
        "Whether the library for point clouds and 3-D views is installed.",
        "Nothing; a run does not need it.",
    ),
    "BP-D13": Explanation(
        "Processors",
        "The processors that OpenCV uses. Results do not depend on their number.",
        "Nothing.",
    ),
}

PLAN: Explanations = {
    "BP-P01": Explanation(
        "No pose can be measured",
        "At no pose of the grid are enough spots in the pictures.",
        "Check that the ranges are where the vehicle will be, and the poses of cameras and screens.",
    ),
    "BP-P02": Explanation(
        "Some poses cannot be measured",
        "At some poses too few spots are in the pictures, or the pose is too uncertain. A run has no measured"
        " pose there.",
        "Move or turn the cameras that lose spots, use wider lenses, or add a beam.",
    ),
    "BP-P03": Explanation(
        "Poses with three spots only",
        "Three spots fit any labels, so that a wrong label is not detected.",
        "Keep a fourth spot in view: a wider lens, or one more beam.",
    ),
    "BP-P04": Explanation(
        "A spot is often out of view",
        "At many poses this spot is outside its picture.",
        "Turn or move that camera, or use a wider lens.",
    ),
    "BP-P05": Explanation(
        "Spots touch",
        "Two spots of one picture come so close that they are detected as one.",
        "Spread the beams, or turn one of them out of the plane of the others.",
    ),
    "BP-P06": Explanation(
        "The goal is not reached everywhere",
        "At some poses the sigma exceeds the stated goal.",
        "Improve the largest contribution in the error budget, or narrow the range.",
    ),
}
