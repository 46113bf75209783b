"""Opens the pictures of a run."""

from __future__ import annotations

from lab.files.run.run_file import Run
from lab.runs.frames.clocked_frames import ClockedFrames
from lab.runs.frames.frames import FrameReader


def open_frames(run: Run) -> FrameReader:
    """The reader of a run's pictures. Single damaged pictures are no error: they are Missing.

    Raises:
        InputError: a folder is empty or has two pictures of one number, a video or table cannot be read, or a frame has
            no timestamp.
    """
    return ClockedFrames(run) if run.clocks else FrameReader(run)
