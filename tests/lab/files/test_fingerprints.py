"""Fingerprints identify the inputs of a run: a changed input has another fingerprint."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

import pytest

from lab.files.run import fingerprints as module
from lab.files.run.fingerprints import fingerprints
from lab.files.run.run_file import load_run
from tests.lab.run_folders import edit, write_run


def by_name(folder: Path) -> dict[str, dict]:
    return {str(Path(entry["path"]).relative_to(folder)): entry for entry in fingerprints(load_run(folder))}


def test_every_input_has_one_entry_with_its_digest_and_size(tmp_path):
    folder = write_run(tmp_path / "run")
    entries = by_name(folder)
    assert list(entries) == ["run.yaml", "rig.yaml", "frames/left", "frames/right"]
    for name in ("run.yaml", "rig.yaml"):
        content = (folder / name).read_bytes()
        assert entries[name]["sha256"] == hashlib.sha256(content).hexdigest()
        assert entries[name]["bytes"] == len(content)
        assert entries[name]["covers"] == "contents"
    pictures = list((folder / "frames/left").iterdir())
    assert entries["frames/left"]["bytes"] == sum(p.stat().st_size for p in pictures)
    assert entries["frames/left"]["covers"] == "names, sizes and contents"


def test_fingerprints_do_not_depend_on_the_location(tmp_path):
    one, other = (by_name(write_run(tmp_path / name / "run")) for name in ("a", "b"))
    assert {n: e["sha256"] for n, e in one.items()} == {n: e["sha256"] for n, e in other.items()}


def test_a_timestamps_file_is_an_input(tmp_path):
    folder = write_run(tmp_path / "run")
    (folder / "times.csv").write_text("frame,t_s\n" + "".join(f"{k},{k * 0.01}\n" for k in range(5)))
    edit(folder / "run.yaml", "frame_rate_hz: 100.0\n", "frame_rate_hz: 100.0\ntimestamps: times.csv\n")
    assert "times.csv" in by_name(folder)


@pytest.mark.parametrize("change", ["rename", "grow", "remove", "add", "edit"])
def test_a_changed_folder_of_pictures_has_another_digest(tmp_path, change):
    folder = write_run(tmp_path / "run")
    before = by_name(folder)
    picture = folder / "frames/left/000002.png"
    match change:
        case "rename":
            picture.rename(picture.with_name("000007.png"))
        case "grow":
            picture.write_bytes(picture.read_bytes() + b"\0")
        case "edit":
            content = bytearray(picture.read_bytes())
            content[len(content) // 2] ^= 1
            picture.write_bytes(content)
        case "remove":
            picture.unlink()
        case "add":
            picture.with_name("000009.png").write_bytes(picture.read_bytes())
    after = by_name(folder)
    assert after["frames/left"]["sha256"] != before["frames/left"]["sha256"]
    assert after["frames/right"] == before["frames/right"]


def test_a_table_of_both_cameras_is_listed_once(tmp_path):
    folder = write_run(tmp_path / "run")
    (folder / "detections.csv").write_text(
        "frame,camera,u_px,v_px,sigma_u_px,sigma_v_px,flux,peak,major_px,minor_px,angle_deg,cov_uv_px2\n"
    )
    for camera in ("left", "right"):
        edit(folder / "run.yaml", f"{{frames: frames/{camera}}}", "{detections: detections.csv}")
    assert list(by_name(folder)) == ["run.yaml", "rig.yaml", "detections.csv"]


def test_the_digest_of_a_huge_file_covers_samples_and_its_size(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "MAX_HASHED_BYTES", 1600)
    folder = write_run(tmp_path / "run")
    rig = folder / "rig.yaml"
    rig.write_text(rig.read_text() + "# " + "x" * 4000 + "\n")
    entry = by_name(folder)["rig.yaml"]
    content = rig.read_bytes()
    starts = [(len(content) - 100) * i // 15 for i in range(16)]
    assert entry["covers"] == "16 samples, 1600 bytes in all"
    assert entry["sha256"] == hashlib.sha256(b"".join(content[s : s + 100] for s in starts)).hexdigest()
    assert entry["bytes"] == os.path.getsize(rig)


@pytest.mark.parametrize("place", ["start", "end"])
def test_a_changed_byte_at_either_end_of_a_sampled_picture_changes_the_digest(tmp_path, monkeypatch, place):
    monkeypatch.setattr(module, "MAX_PICTURE_BYTES", 32)
    folder = write_run(tmp_path / "run")
    picture = folder / "frames/left/000002.png"
    before = by_name(folder)["frames/left"]
    assert before["covers"] == "names, sizes and samples of the contents"
    content = bytearray(picture.read_bytes())
    content[0 if place == "start" else -1] ^= 1
    picture.write_bytes(content)
    assert by_name(folder)["frames/left"]["sha256"] != before["sha256"]


def test_a_full_fingerprint_covers_every_byte_of_a_picture(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "MAX_PICTURE_BYTES", 16)
    folder = write_run(tmp_path / "run")
    picture = folder / "frames/left/000002.png"
    content = picture.read_bytes()
    digests = set()
    for k in range(40):
        picture.write_bytes(content[:k] + bytes([content[k] ^ 1]) + content[k + 1 :])
        entry = next(e for e in fingerprints(load_run(folder), full=True) if e["path"].endswith("left"))
        digests.add(entry["sha256"])
        assert entry["covers"] == "names, sizes and contents"
    assert len(digests) == 40


def test_the_tables_of_the_truth_are_inputs(tmp_path):
    folder = write_run(tmp_path / "run")
    (folder / "truth").mkdir()
    (folder / "truth/pose.csv").write_text("frame\n")
    assert "truth/pose.csv" in by_name(folder)
