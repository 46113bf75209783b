"""The generated pages name everything that the code has; the documentation site can be built."""

from __future__ import annotations

import dataclasses
import os
import re
import shutil
import subprocess
import sys

import pytest

from calibration.budget import ExpectedErrors
from docs.website import codes, commands, parameters, study_tables, validation, yaml_files
from docs.website.navigation import expanded
from docs.website.network import network_addresses
from docs.website.pages import GENERATED
from docs.website.text import cell
from lab.findings.finding import entries
from lab.setup.schema import BLOCKS
from tests.paths import ROOT
from tracking.parameters import DetectParameters, LabelParameters, TrackerParameters

CLASSES = (("", TrackerParameters), ("detect.", DetectParameters), ("labels.", LabelParameters), ("", ExpectedErrors))


def test_every_parameter_has_a_row_with_its_default_and_a_meaning():
    rows = dict(re.findall(r"^\| `([\w.]+)` \| (.*) \|$", parameters.page(), re.MULTILINE))
    names = {
        prefix + f.name: f.default
        for prefix, cls in CLASSES
        for f in dataclasses.fields(cls)
        if f.default is not dataclasses.MISSING
    }
    assert set(rows) == set(names)
    for name, row in rows.items():
        default, _, meaning = row.split(" | ", 2)
        assert len(meaning) > 12, name
        if isinstance(names[name], float):
            assert float(default.strip("`")) == names[name]


def test_a_comment_above_beside_or_within_a_field_is_its_meaning():
    meanings = {f.name: (f.section, f.meaning) for f in parameters.commented_fields(TrackerParameters)}
    assert meanings["method"][1].startswith("rigid: one filter for the vehicle")
    assert meanings["min_vector_px"][1].startswith("px: floor of vector lengths")
    assert meanings["r1_px"][0] == "Matching, section 4.1 (spots)"


def test_every_command_and_every_option_is_listed():
    page = commands.page()
    for name, command in commands.commands():
        assert f"## {name} {{ #{name.replace(' ', '-')} }}" in page
        section = page.split(f"## {name} {{")[1].split("\n## ")[0]
        missing = [
            option
            for p in command.params
            if p.param_type_name == "option" and not getattr(command, "commands", None)
            for option in p.opts
            if f"`{option}" not in section and f", {option}" not in section
        ]
        assert missing == [], name


def test_every_code_has_a_heading_to_which_one_can_link():
    page = codes.page()
    assert [code for code in entries() if f"{{ #{code.lower()} }}" not in page] == []


def test_the_pages_link_to_codes_that_exist():
    texts = [path.read_text(encoding="utf-8") for path in (ROOT / "docs").rglob("*.md")]
    linked = {code.upper() for text in texts for code in re.findall(r"codes\.md#(bp-\w+)", text)}
    assert len(linked) > 20
    assert sorted(linked - set(entries())) == []


def test_every_yaml_file_has_a_table_and_no_remark_is_meant_for_a_linter():
    page = yaml_files.page()
    assert [name for name in BLOCKS if f"{{ #{name} }}" not in page] == []
    assert "`cameras.NAME.camera_matrix.fx` | number above 0 | yes" in page
    assert "noqa" not in page


def test_the_table_of_the_study_is_put_into_its_page():
    page = study_tables.with_tables((ROOT / "docs" / "huo2015.md").read_text(encoding="utf-8"))
    assert not study_tables.MARKER.search(page)
    assert "| 65.97 |" in page


def test_every_figure_of_the_validation_page_is_in_the_page_of_accuracy():
    accuracy = " ".join((ROOT / "docs" / "accuracy.md").read_text(encoding="utf-8").split())
    page = validation.with_comparisons((ROOT / "docs" / "validation.md").read_text(encoding="utf-8"))
    shown = validation.rows()
    assert [row.what for row in shown if row.quote not in accuracy] == []
    assert {row.data for row in shown} == {"simulated", "simulated light in real photographs", "real"}
    for row in shown:
        quoted = {float(n) for n in re.findall(r"\d*\.\d+", row.quote)}
        found = {round(r, 2) for r in (row.lowest, row.highest, row.lowest**2, row.highest**2)}
        assert len(found & quoted) >= 1, row.what
        assert validation.cell(row.what) in page


def test_a_cell_keeps_its_text_whatever_characters_it_has():
    assert cell("a | b_c <d>\n`e_f`") == "a \\| b\\_c \\<d> `e_f`"


def test_a_pattern_in_the_navigation_becomes_the_files_that_match_it(tmp_path):
    (tmp_path / "papers").mkdir()
    for name in ("b.md", "README.md", "a.md"):
        (tmp_path / "papers" / name).write_text("# x")
    for name in ("index.md", "guide.md", "new.md"):
        (tmp_path / name).write_text("# x")
    nav = [{"T": [{"Papers": "papers/*.md"}, {"None": "none/*.md"}, {"More": "*.md"}]}, "index.md", {"G": "guide.md"}]
    found = ["papers/README.md", "papers/a.md", "papers/b.md"]
    assert expanded(nav, tmp_path) == [{"T": [{"Papers": found}, {"More": ["new.md"]}]}, "index.md", {"G": "guide.md"}]
    assert expanded([{"Made": "made/*.md"}], tmp_path, ["made/b.md", "made/a.md"]) == [
        {"Made": ["made/b.md", "made/a.md"]}
    ]


@pytest.mark.parametrize(
    ("html", "found"),
    [
        ('<script src="https://unpkg.com/x"></script>', 1),
        ('<link rel="stylesheet" href="//fonts.example/css">', 1),
        ('<img src="HTTP://example.org/a.png">', 1),
        ('<a href="https://example.org">a link</a><script src="assets/a.js"></script>', 0),
        ('<link rel="canonical" href="https://example.org">', 0),
    ],
)
def test_what_a_page_loads_from_the_network_is_found(html, found):
    assert len(network_addresses(html)) == found


def test_generated_pages_are_not_checked_in():
    assert [name for name in GENERATED if (ROOT / "docs" / name).exists()] == []


@pytest.mark.slow
def test_the_site_is_built_without_a_warning_and_loads_nothing_from_the_network(tmp_path):
    pytest.importorskip("material", reason="MkDocs is not installed; `make docs` installs it")
    for path in ("docs", "mkdocs.yml"):
        copy = shutil.copytree if (ROOT / path).is_dir() else shutil.copy
        copy(ROOT / path, tmp_path / path)
    sights = tmp_path / "docs/website/sights.toml"  # all of them: test_gallery.py
    chosen = [part for part in sights.read_text().split("\n\n[") if part.startswith("mirrored-pictures]")]
    sights.write_text(f"[{chosen[0]}")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path / "site")]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "site/reference/parameters.html").is_file()
    assert (tmp_path / "site/gallery/mirrored-pictures.html").is_file()

    (tmp_path / "docs/python.md").write_text("# Python\n\n[nowhere](nowhere.md)\n")
    broken = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert broken.returncode != 0
    assert "nowhere.md" in broken.stderr
