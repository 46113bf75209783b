"""Checks of `beampose doctor` that need no library: the installation itself."""

from __future__ import annotations

import importlib
import os
import re
import sys
from collections.abc import Mapping, Sequence
from importlib import metadata
from importlib.util import find_spec

from lab.errors import CalibrationError, InputError, RunError
from lab.findings.finding import Finding, Level, finding
from lab.packages import versions

_FILE_CODE, _CALIBRATION_CODE = "BP-D10", "BP-D09"


def line_of(f: Finding) -> str:
    """The line of a check."""
    remedy = f". {f.remedy} [{f.code}]" if f.level > Level.PASS else ""
    return f"{f.level.name:<5}{f.what}{remedy}"


def exit_status(findings: Sequence[Finding]) -> int:
    """Exit status of the command: 0 without a FAIL; 2: a file is wrong; 1: the installation is; 3: a calibration."""
    failed = {f.code for f in findings if f.level is Level.FAIL}
    if _FILE_CODE in failed:
        return InputError.exit_status
    if failed - {_CALIBRATION_CODE}:
        return RunError.exit_status
    return CalibrationError.exit_status if failed else 0


# Checks of Python, of the libraries and of the settings of the environment.


_CV2_PACKAGES = ("opencv-python", "opencv-python-headless", "opencv-contrib-python", "opencv-contrib-python-headless")
# Modules with code of their own, by package: a damaged installation shows only when they are loaded.
_MODULES = {
    "numpy": "numpy", "scipy": "scipy.linalg", "numba": "numba", "opencv-python-headless": "cv2", "isal": "isal",
    "simplejpeg": "simplejpeg", "pydantic": "pydantic", "pandas": "pandas", "pyyaml": "yaml", "jinja2": "jinja2",
}  # fmt: skip
# Variables that change what OpenCV reads: a limit of the picture size, or options of the video decoder.
_OPENCV_VARIABLES = ("OPENCV_IO_MAX_IMAGE_", "OPENCV_FFMPEG_CAPTURE_OPTIONS", "OPENCV_VIDEOIO_PRIORITY", "OPENCV_IPP")
_REQUIREMENT = re.compile(r"^([A-Za-z0-9._-]+)>=([\d.]+)$")


def check_installation() -> list[Finding]:
    """All checks of this module."""
    return [
        check_versions(versions(), requirements()),
        check_libraries(_MODULES),
        check_opencv_packages(installed_packages()),
        check_variables(os.environ),
        check_encoding(sys.getfilesystemencoding()),
        check_point_clouds(),
    ]


def requirements() -> dict[str, str]:
    """Lowest versions that beampose declares, by package; empty if it is not installed as a package."""
    try:
        declared = metadata.requires("beampose") or []
    except metadata.PackageNotFoundError:
        return {}
    return {m[1].lower(): m[2] for text in declared if (m := _REQUIREMENT.match(text.strip()))}


def installed_packages() -> set[str]:
    """Names of the packages of this Python that bring a module `cv2`."""
    found = set()
    for name in _CV2_PACKAGES:
        try:
            metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
        found.add(name)
    return found


def check_versions(found: Mapping[str, str], lowest: Mapping[str, str]) -> Finding:
    """Versions of Python and the libraries. lowest: the declared ones."""
    text = ", ".join(f"{name} {version}" for name, version in found.items())
    old = []
    for name, least in lowest.items():
        version = found.get(name)
        if version is None:
            try:
                version = metadata.version(name)
            except metadata.PackageNotFoundError:
                old.append(f"{name} is missing")
                continue
        if _numbers(version) < _numbers(least):
            old.append(f"{name} {version} is older than {least}")
    if old:
        remedy = "Install beampose again: `python -m pip install --upgrade beampose`"
        return finding("BP-D01", Level.FAIL, f"versions: {'; '.join(old)}", remedy=remedy)
    if not lowest:
        remedy = "Run `make setup`, so that results record the program's version"
        return finding("BP-D01", Level.WARN, f"versions: {text}; beampose is not installed as a package", remedy=remedy)
    return finding("BP-D01", Level.PASS, f"versions: {text}")


def _numbers(version: str) -> tuple[int, ...]:
    return tuple(int(n) for n in re.findall(r"\d+", version.split("+")[0])[:3])


def check_libraries(modules: Mapping[str, str]) -> Finding:
    """Whether the libraries can be loaded. modules: a module of each package."""
    broken = []
    for package, module in modules.items():
        try:
            importlib.import_module(module)
        except Exception as error:  # any: a damaged binary raises what it likes
            broken.append(f"{package} ({type(error).__name__}: {str(error).splitlines()[0] if str(error) else ''})")
    if not broken:
        return finding("BP-D02", Level.PASS, f"libraries: all {len(modules)} can be loaded")
    names = " ".join(text.split(" ")[0] for text in broken)
    remedy = f"Install them again: `python -m pip install --force-reinstall {names}`"
    return finding("BP-D02", Level.FAIL, f"libraries: cannot be loaded: {'; '.join(broken)}", remedy=remedy)


def check_opencv_packages(installed: set[str]) -> Finding:
    """Several OpenCV packages in one Python overwrite each other's files."""
    if len(installed) < 2:
        return finding("BP-D03", Level.PASS, f"OpenCV: one package ({', '.join(installed) or 'none listed'})")
    names = sorted(installed)
    remedy = (
        f"Keep one: `python -m pip uninstall {' '.join(names)}`, then `python -m pip install opencv-python-headless`"
    )
    what = f"OpenCV: {len(names)} packages share the folder cv2 and overwrite each other: {', '.join(names)}"
    return finding("BP-D03", Level.WARN, what, remedy=remedy)


def check_variables(environment: Mapping[str, str]) -> Finding:
    """Variables that change what OpenCV decodes, or that switch the compiled code off."""
    found = [name for name in environment if name.startswith(_OPENCV_VARIABLES)]
    if environment.get("NUMBA_DISABLE_JIT", "0") not in ("", "0"):
        found.append("NUMBA_DISABLE_JIT")
    if not found:
        return finding("BP-D06", Level.PASS, "environment: no variable changes how pictures are read or code is run")
    texts = ", ".join(f"{name}={environment[name]}" for name in sorted(found))
    return finding(
        "BP-D06", Level.WARN, f"environment: {texts}", remedy=f"Unset them, unless they are meant: `unset {found[0]}`"
    )


def check_encoding(encoding: str) -> Finding:
    """The encoding of file names."""
    if encoding.lower().replace("-", "") == "utf8":
        return finding("BP-D11", Level.PASS, "file names: UTF-8")
    remedy = "Set it: `export LC_ALL=C.UTF-8`"
    return finding(
        "BP-D11", Level.WARN, f"file names: {encoding}, other letters than those cannot be opened", remedy=remedy
    )


def check_point_clouds() -> Finding:
    """open3d, which only clouds of points need."""
    if find_spec("open3d") is None:
        return finding("BP-D12", Level.PASS, "open3d: not installed; only point clouds need it")
    return finding("BP-D12", Level.PASS, f"open3d: {metadata.version(_open3d_package())}")


def _open3d_package() -> str:
    names = metadata.packages_distributions().get("open3d", ["open3d"])
    return names[0]
