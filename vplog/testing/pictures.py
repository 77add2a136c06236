"""Made-up pictures of places, their features, and drives of them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import lru_cache

import cv2
import numpy as np

from vplog.data import Bytes, Camera, Frame, Gps, Imu, Ints, Lidar, LogInfo, Odometry, Reference, Scan, Trajectory
from vplog.features.sift import SiftSettings

WIDTH, HEIGHT = 320, 200


@lru_cache
def _panorama(seed: int) -> Bytes:
    """A sum of noise images from 32 px to 1 px, wide enough for 20 views."""
    rng = np.random.default_rng(seed)
    width = 20 * 80 + WIDTH
    total = np.zeros((HEIGHT, width))
    for octave in range(6):
        rough = rng.standard_normal((HEIGHT >> octave, width >> octave))
        total += cv2.resize(rough, (width, HEIGHT), interpolation=cv2.INTER_CUBIC) * 1.6**octave
    return np.clip(127 + total * 45 / total.std(), 0, 255).astype(np.uint8)


def texture(seed: int) -> Bytes:
    """(200, 320) uint8: views 0, 1, .. 19 move to the right by a quarter of their width, 20 begins another place."""
    left = seed % 20 * 80
    return _panorama(seed // 20)[:, left : left + WIDTH].copy()


def coloured(grey: Bytes) -> Bytes:
    """(H, W, 3) uint8 red, green, blue, of different contrast."""
    return np.stack([grey, 64 + grey // 2, 255 - grey], axis=2)


@lru_cache
def reference(seed: int) -> Reference:
    image = texture(seed)
    return Reference(image, SiftSettings(max_features=400)(image), f"drive {seed % 3}", 10**18 + seed)


@dataclass(frozen=True, eq=False)
class DecodedFrame:
    """An image that needs no decoding."""

    stamp_ns: int
    camera: Camera
    image: Bytes

    def decode(self, colour: bool = False) -> Frame:
        return Frame(self.stamp_ns, self.camera, self.image, colour=coloured(self.image) if colour else None)


@dataclass(frozen=True, eq=False)
class PictureLog:
    """A log of pictures."""

    images: list[Bytes]
    name: str = "drive"
    warnings: list[str] = field(default_factory=list)

    def info(self) -> LogInfo:
        return LogInfo(self.name, "images", 10**18, 10**18 + len(self.images) - 1, len(self.images), [])

    def camera(self) -> Camera:
        return Camera("camera", None, "none", np.zeros(0), WIDTH, HEIGHT, np.eye(4))

    def further_cameras(self) -> list[str]:
        return []

    def stamps(self) -> Ints:
        return 10**18 + np.arange(len(self.images), dtype=np.int64)

    def frames(self, stamp_ns: Ints) -> Iterator[DecodedFrame]:
        for stamp in stamp_ns.tolist():
            yield DecodedFrame(stamp, self.camera(), self.images[stamp - 10**18])

    def file_names(self) -> list[str] | None:
        return None

    def odometry(self) -> Odometry | None:
        return None

    def has_depth(self) -> bool:
        return False

    def lidar(self) -> Lidar | None:
        return None

    def scans(self, stamp_ns: Ints) -> Iterator[Scan]:
        yield from ()

    def gps(self) -> Gps | None:
        return None

    def imu(self) -> Imu | None:
        return None

    def truth(self) -> Trajectory | Gps | None:
        return None

    def without_odometry(self) -> str:
        return ""
