"""Every warning, verdict reason, finding and error has a code, and every code an explanation."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator

import pytest

from lab.findings.finding import Finding, Level, unless_pass
from lab import errors
from lab.errors import InputError
from lab.findings import catalogue, program
from lab.findings.catalogue import ENTRIES, SECTIONS
from lab.runs.verdict.verdict_reasons import CODES, ReasonKind, VerdictReason
from tests.paths import ROOT

MAKERS = {"Finding", "unless_pass"}  # the calls that make a finding; `Line` makes a line of the doctor
CODE = re.compile(r"BP-[A-Z]\d\d")


def sources() -> Iterator[tuple[str, str]]:
    for package in ("calibration", "lab"):
        for path in sorted((ROOT / package).rglob("*.py")):
            # calibration/findings.py defines the makers and passes codes on.
            if "lab/explain" not in path.as_posix() and path != ROOT / "calibration" / "findings.py":
                yield path.relative_to(ROOT).as_posix(), path.read_text("utf-8")


def without_code(name: str, text: str) -> list[str]:
    """Calls that make a finding that may be a warning, without a literal code or one of a table `codes`."""
    wrong, makers = (
        [],
        MAKERS | ({"Line"} if name.startswith(("lab/setup/doctor", "lab/setup/installation")) else set()),
    )
    for node in ast.walk(ast.parse(text)):
        if not (isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in makers):
            continue
        if node.args and isinstance(node.args[0], ast.Attribute) and node.args[0].attr == "PASS":
            continue
        given = [k.value for k in node.keywords if k.arg == "code"] or node.args[:1]
        codes = [c.value for c in given if isinstance(c, ast.Constant) and CODE.fullmatch(str(c.value))]
        codes += [c.attr for c in given if isinstance(c, ast.Attribute) and ast.unparse(c.value).endswith("codes")]
        if not codes:
            wrong.append(f"{name}:{node.lineno}")
    return wrong


def codes_in_use() -> set[str]:
    return {code for _, text in sources() for code in CODE.findall(text)}


def test_every_finding_that_may_be_a_warning_has_a_code():
    assert [wrong for name, text in sources() for wrong in without_code(name, text)] == []


@pytest.mark.parametrize(
    "call",
    [
        "Finding(Level.WARN, 'x')",
        "unless_pass(level, 'x', 'y', 'z', code=other)",
        "Finding(Level.WARN, 'x', code=self.other)",
    ],
)
def test_a_finding_without_a_code_is_found(call):
    assert without_code("here.py", call) == ["here.py:1"]
    assert without_code("here.py", "Finding(Level.PASS, 'x')\nFinding(Level.FAIL, 'x', code='BP-B01')") == []
    assert without_code("here.py", "Finding(Level.WARN, 'x', code=target.codes.few)") == []


def test_every_code_in_use_is_explained_and_every_explained_code_is_in_use():
    assert codes_in_use() - set(ENTRIES) == set()
    assert set(ENTRIES) - codes_in_use() - set(program.ERRORS) == set()


def test_every_kind_of_verdict_reason_has_its_own_explained_code():
    assert set(CODES) == set(ReasonKind)
    assert len(set(CODES.values())) == len(ReasonKind)
    assert set(CODES.values()) == set(SECTIONS["Verdict of a run"])


def test_the_codes_of_verdict_reasons_never_change():
    first = ["no_frames", "never_found", "few_measured", "no_pictures", "camera_late", "camera_stopped"]
    first += ["missing_pictures", "nothing_detected", "few_points", "not_acquired", "not_confirmed", "ambiguous"]
    first += ["lost", "contradiction", "internal", "noise_scale", "model"]
    for number, kind in enumerate(first, start=1):
        assert CODES[ReasonKind(kind)] == f"BP-V{number:02d}"


def test_a_verdict_reason_of_the_model_check_has_the_code_of_its_finding():
    reason = VerdictReason(ReasonKind.MODEL, False, "what", "remedy", code="BP-M03")
    assert reason.as_mapping()["code"] == "BP-M03"
    assert VerdictReason(ReasonKind.LOST, False, "what", "remedy").as_mapping()["code"] == CODES[ReasonKind.LOST]


def test_every_class_of_error_has_the_code_of_its_exit_status():
    classes = [c for c in vars(errors).values() if isinstance(c, type) and issubclass(c, errors.BeamposeError)]
    assert len(classes) == 4
    for c in classes:
        assert c.code == f"BP-E0{c.exit_status}"
        assert f"exit status {c.exit_status}" in ENTRIES[c.code].title
    assert f"exit status {errors.QUALITY_GATE_FAILED}" in ENTRIES["BP-E04"].title


def test_a_code_belongs_to_one_section_and_has_all_texts():
    assert sum(map(len, SECTIONS.values())) == len(ENTRIES)
    for code, text in ENTRIES.items():
        assert CODE.fullmatch(code)
        assert min(map(len, text)) > 3
        assert text.meaning.endswith(".")
        assert text.remedy.endswith(".")


@pytest.mark.parametrize("typed", ["BP-V03", "bp-v03", "V03", "v3"])
def test_a_code_is_explained_however_it_is_typed(typed):
    assert catalogue.explain(typed).startswith("BP-V03  Few frames with a measured pose\n")


def test_a_code_that_does_not_exist_is_an_input_error():
    with pytest.raises(InputError, match="expected a code such as BP-V03, got 'BP-V99'"):
        catalogue.explain("BP-V99")


def test_the_list_has_every_code():
    assert set(CODE.findall("\n".join(catalogue.listed()))) == set(ENTRIES)


def test_a_finding_that_passes_keeps_its_code_and_drops_its_remedy():
    assert unless_pass(Level.PASS, "a", "b", "c", code="BP-B01") == Finding(Level.PASS, "a", code="BP-B01")
    assert unless_pass(Level.WARN, "a", "b", "c", code="BP-B01") == Finding(Level.WARN, "a", "b", "c", "BP-B01")
