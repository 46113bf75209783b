"""A result folder is complete or absent, and foreign files are never deleted."""

from __future__ import annotations

import errno
import importlib
import os
import re
import stat
import sys
from pathlib import Path

import pytest

from lab.errors import InputError, RunError
from lab.files.output import part_folder
from lab.files.text.atomic_write import atomic_folder, atomic_write_text, check_output_folder, keep_good_results


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


@pytest.mark.skipif(sys.platform != "linux", reason="the names of open files are read from /proc")
def test_all_files_are_on_the_disk_before_the_folder_gets_its_name(tmp_path, monkeypatch):
    """Otherwise a power cut leaves a complete folder of empty files."""
    original, synced = os.fsync, []

    def fsync(file: int) -> None:
        assert not target.exists()
        synced.append(os.path.basename(os.readlink(f"/proc/self/fd/{file}")))
        original(file)

    monkeypatch.setattr(os, "fsync", fsync)
    target = tmp_path / "results"
    with atomic_folder(target, never) as work:
        (work / "inner").mkdir()
        for name in ("a.csv", "inner/b.txt"):
            (work / name).write_text("1")
    assert sorted(synced) == sorted(["a.csv", "b.txt", "inner", work.name])


def test_a_disk_that_fails_at_the_end_leaves_the_old_results(tmp_path, monkeypatch):
    def fsync(file: int) -> None:
        raise OSError(errno.EIO, "Input/output error")

    target = tmp_path / "results"
    target.mkdir()
    (target / "a.csv").write_text("old")
    monkeypatch.setattr(os, "fsync", fsync)
    with pytest.raises(OSError, match="Input/output"), atomic_folder(target, always) as work:
        (work / "a.csv").write_text("new")
    assert (target / "a.csv").read_text() == "old"
    assert names(tmp_path) == ["results"]


def test_a_full_disk_is_named_with_the_folder_and_what_to_do(tmp_path):
    """The system says neither which disk is full nor, after a failed write, which file it was."""
    message = f"{tmp_path / 'results'}: expected room for the results, found a full disk; free some, or choose another"
    with pytest.raises(RunError, match=re.escape(message)), atomic_folder(tmp_path / "results", never):
        raise OSError(errno.ENOSPC, "No space left on device")
    assert names(tmp_path) == []


@pytest.mark.parametrize("folder", [".", "", "../here", "{}"])
def test_the_current_folder_is_not_replaced(tmp_path, monkeypatch, folder):
    """Under a shell in it, all would be gone."""
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    with pytest.raises(InputError, match="found the current folder; name a folder in it"):
        check_output_folder(Path(folder.format(tmp_path / "here")), always)
    check_output_folder(Path("inner"), always)
    monkeypatch.chdir("/")
    with pytest.raises(InputError, match="found a mounted volume; name a folder in it"):
        check_output_folder(Path("."), always)


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
    for left in (".results.part-4711", ".results.part-00ff", ".results.old-00ff"):
        (tmp_path / left).mkdir()
        (tmp_path / left / "a.csv").write_text("half of long ago")
    (tmp_path / "results").mkdir()
    (tmp_path / ".results.beampose-lock").write_text("of a process that was killed")
    with atomic_folder(tmp_path / "results", never) as work:
        (work / "b.csv").write_text("1")
    assert names(tmp_path / "results") == ["b.csv"]
    assert names(tmp_path) == ["results"]


def test_parts_of_other_targets_with_a_similar_name_are_kept(tmp_path):
    others = [".results-2.part-00ff", ".results.part-1.part-00ff", ".results.backup"]
    for other in others:
        (tmp_path / other).mkdir()
    with atomic_folder(tmp_path / "results", never):
        pass
    assert names(tmp_path) == sorted([*others, "results"])


def test_results_between_the_two_renames_are_put_back_at_the_next_start(tmp_path):
    (tmp_path / ".results.old-00ff").mkdir()
    (tmp_path / ".results.old-00ff" / "good.csv").write_text("1")

    def fail():
        with atomic_folder(tmp_path / "results", always):
            raise ValueError("again")

    with pytest.raises(ValueError, match="again"):
        fail()
    assert names(tmp_path) == ["results"]
    assert names(tmp_path / "results") == ["good.csv"]


@pytest.mark.parametrize("can_exchange", [True, False])
def test_an_old_target_is_replaced_with_and_without_an_exchange_of_folders(tmp_path, monkeypatch, can_exchange):
    if not can_exchange:
        monkeypatch.setattr(part_folder, "exchange", lambda one, other: False)
    target = tmp_path / "results"
    for number in "12":
        with atomic_folder(target, always) as work:
            (work / number).write_text(number)
        assert names(target) == [number]
        assert names(tmp_path) == ["results"]


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="renameat2 is a call of Linux")
def test_two_folders_are_exchanged_in_one_step(tmp_path):
    for name in ("one", "other"):
        (tmp_path / name).mkdir()
        (tmp_path / name / name).write_text(name)
    assert part_folder.exchange(tmp_path / "one", tmp_path / "other")
    assert (names(tmp_path / "one"), names(tmp_path / "other")) == (["other"], ["one"])
    assert not part_folder.exchange(tmp_path / "one", tmp_path / "nothing")


def test_a_second_writer_is_refused_and_disturbs_nothing(tmp_path):
    target, alias = tmp_path / "results", tmp_path / "alias"
    alias.symlink_to(target)
    with atomic_folder(target, never) as work:
        target.mkdir()
        for place in (target, alias):
            with (
                pytest.raises(
                    InputError, match=rf"{place}: .* in use by process {os.getpid()} on .*; wait for its end"
                ),
                atomic_folder(place, never),
            ):
                pytest.fail("the block must not begin")
        (work / "a.csv").write_text("1")
    assert names(target) == ["a.csv"]
    assert names(tmp_path) == ["alias", "results"]


def test_a_link_to_a_folder_remains_and_the_folder_is_replaced(tmp_path):
    (tmp_path / "disk" / "real").mkdir(parents=True)
    link = tmp_path / "results"
    link.symlink_to(tmp_path / "disk" / "real")
    with atomic_folder(link, never) as work:
        (work / "a.csv").write_text("1")
    assert link.is_symlink()
    assert names(tmp_path / "disk" / "real") == ["a.csv"]
    assert names(tmp_path / "disk") == ["real"]


def test_a_file_system_without_locks_is_used_without_them_and_nothing_is_swept(tmp_path, monkeypatch):
    def unsupported(*_):
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(part_folder.fcntl, "flock", unsupported)
    (tmp_path / ".results.part-00ff").mkdir()  # perhaps of a living process: it cannot be known
    with atomic_folder(tmp_path / "results", never) as work:
        (work / "a.csv").write_text("1")
    assert names(tmp_path / "results") == ["a.csv"]
    assert ".results.part-00ff" in names(tmp_path)
    atomic_write_text("1", tmp_path / "b.csv")
    assert (tmp_path / "b.csv").read_text() == "1"


def test_the_folder_has_the_usual_permissions(tmp_path):
    before = os.umask(0o027)
    try:
        with atomic_folder(tmp_path / "results", never):
            pass
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "results").stat().st_mode) == 0o750


def test_part_files_of_killed_processes_are_removed_and_those_of_living_ones_kept(tmp_path):
    target = tmp_path / "batch.csv"
    dead, alive, other = (tmp_path / f".{name}.part" for name in ("batch.csv.00ff", "batch.csv.11ff", "runs.csv.00ff"))
    for path in (dead, alive, other):
        path.write_text("half")
    with alive.open("rb") as file:
        assert part_folder.lock(file.fileno())
        atomic_write_text("1", target)
        assert names(tmp_path) == sorted([alive.name, other.name, target.name])
    atomic_write_text("2", target)
    assert names(tmp_path) == sorted([other.name, target.name])
    assert target.read_text() == "2"


def test_a_part_file_that_another_process_took_for_a_left_one_is_written_again(tmp_path, monkeypatch):
    answers = iter([BlockingIOError(), None])

    def taken_once(*_):
        answer = next(answers, None)
        if answer is not None:
            raise answer

    monkeypatch.setattr(part_folder.fcntl, "flock", taken_once)
    atomic_write_text("1", tmp_path / "a.csv")
    assert (tmp_path / "a.csv").read_text() == "1"
    assert names(tmp_path) == ["a.csv"]


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
            monkeypatch.setattr(part_folder, "exchange", lambda one, other: False)
            monkeypatch.setattr(Path, "rename", broken)

    with pytest.raises(RunError, match="found a full disk"):
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
        lambda out: importlib.import_module("lab.setup.plan").plan_rig(Path("none.yaml"), out),
    ],
    ids=["screen", "beams", "rig", "camera", "check", "plan"],
)
def test_every_long_command_checks_its_target_first(work, tmp_path):
    (tmp_path / "letter.txt").write_text("dear")
    with pytest.raises(InputError, match="choose another --out"):
        work(tmp_path)
