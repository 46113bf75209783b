"""A result folder is complete or absent, and foreign files are never deleted."""

from __future__ import annotations

import importlib
import os
from pathlib import Path

import pytest

from lab.errors import InputError
from lab.files.text.atomic_write import atomic_folder, check_output_folder, keep_good_results


def never(folder: Path) -> bool:
    return False


def always(folder: Path) -> bool:
    return True


def names(folder: Path) -> list[str]:
    return sorted(p.name for p in folder.iterdir())


def test_the_target_appears_only_when_the_block_has_ended(tmp_path):
    target = tmp_path / "results"
    with atomic_folder(target, never) as work:
        (work / "a.csv").write_text("1")
        assert not target.exists()
        assert work.parent == target.parent  # the same file system: a rename cannot become a copy
    assert names(target) == ["a.csv"]
    assert names(tmp_path) == ["results"]


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt, SystemExit])
def test_a_block_that_ends_with_an_exception_leaves_nothing(tmp_path, error):
    target = tmp_path / "results"

    def write_half():
        with atomic_folder(target, never) as work:
            (work / "a.csv").write_text("half")
            raise error

    with pytest.raises(error):
        write_half()
    assert names(tmp_path) == []


def test_earlier_results_are_replaced_only_when_the_new_ones_are_complete(tmp_path):
    target = tmp_path / "results"
    target.mkdir()
    (target / "old.csv").write_text("old")

    def fail():
        with atomic_folder(target, always) as work:
            (work / "new.csv").write_text("half")
            raise ValueError("disk on fire")

    with pytest.raises(ValueError, match="disk on fire"):
        fail()
    assert names(target) == ["old.csv"]
    with atomic_folder(target, always) as work:
        (work / "new.csv").write_text("new")
    assert names(target) == ["new.csv"]
    assert names(tmp_path) == ["results"]


def test_a_folder_with_something_else_in_it_is_refused_and_untouched(tmp_path):
    target = tmp_path / "thesis"
    target.mkdir()
    (target / "chapter.tex").write_text("years of work")
    with (
        pytest.raises(InputError, match=r"thesis: the folder holds something other than earlier results"),
        atomic_folder(target, never),
    ):
        pytest.fail("the block must not begin")
    assert (target / "chapter.tex").read_text() == "years of work"
    assert names(tmp_path) == ["thesis"]


def test_an_empty_folder_is_replaced(tmp_path):
    target = tmp_path / "results"
    target.mkdir()
    with atomic_folder(target, never) as work:
        (work / "a").write_text("1")
    assert names(target) == ["a"]


def test_a_file_as_target_is_refused(tmp_path):
    target = tmp_path / "results"
    target.write_text("a file")
    with (
        pytest.raises(InputError, match="expected a folder for the results, found a file"),
        atomic_folder(target, always),
    ):
        pytest.fail("the block must not begin")
    assert target.read_text() == "a file"


def test_missing_parent_folders_are_made(tmp_path):
    with atomic_folder(tmp_path / "a" / "b" / "results", never) as work:
        (work / "x").write_text("1")
    assert names(tmp_path / "a" / "b" / "results") == ["x"]


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_without_write_permission_is_a_plain_error(tmp_path):
    closed = tmp_path / "closed"
    closed.mkdir(mode=0o500)
    with pytest.raises(InputError, match="the folder cannot be made"), atomic_folder(closed / "results", never):
        pytest.fail("the block must not begin")


def test_a_parent_that_is_a_file_is_a_plain_error(tmp_path):
    (tmp_path / "file").write_text("")
    with (
        pytest.raises(InputError, match="the folder cannot be made"),
        atomic_folder(tmp_path / "file" / "results", never),
    ):
        pytest.fail("the block must not begin")


def test_the_working_folder_of_a_killed_run_is_removed(tmp_path):
    left = tmp_path / f".results.part-{os.getpid()}"
    left.mkdir()
    (left / "a.csv").write_text("half of long ago")
    with atomic_folder(tmp_path / "results", never) as work:
        (work / "b.csv").write_text("1")
    assert names(tmp_path / "results") == ["b.csv"]


def test_old_results_are_restored_when_the_last_rename_fails(tmp_path, monkeypatch):
    target = tmp_path / "results"
    target.mkdir()
    (target / "old").write_text("1")
    rename = Path.rename

    def broken(self, to):
        if ".part-" in self.name:
            raise OSError(28, "No space left on device")
        return rename(self, to)

    def replace_it():
        with atomic_folder(target, always) as work:
            (work / "new").write_text("1")
            monkeypatch.setattr(Path, "rename", broken)

    with pytest.raises(OSError, match="No space left"):
        replace_it()
    assert names(target) == ["old"]
    assert names(tmp_path) == ["results"]


def test_failed_results_do_not_replace_good_ones(tmp_path):
    good = tmp_path / "left"
    assert keep_good_results(good, True, "camera.yaml") == good
    good.mkdir()
    (good / "camera.yaml").write_text("good")
    assert keep_good_results(good, False, "camera.yaml") == good
    assert keep_good_results(good, True, "camera.yaml") == tmp_path / "left-failed"
    assert keep_good_results(good, True, "rig.yaml") == good


def test_an_unusable_target_is_reported_before_any_work_with_a_remedy(tmp_path):
    foreign = tmp_path / "letters"
    foreign.mkdir()
    (foreign / "letter.txt").write_text("dear")
    (tmp_path / "file").write_text("")
    (tmp_path / "link").symlink_to(tmp_path / "nowhere")
    for place, words in (
        (foreign, "holds something other than earlier results"),
        (tmp_path / "file", "found a file"),
        (tmp_path / "file" / "sub" / "results", "file is a file"),
        (tmp_path / "link", "a broken link"),
    ):
        with pytest.raises(InputError, match=f"{words}; choose another --out"):
            check_output_folder(place, never)
    assert names(tmp_path) == ["file", "letters", "link"]


def test_a_usable_target_is_accepted_and_nothing_is_made(tmp_path):
    (tmp_path / "old").mkdir()
    (tmp_path / "old" / "a.csv").write_text("1")
    check_output_folder(tmp_path / "old", always)
    check_output_folder(tmp_path / "new" / "results", never)
    assert names(tmp_path) == ["old"]


@pytest.mark.parametrize(
    "work",
    [
        lambda out: importlib.import_module("lab.calibrate.screens.screen").calibrate_screen(Path("none.yaml"), out),
        lambda out: importlib.import_module("lab.calibrate.beams.beams").calibrate_beams(Path("none.yaml"), out),
        lambda out: importlib.import_module("lab.calibrate.rig.rig").calibrate_rig(Path("none.yaml"), out),
        lambda out: importlib.import_module("lab.calibrate.camera.camera").calibrate_camera([], "none", out),
        lambda out: importlib.import_module("lab.calibrate.drift_check.drift_check").check_drift(
            Path("none.yaml"), out, None
        ),
        lambda out: importlib.import_module("lab.plan.plan").plan_rig(Path("none.yaml"), out),
    ],
    ids=["screen", "beams", "rig", "camera", "check", "plan"],
)
def test_every_long_command_checks_its_target_first(work, tmp_path):
    (tmp_path / "letter.txt").write_text("dear")
    with pytest.raises(InputError, match="choose another --out"):
        work(tmp_path)
