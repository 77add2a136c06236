"""Small JPEGs of the keyframes, and their settings."""

from __future__ import annotations

import cv2
import numpy as np
from pydantic import Field

from vplog.data import Bytes
from vplog.settings import Settings

_THUMBNAIL_MEGAPIXELS, _THUMBNAIL_QUALITY = 0.04, 60


class PictureSettings(Settings):
    """Images of the camera in result.mcap and report.html."""

    megapixels: float = Field(default=0.15, ge=0, le=100)
    """A keyframe's picture in result.mcap: 0.15 is 450 x 335, some 20 kB. 0 leaves the images out: the stamps are
    those of the log, so a viewer that opens both files shows the log's images instead."""
    quality: int = Field(default=75, ge=1, le=100)
    """JPEG quality of all pictures."""
    closures: int = Field(default=30, ge=0, le=20_000)
    """Candidates whose matches, boxes and votes are a picture in result.mcap, for Foxglove and rerun: half of them
    accepted ones, the others rejected. One takes some 0.07 s of one core and 100 kB; a run again with another value
    draws them without reading the log. report.html draws those of all closures by itself."""


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


def thumbnail(image: Bytes) -> bytes:
    """A JPEG of 230 x 170 px and some 5 kB."""
    return jpeg(shrink(image, _THUMBNAIL_MEGAPIXELS), _THUMBNAIL_QUALITY)


def preview(image: Bytes, settings: PictureSettings) -> bytes:
    """A keyframe's picture as a JPEG; empty where pictures are switched off."""
    return jpeg(shrink(image, settings.megapixels), settings.quality) if settings.megapixels else b""
