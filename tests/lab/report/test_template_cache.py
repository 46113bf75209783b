"""Compiled templates on disk: used by the next process, and never required."""

from __future__ import annotations

from pathlib import Path

import jinja2
import pytest

from lab.report import page

NAME = "failure.html.j2"


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    """Where templates are kept in this test."""
    monkeypatch.setattr(page, "private_folder", lambda sources: tmp_path)
    return tmp_path


def loaded() -> list[str]:
    """The templates that a new process compiles for one page."""
    compiled, compile_template = [], jinja2.Environment.compile

    def counted(self, source, name=None, *rest, **more):
        compiled.append(name)
        return compile_template(self, source, name, *rest, **more)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(jinja2.Environment, "compile", counted)
        page.environment.__wrapped__().get_template(NAME)
    return compiled


def test_the_next_process_compiles_no_template(folder):
    assert loaded() == [NAME]
    assert loaded() == []


@pytest.mark.parametrize("left", [0, 15, 25, 200])
def test_a_truncated_file_is_compiled_again(folder, left):
    loaded()
    (file,) = folder.iterdir()
    file.write_bytes(file.read_bytes()[:left])
    assert loaded() == [NAME]
    assert loaded() == []


def test_a_full_disk_is_no_error(folder, monkeypatch):
    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("jinja2.bccache.tempfile.NamedTemporaryFile", full)
    assert loaded() == [NAME]
    assert list(folder.iterdir()) == []


def test_without_a_safe_folder_templates_are_compiled_in_every_process(monkeypatch):
    monkeypatch.setattr(page, "private_folder", lambda sources: None)
    assert loaded() == loaded() == [NAME]


def test_an_edited_template_or_another_setting_of_the_engine_means_another_folder(monkeypatch):
    given = []
    monkeypatch.setattr(page, "private_folder", given.append)
    page.environment.__wrapped__()
    assert {Path(str(page.__file__)), *page.TEMPLATES.iterdir()} <= set(given[0])
