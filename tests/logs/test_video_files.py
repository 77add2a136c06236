"""Video files that hold other than one whole stream of upright frames: what is taken, and what is noted."""

from __future__ import annotations

import struct
from fractions import Fraction
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from vplog import logs
from vplog.errors import LogError

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

av = pytest.importorskip("av", reason="PyAV is not installed: pip install av")

COUNT, RATE = 40, 10


def write(
    path: Path, streams: Sequence[tuple[str, int, int]] = (("mpeg4", 64, COUNT),), first: int = 0, **fields: Any
) -> Path:
    """Streams of a codec, a width and a count of frames, each brighter than the one before; `fields` of encoders."""
    with av.open(str(path), "w") as container:
        tracks = []
        for codec, width, count in streams:
            track = container.add_stream(codec, rate=RATE, options={"g": "5"})
            track.width, track.height, track.pix_fmt = width, 48, "yuvj420p" if codec == "mjpeg" else "yuv420p"
            track.time_base = track.codec_context.time_base = Fraction(1, RATE)
            for name, value in fields.items():
                setattr(track.codec_context, name, value)
            tracks.append((track, count))
        for row in range(COUNT):
            for track, count in tracks:
                if row < count:
                    grey = np.full((48, track.width), 20 + 5 * row, np.uint8)
                    frame = av.VideoFrame.from_ndarray(grey, "gray").reformat(format=track.pix_fmt)
                    frame.pts, frame.time_base = first + row, Fraction(1, RATE)
                    container.mux(track.encode(frame))
        for track, _ in tracks:
            container.mux(track.encode())
    return path


def patched(path: Path, matrix: tuple[int, ...]) -> Path:
    """With the a b c d of another display matrix in `tkhd`."""
    data = bytearray(path.read_bytes())
    at = data.index(b"tkhd") + 44
    a, b, c, d = (value << 16 for value in matrix)
    data[at : at + 36] = struct.pack(">9i", a, b, 0, c, d, 0, 0, 0, 1 << 30)
    path.write_bytes(data)
    return path


@pytest.mark.parametrize(
    ("streams", "ending", "noted"),
    [
        ([("mjpeg", 32, 1), ("mpeg4", 64, COUNT)], "mov", False),
        ([("mjpeg", 32, 1), ("mpeg4", 64, COUNT)], "mkv", False),
        ([("mpeg4", 64, COUNT), ("mpeg4", 32, COUNT)], "mp4", True),
        ([("mpeg4", 32, 20), ("mpeg4", 64, COUNT)], "mp4", True),
    ],
)
def test_the_stream_of_most_packets_is_used(streams: list, ending: str, noted: bool, tmp_path: Path) -> None:
    log = logs.open(write(tmp_path / f"a.{ending}", streams))
    assert len(log.stamps()) == COUNT
    assert [frame.decode().image.shape for frame in log.frames(log.stamps()[[0, 30]])] == [(48, 64)] * 2
    assert ("has the video streams 0 (" in " ".join(log.warnings)) == noted


@pytest.mark.parametrize("name", ["a.mkv", "a.avi"])
@pytest.mark.parametrize("share", [0.5, 1.0])
def test_a_video_that_is_cut_short_is_noted(name: str, share: float, tmp_path: Path) -> None:
    path = write(tmp_path / name, [("mjpeg", 320, COUNT)])
    data = path.read_bytes()
    path.write_bytes(data[: round(share * len(data))])
    log = logs.open(path)
    assert (len(log.stamps()) < 0.7 * COUNT) == (share < 1)
    assert ("of the 4.0 s that it names: is it cut?" in " ".join(log.warnings)) == (share < 1)


@pytest.mark.parametrize("name", ["a.mkv", "a.mp4"])
def test_a_video_whose_time_begins_later_is_whole(name: str, tmp_path: Path) -> None:
    """Segments of a stream, as of a dash camera."""
    log = logs.open(write(tmp_path / name, first=600))
    assert len(log.stamps()) == COUNT
    assert not log.warnings


def test_of_frames_with_one_time_stamp_the_first_is_kept(tmp_path: Path) -> None:
    with av.open(str(write(tmp_path / "a.mkv"))) as found, av.open(str(tmp_path / "b.mkv"), "w") as container:
        track = container.add_stream_from_template(found.streams.video[0])
        for packet in found.demux(video=0):
            if packet.size:
                packet.pts = packet.dts = packet.pts // 400 * 400  # ms
                packet.stream = track
                container.mux(packet)
    log = logs.open(tmp_path / "b.mkv")
    assert len(log.stamps()) == COUNT // 4
    means = [frame.decode().image.mean() for frame in log.frames(log.stamps())]
    np.testing.assert_allclose(means, 20 + 20 * np.arange(COUNT // 4), atol=4)
    assert f"{COUNT - COUNT // 4} frames of b.mkv with the time stamp of another" in " ".join(log.warnings)


@pytest.mark.parametrize(
    ("fields", "matrix", "note"),
    [
        ({}, (1, 0, 0, 1), ""),
        ({"sample_aspect_ratio": Fraction(4, 3)}, (1, 0, 0, 1), "1.33 times as wide as high"),
        ({"flags": 1 << 18 | 1 << 29}, (1, 0, 0, 1), "interlaced"),
        ({}, (-1, 0, 0, 1), "mirrors its pictures"),
        ({}, (0, 1, 1, 0), "mirrors its pictures"),
    ],
    ids=["plain", "anamorphic", "interlaced", "mirrored", "transposed"],
)
def test_frames_of_another_geometry_are_noted(fields: dict, matrix: tuple, note: str, tmp_path: Path) -> None:
    log = logs.open(patched(write(tmp_path / "a.mp4", **fields), matrix))
    assert next(iter(log.frames(log.stamps()))).decode().image.shape == (48, 64)
    assert note in " ".join(log.warnings)
    assert len(log.warnings) == bool(note)


def test_a_codec_that_is_not_known_is_one_line(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mp4")
    path.write_bytes(path.read_bytes().replace(b"mp4v", b"zzz1").replace(b"esds", b"zzzz"))
    with pytest.raises(LogError, match=r"a\.mp4 is encrypted, or of a codec that FFmpeg does not know"):
        logs.open(path)


@pytest.mark.parametrize(
    ("others", "found"),
    [
        ((), ["a/1.mp4", "a/2.MOV", "b/3.mkv"]),
        (("b/drive.mcap",), ["b/drive.mcap"]),
        (("a/images/sub/1.png",), [""]),
        (("1.mp4",), ["1.mp4", "a/1.mp4", "a/2.MOV", "b/3.mkv"]),
        (("notes.txt", "a/.1.png"), ["a/1.mp4", "a/2.MOV", "b/3.mkv"]),
    ],
)
def test_videos_of_a_folder_without_images_are_drives(others: Sequence[str], found: list[str], tmp_path: Path) -> None:
    """All of them, or the folder itself."""
    clip, *files = ("a/1.mp4", "a/2.MOV", "b/3.mkv", "lost+found/4.mp4", *others)
    for name in (clip, *files):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(b"\x89PNG\r\n\x1a\n" if name.endswith("png") else b"\0\0\0\x18ftypisom")
    assert logs.logs_below(tmp_path) == [tmp_path / name for name in found]
    if not others:
        with pytest.raises(LogError, match=r"holds 2 videos\. Give one of them, or the folder to `vplog batch`"):
            logs.open(tmp_path / "a")


@pytest.mark.parametrize(("name", "way"), [("a.MTS", "-c copy a.mp4"), ("a.mov", "-c copy a.mp4"), ("a.gif", "a.mp4")])
def test_videos_that_are_not_read_are_to_be_converted(name: str, way: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(b"G@\x11\x10" + bytes(188))
    for path in (tmp_path, tmp_path / name):
        for step in (logs.open, logs.check):
            with pytest.raises(LogError, match=f"Convert a video to MP4 first: ffmpeg -i {name} {way}"):
                step(path)
