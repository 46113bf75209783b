"""Reading of frames: every picture has its own number, and a run continues past damaged ones."""

from __future__ import annotations

import os
import struct
import subprocess
import sys
import threading
import time
import zlib
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from lab.errors import InputError
from lab.files.run.run_file import load_run
from lab.pictures import picture_file
from lab.pictures.picture_file import MissingPicture, read_picture
from lab.pictures.source import AHEAD, list_folder, pictures, video_at
from lab.runs.frames import frames
from lab.runs.frames.frames import FrameSet, open_frames, pictures_at
from lab.runs.frames.pipeline import Pipeline
from tests.lab.run_folders import edit, picture_of, write_run

SIZE = (64, 48)


def decode(data, size_px):
    """The picture in the bytes of a file."""
    return picture_file.decode(np.frombuffer(data, np.uint8), size_px)


def textured(dtype: type = np.uint8, channels: int = 1) -> np.ndarray:
    """A picture of noise, which compresses badly, so that a truncated file ends within its content."""
    rng = np.random.default_rng(3)
    shape = (48, 64) if channels == 1 else (48, 64, channels)
    return rng.integers(0, np.iinfo(dtype).max, shape).astype(dtype)


def encoded(suffix: str, picture: np.ndarray) -> bytes:
    return cv2.imencode(suffix, picture)[1].tobytes()


def read_all(folder: Path) -> list[FrameSet]:
    return list(open_frames(load_run(folder)))


# One picture ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("suffix", "dtype"),
    [(s, np.uint8) for s in (".png", ".tif", ".bmp", ".pgm")] + [(s, np.uint16) for s in (".png", ".tif", ".pgm")],
)
def test_a_lossless_grey_picture_is_read_exactly(suffix, dtype):
    picture = textured(dtype)
    got = decode(encoded(suffix, picture), SIZE)
    assert got.dtype == dtype
    np.testing.assert_array_equal(got, picture)


@pytest.mark.parametrize(
    ("suffix", "dtype"),
    [(".png", np.uint8), (".tif", np.uint8), (".bmp", np.uint8), (".png", np.uint16), (".tif", np.uint16)],
)
def test_a_grey_picture_saved_in_colour_keeps_its_values(suffix, dtype):
    grey = textured(dtype)
    got = decode(encoded(suffix, np.dstack([grey, grey, grey])), SIZE)
    assert got.dtype == dtype
    # OpenCV's weights of red, green and blue sum to 1 within 2^-14: at 16 bits the error may be one.
    assert np.abs(got.astype(int) - grey).max() <= (0 if dtype == np.uint8 else 1)


def test_colour_becomes_grey_by_luminance_and_alpha_is_ignored():
    colour = np.zeros((48, 64, 4), np.uint8)
    colour[..., 2], colour[..., 3] = 100, 7  # red, almost transparent
    assert abs(int(decode(encoded(".png", colour), SIZE)[0, 0]) - 0.299 * 100) <= 1


def test_a_jpeg_is_read_to_the_accuracy_of_its_compression():
    smooth = np.tile(np.linspace(20, 200, 64).astype(np.uint8), (48, 1))
    got = decode(cv2.imencode(".jpg", smooth, [cv2.IMWRITE_JPEG_QUALITY, 100])[1].tobytes(), SIZE)
    assert np.abs(got.astype(int) - smooth).max() <= 3


def test_the_display_orientation_of_a_jpeg_is_not_applied():
    picture = np.zeros((48, 64), np.uint8)
    picture[:, :8] = 200
    data = encoded(".jpg", picture)
    exif = b"Exif\0\0II*\0" + struct.pack("<IHHHIHHI", 8, 1, 0x0112, 3, 1, 3, 0, 0)  # orientation 3: upside down
    data = data[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + data[2:]
    turned = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert turned[0, 0] < 50, "the test's file is not rotated by a viewer"
    assert decode(data, SIZE)[0, 0] > 150


@pytest.mark.parametrize("suffix", [".png", ".tif", ".bmp", ".pgm", ".jpg"])
@pytest.mark.parametrize("share", [0.02, 0.3, 0.6, 0.9, 0.99])
def test_a_truncated_picture_is_unreadable(suffix, share, capfd):
    data = encoded(suffix, textured())
    got = decode(data[: int(len(data) * share)], SIZE)
    assert isinstance(got, MissingPicture)
    assert got.reason.startswith("unreadable")
    assert capfd.readouterr().err == ""


def test_opencv_alone_reads_a_truncated_jpeg_without_error(tmp_path):
    """The reason why `decode` searches for the end marker, and pictures are not read by cv2.imread."""
    data = encoded(".jpg", textured())
    (tmp_path / "half.jpg").write_bytes(data[: len(data) // 2])
    assert cv2.imread(str(tmp_path / "half.jpg"), cv2.IMREAD_GRAYSCALE) is not None


@pytest.mark.parametrize("at", [0.3, 0.5, 0.9])
def test_one_wrong_byte_in_a_png_is_detected_by_its_checksum(at, capfd):
    data = bytearray(encoded(".png", textured()))
    data[int(len(data) * at)] ^= 0x10
    assert decode(bytes(data), SIZE).reason.startswith("unreadable: damaged (a checksum")
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("tail", [b"", b"\0" * 512, b"camera's own remark \xff\x00"])
def test_a_jpeg_with_data_after_its_end_is_complete(tail):
    assert not isinstance(decode(encoded(".jpg", textured()) + tail, SIZE), MissingPicture)


def test_the_end_of_a_progressive_jpeg_with_a_thumbnail_is_recognised():
    data = cv2.imencode(".jpg", textured(), [cv2.IMWRITE_JPEG_PROGRESSIVE, 1, cv2.IMWRITE_JPEG_RST_INTERVAL, 2])[1]
    thumbnail = encoded(".jpg", textured()[:8, :8])
    segment = b"\xff\xe1" + struct.pack(">H", len(thumbnail) + 2) + thumbnail
    whole = data.tobytes()[:2] + segment + data.tobytes()[2:]
    assert not isinstance(decode(whole, SIZE), MissingPicture)
    assert decode(whole[:-2], SIZE) == MissingPicture("unreadable: cut short")


@pytest.mark.parametrize("data", [b"", b"hello", b"\x89PNG\r\n\x1a\n", b"\xff\xd8", b"P5\n999999 999999\n255\n00"])
def test_an_empty_file_or_one_that_is_not_a_picture_is_unreadable(data, capfd):
    assert decode(data, SIZE).reason.startswith("unreadable")
    assert capfd.readouterr().err == ""


def test_a_png_with_an_absurd_size_in_its_header_is_unreadable():
    header = struct.pack(">IIBBBBB", 2**30, 2**30, 8, 0, 0, 0, 0)
    chunk = lambda kind, body: struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))  # noqa: E731
    data = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(b"0")) + chunk(b"IEND", b"")
    assert decode(data, SIZE).reason.startswith("unreadable")


def test_other_sizes_and_other_depths_than_8_or_16_bits_are_rejected(tmp_path):
    assert decode(encoded(".png", textured()), (48, 64)).reason == "wrong size 64x48, the rig says 48x64"
    assert "float32" in decode(encoded(".tif", textured().astype(np.float32)), SIZE).reason
    assert read_picture(tmp_path / "gone.png", SIZE).reason == "unreadable: No such file or directory"


# Folders --------------------------------------------------------------------------------------------------------


def test_every_picture_has_its_own_number_and_comes_in_order(tmp_path):
    sets = read_all(write_run(tmp_path / "a", frames=40))
    assert [s.frame for s in sets] == list(range(40))
    for s in sets:
        for camera in ("left", "right"):
            np.testing.assert_array_equal(s.images[camera], picture_of(s.frame))


def test_missing_numbers_are_dropped_frames_of_that_camera(tmp_path):
    folder = write_run(tmp_path / "a", frames=8)
    for camera, number in (("left", 0), ("left", 3), ("right", 3), ("right", 4), ("right", 7)):
        (folder / "frames" / camera / f"{number:06d}.png").unlink()
    reader = open_frames(load_run(folder))
    got = {s.frame: [c for c, p in s.images.items() if not isinstance(p, MissingPicture)] for s in reader}
    both = ["left", "right"]
    assert got == {0: ["right"], 1: both, 2: both, 3: [], 4: ["left"], 5: both, 6: both, 7: ["left"]}
    assert reader.notes == ["left: 2 frames dropped (0, 3)", "right: 3 frames dropped (3, 4, 7)"]
    assert (reader.first, reader.last, reader.expected_frames) == (0, 7, 8)


def test_the_run_continues_past_damaged_empty_and_wrong_sized_pictures(tmp_path, capfd):
    folder = write_run(tmp_path / "a", frames=6)
    left = folder / "frames" / "left"
    whole = (left / "000001.png").read_bytes()
    (left / "000001.png").write_bytes(whole[: len(whole) // 2])
    (left / "000002.png").write_bytes(b"")
    cv2.imwrite(str(left / "000004.png"), np.zeros((10, 12), np.uint8))
    reader = open_frames(load_run(folder))
    reasons = {s.frame: s.images["left"].reason for s in reader if isinstance(s.images["left"], MissingPicture)}
    assert reasons == {
        1: "unreadable: cut short",
        2: "unreadable: the file is empty",
        4: "wrong size 12x10, the rig says 64x48",
    }
    assert reader.notes == [f"left: 1 frame {reason} ({frame})" for frame, reason in reasons.items()]
    assert capfd.readouterr().err == ""


def test_the_number_is_the_last_group_of_digits_of_the_name(tmp_path):
    names = ["cam2_run7_0012.PNG", "13.jpeg", "cam2-000014_raw.Tiff", "15.bmp", "16.pgm"]
    for name in [*names, "._17.png", "background.png", "notes18.txt", "19.png.part"]:
        (tmp_path / name).write_bytes(b"")
    (tmp_path / "20.png").mkdir()
    listing = list_folder(tmp_path)
    assert listing.files == {k: tmp_path / name for k, name in zip(range(12, 17), names, strict=True)}
    assert listing.ignored == ("._17.png", "19.png.part", "background.png", "notes18.txt")


@pytest.mark.parametrize("other", ["0.png", "000000.tif", "left_000000.png"])
def test_two_pictures_of_one_number_are_an_error(other, tmp_path):
    folder = write_run(tmp_path / "a")
    (folder / "frames/left" / other).write_bytes(b"")
    with pytest.raises(InputError, match=r"expected one picture per frame, got .* for frame 0; remove one"):
        open_frames(load_run(folder))


def test_an_empty_folder_is_an_error(tmp_path):
    folder = write_run(tmp_path / "a")
    for path in (folder / "frames/left").iterdir():
        path.rename(path.with_suffix(".raw"))
    with pytest.raises(InputError, match=r"left: expected pictures with a number .*, found none among 5 files"):
        open_frames(load_run(folder))


def test_a_number_far_from_the_others_is_an_error_and_not_a_million_empty_rows(tmp_path):
    folder = write_run(tmp_path / "a")
    (folder / "frames/left/1000000.png").write_bytes(b"")
    with pytest.raises(InputError, match="got 11 pictures between frame 0 and frame 1000000; is a stray file"):
        open_frames(load_run(folder))


def test_a_long_gap_between_several_pictures_is_kept(tmp_path):
    folder = write_run(tmp_path / "a")
    for camera in ("left", "right"):
        for old, new in ((3, 20000), (4, 20001)):
            (folder / f"frames/{camera}/{old:06d}.png").rename(folder / f"frames/{camera}/{new:06d}.png")
    sets = read_all(folder)
    assert len(sets) == 20002
    assert sum(isinstance(s.images["left"], MissingPicture) for s in sets) == 20002 - 5


def test_a_single_stray_file_is_an_error_before_the_gap_is_filled(tmp_path):
    """90,000 empty rows take 95 s."""
    folder = write_run(tmp_path / "a", frames=30)
    (folder / "frames/left/090000.png").write_bytes(b"")
    with pytest.raises(InputError) as refused:
        open_frames(load_run(folder))
    assert str(refused.value) == (
        f"{folder / 'frames/left/090000.png'}: expected frame numbers without a long gap, got 90000, where the others"
        " are 0 to 29; is it a stray file? Remove it"
    )


def test_a_picture_without_a_timestamp_is_an_error_and_a_dropped_one_needs_none(tmp_path):
    folder = write_run(tmp_path / "a")
    edit(folder / "run.yaml", "name: small", "name: small\ntimestamps: times.csv")
    (folder / "times.csv").write_text("frame,t_s\n0,0\n1,0.01\n2,0.02\n4,0.04\n")
    with pytest.raises(InputError, match=r"timestamps: .* got none for 1 of them \(the first is frame 3\)"):
        open_frames(load_run(folder))
    for camera in ("left", "right"):
        (folder / "frames" / camera / "000003.png").unlink()
    assert len(read_all(folder)) == 5


# Reading ahead --------------------------------------------------------------------------------------------------


def test_a_limited_number_of_frames_is_read_ahead(tmp_path, monkeypatch):
    lock, state = threading.Lock(), {"read": 0}
    real = read_picture

    def counted(path, *how):
        with lock:
            state["read"] += 1
        return real(path, *how)

    monkeypatch.setattr("lab.pictures.source.read_picture", counted)
    for taken, _ in enumerate(open_frames(load_run(write_run(tmp_path / "a", frames=60))), start=1):
        if taken == 20:  # while the consumer processes this frame, the threads read up to the limit
            until = time.monotonic() + 10
            while state["read"] < 2 * (taken + AHEAD - 1) and time.monotonic() < until:
                time.sleep(0.01)
            time.sleep(0.1)
            assert state["read"] == 2 * (taken + AHEAD - 1)
    assert state["read"] == 120


def test_pictures_that_the_noise_is_estimated_from_are_not_decoded_again(tmp_path, monkeypatch):
    decoded = []

    def noted(path, *how):
        decoded.append(path)
        return read_picture(path, *how)

    monkeypatch.setattr("lab.pictures.source.read_picture", noted)
    pipeline = Pipeline.of(load_run(write_run(tmp_path / "a", frames=20)))
    assert decoded
    for frame_set in pipeline.reader:
        for picture in frame_set.images.values():
            np.testing.assert_array_equal(picture, picture_of(frame_set.frame))
    assert len(decoded) == len(set(decoded)) == 40


def test_an_exception_in_a_thread_reaches_the_reader(tmp_path, monkeypatch):
    def broken(path, *_):
        raise RuntimeError(f"boom {path.name}")

    monkeypatch.setattr("lab.pictures.source.read_picture", broken)
    with pytest.raises(RuntimeError, match=r"boom 000000\.png"):
        read_all(write_run(tmp_path / "a"))
    assert not [t for t in threading.enumerate() if t.name.startswith("decode")]


def test_stopping_early_leaves_no_thread_and_the_reader_can_start_again(tmp_path):
    reader = open_frames(load_run(write_run(tmp_path / "a", frames=40)))
    for frame_set in reader:
        if frame_set.frame == 3:
            break
    walk = iter(reader)
    next(walk)
    walk.close()
    assert not [t for t in threading.enumerate() if t.name.startswith("decode")]
    assert [s.frame for s in reader] == list(range(40))


MEASURE = """
import resource, sys
from pathlib import Path
from lab.files.run.run_file import load_run
from lab.runs.frames.frames import open_frames
count = sum(1 for _ in open_frames(load_run(Path(sys.argv[1]))))
print(count, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
"""


@pytest.mark.slow
def test_memory_does_not_grow_with_the_length_of_the_run(tmp_path):
    peaks = {}
    for count in (60, 600):
        folder = write_run(tmp_path / str(count), frames=1)
        big = np.random.default_rng(0).integers(0, 9, (1024, 1280)).astype(np.uint8)
        text = (folder / "rig.yaml").read_text().replace("image_size_px: [64, 48]", "image_size_px: [1280, 1024]")
        (folder / "rig.yaml").write_text(text)
        for camera in ("left", "right"):
            first = folder / "frames" / camera / "000000.png"
            cv2.imwrite(str(first), big)
            for frame in range(1, count):
                os.link(first, folder / "frames" / camera / f"{frame:06d}.png")
        out = subprocess.run([sys.executable, "-c", MEASURE, str(folder)], capture_output=True, text=True, check=True)
        got, peaks[count] = map(int, out.stdout.split())
        assert got == count
    assert peaks[600] <= 1.1 * peaks[60]


# Videos ---------------------------------------------------------------------------------------------------------


def write_video(path: Path, count: int, fourcc: str = "FFV1") -> None:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*fourcc), 100, SIZE, False)
    if not writer.isOpened():
        pytest.skip(f"this OpenCV cannot write {fourcc} video")
    for frame in range(count):
        writer.write(picture_of(frame))
    writer.release()


@pytest.fixture
def video_run(tmp_path) -> Path:
    """Left a lossless video of 12 pictures, right a folder of 5."""
    folder = write_run(tmp_path / "a")
    write_video(folder / "left.avi", 12)
    edit(folder / "run.yaml", "frames/left", "left.avi")
    return folder


def test_frame_n_of_a_video_is_its_nth_picture(video_run):
    reader = open_frames(load_run(video_run))
    sets = list(reader)
    assert [s.frame for s in sets] == list(range(12))
    for s in sets:
        np.testing.assert_array_equal(s.images["left"], picture_of(s.frame))
        assert isinstance(s.images["right"], MissingPicture) == (s.frame >= 5)
    assert reader.expected_frames == 12


@pytest.mark.parametrize("fourcc", ["FFV1", "MJPG"])
def test_the_grey_of_a_colour_video_is_that_of_all_channels(fourcc, tmp_path):
    """A green light is grey in a lossless video (all channels come) and in a compressed one (the luma comes) alike."""
    path = tmp_path / "green.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*fourcc), 25, SIZE, True)
    if not writer.isOpened():
        pytest.skip(f"this OpenCV cannot write {fourcc} video")
    for _ in range(3):
        writer.write(np.full((SIZE[1], SIZE[0], 3), (10, 200, 10), np.uint8))
    writer.release()
    picture = next(picture for _, picture in pictures(video_at(path), SIZE))
    assert isinstance(picture, np.ndarray)
    assert np.median(picture) == pytest.approx(0.587 * 200 + 0.413 * 10, abs=8)


def test_frames_after_the_end_of_a_video_are_dropped(video_run):
    write_video(video_run / "left.avi", 3)
    sets = read_all(video_run)
    assert [isinstance(s.images["left"], MissingPicture) for s in sets] == [False] * 3 + [True] * 2


def test_pictures_of_a_video_of_another_size_are_missing(video_run):
    text = (video_run / "rig.yaml").read_text().replace("image_size_px: [64, 48]", "image_size_px: [48, 64]", 1)
    (video_run / "rig.yaml").write_text(text)
    assert {s.images["left"].reason for s in read_all(video_run)} == {"wrong size 64x48, the rig says 48x64"}


@pytest.mark.parametrize("content", [b"", b"no video at all" * 100])
def test_a_file_that_is_not_a_video_is_an_input_error(content, video_run):
    (video_run / "left.avi").write_bytes(content)
    with pytest.raises(InputError, match=r"left\.avi: expected a video that OpenCV can read"):
        open_frames(load_run(video_run))


def test_a_video_that_is_shorter_than_its_header_states_is_noted(video_run, monkeypatch):
    monkeypatch.setattr(frames, "video_at", lambda path, camera: replace(video_at(path, camera), count=20))
    reader = open_frames(load_run(video_run))
    assert len(list(reader)) == 12
    assert reader.notes[0].endswith("left.avi: ended after 12 pictures; its header states 20")


def test_single_pictures_can_be_read(video_run):
    run = load_run(video_run)
    got = pictures_at(run, "left", [7, 3, 40, 3])
    assert list(got) == [3, 7, 40]
    np.testing.assert_array_equal(got[3], picture_of(3))
    np.testing.assert_array_equal(got[7], picture_of(7))
    assert got[40] == MissingPicture("dropped")
    folder = pictures_at(run, "right", [4, 9])
    np.testing.assert_array_equal(folder[4], picture_of(4))
    assert folder[9] == MissingPicture("dropped")
