"""Image files decode to what OpenCV makes of them, and damage is an error of ours: no library prints on stderr."""

from __future__ import annotations

import io
import struct
import subprocess
import sys
import zlib
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest
from PIL import Image

from vplog.image_file import BadImageError, decode_image

if TYPE_CHECKING:
    from pathlib import Path

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


def png_of(head: bytes, body: bytes) -> bytes:
    data = bytearray(b"\x89PNG\r\n\x1a\n")
    for kind, content in ((b"IHDR", head), (b"IDAT", body), (b"IEND", b"")):
        data += struct.pack(">I", len(content)) + kind + content + bytes(4)
    return with_sound_checksums(data)


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


@pytest.mark.parametrize("colour", [0, 2, 4, 6])
@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("size", [(1, 1), (3, 2), (9, 17)])
def test_an_interlaced_png_is_read(size: tuple[int, int], bits: int, colour: int) -> None:
    """Seven passes, of which small images lack some."""
    width, height = size
    samples = {0: 1, 2: 3, 4: 2, 6: 4}[colour]
    pixels = RNG.integers(0, 256, (height, width, samples * bits // 8)).astype(np.uint8)
    steps = ((0, 0, 8, 8), (4, 0, 8, 8), (0, 4, 4, 8), (2, 0, 4, 4), (0, 2, 2, 4), (1, 0, 2, 2), (0, 1, 1, 2))
    rows = [row for x, y, dx, dy in steps for row in pixels[y::dy, x::dx] if row.size]
    head = struct.pack(">IIBBBBB", width, height, bits, colour, 0, 0, 1)
    file = png_of(head, zlib.compress(b"".join(b"\0" + row.tobytes() for row in rows)))
    expected = cv2.imdecode(np.frombuffer(file, np.uint8), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH)
    assert expected is not None
    np.testing.assert_array_equal(decode_image(file), expected)
    with pytest.raises(BadImageError, match="do not unpack to its size"):
        decode_image(png_of(head, zlib.compress(b"\0" * 5000)))


def test_stderr_of_a_command_has_vplogs_lines_alone(tmp_path: Path) -> None:
    """A folder of sound and damaged images of one camera; what is lost is said by vplog."""
    kinds = ("png", "jpeg", "webp", "bmp")
    for number in range(24):
        kind = kinds[number % 4]
        data = FILES[kind] if number < 8 else damaged(FILES[kind], number // 4)
        (tmp_path / f"{number:03}.{kind}").write_bytes(data)
    done = subprocess.run(
        [sys.executable, "-m", "vplog", "library", str(tmp_path), "-o", str(tmp_path / "lib"), "--set",
         "library.size=24"], capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert "Lost: " in done.stderr
    for line in done.stderr.splitlines():
        assert not any(word in line for word in ("libpng", "JPEG data", "[ERROR", "[ WARN", "imdecode_")), line
