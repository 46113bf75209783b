"""Colour pictures of a recording, and the colour that the user names."""

from __future__ import annotations

from collections.abc import Iterator

from lab.detect.inputs import PictureFiles, Video
from lab.errors import InputError
from lab.pictures.colour import ColourPicture, colour_of, read_colour
from lab.pictures.picture_file import UNREADABLE, MissingPicture
from lab.runs.frames.frame_sources import open_video
from tracking.single_target.colour import HUES, hue_of

COLOUR = "colour"  # the detector


def hue_named(name: str | None) -> float:
    """Hue, degrees, of a name or of #rrggbb.

    Raises:
        InputError: there is no such colour, or it is a grey.
    """
    known = f"{', '.join(HUES)}, or #rrggbb such as #d02030"
    if name is None:
        raise InputError(f"--detector {COLOUR}: expected --colour with {known}, got none")
    if name in HUES:
        return HUES[name]
    digits = name.removeprefix("#")
    if not (name.startswith("#") and len(digits) == 6 and all(c in "0123456789abcdefABCDEF" for c in digits)):
        raise InputError(f"--colour: expected {known}, got {name!r}")
    red, green, blue = (float(int(digits[i : i + 2], 16)) for i in (0, 2, 4))
    hue = hue_of((blue, green, red))
    if hue is None:
        raise InputError(f"--colour: expected a colour, got the grey {name}; use --detector darker or brighter")
    return hue


def colour_pictures(inputs: PictureFiles | Video) -> Iterator[tuple[int, ColourPicture | MissingPicture]]:
    """All pictures with their frame numbers, (h, w, 3), BGR, 8 bits."""
    if isinstance(inputs, PictureFiles):
        for number, path in inputs.files:
            yield number, read_colour(path, None)
        return
    capture = open_video(inputs.path, colour=True)
    try:
        number = 0
        while capture.grab():
            decoded, picture = capture.retrieve()
            usable = decoded and picture is not None
            yield number, colour_of(picture, None) if usable else MissingPicture(f"{UNREADABLE}: damaged")
            number += 1
    finally:
        capture.release()
