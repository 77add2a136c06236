"""Images that are decoded while the log is gone through are those that are decoded when they are asked for."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest

from vplog import logs
from vplog.cores import limited
from vplog.errors import LogError
from vplog.logs import early as early_module
from vplog.logs.containers import Block, Channel
from vplog.logs.early import EarlyImages

from .drives import Drive, foxglove_messages, write_foxglove
from .test_real_logs import data

if TYPE_CHECKING:
    from pathlib import Path

    from vplog.logs.containers import Place

CAMERA = Channel("/camera", "foxglove.CompressedImage", "protobuf")


class Plain:
    """A container that holds one block, of which `there` bytes are given with it."""

    def __init__(self, images: list[bytes], there: int | None = None) -> None:
        from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage

        messages = [CompressedImage(frame_id="c", format="jpeg", data=image).SerializeToString() for image in images]
        self.whole = b"".join(messages)
        stops = np.cumsum([len(message) for message in messages]).tolist()
        starts = [0, *stops[:-1]]
        places: list[Place] = list(zip(starts, stops, strict=True))
        count = len(images)
        self.block = Block(self.whole[:there], [CAMERA] * count, list(range(count)), starts, stops, places)

    def read(self, place: Place) -> bytes:
        return self.whole[place[0] : place[1]]


def jpegs(count: int, side: int = 16) -> list[bytes]:
    pixels = np.random.default_rng(0).integers(0, 256, (count, side, side), np.uint8)
    return [cv2.imencode(".jpg", image)[1].tobytes() for image in pixels]


def waited_for(early: EarlyImages) -> EarlyImages:
    early._pool.shutdown(wait=True)
    return early


@pytest.mark.parametrize("there", [None, 0])
def test_what_is_taken_is_the_image_and_is_taken_once(there: int | None) -> None:
    files = jpegs(3)
    log = Plain(files, there)
    early = EarlyImages(log, CAMERA, 3)  # pyright: ignore[reportArgumentType]
    early.offer(log.block)
    waited_for(early)
    assert early.frame_and_size(log.block.places[0]) == ("c", (16, 16))
    for file, place in zip(files, log.block.places, strict=True):
        found = early.take(place)
        assert found is not None
        expected = cv2.imdecode(np.frombuffer(file, np.uint8), cv2.IMREAD_GRAYSCALE)
        np.testing.assert_array_equal(found.grey(0), expected)
        assert early.take(place) is None


def test_a_damaged_image_is_told_as_ever() -> None:
    log = Plain([*jpegs(1), b"\xff\xd8\xff no image"])
    early = EarlyImages(log, CAMERA, 3)  # pyright: ignore[reportArgumentType]
    early.offer(log.block)
    found = waited_for(early).take(log.block.places[1])
    if found is not None:  # its size cannot be told, so that it is not begun
        with pytest.raises(LogError, match="/camera at 5 ns cannot be decoded"):
            found.grey(5)


def test_what_is_kept_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first is decoded whatever its size, for its size; of the others no more than there is room for."""
    for room, kept in ((10 * 256, 10), (255, 0)):
        monkeypatch.setattr(early_module, "_MOST_PX", room)
        monkeypatch.setattr(early_module, "_WAITING", 100)
        log = Plain(jpegs(30))
        early = EarlyImages(log, CAMERA, 3)  # pyright: ignore[reportArgumentType]
        early.offer(log.block)
        waited_for(early)
        assert early.frame_and_size(log.block.places[0]) == ("c", (16, 16))
        found = [early.take(place) for place in log.block.places]
        assert sum(one is not None for one in found) == kept


def test_few_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(early_module, "_WAITING", 2)
    monkeypatch.setattr(EarlyImages, "_decode", lambda *_: None)  # and gives no place back
    log = Plain(jpegs(30))
    early = EarlyImages(log, CAMERA, 3)  # pyright: ignore[reportArgumentType]
    early.offer(log.block)
    assert len(early._begun) == 7  # the first takes none


def test_frames_are_the_same_without(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    paths = [write_foxglove(tmp_path / "drive.mcap", foxglove_messages(Drive()), "protobuf", chunk_size=4096)]
    paths.append(data("drives/gardens_day_left.mcap"))
    for path in paths:
        log = logs.open(path)
        stamps = log.stamps()[:40]
        found = [frame.decode().image for frame in log.frames(stamps)]
        monkeypatch.setattr(EarlyImages, "offer", lambda *_: None)
        plain = logs.open(path)
        for image, frame in zip(found, plain.frames(stamps), strict=True):
            np.testing.assert_array_equal(image, frame.decode().image)
        assert plain.warnings == log.warnings
        monkeypatch.undo()


def test_none_is_decoded_early_by_one_thread() -> None:
    log = Plain(jpegs(3))
    with limited(1):
        early = EarlyImages(log, CAMERA)  # pyright: ignore[reportArgumentType]
    early.offer(log.block)
    assert early.frame_and_size(log.block.places[0]) is None
