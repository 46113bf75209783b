"""Picture files of every kind: decoded to the last bit where intact, a reason where damaged."""

from __future__ import annotations

import resource
import struct
import subprocess
import sys
import threading
import zlib
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pytest

from lab.pictures import picture_file
from lab.pictures.inflate import decompress
from lab.pictures.picture_file import MissingPicture, read_picture
from tests.lab.pictures.picture_files import chunk, png, tiff

SIZE = (37, 29)
AS_OPENCV = cv2.IMREAD_ANYDEPTH | cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION


def noise(dtype: type = np.uint8, channels: int = 1, largest: int | None = None) -> np.ndarray:
    shape = (29, 37) if channels == 1 else (29, 37, channels)
    top = np.iinfo(dtype).max if largest is None else largest
    return np.random.default_rng(5).integers(0, top, shape, endpoint=True).astype(dtype)


def decode(data: bytes, size_px: tuple[int, int]) -> np.ndarray | MissingPicture:
    return picture_file.decode(np.frombuffer(bytearray(data), np.uint8), size_px)


def assert_same(data: bytes, picture: np.ndarray) -> None:
    got = decode(data, SIZE)
    assert not isinstance(got, MissingPicture), got.reason
    assert got.dtype == picture.dtype
    np.testing.assert_array_equal(got, picture)
    # compiled detection is made for one kind of array
    assert got.flags.c_contiguous
    assert got.flags.aligned
    assert got.flags.writeable
    assert got.dtype.isnative


def as_opencv(data: bytes) -> np.ndarray:
    return cv2.imdecode(np.frombuffer(data, np.uint8), AS_OPENCV)


# PNG ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("filters", [(0,), (1,), (2,), (3,), (4,), (4, 3, 2, 1, 0), (1, 1, 3, 4, 4, 2)])
def test_a_grey_png_of_every_filter_is_read_to_the_last_bit(dtype, filters):
    assert_same(png(noise(dtype), filters=filters), noise(dtype))
    smooth = np.add.outer(np.arange(29), np.arange(37)).astype(dtype) * (1 if dtype == np.uint8 else 900)
    assert_same(png(smooth, filters=filters), smooth)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize(("colour_type", "channels"), [(0, 1), (2, 3), (4, 2), (6, 4)])
@pytest.mark.parametrize("interlaced", [False, True])
def test_other_pngs_are_decoded_as_by_opencv(dtype, colour_type, channels, interlaced):
    data = png(noise(dtype, channels), colour_type=colour_type, interlaced=interlaced, filters=(0, 4))
    assert_same(data, as_opencv(data))
    if channels < 3:
        assert_same(data, noise(dtype, channels).reshape(29, 37, -1)[..., 0])


@pytest.mark.parametrize("bits", [1, 2, 4])
def test_pixels_of_less_than_a_byte_fill_the_range_of_8_bits(bits):
    picture = noise(largest=2**bits - 1)
    assert_same(png(picture, bits=bits), picture * (255 // (2**bits - 1)))


@pytest.mark.parametrize("transparent", [b"", chunk(b"tRNS", bytes(range(16)))])
def test_a_palette_is_applied_and_converted_to_grey(transparent):
    colours = np.random.default_rng(1).integers(0, 256, (16, 3)).astype(np.uint8)
    data = png(noise(largest=15), colour_type=3, bits=4, before=chunk(b"PLTE", colours.tobytes()) + transparent)
    assert_same(data, as_opencv(data))
    red, green, blue = colours[noise(largest=15)].astype(float).transpose(2, 0, 1)
    assert np.abs(decode(data, SIZE) - (0.299 * red + 0.587 * green + 0.114 * blue)).max() <= 1


def test_gamma_colour_and_transparency_chunks_change_no_stored_value():
    remarks = chunk(b"gAMA", struct.pack(">I", 10)) + chunk(b"sBIT", b"\x05") + chunk(b"tRNS", b"\x00\x07")
    assert_same(png(noise(), before=remarks), noise())


@pytest.mark.parametrize("colour_type", [0, 2])
def test_a_png_with_correct_checksums_and_damaged_content_is_unreadable_without_output(colour_type, capfd):
    samples = noise(channels={0: 1, 2: 3}[colour_type])
    packed = bytearray(zlib.compress(samples.tobytes()))
    too_short, too_long = zlib.compress(bytes(100)), zlib.compress(bytes(10**5))
    wrong_sum = bytes([*packed[:-1], packed[-1] ^ 1])
    packed[40] ^= 0xFF
    for content in (bytes(packed), bytes(packed[:50]), too_short, too_long, wrong_sum, b""):
        reason = decode(png(samples, colour_type=colour_type, content=content), SIZE).reason
        assert reason == "unreadable: damaged (its content cannot be unpacked)"
    assert capfd.readouterr() == ("", "")


def test_an_unknown_filter_is_damage(capfd):
    rows = np.full((29, 38), 5, np.uint8)
    assert decode(png(noise(), content=zlib.compress(rows.tobytes())), SIZE).reason.endswith("(an unknown filter)")
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(("bits", "colour_type"), [(3, 0), (16, 7), (8, 1), (32, 0)])
def test_an_impossible_png_header_is_damage(bits, colour_type, capfd):
    data = png(noise(), colour_type=colour_type)
    header = struct.pack(">IIBBBBB", *SIZE, bits, colour_type, 0, 0, 0)
    data = data[:8] + chunk(b"IHDR", header) + data[33:]
    assert isinstance(decode(data, SIZE), MissingPicture)
    assert capfd.readouterr() == ("", "")


# TIFF -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize(
    "layout", [{}, {"rows_per_strip": 4}, {"rows_per_strip": 29}, {"tile": (16, 16)}, {"tile": (48, 32)}, {"pages": 3}]
)
@pytest.mark.parametrize("packing", [{}, {"deflated": True}, {"deflated": True, "predictor": 2}])
def test_a_grey_tiff_is_read_to_the_last_bit(dtype, order, big, layout, packing):
    assert_same(tiff(noise(dtype), order=order, big=big, **layout, **packing), noise(dtype))


@pytest.mark.parametrize("compression", [1, 5, 8, 32773])
def test_a_tiff_that_opencv_wrote_is_read_to_the_last_bit(compression):
    for dtype in (np.uint8, np.uint16):
        data = cv2.imencode(".tif", noise(dtype), [cv2.IMWRITE_TIFF_COMPRESSION, compression])[1].tobytes()
        assert_same(data, noise(dtype))


def test_packed_bytes_of_every_length_and_kind_are_decompressed():
    """Long runs, self-referring strings, full and cleared code tables, compressed by OpenCV."""
    rng = np.random.default_rng(2)
    for picture in (
        np.zeros((300, 400), np.uint8),
        rng.integers(0, 256, (300, 400)).astype(np.uint8),
        rng.integers(0, 3, (300, 400)).astype(np.uint8),
        np.repeat(rng.integers(0, 256, (300, 20)), 20, axis=1).astype(np.uint8),
    ):
        for compression, predictor in ((5, 1), (5, 2), (32773, 1)):
            flags = [cv2.IMWRITE_TIFF_COMPRESSION, compression, cv2.IMWRITE_TIFF_PREDICTOR, predictor]
            got = decode(cv2.imencode(".tif", picture, flags)[1].tobytes(), (400, 300))
            np.testing.assert_array_equal(got, picture)


def test_a_damaged_8_bit_strip_is_not_a_picture_of_zeros(capfd):
    data = cv2.imencode(".tif", noise(), [cv2.IMWRITE_TIFF_COMPRESSION, 5])[1].tobytes()
    at = data.index(b"\x80", 8)  # the first code of LZW empties the table
    beyond = data[: at + 40] + b"\xff\xff\xff" + data[at + 43 :]  # a code that is not in the table yet
    assert not as_opencv(beyond).all()
    assert decode(beyond, SIZE) == MissingPicture("unreadable: damaged, or cut short")
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("order", ["<", ">"])
def test_the_orientation_tag_of_a_tiff_is_not_applied(order):
    assert_same(tiff(noise(), order=order, tags={274: 3}), noise())
    black_is_one = decode(tiff(noise(), order=order, tags={274: 6, 262: 0}), SIZE)  # by OpenCV
    np.testing.assert_array_equal(black_is_one, 255 - noise())


@pytest.mark.parametrize(
    ("dtype", "name"), [(np.float32, "float32"), (np.float64, "float64"), (np.int16, "int16"), (np.uint32, "uint32")]
)
def test_sample_types_that_no_camera_has_are_refused_before_decoding(dtype, name):
    assert decode(tiff(noise().astype(dtype)), SIZE).reason.startswith(f"unreadable: {name} numbers, expected 8 or 16")


@pytest.mark.parametrize("changes", [{273: 10**6}, {279: 5}, {278: 0}, {322: 2**30, 323: 2**30}, {259: 9}, {259: 10}])
def test_a_tiff_whose_directory_contradicts_its_content_is_unreadable(changes, capfd):
    for deflated in (False, True):
        got = decode(tiff(noise(), deflated=deflated, rows_per_strip=5, tags=changes), SIZE)
        assert isinstance(got, MissingPicture) or np.array_equal(got, noise())
    assert capfd.readouterr() == ("", "")


# PGM, BMP, JPEG -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("largest", [1, 100, 255, 256, 1023, 4095, 65535])
@pytest.mark.parametrize("head", ["P{} 37 29 {}\n", "P{}\n# by a camera\n37 # wide\n29\n{}\n", "P{}\n37\t29\r{} "])
def test_a_pgm_has_its_stored_values_whatever_the_stated_maximum(largest, head):
    dtype = np.uint8 if largest < 256 else np.uint16
    picture = noise(dtype, largest=largest)
    assert_same(head.format(5, largest).encode() + picture.astype(picture.dtype.newbyteorder(">")).tobytes(), picture)
    text = "\n".join(" ".join(map(str, row)) for row in picture.tolist())
    assert_same(head.format(2, largest).encode() + text.encode() + b"\n", picture)


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"P5 37 29 255\n" + bytes(37 * 29 - 1), "cut short"),
        (b"P2 37 29 255\n" + b"1 " * (37 * 29 - 1), "cut short"),
        (b"P2 37 29 255\n" + b"1 " * (37 * 29 - 1) + b"256", "damaged (a value is not within 0 and 255)"),
        (b"P2 37 29 255\n" + b"1 " * (37 * 29 - 1) + b"x", "damaged (expected whole numbers)"),
        (b"P2 37 29 255\n" + b"9" * 5000 + b" 1" * (37 * 29), "damaged (expected whole numbers)"),
        (b"P5 37 29 70000\n", "damaged (its largest value is 70000)"),
        (b"P5 37 29 0\n", "damaged (its largest value is 0)"),
        (b"P5 0 29 255\n", "damaged (the header says 0x29 px)"),
        (b"P5 37 x 255\n", "damaged (its header)"),
        (b"P5 37", "cut short"),
    ],
)
def test_an_invalid_pgm_is_refused_with_the_reason(data, reason):
    assert decode(data, SIZE) == MissingPicture(f"unreadable: {reason}")


def test_pbm_and_colour_ppm_are_decoded_as_by_opencv():
    for data in (b"P4 37 29\n" + bytes(range(5 * 29)), b"P6 37 29 255\n" + noise(channels=3).tobytes()):
        assert_same(data, as_opencv(data))


@pytest.mark.parametrize("channels", [1, 3])
def test_a_bmp_is_decoded_as_by_opencv(channels):
    data = cv2.imencode(".bmp", noise(channels=channels))[1].tobytes()
    assert_same(data, as_opencv(data))


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("progressive", [0, 1])
def test_a_jpeg_is_decoded_as_by_opencv(channels, progressive):
    flags = [cv2.IMWRITE_JPEG_QUALITY, 90, cv2.IMWRITE_JPEG_PROGRESSIVE, progressive]
    data = cv2.imencode(".jpg", noise(channels=channels), flags)[1].tobytes()
    assert_same(data, as_opencv(data))


def test_a_damaged_jpeg_is_unreadable_but_padding_before_a_marker_is_allowed(capfd):
    data = cv2.imencode(".jpg", noise())[1].tobytes()
    half = len(data) // 2
    assert decode(data[:half] + data[half + 30 :], SIZE).reason.startswith("unreadable: damaged (")
    padded = decode(data[:-2] + b"\x55" * 9 + data[-2:], SIZE)
    np.testing.assert_array_equal(padded, as_opencv(data))
    assert capfd.readouterr() == ("", "")


def test_a_jpeg_without_an_end_marker_or_a_frame_header_is_unreadable(capfd):
    data = cv2.imencode(".jpg", noise())[1].tobytes()
    assert decode(data[:-2], SIZE) == MissingPicture("unreadable: cut short")
    assert decode(b"\xff\xd8\xff\xd9", SIZE) == MissingPicture(
        "unreadable: damaged (no frame header before the first scan)"
    )
    assert decode(data[:20], SIZE) == MissingPicture("unreadable: cut short")
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(("bits", "named"), [(12, True), (16, False)])
def test_a_jpeg_of_twelve_bits_is_named_and_one_of_sixteen_is_left_to_the_decoder(bits, named, capfd):
    data = bytearray(cv2.imencode(".jpg", noise())[1].tobytes())
    data[data.index(b"\xff\xc0") + 4] = bits
    reason = decode(bytes(data), SIZE).reason
    assert reason.startswith("unreadable: ")
    assert (f"{bits} bit numbers, expected 8 or 16 bits" in reason) == named
    assert capfd.readouterr() == ("", "")


# Hostile headers ------------------------------------------------------------------------------------------------


def of_size(kind: str, width: int, height: int) -> bytes:
    """The smallest file of a kind with this size in its header."""
    if kind == "png":
        return png(noise(), size=(width, height))
    if kind == "colour png":
        return png(noise(channels=3), colour_type=2, size=(width, height))
    if kind == "tiff":
        return tiff(noise(), tags={256: width, 257: height})
    if kind == "deflated tiff":
        return tiff(noise(), deflated=True, tags={256: width, 257: height, 278: height})
    if kind == "pgm":
        return b"P5 %d %d 255\n" % (width, height) + bytes(50)
    if kind == "ascii pgm":
        return b"P2 %d %d 255\n" % (width, height) + b"0 " * 50
    if kind == "bmp":
        data = cv2.imencode(".bmp", noise())[1].tobytes()
        return data[:18] + struct.pack("<ii", width, height) + data[26:]
    data = cv2.imencode(".jpg", noise())[1].tobytes()
    at = data.index(b"\xff\xc0") + 5
    return data[:at] + struct.pack(">HH", height % 65536, width % 65536) + data[at + 4 :]


KINDS = ["png", "colour png", "tiff", "deflated tiff", "pgm", "ascii pgm", "bmp", "jpeg"]


@pytest.mark.parametrize("kind", KINDS)
def test_a_picture_of_another_size_than_the_rig_has_is_not_decoded(kind, monkeypatch):
    def never(*_):
        raise AssertionError("decoded")

    for name in ("png", "jpeg", "tiff", "pnm", "bmp"):
        monkeypatch.setitem(sys.modules["lab.pictures.picture_file"]._DECODERS, name, never)
    assert decode(of_size(kind, 640, 480), SIZE) == MissingPicture("wrong size 640x480, the rig says 37x29")
    big = decode(of_size(kind, 30000, 30000), None).reason
    assert big.startswith("unreadable: the header says 30000x30000 px, more than")
    for size in ((0, 480), (640, 0)):
        assert (
            decode(of_size(kind, *size), None).reason == f"unreadable: damaged (the header says {size[0]}x{size[1]} px)"
        )


@pytest.mark.parametrize("kind", KINDS)
def test_content_smaller_than_the_stated_size_is_unreadable_without_output(kind, capfd):
    got = decode(of_size(kind, 37, 3000), (37, 3000))
    assert isinstance(got, MissingPicture)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("kind", KINDS)
def test_any_truncated_or_changed_file_is_a_picture_or_missing_never_an_exception(kind, capfd):
    whole = of_size(kind, *SIZE)
    rng = np.random.default_rng(11)
    for end in {*range(min(len(whole), 120)), *rng.integers(0, len(whole), 30).tolist()}:
        decode(whole[:end], SIZE)
    for _ in range(300):
        changed = bytearray(whole)
        for at in rng.integers(0, rng.choice([60, len(whole)]), rng.integers(1, 4)):
            changed[at] = rng.integers(256)
        decode(bytes(changed), SIZE)
    assert capfd.readouterr() == ("", "")


def test_a_stream_of_gigabytes_is_decompressed_only_to_the_size_of_the_picture():
    packer = zlib.compressobj()
    first, again = (packer.compress(bytes(1 << 20)) + packer.flush(zlib.Z_FULL_FLUSH) for _ in range(2))
    bomb = first + 2000 * again + packer.flush()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert decompress(bomb, 30 * 37) is None
    assert isinstance(decode(png(noise(), content=bomb), SIZE), MissingPicture)
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    assert grown <= 50_000 * (1024 if sys.platform == "darwin" else 1)


def test_a_file_too_large_to_be_a_picture_of_the_rig_is_not_read_into_memory(tmp_path):
    path = tmp_path / "000000.pgm"
    with path.open("wb") as file:
        file.write(b"P5 60000 60000 255\n")
        file.truncate(3_600_000_100)  # takes no room on the disk
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert read_picture(path, SIZE).reason.startswith("unreadable: the header says 60000x60000 px")
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    assert grown <= 50_000 * (1024 if sys.platform == "darwin" else 1)


# Threads --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".png", ".tif", ".jpg"])
def test_pictures_are_the_same_for_any_number_of_threads(suffix, tmp_path):
    paths = []
    for k in range(24):
        paths.append(tmp_path / f"{k:03d}{suffix}")
        cv2.imwrite(str(paths[-1]), np.roll(noise(), k, axis=1))
    alone = [read_picture(p, SIZE) for p in paths]
    for threads in (2, 7):
        with ThreadPoolExecutor(threads) as pool:
            for a, b in zip(alone, pool.map(lambda p: read_picture(p, SIZE), paths), strict=True):
                np.testing.assert_array_equal(a, b)


def test_other_threads_run_while_a_png_is_decoded():
    """The GIL is released: a counting thread continues during the decoding."""
    big = np.random.default_rng(0).integers(0, 3, (3000, 4000)).astype(np.uint8)
    data = cv2.imencode(".png", big, [cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_PAETH])[1].tobytes()
    decode(data, None)
    counts, done = [0], threading.Event()

    def decoding() -> None:
        decode(data, None)
        done.set()

    thread = threading.Thread(target=decoding)
    thread.start()
    while not done.is_set():
        counts[0] += 1
        done.wait(1e-4)
    thread.join()
    assert counts[0] >= 20


CHATTER = """
import sys
import numpy as np
from lab.pictures.picture_file import decode
for line in sys.stdin.buffer.read().split(b"=====")[:-1]:
    print(type(decode(np.frombuffer(line, np.uint8), None)).__name__)
"""


def test_a_process_writes_nothing_to_standard_error():
    files = [of_size(kind, 37, 300) for kind in KINDS]
    out = subprocess.run(
        [sys.executable, "-c", CHATTER], input=b"".join(f + b"=====" for f in files), capture_output=True, check=True
    )
    assert out.stderr == b""
    assert set(out.stdout.split()) <= {b"MissingPicture", b"ndarray"}
