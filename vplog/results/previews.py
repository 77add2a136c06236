"""Small pictures of the keyframes, made as these stream by and kept on disk, so that memory does not grow."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING, Self

import cv2
import numpy as np
from pydantic import Field

from vplog.errors import ResultError
from vplog.settings import Settings

if TYPE_CHECKING:
    from pathlib import Path

    from vplog.data import Bytes


class PictureSettings(Settings):
    """What result.mcap and report.html show of the camera's images."""

    megapixels: float = Field(default=0.15, ge=0, le=100)
    """Of a keyframe's picture in result.mcap: 0.15 is 450 x 335, some 20 kB. 0 leaves the images out: the stamps are
    those of the log, so a viewer that opens both files shows the log's images instead."""
    quality: int = Field(default=75, ge=1, le=100)
    """JPEG quality of all pictures."""
    closures: int = Field(default=12, ge=0, le=1000)
    """Candidates drawn with their matches, boxes and voting maps: half of them accepted ones, the others rejected. One
    takes 0.07 to 0.2 s of one core and 100 kB."""


def scaled_size(width: int, height: int, megapixels: float) -> tuple[int, int]:
    """Width and height in px of an image within so many megapixels, never larger than it is, at least 1 x 1."""
    scale = min(1.0, (megapixels * 1e6 / (width * height)) ** 0.5) if width and height else 1.0
    return max(1, round(width * scale)), max(1, round(height * scale))


def shrink(image: Bytes, megapixels: float) -> Bytes:
    """The image (H, W) or (H, W, 3) within so many megapixels, by area averages."""
    size = scaled_size(image.shape[1], image.shape[0], megapixels)
    if size == image.shape[1::-1]:
        return image
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def jpeg(image: Bytes, quality: int) -> bytes:
    """The image as a JPEG file: the same bytes for the same pixels."""
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()


class Previews:
    """A scratch file of small JPEGs, one keyframe after the other. Removed on exit."""

    def __init__(self, path: Path, settings: PictureSettings) -> None:
        self._path, self._settings = path, settings
        self._ends = [0]
        try:
            self._file = path.open("w+b")
        except OSError as error:
            raise ResultError(f"Cannot write {path}: {error.strerror}.") from None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        with contextlib.suppress(OSError):  # a full disk fails again here; append has said so, and the file goes
            self._file.close()
        self._path.unlink(missing_ok=True)

    def __len__(self) -> int:
        return len(self._ends) - 1

    def append(self, image: Bytes) -> None:
        """Keep the next keyframe's picture; nothing where pictures are switched off. Raises ResultError."""
        if not self._settings.megapixels:
            return
        data = jpeg(shrink(image, self._settings.megapixels), self._settings.quality)
        try:
            self._file.seek(self._ends[-1])
            self._file.write(data)
            self._file.flush()
        except OSError as error:
            raise ResultError(
                f"Cannot store pictures in {self._path}: {error.strerror}. --set pictures.megapixels=0 does without."
            ) from None
        self._ends.append(self._ends[-1] + len(data))

    def __getitem__(self, row: int) -> bytes:
        """The JPEG of keyframe `row`."""
        if not 0 <= row < len(self):
            raise IndexError(row)
        self._file.seek(self._ends[row])
        return self._file.read(self._ends[row + 1] - self._ends[row])

    def image(self, row: int) -> Bytes:
        """(h, w) uint8 grey."""
        return np.asarray(cv2.imdecode(np.frombuffer(self[row], np.uint8), cv2.IMREAD_GRAYSCALE), np.uint8)
