from __future__ import annotations

import io
import struct
import zlib

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from vplog.logs.messages.pixels import Levels, depth_m, grey, is_depth
from vplog.logs.messages.records import BadMessageError, ImageMessage
from vplog.storage.image_file import image_size

RNG = np.random.default_rng(1)


def raw(encoding: str, pixels: np.ndarray, padding: int = 0, big_endian: bool = False) -> ImageMessage:
    """The message of native (H, W[, C]) pixels with `padding` bytes behind each row."""
    height, width = pixels.shape[:2]
    data = pixels.astype(pixels.dtype.newbyteorder(">" if big_endian else "<")).tobytes()
    row = len(data) // height
    rows = [data[i * row : (i + 1) * row] + b"\xee" * padding for i in range(height)]
    return ImageMessage(0, "", encoding, b"".join(rows), False, width, height, row + padding, big_endian)


@pytest.mark.parametrize("padding", [0, 5])
@pytest.mark.parametrize(
    ("encoding", "order"),
    [("rgb8", "RGB"), ("bgr8", "BGR"), ("rgba8", "RGBA"), ("bgra8", "BGRA"), ("8UC3", "BGR"), ("8UC4", "BGRA")],
)
def test_colours_become_the_same_grey(encoding: str, order: str, padding: int) -> None:
    colour = {c: RNG.integers(0, 256, (7, 9)).astype(np.uint8) for c in "RGBA"}
    expected = 0.299 * colour["R"] + 0.587 * colour["G"] + 0.114 * colour["B"]  # ITU-R BT.601
    image = grey(raw(encoding, np.stack([colour[c] for c in order], axis=-1), padding))
    assert image.dtype == np.uint8
    np.testing.assert_allclose(image, expected, atol=0.51)


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_mosaics_become_the_grey_of_their_colours(pattern: str, bits: int) -> None:
    """Two fields of one colour each: inside a field every way of filling the gaps gives the field's colour."""
    colours = {c: np.repeat([[left, right]], 10, axis=1).repeat(8, axis=0) for c, left, right in _FIELDS}
    mosaic = np.zeros((8, 20), np.uint8)
    for i, c in enumerate(pattern.upper()):
        mosaic[i // 2 :: 2, i % 2 :: 2] = colours[c][i // 2 :: 2, i % 2 :: 2]
    expected = 0.299 * colours["R"] + 0.587 * colours["G"] + 0.114 * colours["B"]
    pixels = mosaic if bits == 8 else mosaic.astype(np.uint16) * 257
    image = grey(raw(f"bayer_{pattern}{bits}", pixels, padding=6, big_endian=bits == 16), Levels(0, 65535))
    np.testing.assert_allclose(image[:, 2:8], expected[:, 2:8], atol=1)
    np.testing.assert_allclose(image[:, 12:18], expected[:, 12:18], atol=1)
    file = cv2.imencode(".png", mosaic)[1].tobytes()  # as a transport compresses it
    packed = grey(ImageMessage(0, "", f"bayer_{pattern}8; png compressed ", file, True))
    np.testing.assert_array_equal(packed, grey(raw(f"bayer_{pattern}8", mosaic)))


_FIELDS = (("R", 200, 90), ("G", 40, 120), ("B", 90, 250))


@pytest.mark.parametrize(("encoding", "first"), [("yuv422", 1), ("uyvy", 1), ("yuv422_yuy2", 0), ("yuyv", 0)])
def test_shared_colours_leave_the_luma(encoding: str, first: int) -> None:
    pixels = RNG.integers(0, 256, (6, 8, 2)).astype(np.uint8)
    np.testing.assert_array_equal(grey(raw(encoding, pixels, 4)), pixels[..., first])


@pytest.mark.parametrize(("encoding", "planes"), [("nv12", 1.5), ("nv21", 1.5), ("nv24", 3.0)])
def test_luma_planes_come_first(encoding: str, planes: float) -> None:
    pixels = RNG.integers(0, 256, (6, 8)).astype(np.uint8)
    colours = bytes(int(6 * 8 * (planes - 1)))
    message = ImageMessage(0, "", encoding, pixels.tobytes() + colours, False, 8, 6, 8)
    np.testing.assert_array_equal(grey(message), pixels)


@pytest.mark.parametrize("bits", [10, 12, 14, 16])
def test_low_bits_of_sixteen_are_seen(bits: int) -> None:
    pixels = RNG.integers(0, 2**bits, (20, 30)).astype(np.uint16)
    pixels[0, 0] = 2**bits - 1
    expected = grey(raw("mono16", pixels))
    assert np.abs(expected - pixels * 255.0 / 2**bits).max() < 3
    file = cv2.imencode(".png", pixels)[1].tobytes()
    np.testing.assert_array_equal(grey(ImageMessage(0, "", "mono16; png compressed ", file, True)), expected)
    for encoding in ("rgb16", "bgr16", "16UC3", "rgba16", "bgra16", "16UC4"):
        opaque = [np.full_like(pixels, 2**16 - 1)] * ("4" in encoding or "a" in encoding)
        colour = grey(raw(encoding, np.stack([*[pixels] * 3, *opaque], axis=-1)))
        np.testing.assert_allclose(colour, expected, atol=1)


def test_hot_pixels_take_no_greys() -> None:
    """One of 65535 among 12 bits left thirteen greys, by the highest bit that is set."""
    scene = cv2.resize(RNG.integers(0, 4096, (9, 12)).astype(np.uint16), (160, 120), interpolation=cv2.INTER_LINEAR)
    hot = scene.copy()
    hot[3, 5] = hot[7, 9] = 65535
    difference = np.abs(grey(raw("mono16", hot)).astype(int) - grey(raw("mono16", scene)))
    assert np.delete(difference, [3, 7], 0).max() <= 1
    assert len(np.unique(grey(raw("mono16", hot)))) > 200


def test_what_a_thermal_camera_counts_is_spread() -> None:
    """Kelvin in hundredths, of a scene of 20 to 30 degrees; below 256 values a grey is one."""
    scene = (29_315 + 1000 * RNG.random((60, 80))).astype(np.uint16)
    assert len(np.unique(grey(raw("16UC1", scene)))) == 256
    even = (29_315 + 9 * RNG.random((60, 80))).astype(np.uint16)
    assert np.ptp(grey(raw("16UC1", even)).astype(int)) <= 9


@pytest.mark.parametrize("padding", [0, 3])
def test_mono_rows_with_padding(padding: int) -> None:
    pixels = RNG.integers(0, 256, (6, 5)).astype(np.uint8)
    np.testing.assert_array_equal(grey(raw("mono8", pixels, padding)), pixels)
    last_row_bare = raw("mono8", pixels, padding)
    bare = ImageMessage(
        0, "", "mono8", last_row_bare.data[: len(last_row_bare.data) - padding], False, 5, 6, 5 + padding
    )
    np.testing.assert_array_equal(grey(bare), pixels)


@pytest.mark.parametrize("big_endian", [False, True])
def test_sixteen_bits_in_both_byte_orders(big_endian: bool) -> None:
    pixels = RNG.integers(1, 65535, (6, 5)).astype(np.uint16)
    pixels[0, 0] = 65534
    np.testing.assert_allclose(grey(raw("mono16", pixels, 2, big_endian), Levels(0, 65535)), pixels / 257, atol=0.5)
    np.testing.assert_allclose(depth_m(raw("16UC1", pixels, 2, big_endian)), pixels / 1000.0, rtol=1e-6)
    metres = RNG.uniform(0.1, 9, (6, 5)).astype(np.float32)
    metres[0, :4] = np.nan, np.inf, 0.0, -1.0
    depth = depth_m(raw("32FC1", metres, 4, big_endian))
    assert np.isnan(depth[0, :4]).all()
    np.testing.assert_array_equal(depth[1:], metres[1:])


def test_depth_in_png() -> None:
    pixels = RNG.integers(1, 65535, (6, 5)).astype(np.uint16)
    pixels[0, 0], pixels[0, 1] = 0, 65535
    file = cv2.imencode(".png", pixels)[1].tobytes()
    for header, encoding in (
        (bytes(12), "16UC1; compressedDepth png"),
        (b"", "16UC1; png compressed"),
        (bytes(12), "png"),
    ):
        depth = depth_m(ImageMessage(0, "", encoding, header + file, True))
        assert np.isnan(depth[0, :2]).all()
        np.testing.assert_allclose(depth[1:], pixels[1:] / 1000.0, rtol=1e-6)
    assert is_depth(ImageMessage(0, "", "16UC1; compressedDepth png", file, True))
    assert not is_depth(ImageMessage(0, "", "bgr8; jpeg compressed bgr8", file, True))


def test_depth_in_tiff() -> None:
    """The one format of compressed_image_transport that takes 32FC1."""
    millimetres = RNG.integers(1, 65535, (6, 5)).astype(np.uint16)
    metres = RNG.uniform(0.5, 9, (6, 5)).astype(np.float32)
    metres[0, 0], millimetres[0, 0] = np.nan, 0
    for encoding, pixels, expected in (("32FC1", metres, metres), ("16UC1", millimetres, millimetres / 1000.0)):
        file = cv2.imencode(".tiff", pixels)[1].tobytes()
        depth = depth_m(ImageMessage(0, "", f"{encoding}; tiff compressed ", file, True))
        assert np.isnan(depth[0, 0])
        np.testing.assert_allclose(depth[1:], expected[1:], rtol=1e-6)


def test_quantised_inverse_depth() -> None:
    """As the transport's encoder: raw = a / depth + b with a = q (q + 1), b = 1 - a / max."""
    metres = RNG.uniform(0.5, 9, (6, 5)).astype(np.float32)
    q, farthest = 100.0, 10.0
    a = q * (q + 1)
    b = 1 - a / farthest
    file = cv2.imencode(".png", np.round(a / metres + b).astype(np.uint16))[1].tobytes()
    message = ImageMessage(0, "", "32FC1; compressedDepth png", struct.pack("<iff", 1, a, b) + file, True)
    np.testing.assert_allclose(depth_m(message), metres, rtol=0.01)


def rvl(pixels: np.ndarray) -> bytes:
    """Wilson's encoder, number by number."""
    nibbles: list[int] = []

    def put(value: int) -> None:
        while True:
            nibbles.append(value & 7 | (8 if value >> 3 else 0))
            value >>= 3
            if not value:
                return

    flat, at, previous = pixels.ravel().tolist(), 0, 0
    while at < len(flat):
        for zero in (True, False):
            stop = at
            while stop < len(flat) and (flat[stop] == 0) == zero:
                stop += 1
            put(stop - at)
            for depth in flat[at:stop] if not zero else ():
                put((depth - previous) * 2 if depth >= previous else (previous - depth) * 2 - 1)
                previous = depth
            at = stop
    nibbles += [0] * (-len(nibbles) % 8)
    words = [int("".join(f"{n:x}" for n in nibbles[i : i + 8]), 16) for i in range(0, len(nibbles), 8)]
    return struct.pack("<II", pixels.shape[1], pixels.shape[0]) + struct.pack(f"<{len(words)}I", *words)


def test_depth_in_rvl() -> None:
    pixels = (1000 + np.cumsum(RNG.integers(-40, 40, (30, 50)), axis=1)).astype(np.uint16)
    pixels[4:9, 10:30], pixels[0, 0], pixels[-1, -5:] = 0, 0, 0
    pixels[20, 20] = 60000
    depth = depth_m(ImageMessage(0, "", "16UC1; compressedDepth rvl", bytes(12) + rvl(pixels), True))
    np.testing.assert_array_equal(np.isnan(depth), pixels == 0)
    np.testing.assert_allclose(depth[pixels > 0], pixels[pixels > 0] / 1000.0, rtol=1e-6)
    for bad in (rvl(pixels)[:-40], rvl(pixels)[:5], struct.pack("<II", 2**31, 2**31) + bytes(40)):
        with pytest.raises(BadMessageError):
            depth_m(ImageMessage(0, "", "16UC1; compressedDepth rvl", bytes(12) + bad, True))


@given(st.binary(max_size=60))
def test_any_rvl_is_a_depth_or_a_known_error(data: bytes) -> None:
    message = ImageMessage(0, "", "16UC1; compressedDepth rvl", bytes(12) + struct.pack("<II", 8, 4) + data, True)
    try:
        assert depth_m(message).shape == (4, 8)
    except BadMessageError as error:
        assert "RVL" in str(error)


@pytest.mark.parametrize("kind", [".jpg", ".png", ".webp", ".bmp", ".pgm", ".ppm"])
def test_files_decode_and_say_their_size(kind: str) -> None:
    pixels = np.tile(np.arange(0, 250, 5, dtype=np.uint8), (30, 1))
    colour = cv2.cvtColor(pixels, cv2.COLOR_GRAY2BGR) if kind == ".ppm" else pixels
    data = cv2.imencode(kind, colour)[1].tobytes()
    assert image_size(data) == (50, 30)
    assert np.abs(grey(ImageMessage(0, "", kind, data, True)).astype(int) - pixels).max() < 12


@pytest.mark.parametrize("colours", [1, 3])
@pytest.mark.parametrize("progressive", [0, 1])
@pytest.mark.parametrize("sampling", [0x111111, 0x211111, 0x221111])  # 4:4:4, 4:2:2, 4:2:0
def test_a_jpeg_is_what_opencv_makes_of_it(sampling: int, progressive: int, colours: int) -> None:
    noise = np.random.default_rng(5).integers(0, 256, (123, 157, 3)).astype(np.uint8)
    pixels = cv2.GaussianBlur(noise, (5, 5), 2)[..., :colours]
    settings = [cv2.IMWRITE_JPEG_PROGRESSIVE, progressive, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, sampling]
    data = cv2.imencode(".jpg", np.ascontiguousarray(pixels), [*settings, cv2.IMWRITE_JPEG_RST_INTERVAL, 3])[1]
    damaged, last_scan = data.copy(), slice(-320, -20)
    part = damaged[last_scan]
    spared = (part == 0xFF) | (part == 0xAA) | (np.roll(part, 1) == 0xFF)
    part[~spared] ^= 0x55  # no marker is made or lost: the rest is read all the same
    images = []
    for file in (data, damaged):
        images.append(grey(ImageMessage(0, "", "jpeg", file.tobytes(), True)))
        expected = cv2.imdecode(file, cv2.IMREAD_GRAYSCALE)
        assert expected is not None
        np.testing.assert_array_equal(images[-1], expected)
    assert not np.array_equal(images[0], images[1])


def test_a_jpeg_of_four_colours_is_read() -> None:
    file = io.BytesIO()
    Image.fromarray(np.zeros((20, 30, 4), np.uint8), "CMYK").save(file, "JPEG")
    assert grey(ImageMessage(0, "", "jpeg", file.getvalue(), True)).shape == (20, 30)


def test_size_that_the_data_do_not_justify_is_refused_before_it_is_allocated() -> None:
    with pytest.raises(BadMessageError, match="do not hold"):
        grey(ImageMessage(0, "", "mono8", bytes(100), False, 2**31, 2**31, 2**31))
    with pytest.raises(BadMessageError, match="do not hold"):
        grey(ImageMessage(0, "", "rgb8", bytes(100), False, 10, 10, 10))
    with pytest.raises(BadMessageError, match="do not hold"):
        grey(ImageMessage(0, "", "mono8", b"", False, 0, 0, 0))
    webp = b"RIFF\0\0\0\0WEBPVP8X" + bytes(8) + (19_999).to_bytes(3, "little") + (9_999).to_bytes(3, "little")
    with pytest.raises(BadMessageError, match="20000 x 10000 px are more than the 67108864 that are read of 30 bytes"):
        grey(ImageMessage(0, "", "webp", webp, True))
    head = b"IHDR" + struct.pack(">IIBBBBB", 100_000, 100_000, 8, 0, 0, 0, 0)
    end = struct.pack(">I4sI", 0, b"IEND", zlib.crc32(b"IEND"))
    bomb = b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + head + struct.pack(">I", zlib.crc32(head)) + end
    with pytest.raises(BadMessageError, match="100000 x 100000"):
        grey(ImageMessage(0, "", "png", bomb, True))


def test_pictures_of_phones_are_read() -> None:
    data = cv2.imencode(".jpg", np.zeros((9000, 12000), np.uint8))[1].tobytes()
    assert grey(ImageMessage(0, "", "jpeg", data, True)).shape == (9000, 12000)


def test_cut_files_are_no_half_images() -> None:
    data = cv2.imencode(".jpg", RNG.integers(0, 256, (40, 50)).astype(np.uint8))[1].tobytes()
    assert image_size(data + bytes(100)) == (50, 40)  # cameras pad their buffers
    with pytest.raises(BadMessageError, match=r"are not a whole JPEG, PNG|its JPEG is damaged"):
        grey(ImageMessage(0, "", "jpeg", data[:-50], True))
    data = cv2.imencode(".png", RNG.integers(0, 256, (40, 50)).astype(np.uint8))[1].tobytes()
    claim = data[:33] + b"\xff" + data[34:]  # the length of the first chunk behind the header
    for bad in (data[:-20], data[: len(data) // 2], claim):
        with pytest.raises(BadMessageError, match=r"are not a whole JPEG, PNG|its JPEG is damaged"):
            grey(ImageMessage(0, "", "png", bad, True))


@pytest.mark.parametrize("kind", [".jpg", ".png", ".webp"])
def test_images_of_one_grey_are_not_refused(kind: str) -> None:
    data = cv2.imencode(kind, np.zeros((2000, 3000), np.uint8))[1].tobytes()
    assert grey(ImageMessage(0, "", kind, data, True)).shape == (2000, 3000)


@given(
    st.binary(max_size=60),
    st.sampled_from([b"", b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n", b"RIFF0000WEBPVP8 ", b"BM", b"P5 "]),
)
def test_damaged_bytes_are_a_known_error(data: bytes, head: bytes) -> None:
    for read in (grey, depth_m):
        with pytest.raises(BadMessageError):
            read(ImageMessage(0, "", "16UC1; compressedDepth png", head + data, True))
