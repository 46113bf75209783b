"""OpenCV's predefined dictionaries of ArUco markers."""

from __future__ import annotations

import difflib

import cv2

_FAMILIES = "DICT_4X4_50 (_100, _250, _1000), likewise DICT_5X5_, DICT_6X6_ and DICT_7X7_, and DICT_APRILTAG_36h11"


class DictionaryError(ValueError):
    """An unknown dictionary of markers."""


def _dictionaries() -> dict[str, int]:
    """OpenCV's predefined dictionaries by name; of names for the same one (36H11, 36h11), the lower case."""
    by_number: dict[int, str] = {}
    for name in sorted(n for n in dir(cv2.aruco) if n.startswith("DICT_")):  # upper case sorts first
        by_number[int(getattr(cv2.aruco, name))] = name
    return {by_number[number]: number for number in sorted(by_number)}


DICTIONARIES = _dictionaries()  # name -> OpenCV's number, in OpenCV's order


def dictionary_name(text: str) -> str:
    """OpenCV's name of a dictionary of ArUco markers, from a name in any case.

    Raises:
        ValueError: there is no such dictionary; the message gives similar names.
    """
    by_lower = {name.lower(): name for name in DICTIONARIES}
    if text.lower() in by_lower:
        return by_lower[text.lower()]
    if f"dict_{text.lower()}" in by_lower:
        return by_lower[f"dict_{text.lower()}"]
    near = difflib.get_close_matches(text.lower(), by_lower, n=2, cutoff=0.6)
    hint = f"did you mean {' or '.join(by_lower[n] for n in near)}? " if near else ""
    raise DictionaryError(f"expected one of OpenCV's dictionaries, got {text!r}; {hint}there are {_FAMILIES}")


def dictionary_size(name: str) -> int:
    """Number of markers of a dictionary."""
    return len(cv2.aruco.getPredefinedDictionary(DICTIONARIES[name]).bytesList)
