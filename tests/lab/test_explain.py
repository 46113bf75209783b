"""Every warning, verdict reason, finding and error has a code, and every code an explanation."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator

import numpy as np
import pytest

from calibration.lens.fit.lens_fit import CORNER_GATE
from lab import errors
from lab.calibrate.beams.beams_page import ARCSEC, BeamGoals
from lab.calibrate.camera.pair import GOOD_RANGE_SHARE
from lab.calibrate.rig.rig_page import RigLimits
from lab.calibrate.screens.screen_page import ScreenLimits
from lab.errors import InputError
from lab.findings.finding import Finding, Level, entries, explain, finding, listed, sections
from lab.runs.verdict import quality
from lab.runs.verdict.score import KNOWN_TO
from tests.paths import ROOT
from tracking.background.camera_motion import FARTHEST_PX
from tracking.light_tracker.frames import LightParameters

CODE = re.compile(r"BP-[A-Z]\d\d")


def sources() -> Iterator[tuple[str, str]]:
    for path in sorted((ROOT / "lab").rglob("*.py")):
        if "lab/findings" not in path.as_posix():
            yield path.relative_to(ROOT).as_posix(), path.read_text("utf-8")


def without_code(name: str, text: str) -> list[str]:
    """Calls that make a finding without a literal code, one of a table `codes` or one of a loop over literal codes."""
    wrong = []
    for node in ast.walk(ast.parse(text)):
        if not (isinstance(node, ast.Call) and isinstance(node.func, ast.Name)):
            continue
        if node.func.id == "Finding" or (node.func.id == "finding" and not CODE.fullmatch(_code(node, text))):
            wrong.append(f"{name}:{node.lineno}")
    return wrong


def _code(call: ast.Call, text: str) -> str:
    """The code of a call, or one that the text shows for the name that it is given."""
    given = call.args[0] if call.args else ast.Constant("")
    if isinstance(given, ast.Constant):
        return str(given.value)
    if isinstance(given, ast.Attribute) and ast.unparse(given.value).endswith("codes"):
        return "BP-A00"
    return "BP-A00" if re.search(rf'{re.escape(ast.unparse(given))} = "BP-|for {ast.unparse(given)}, ', text) else ""


def codes_in_use() -> set[str]:
    return {code for _, text in sources() for code in CODE.findall(text)}


FROM_SUMMARIES = {"lab/report/summary.py"}  # reads findings that were written with their codes


def test_every_finding_that_may_be_a_warning_has_a_code():
    found = [wrong for name, text in sources() if name not in FROM_SUMMARIES for wrong in without_code(name, text)]
    assert found == []


@pytest.mark.parametrize(
    "call", ["Finding(Level.WARN, 'x')", "finding(code, level, 'x')", "finding('', Level.WARN, 'x')"]
)
def test_a_finding_without_a_code_is_found(call):
    assert without_code("here.py", call) == ["here.py:1"]
    assert without_code("here.py", "passed('x')\nfinding('BP-B01', Level.FAIL, 'x')") == []
    assert without_code("here.py", "finding(target.codes.few, Level.WARN, 'x')") == []


def test_every_code_in_use_is_explained_and_every_explained_code_is_in_use():
    assert codes_in_use() - set(entries()) == set()
    assert set(entries()) - codes_in_use() - set(sections()["Errors"]) == {"BP-V17"}  # of results of older versions


def test_every_kind_of_verdict_reason_has_its_own_code():
    own = [entry.kind for entry in sections()["Verdict of a run"].values()]
    assert all(own)
    assert len(set(own)) == len(own)
    assert {entry.kind for entry in sections()["Model check of a run"].values()} == {"model"}


def test_the_codes_of_verdict_reasons_never_change():
    first = ["no_frames", "never_found", "few_measured", "no_pictures", "camera_late", "camera_stopped"]
    first += ["missing_pictures", "nothing_detected", "few_points", "not_acquired", "not_confirmed", "ambiguous"]
    first += ["lost", "contradiction", "internal", "noise_scale", "model"]
    for number, kind in enumerate(first, start=1):
        assert entries()[f"BP-V{number:02d}"].kind == kind


def test_a_finding_in_a_summary_has_its_code_and_the_kind_of_it():
    for code, kind in (("BP-M03", "model"), ("BP-V13", "lost"), ("BP-W01", "")):
        mapping = finding(code, Level.WARN, "what").as_mapping()
        assert (mapping["code"], mapping["kind"], mapping["level"]) == (code, kind, "check")


def test_every_class_of_error_has_the_code_of_its_exit_status():
    classes = [c for c in vars(errors).values() if isinstance(c, type) and issubclass(c, errors.BeamposeError)]
    assert len(classes) == 4
    for c in classes:
        assert c.code == f"BP-E0{c.exit_status}"
        assert f"exit status {c.exit_status}" in entries()[c.code].title
    assert f"exit status {errors.QUALITY_GATE_FAILED}" in entries()["BP-E04"].title


def test_a_code_belongs_to_one_section_and_has_all_texts():
    assert sum(map(len, sections().values())) == len(entries())
    for code, text in entries().items():
        assert CODE.fullmatch(code)
        assert min(map(len, (text.title, text.meaning, text.remedy))) > 3
        assert text.meaning.endswith(".")
        assert text.remedy.endswith(".")


@pytest.mark.parametrize("typed", ["BP-V03", "bp-v03", "V03", "v3"])
def test_a_code_is_explained_however_it_is_typed(typed):
    assert explain(typed).startswith("BP-V03  Few frames with a measured pose\n")


def test_a_code_that_does_not_exist_is_an_input_error():
    with pytest.raises(InputError, match="expected a code such as BP-V03, got 'BP-V99'"):
        explain("BP-V99")


def test_the_list_has_every_code():
    assert set(CODE.findall("\n".join(listed()))) == set(entries())


def test_a_finding_has_the_texts_of_its_code_or_variant_unless_others_are_given():
    of_code = entries()["BP-C09"]
    assert finding("BP-C09", Level.WARN, "a") == Finding(Level.WARN, "a", of_code.meaning, of_code.remedy, "BP-C09")
    laser = finding("BP-C09", Level.WARN, "a", variant="laser")
    assert laser.remedy == of_code.variants["laser"]["remedy"] != of_code.remedy
    assert finding("BP-C09", Level.WARN, "a", why="b", remedy="c", variant="laser").remedy == "c"


def test_a_finding_that_passes_keeps_its_code_and_drops_its_remedy():
    assert finding("BP-B01", Level.PASS, "a", remedy="c") == Finding(Level.PASS, "a", code="BP-B01")


SCREEN, BEAM, RIG = ScreenLimits(), BeamGoals(), RigLimits()


@pytest.mark.parametrize(
    ("code", "words", "limits"),
    [
        ("BP-V03", "below {} %", [100 * quality.GOOD_MEASURED]),
        ("BP-V07", "More than {} %", [100 * (1 - quality.GOOD_PICTURES)]),
        ("BP-V19.pictures", "up to {} px", [FARTHEST_PX]),
        ("BP-V20", "{} mm and {} mrad", [1e3 * KNOWN_TO, 1e3 * KNOWN_TO]),
        ("BP-V20", "more than {} %", [100 * quality.MOST_WRONG]),
        ("BP-S02", "above {} times, FAIL above {} times", [SCREEN.factor_warn, SCREEN.factor_fail]),
        ("BP-S04", "More than {} %", [100 * SCREEN.outliers_fail]),
        ("BP-S08", "above {} mm, FAIL above {} mm", [1e3 * SCREEN.scatter_warn_m, 1e3 * SCREEN.scatter_fail_m]),
        ("BP-S09", "above {} mm, FAIL above {} mm", [1e3 * SCREEN.sigma_spot_warn_m, 1e3 * SCREEN.sigma_spot_fail_m]),
        ("BP-B05", "More than {} %", [100 * BEAM.wrong_share]),
        ("BP-B08", "above {} times", [BEAM.noise_scale]),
        ("BP-B09", "above {} arcsec (RMS", [BEAM.direction / ARCSEC]),
        ("BP-B09", "FAIL above {} arcsec", [BEAM.direction_unusable / ARCSEC]),
        ("BP-R02", "above {} times, FAIL above {} times", [RIG.scale_warn, RIG.scale_fail]),
        ("BP-R05", "above {} %, FAIL above {} %", [100 * RIG.wrong_warn, 100 * RIG.wrong_fail]),
        ("BP-R07", "above {} times, FAIL above {} times", [RIG.hold_out_warn, RIG.hold_out_fail]),
        ("BP-R09", "WARN above {} deg or {} mm", [np.rad2deg(RIG.attitude_warn), 1e3 * RIG.position_warn_m]),
        ("BP-R09", "FAIL above {} deg or {} mm", [np.rad2deg(RIG.attitude_fail), 1e3 * RIG.position_fail_m]),
        ("BP-L12", "more than {} sigmas", [CORNER_GATE]),
        ("BP-Q03", "exceeds {} %", [100 * GOOD_RANGE_SHARE]),
        ("BP-G01", "smaller than {} px", [LightParameters().smallest_px]),
    ],
)
def test_a_limit_that_an_explanation_states_is_the_one_that_decides(code, words, limits):
    code, _, variant = code.partition(".")
    assert words.format(*(f"{limit:.4g}" for limit in limits)) in entries()[code].variant(variant).meaning
