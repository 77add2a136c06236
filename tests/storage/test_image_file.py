"""Image files decode to what OpenCV makes of them, and damage is an error of ours: no library prints on stderr."""

from __future__ import annotations

import io
import struct
import zlib
from contextlib import suppress
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest
import simplejpeg
from PIL import Image

from vplog import logs
from vplog.storage.image_file import BadImageError, decode_image, decoding_bytes

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from conftest import Said

RNG = np.random.default_rng(4)
COLOUR = cv2.resize(RNG.integers(0, 256, (12, 16, 3)).astype(np.uint8), (160, 120))
DEPTH = COLOUR[..., 0].astype(np.uint16) * 16


def encoded(kind: str, pixels: np.ndarray = COLOUR, *options: int) -> bytes:
    return cv2.imencode(kind, pixels, options)[1].tobytes()


def by_pillow(kind: str, pixels: np.ndarray, mode: str | None = None, **options: object) -> bytes:
    file = io.BytesIO()
    image = Image.fromarray(pixels) if mode is None else Image.fromarray(pixels).convert(mode)
    image.save(file, kind, **options)
    return file.getvalue()


FILES = {
    "png": encoded(".png"),
    "png16": encoded(".png", DEPTH),
    "palette": by_pillow("PNG", COLOUR, "P"),
    "one-bit": by_pillow("PNG", COLOUR, "1"),
    "profile": by_pillow("PNG", COLOUR, icc_profile=b"no profile" * 20),
    "jpeg": encoded(".jpg"),
    "progressive": encoded(".jpg", COLOUR, cv2.IMWRITE_JPEG_PROGRESSIVE, 1),
    "inks": by_pillow("JPEG", np.dstack([COLOUR, COLOUR[..., 0]]), "CMYK"),
    "exif": by_pillow("JPEG", COLOUR, icc_profile=b"x" * 90, exif=b"Exif\0\0II*\0garbage"),
    "webp": encoded(".webp"),
    "bmp": encoded(".bmp"),
    "pgm": encoded(".pgm", COLOUR[..., 0]),
    "tiff": by_pillow("TIFF", COLOUR),
}


def with_sound_checksums(png: bytearray) -> bytes:
    position = 8
    while position + 12 <= len(png):
        (length,) = struct.unpack_from(">I", png, position)
        if (stop := position + 8 + length) + 4 > len(png):
            break
        struct.pack_into(">I", png, stop, zlib.crc32(png[position + 4 : stop]))
        position = stop + 4
    return bytes(png)


def chunk(kind: bytes, content: bytes, wrong: int = 0) -> bytes:
    """With a checksum that is off by `wrong`."""
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content) ^ wrong)


def random_png(rng: np.random.Generator, coding: tuple[int, int] = (0, 0), palette: int | None = None) -> bytes:
    """Of any colour type, depth and filters, interlaced or not, with what encoders leave in and beside the pixels.
    `coding`: its methods of compression and filters; `palette`: the bytes of a palette, whatever the type."""
    colour = int(rng.choice([0, 2, 3, 4, 6]))
    bits = int(rng.choice({0: (1, 2, 4, 8, 16), 3: (1, 2, 4, 8)}.get(colour, (8, 16))))
    (width, height), interlaced = rng.integers(4, 30, 2).tolist(), int(rng.integers(2))
    samples = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}[colour]
    steps = ((0, 0, 8, 8), (4, 0, 8, 8), (0, 4, 4, 8), (2, 0, 4, 4), (0, 2, 2, 4), (1, 0, 2, 2), (0, 1, 1, 2))
    pixels = b""
    for x, y, dx, dy in steps if interlaced else ((0, 0, 1, 1),):
        row = (-(-(width - x) // dx) * samples * bits + 7) // 8
        pixels += b"".join(bytes([rng.integers(5)]) + rng.bytes(row) for _ in range(-(-(height - y) // dy)) if row)
    body = zlib.compress(pixels + bytes(rng.choice([0, 0, 50])), int(rng.integers(10))) + bytes(rng.choice([0, 0, 8]))
    at, more = int(rng.integers(len(body))), rng.random(5) < 0.3
    return b"".join([
        b"\x89PNG\r\n\x1a\n",
        chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, bits, colour, *coding, interlaced)),
        chunk(b"tEXt", b"a\0b", wrong=1) if more[0] else b"",
        chunk(b"acTL", struct.pack(">II", 1, 0)) if more[1] else b"",
        chunk(b"PLTE", rng.bytes(3 << bits if palette is None else palette)) if colour == 3 or palette else b"",
        chunk(b"tRNS", b"\0\1" * samples) if more[2] and colour < 3 else b"",
        chunk(b"IDAT", body[:at]), chunk(b"IDAT", b"") if more[3] else b"", chunk(b"IDAT", body[at:]),
        chunk(b"IEND", b"", wrong=int(more[4])),
        bytes(rng.choice([0, 9])),
    ])  # fmt: skip


def damaged(data: bytes, seed: int) -> bytes:
    """Cut, with flipped bits, with foreign bytes, or, of PNG, with flipped bits under sound checksums."""
    rng, found = np.random.default_rng(seed), bytearray(data)
    if seed % 4 == 0:
        return bytes(found[: rng.integers(1, len(found))])
    if seed % 4 == 1:
        at = int(rng.integers(len(found)))
        found[at : at + 50] = rng.integers(0, 256, len(found[at : at + 50])).astype(np.uint8).tobytes()
    for at in rng.integers(0, len(found), 3):
        found[at] ^= 1 << int(rng.integers(8))
    return with_sound_checksums(found) if seed % 4 == 2 and data[1:4] == b"PNG" else bytes(found)


@pytest.mark.parametrize("unchanged", [False, True])
@pytest.mark.parametrize("name", FILES)
def test_nothing_is_printed_of_damage(name: str, unchanged: bool, capfd: pytest.CaptureFixture[str]) -> None:
    for seed in range(120):
        data = FILES[name] if seed == 0 else damaged(FILES[name], seed)
        try:
            assert decode_image(data, unchanged).size
        except BadImageError as error:
            assert str(error)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("name", ["jpeg", "exif", "inks"])
def test_a_jpeg_that_lacks_its_end_marker_alone_is_whole(name: str, capfd: pytest.CaptureFixture[str]) -> None:
    data = FILES[name].removesuffix(b"\xff\xd9")
    assert np.array_equal(decode_image(data), decode_image(FILES[name]))
    for cut in (1, 2, 3, 9, len(data) // 4, len(data) // 2):
        with pytest.raises(BadImageError):
            decode_image(data[:-cut])
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("name", ["progressive", "two scans"])
def test_a_jpeg_of_several_scans_needs_its_end_marker(name: str) -> None:
    data = (
        FILES["progressive"]
        if name == "progressive"
        else FILES["jpeg"].replace(b"\xff\xda\0\x0c\3", b"\xff\xda\0\x0c\1")
    )
    with pytest.raises(BadImageError, match="not a whole JPEG"):
        decode_image(data.removesuffix(b"\xff\xd9"))


def test_a_jpeg_of_12_bits_is_refused_with_its_bits(capfd: pytest.CaptureFixture[str]) -> None:
    data = bytearray(FILES["jpeg"])
    data[data.index(b"\xff\xc0") + 4] = 12
    with pytest.raises(BadImageError, match="12 bits a sample"):
        decode_image(bytes(data))
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("compression", [None, "tiff_lzw", "tiff_adobe_deflate", "packbits"])
@pytest.mark.parametrize("pixels", [COLOUR, COLOUR[..., 0], DEPTH], ids=["colour", "grey", "grey16"])
def test_tiff_is_read_and_a_cut_one_is_not(compression: str | None, pixels: np.ndarray) -> None:
    data = by_pillow("TIFF", pixels, compression=compression)
    expected = cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY) if pixels.ndim == 3 else pixels
    found = decode_image(data)
    assert found.dtype == expected.dtype
    assert np.abs(found.astype(int) - expected).max() <= 1
    for stop in np.linspace(1, len(data) * 0.9, 20).astype(int):
        with pytest.raises(BadImageError):
            decode_image(data[:stop])


def test_a_folder_of_tiff_is_a_log(tmp_path: Path) -> None:
    for number in range(4):
        (tmp_path / f"{number:03d}.tiff").write_bytes(FILES["tiff"])
    log = logs.open(tmp_path)
    frames = log.frames(log.stamps())
    assert [frame.decode().image.shape for frame in frames] == [(120, 160)] * 4


def test_tiff_of_floats_is_refused() -> None:
    with pytest.raises(BadImageError, match="float32"):
        decode_image(by_pillow("TIFF", DEPTH.astype(np.float32)))


@pytest.mark.parametrize("name", sorted(FILES.keys() - {"tiff", "inks"}))
def test_pixels_are_opencvs(name: str) -> None:
    data = np.frombuffer(FILES[name], np.uint8)
    grey = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH)
    assert grey is not None
    np.testing.assert_array_equal(decode_image(FILES[name]), grey)
    unchanged = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    assert unchanged is not None
    np.testing.assert_array_equal(decode_image(FILES[name], unchanged=True), unchanged)


def test_four_inks_are_grey_as_opencv_has_them() -> None:
    grey = cv2.imdecode(np.frombuffer(FILES["inks"], np.uint8), cv2.IMREAD_GRAYSCALE)
    assert grey is not None
    assert np.abs(decode_image(FILES["inks"]).astype(int) - grey).max() <= 2


@pytest.mark.parametrize("seed", range(100))
def test_a_png_that_libpng_reads_is_read(seed: int) -> None:
    file = random_png(np.random.default_rng(seed))
    expected = cv2.imdecode(np.frombuffer(file, np.uint8), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH)
    assert expected is not None
    np.testing.assert_array_equal(decode_image(file), expected)


def test_grey_of_a_png_is_of_its_values_alone() -> None:
    """As that of rgb8 is: the gamma that a program writes beside the pixels is no camera's."""
    at = FILES["png"].index(b"IDAT") - 4
    gamma = FILES["png"][:at] + chunk(b"gAMA", struct.pack(">I", 45455)) + FILES["png"][at:]
    np.testing.assert_array_equal(decode_image(gamma), decode_image(FILES["png"]))


def test_nothing_is_printed_of_a_png_of_another_coding(capfd: pytest.CaptureFixture[str]) -> None:
    """In its header or palette, under sound checksums."""
    rng = np.random.default_rng(8)
    for _ in range(100):
        methods = (int(rng.choice([0, 0, 1])), int(rng.choice([0, 0, 64])))
        with suppress(BadImageError):
            decode_image(random_png(rng, methods, int(rng.integers(900))))
    assert capfd.readouterr() == ("", "")


def test_stderr_of_a_command_has_vplogs_lines_alone(tmp_path: Path, verb: Callable[..., Said]) -> None:
    """A folder of sound and damaged images of one camera; what is lost is said by vplog."""
    kinds = ("png", "jpeg", "webp", "bmp")
    for number in range(24):
        kind = kinds[number % 4]
        data = FILES[kind] if number < 8 else damaged(FILES[kind], number // 4)
        (tmp_path / f"{number:03}.{kind}").write_bytes(data)
    said = verb("library", tmp_path, "-o", tmp_path / "lib", "--set", "library.size=24")
    assert "Lost: " in said.err
    for line in said.err.splitlines():
        assert not any(word in line for word in ("libpng", "JPEG data", "[ERROR", "[ WARN", "imdecode_")), line


def test_a_jpeg_of_thousands_of_scans_is_refused() -> None:
    """Each is a pass over all blocks: 16 MB of them take half an hour."""
    data = cv2.imencode(".jpg", np.zeros((64, 64), np.uint8), [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
    scan = data.rindex(b"\xff\xda")
    with pytest.raises(BadImageError, match="more than 500 scans"):
        decode_image(data[:scan] + data[scan:-2] * 1000 + data[-2:])


LARGE = cv2.resize(RNG.integers(0, 256, (12, 16, 3)).astype(np.uint8), (1601, 1203))


@pytest.mark.parametrize("progressive", [0, 1])
def test_a_jpeg_is_reduced_as_far_as_so_many_pixels_allow(progressive: int) -> None:
    data = encoded(".jpg", LARGE, cv2.IMWRITE_JPEG_PROGRESSIVE, progressive)
    whole = decode_image(data)
    for least_px, eighths in ((10**7, 8), (10**6, 8), (400_000, 4), (260_000, 3), (10_000, 1), (1, 1)):
        found = decode_image(data, least_px=least_px)
        assert found.shape == (-(-1203 * eighths // 8), -(-1601 * eighths // 8))
        assert decode_image(data, True, least_px).shape == (*found.shape, 3)
        expected = cv2.resize(whole, found.shape[::-1], interpolation=cv2.INTER_AREA)
        assert np.abs(found.astype(int) - expected).mean() < 2


def test_the_memory_that_decoding_takes_is_known_by_the_header() -> None:
    px = COLOUR.shape[0] * COLOUR.shape[1]
    samples = {"png16": 2, "pgm": 2}
    for name, data in FILES.items():
        expected = 20 * px * samples.get(name, 1)
        assert expected <= decoding_bytes(data) <= 1.4 * expected, name
    rgba16 = encoded(".png", np.zeros((30, 40, 4), np.uint16))
    assert decoding_bytes(rgba16) == 40 * 1200
    assert decoding_bytes(encoded(".tiff", np.zeros((30, 40, 3), np.float64))) == 160 * 1200
    assert decoding_bytes(b"no image") == 0
    large = encoded(".jpg", LARGE)
    assert decoding_bytes(large, 10_000) < decoding_bytes(large) / 2


@pytest.mark.parametrize("marker", [0x00, 0x01, 0xD0, 0xD7])
def test_a_jpeg_does_not_hide_its_size_behind_markers_without_a_length(marker: int) -> None:
    """libjpeg passes over such a marker alone, and would find the frame in what seems to be its segment."""
    large, small = encoded(".jpg", LARGE), FILES["jpeg"]
    at, size = large.index(b"\xff\xc0"), 19
    frame, hidden = large[at : at + size], small[small.index(b"\xff\xc0") :][:size]
    comment = b"\xff\xfe" + struct.pack(">H", 2 + size)
    seeming = bytes([0xFF, marker]) + struct.pack(">H", 2 + size + len(comment)) + frame + comment
    forged = large[:at] + seeming + hidden + large[at + size :]
    assert simplejpeg.decode_jpeg_header(forged, strict=False)[:2] == LARGE.shape[:2]
    assert decoding_bytes(forged) in (0, decoding_bytes(large))


def test_a_tiff_does_not_hide_its_size_in_its_tiles() -> None:
    data = bytearray(by_pillow("TIFF", COLOUR))
    before, start = decoding_bytes(bytes(data)), int.from_bytes(data[4:8], "little")
    for number in range(int.from_bytes(data[start : start + 2], "little")):
        at = start + 2 + 12 * number
        if int.from_bytes(data[at : at + 2], "little") in (282, 278):  # a tag that is not needed
            struct.pack_into("<HHII", data, at, 322, 4, 1, 100_000)
            break
    else:
        pytest.fail("no tag to replace")
    assert decoding_bytes(bytes(data)) == before * 100_000 // COLOUR.shape[1]


def test_a_pnm_does_not_hide_its_size_in_a_comment() -> None:
    assert decoding_bytes(b"P5 # a\r16000 16000\n1 1 255\n" + bytes(99)) == decoding_bytes(b"P5 16000 16000 255\n")
