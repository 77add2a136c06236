"""Video in logs: every frame is the one at its stamp, whichever are asked for, and damage stays within its stretch."""

from __future__ import annotations

import builtins
import ctypes
import os
import re
from contextlib import contextmanager, suppress
from fractions import Fraction
from functools import cache, partial
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.logs.drives import START_NS, Written, store, write_foxglove, write_raw
from vplog import logs
from vplog.errors import LogError
from vplog.logs.datasets.video import VideoFrames
from vplog.logs.messages import video as video_module
from vplog.logs.messages.h264 import FrameNumbers
from vplog.logs.messages.records import BadMessageError
from vplog.logs.messages.video import VideoStream, codec_of, new_decoder, packet_kind

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from av import VideoFrame

av = pytest.importorskip("av", reason="PyAV is not installed: pip install av")
foxglove = pytest.importorskip("foxglove_schemas_protobuf.CompressedVideo_pb2")

COUNT, WIDTH, HEIGHT, GROUP = 40, 96, 64, 12
PERIOD_NS = 50_000_000
ENCODERS = {"h264": "libx264", "hevc": "libx265", "vp9": "libvpx-vp9", "av1": "libsvtav1"}
FORMATS = {"h264": "h264", "hevc": "h265", "vp9": "vp9", "av1": "av1"}
"""Names in foxglove.CompressedVideo (docs.foxglove.dev/docs/sdk/schemas/compressed-video)."""


@cache
def pictures() -> list[np.ndarray]:
    """Smooth grey frames (H, W), each with a bar of its own."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    frames = []
    for i in range(COUNT):
        picture = 90 + 60 * np.sin((x + 2 * i) / 11) * np.cos(y / 13)
        picture[:, 2 * i : 2 * i + 6] = 230
        frames.append(np.clip(picture, 0, 255).astype(np.uint8))
    return frames


def encoded(encoder: Any, codec: str, b_frames: int, params: str) -> Iterator[Any]:
    """Packets of `pictures`."""
    encoder.width, encoder.height, encoder.pix_fmt = WIDTH, HEIGHT, "yuv420p"
    encoder.time_base, encoder.framerate = Fraction(1, 20), Fraction(20)
    encoder.gop_size, encoder.max_b_frames, encoder.thread_count = GROUP, b_frames, 1
    encoder.options = {
        "h264": {
            "crf": "12", "tune": "fastdecode" if b_frames else "zerolatency", "bf": str(b_frames),
            **({"x264-params": params} if params else {}),
        },
        "hevc": {"crf": "10", "x265-params": f"{params}bframes={b_frames}:keyint={GROUP}:log-level=none:pools=1"},
        "vp9": {"crf": "8", "b": "0", "lag-in-frames": "0", "deadline": "realtime"},
        "av1": {"crf": "16", "preset": "8", "svtav1-params": "scd=0" if b_frames else "pred-struct=1:scd=0"},
    }[codec]  # fmt: skip
    with scheduled_as_before():
        for i, picture in enumerate(pictures()):
            frame = av.VideoFrame.from_ndarray(np.repeat(picture[:, :, None], 3, axis=2), format="rgb24")
            frame.pts = i
            yield from encoder.encode(frame)
        yield from encoder.encode(None)


@contextmanager
def scheduled_as_before() -> Iterator[None]:
    """SVT-AV1 gives the thread that it is opened in the highest real-time priority, where it may, as root does: what
    runs beside then starves, and so do processes that busy ones are started beside."""
    if not hasattr(os, "sched_getscheduler"):  # on macOS
        yield
        return
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        yield
    finally:
        os.sched_setscheduler(0, *before)


@cache
def packets(codec: str, b_frames: int = 0, params: str = "") -> tuple[bytes, ...]:
    """One payload a frame, in the order of decoding; `params` are those of x264 or x265."""
    found = list(encoded(av.CodecContext.create(ENCODERS[codec], "w"), codec, b_frames, params))
    assert len(found) == COUNT
    packets.pts = {**getattr(packets, "pts", {}), (codec, b_frames, params): [packet.pts for packet in found]}  # type: ignore[attr-defined]
    return tuple(bytes(packet) for packet in found)


def shown(codec: str, b_frames: int, params: str = "") -> list[int]:
    """The picture that each of `packets` holds."""
    packets(codec, b_frames, params)
    return packets.pts[codec, b_frames, params]  # type: ignore[attr-defined]


def close(found: np.ndarray | VideoFrame, number: int) -> bool:
    """Nearer to its own picture than compression takes it, and further from its neighbours'."""
    image = found if isinstance(found, np.ndarray) else video_module.grey(found)
    errors = [np.abs(image.astype(float) - picture).mean() for picture in pictures()]
    return int(np.argmin(errors)) == number and errors[number] < 3.0


def stream(codec: str, payloads: Sequence[bytes]) -> VideoStream:
    return VideoStream(codec, payloads.__getitem__, len(payloads), partial(new_decoder, codec, "/video", print))


@pytest.mark.parametrize("codec", ENCODERS)
@pytest.mark.parametrize("rows", [range(COUNT), [0, 3, 11, 12, 13, 30, 39], [35], [38, 5, 20]])
def test_any_frames_in_any_order_are_those_asked_for(codec: str, rows: Any) -> None:
    video = stream(codec, packets(codec))
    for row in rows:
        assert close(video.frame(row), row), row


@pytest.mark.parametrize("codec", ["h264", "hevc", "av1"])
def test_frames_that_come_out_later_than_their_packets(codec: str) -> None:
    payloads = packets(codec, 3)
    order = shown(codec, 3)
    assert codec == "av1" or order != sorted(order)  # the encoder did reorder; AV1 hides that within a packet
    video = stream(codec, payloads)
    for row, number in enumerate(order):
        assert close(video.frame(row), number)


OPEN_265 = "open-gop=1:min-keyint=12:scenecut=0:no-scenecut=1:"


def test_pictures_that_refer_back_over_a_key_frame() -> None:
    """Open groups of H.265: what is shown before a key frame and sent behind it needs the group before."""
    payloads = packets("hevc", 3, OPEN_265)
    order = shown("hevc", 3, OPEN_265)
    keys = [row for row, payload in enumerate(payloads) if packet_kind("hevc", payload) >= 3]
    behind = [row for row in range(keys[1], COUNT) if order[row] < order[max(key for key in keys if key <= row)]]
    assert behind, "the encoder did make open groups"
    video = stream("hevc", payloads)
    for row, number in enumerate(order):
        assert close(video.frame(row), number)
    for row in behind:
        assert close(stream("hevc", payloads).frame(row), order[row])


OPEN = f"open-gop=1:keyint={GROUP}:scenecut=0:b-adapt=0:ref=3"
REFRESHED = f"intra-refresh=1:keyint={GROUP}:scenecut=0"


@pytest.mark.parametrize(("params", "b_frames", "most"), [(OPEN, 3, GROUP + 3), (REFRESHED, 0, 2 * GROUP - 1)])
def test_streams_of_h264_with_one_idr_picture_are_entered_at_recovery_points(
    params: str, b_frames: int, most: int
) -> None:
    """Open groups, and gradual refresh: a cut or a missing packet costs a group, not all that follows."""
    payloads = packets("h264", b_frames, params)
    order = shown("h264", b_frames, params)
    cut, missing = list(range(5, COUNT)), [row for row in range(COUNT) if row != GROUP + 4]
    for rows in (range(COUNT), cut, missing):
        video, lost = stream("h264", [payloads[row] for row in rows]), 0
        for row in range(video.first_key() or 0, len(rows)):
            try:
                assert close(video.frame(row), order[rows[row]]), row
            except BadMessageError:
                lost += 1
        assert lost <= (0 if len(rows) == COUNT else most)


@pytest.mark.parametrize("codec", ENCODERS)
def test_a_packet_that_was_recorded_twice_changes_no_picture(codec: str, tmp_path: Path) -> None:
    found = messages("foxglove", packets(codec), codec=codec)
    for number in (2 * GROUP, GROUP + 7, GROUP + 1):  # a key frame among them
        found.insert(number, found[number])
    log = logs.open(write_raw(tmp_path / "drive.mcap", found))
    frames = list(log.frames(log.stamps()))
    assert len(frames) == COUNT
    for row, frame in enumerate(frames):
        assert close(frame.decode().image, row)


def test_only_stretches_with_frames_of_interest_are_decoded() -> None:
    read: list[int] = []
    payloads = packets("h264")

    def packet(row: int) -> bytes:
        read.append(row)
        return payloads[row]

    video = VideoStream("h264", packet, COUNT, partial(new_decoder, "h264", "/video", print))
    video.frame(2)
    read.clear()
    video.frame(26)
    assert min(read) == 24  # the key frame before it, not those of rows 3 to 23
    read.clear()
    video.frame(27)
    assert set(read) == {27}


def test_damage_ends_at_the_next_key_frame() -> None:
    payloads = list(packets("h264"))
    payloads[GROUP + 3] = b""
    payloads[2 * GROUP + 5] = payloads[2 * GROUP + 5][:20] + bytes(40)
    video = stream("h264", payloads)
    lost = []
    for row in range(COUNT):
        try:
            assert close(video.frame(row), row)
        except BadMessageError:
            lost.append(row)
    assert lost == [*range(GROUP + 3, 2 * GROUP), *range(2 * GROUP + 5, 3 * GROUP)]


def test_a_long_stretch_behind_damage_costs_no_more_for_each_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    """The one key frame of a stream is not looked for from each frame back to its start."""
    count, looked = 1000, list[int]()
    kind = VideoStream._kind
    monkeypatch.setattr(VideoStream, "_kind", lambda self, number: looked.append(number) or kind(self, number))
    payloads = [packets("h264")[0], b"", *packets("h264")[1 : GROUP - 1] * 100][:count]
    video = stream("h264", payloads)
    assert video.frame(0) is not None
    for row in range(1, count):
        with pytest.raises(BadMessageError):
            video.frame(row)
    assert len(looked) < 10 * count


@pytest.mark.parametrize(
    ("codec", "b_frames"), [("h264", 0), ("h264", 3), ("hevc", 0), ("hevc", 3), ("vp9", 0), ("av1", 0)]
)
def test_a_missing_packet_gives_no_wrong_picture(codec: str, b_frames: int) -> None:
    payloads = packets(codec, b_frames)
    order = shown(codec, b_frames)
    for missing in (GROUP + 3, 2 * GROUP + 7):
        video = stream(codec, payloads[:missing] + payloads[missing + 1 :])
        left = order[:missing] + order[missing + 1 :]
        right = []
        for row, number in enumerate(left):
            try:
                assert close(video.frame(row), number), (missing, number)
                right.append(number)
            except BadMessageError:
                continue
        assert set(order[:missing]) <= set(right)
        later = missing // GROUP * GROUP + GROUP + b_frames  # where the next key frame is, and what refers back over it
        assert set(order[later:]) <= set(right)


def signed(value: int) -> str:
    """The bits of se(v), ITU-T H.264 9.1.1."""
    code = f"{2 * value if value > 0 else 1 - 2 * value:b}"
    return (len(code) - 1) * "0" + code


DEFAULT_4X4 = (-2, 7, 0, 7, 0, 0, 8, 0, 0, 0, 4, 0, 0, 5, 0, 5)
"""Differences between the scales of Default_4x4_Intra (ITU-T H.264, table 7-3), from 8 on."""
SCALING_LISTS = f"11{''.join(map(signed, DEFAULT_4X4))}001{signed(-8)}001{signed(-8)}0"
"""The flag of scaling lists in a parameter set (7.3.2.1.1), and eight lists with the defaults of the standard: one in
full, two that end at once, which names the default, and five that fall back."""


def with_scaling_lists(payload: bytes) -> bytes:
    """The packet with lists in its sequence parameter set, where x264 writes them to that of its pictures alone, which
    goes before."""
    head, separator, rest = payload.partition(b"\x00\x00\x01\x67")
    parameters, behind, rest = rest.partition(b"\x00\x00\x00\x01")
    if not separator:
        return payload
    bits = "".join(f"{byte:08b}" for byte in parameters.replace(b"\x00\x00\x03", b"\x00\x00"))
    at = 24 + len("1010110")  # set 0, 4:2:0, 8 bits, lossy
    assert bits[24 : at + 1] == "10101100"
    bits = (bits[:at] + SCALING_LISTS + bits[at + 1 :]).rstrip("0")
    bits += -len(bits) % 8 * "0"
    parameters = bytes(int(bits[i : i + 8], 2) for i in range(0, len(bits), 8))
    escaped = re.sub(rb"\x00\x00(?=[\x00-\x03])", b"\x00\x00\x03", parameters)
    return head + separator + escaped + behind + rest


@pytest.mark.parametrize("missing", [GROUP + 3, 2 * GROUP + 7])
def test_a_missing_packet_of_a_stream_with_scaling_lists_gives_no_wrong_picture(missing: int) -> None:
    payloads = [with_scaling_lists(payload) for payload in packets("h264", 0, "cqm=jvt")]
    assert payloads != [*packets("h264", 0, "cqm=jvt")]
    video, shown = stream("h264", payloads[:missing] + payloads[missing + 1 :]), []
    for row, number in enumerate([*range(missing), *range(missing + 1, COUNT)]):
        with suppress(BadMessageError):
            assert close(video.frame(row), number), number
            shown.append(number)
    assert shown == [*range(missing), *range(missing // GROUP * GROUP + GROUP, COUNT)]


@pytest.mark.parametrize("profile", ["baseline", "main", "high", "high10"])
def test_frame_numbers_of_whole_streams_follow(profile: str) -> None:
    """Whatever the parameter sets hold, scaling lists too, as the encoder's own streams have no gap."""
    encoder = av.CodecContext.create("libx264", "w")
    encoder.width, encoder.height = WIDTH, HEIGHT
    encoder.pix_fmt = "yuv420p10le" if profile == "high10" else "yuv420p"
    encoder.time_base, encoder.framerate = Fraction(1, 20), Fraction(20)
    matrices = ":cqm=jvt" if profile.startswith("high") else ""
    encoder.options = {"profile": profile, "x264-params": f"keyint=30:scenecut=0{matrices}"}
    numbers, found = FrameNumbers(), []
    for i, picture in enumerate(pictures()):
        frame = av.VideoFrame.from_ndarray(np.repeat(picture[:, :, None], 3, axis=2), format="rgb24")
        frame.pts = i
        found.extend(bytes(packet) for packet in encoder.encode(frame))
    found.extend(bytes(packet) for packet in encoder.encode(None))
    assert len(found) == COUNT
    assert all(numbers.follows(packet) for packet in found)


@given(st.binary(max_size=80))
def test_any_bytes_are_followed_without_error(data: bytes) -> None:
    numbers = FrameNumbers()
    assert numbers.follows(data)
    for head in (b"\x67", b"\x65", b"\x41"):
        numbers.follows(b"\x00\x00\x01" + head + data)


def test_what_is_video() -> None:
    for name in ("h264", "H264", "libx264;yuv420p;bgr8;bgr8", "h264_nvenc", "avc1"):
        assert codec_of(name) == "h264"
    assert codec_of("h265") == codec_of("hevc_vaapi") == codec_of("libx265") == "hevc"
    assert codec_of("jpeg") == codec_of("bgr8; jpeg compressed bgr8") == codec_of("16UC1; compressedDepth png") == ""


def messages(
    kind: str, payloads: Sequence[bytes], first: int = 0, codec: str = "h264"
) -> list[tuple[str, str, str, int, bytes]]:
    """A log of the video from row `first` on, in one of the ways it is recorded."""
    ros = store(2)
    fields = (
        "std_msgs/Header header\nint32 width\nint32 height\nstring encoding\nuint64 pts\nuint8 flags\n"
        "bool is_bigendian\nuint8[] data"
    )
    packet_type = "ffmpeg_image_transport_msgs/msg/FFMPEGPacket"
    if packet_type not in ros.fielddefs:
        from rosbags.typesys import get_types_from_msg

        ros.register(get_types_from_msg(fields, packet_type))
    found = []
    for i, payload in list(enumerate(payloads))[first:]:
        stamp = START_NS + i * PERIOD_NS
        time = ros.types["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9)
        header = ros.types["std_msgs/msg/Header"](stamp=time, frame_id="camera")
        data = np.frombuffer(payload, np.uint8)
        if kind == "foxglove":
            message = foxglove.CompressedVideo(frame_id="camera", data=payload, format=FORMATS[codec])
            message.timestamp.seconds, message.timestamp.nanos = stamp // 10**9, stamp % 10**9
            found.append(("/video", "foxglove.CompressedVideo", "protobuf", stamp, message.SerializeToString()))
            continue
        if kind == "compressed":
            name = "sensor_msgs/msg/CompressedImage"
            message = ros.types[name](header=header, format=FORMATS[codec], data=data)
        else:
            name = packet_type
            message = ros.types[name](
                header=header, width=WIDTH, height=HEIGHT, encoding=f"{ENCODERS[codec]};yuv420p;bgr8;bgr8", pts=i,
                flags=0, is_bigendian=False, data=data,
            )  # fmt: skip
        found.append(("/video", name, "cdr", stamp, bytes(ros.serialize_cdr(message, name))))
    return found


@pytest.mark.parametrize("codec", ENCODERS)
@pytest.mark.parametrize("kind", ["foxglove", "compressed", "ffmpeg"])
def test_video_in_a_log(kind: str, codec: str, tmp_path: Path) -> None:
    log = logs.open(write_raw(tmp_path / "drive.mcap", messages(kind, packets(codec), codec=codec)))
    assert len(log.stamps()) == COUNT
    assert (log.camera().width, log.camera().height) == (WIDTH, HEIGHT)
    wanted = log.stamps()[[1, 14, 15, 33]]
    for frame, row in zip(log.frames(wanted), (1, 14, 15, 33), strict=True):
        assert close(frame.decode().image, row)


@pytest.mark.parametrize("encoding", ["protobuf", "json"])
def test_no_frame_is_lost_where_chunks_end(encoding: str, tmp_path: Path) -> None:
    """Chunks of one or two packets, more of them between two key frames than are kept unpacked."""
    found = []
    for i, payload in enumerate(packets("h264")):
        stamp = START_NS + i * PERIOD_NS
        message = foxglove.CompressedVideo(frame_id="camera", data=payload, format="h264")
        message.timestamp.seconds, message.timestamp.nanos = stamp // 10**9, stamp % 10**9
        found.append(Written("/video", "foxglove.CompressedVideo", stamp, message))
    log = logs.open(write_foxglove(tmp_path / "drive.mcap", found, encoding, chunk_size=200))
    assert len(log.stamps()) == COUNT
    for frame, row in zip(log.frames(log.stamps()), range(COUNT), strict=True):
        assert close(frame.decode().image, row)
    (last,) = log.frames(log.stamps()[[GROUP - 1]])
    assert close(last.decode().image, GROUP - 1)


@pytest.mark.parametrize("codec", ENCODERS)
def test_frames_before_the_first_key_frame_are_left_out_and_counted(codec: str, tmp_path: Path) -> None:
    log = logs.open(write_raw(tmp_path / "drive.mcap", messages("foxglove", packets(codec), first=5, codec=codec)))
    stamps = log.stamps()
    assert stamps[0] == START_NS + GROUP * PERIOD_NS
    assert f"{GROUP - 5} images before the first key frame" in " ".join(log.warnings)
    for frame, row in zip(log.frames(stamps), range(GROUP, COUNT), strict=True):
        assert close(frame.decode().image, row)
    group = messages("foxglove", packets(codec)[:GROUP], first=1, codec=codec)
    log = logs.open(write_raw(tmp_path / "none.mcap", group))
    with pytest.raises(LogError, match="No image of /video can be read"):
        log.stamps()


@pytest.mark.parametrize("codec", ["h264", "vp9", "av1"])  # FFmpeg's H.265 does not tell
def test_half_a_packet_is_no_picture(codec: str) -> None:
    payloads = list(packets(codec))
    for row in (GROUP + 3, 2 * GROUP):
        payloads[row] = payloads[row][: len(payloads[row]) // 2]
    video, lost = stream(codec, payloads), []
    for row in range(COUNT):
        try:
            assert close(video.frame(row), row), row
        except BadMessageError:
            lost.append(row)
    assert {*lost} <= {*range(GROUP + 3, 3 * GROUP)}
    assert {GROUP + 3, 2 * GROUP} <= {*lost}


@pytest.mark.parametrize("codec", ENCODERS)
def test_a_damaged_first_group_costs_no_other(codec: str, tmp_path: Path) -> None:
    payloads = list(packets(codec))
    payloads[0] = payloads[0][: len(payloads[0]) * 3 // 4]
    log = logs.open(write_raw(tmp_path / "drive.mcap", messages("foxglove", payloads, codec=codec)))
    assert (log.camera().width, log.camera().height) == (WIDTH, HEIGHT)
    sound = log.stamps()[log.stamps() >= START_NS + GROUP * PERIOD_NS]
    for frame, row in zip(log.frames(sound), range(GROUP, COUNT), strict=True):
        assert close(frame.decode().image, row)


def test_undecodable_frames_say_why_and_the_rest_goes_on(tmp_path: Path) -> None:
    payloads = list(packets("h264"))
    payloads[GROUP + 1] = b""
    log = logs.open(write_raw(tmp_path / "drive.mcap", messages("foxglove", payloads)))
    frames = list(log.frames(log.stamps()))
    with pytest.raises(LogError, match=r"/video at .* a video packet between its key frame and it is damaged"):
        frames[GROUP + 4].decode()
    assert close(frames[2 * GROUP - 1].decode().image, 2 * GROUP)  # the empty message is no frame


def test_without_pyav_one_line_names_the_library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_raw(tmp_path / "drive.mcap", messages("foxglove", packets("h264")))
    real = builtins.__import__

    def missing(name: str, *arguments: Any, **options: Any) -> Any:
        if name == "av":
            raise ImportError(name)
        return real(name, *arguments, **options)

    monkeypatch.setattr(builtins, "__import__", missing)
    log = logs.open(path)
    with pytest.raises(LogError, match=r"/video is H\.264 video.*pip install av"):
        log.camera()
    assert any("pip install av" in line for line in log.info().warnings)


def test_an_ffmpeg_without_the_decoder_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(video_module, "_DECODERS", {"av1": ("no_such_decoder",)})
    with pytest.raises(LogError, match=r"/video is AV1 video.*lacks its decoder, no_such_decoder"):
        stream("av1", packets("av1")).frame(0)


def test_luma_is_that_of_pictures() -> None:
    """Limited range is stretched: black is 0 and white 255, as OpenCV's own reader of files has it."""
    video = stream("h264", packets("h264"))
    image = video_module.grey(video.frame(0))
    y, u = np.full((4, 4), 235, np.uint8), np.full((2, 4), 128, np.uint8)
    white = cv2.cvtColor(np.vstack([y, u]), cv2.COLOR_YUV2RGB_I420)
    assert white.min() == 255
    assert abs(int(np.median(image[:, 1:5])) - 230) <= 2


@pytest.mark.parametrize(
    ("set_range", "expected"), [(0, [0, 16, 235, 255]), (1, [0, 0, 255, 255]), (2, [0, 16, 235, 255])]
)
def test_a_grey_plane_has_the_full_range_unless_it_is_said(set_range: int, expected: list[int]) -> None:
    frame = av.VideoFrame.from_ndarray(np.tile(np.array([[0, 16, 235, 255]], np.uint8), (4, 1)), "gray")
    frame.color_range = set_range
    np.testing.assert_array_equal(video_module.grey(frame), [expected] * 4)


FILES = {"h264": "a.mp4", "vp9": "a.webm", "av1": "a.mkv"}


def write_file(path: Path, codec: str, b_frames: int = 0, params: str = "") -> Path:
    """A file of `pictures` at 20 frames a second."""
    with av.open(str(path), "w") as container:
        track = container.add_stream(ENCODERS[codec], rate=20)
        for packet in encoded(track.codec_context, codec, b_frames, params):
            packet.stream = track
            container.mux(packet)
    return path


def luma(frames: VideoFrames, row: int) -> np.ndarray:
    message = frames.message(row)
    return np.frombuffer(message.data, np.uint8).reshape(message.height, message.width)


@pytest.mark.parametrize("codec", FILES)
def test_damage_in_a_file_gives_no_wrong_picture(codec: str, tmp_path: Path) -> None:
    path = write_file(tmp_path / FILES[codec], codec)
    data = bytearray(path.read_bytes())
    with av.open(str(path)) as container:
        payloads = [bytes(packet) for packet in container.demux()]
    for number in (GROUP + 3, 2 * GROUP + 7):
        at = data.index(payloads[number]) + 8
        data[at : at + 24] = bytes(24)
    path.write_bytes(data)
    frames, lost = VideoFrames(path), []
    for row in range(COUNT):
        image = luma(frames, row)
        if not image.size:
            lost.append(row)
        else:
            assert close(image, row), row
    assert {GROUP + 3, 2 * GROUP + 7} <= {*lost} <= {*range(GROUP + 3, 2 * GROUP), *range(2 * GROUP + 7, 3 * GROUP)}


@pytest.mark.parametrize(("codec", "name", "params"), [("h264", "a.mkv", OPEN), ("hevc", "a.mkv", OPEN_265)])
def test_sound_files_with_open_groups_lose_no_frame(codec: str, name: str, params: str, tmp_path: Path) -> None:
    frames = VideoFrames(write_file(tmp_path / name, codec, 3, params))
    for row in (*range(COUNT), 38, 3, 25, 26, 11, 12, 13, 0, 35, 36, 37, 23, 22, 14):
        assert close(luma(frames, row), row), row


def test_a_packet_is_followed_by_zeros() -> None:
    """A decoder that reads behind its packet finds the same each time."""
    packet = video_module.padded(b"\1" * 5)
    assert bytes(packet) == b"\1" * 5
    assert ctypes.string_at(packet.buffer_ptr, 5 + 64) == b"\1" * 5 + bytes(64)


def test_vp9_without_libvpx_is_decoded_and_said(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(video_module, "_DECODERS", {"vp9": ("no_libvpx", "vp9")})
    log = logs.open(write_raw(tmp_path / "drive.mcap", messages("foxglove", packets("vp9"), codec="vp9")))
    frames = list(log.frames(log.stamps()[:3]))
    assert all(close(frame.decode().image, row) for row, frame in enumerate(frames))
    assert [line for line in log.warnings if "lacks no_libvpx: /video, VP9 video, may show a wrong picture" in line]
