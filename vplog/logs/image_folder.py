"""A folder of images as a Log: odometry and calibration come from files beside it, if at all."""

from __future__ import annotations

import re
import statistics
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from vplog.data import Frame, LogInfo, Topic
from vplog.errors import LogError
from vplog.logs.cameras import camera_of
from vplog.logs.frames import affine_to_camera, warped
from vplog.logs.image_groups import of_one_camera
from vplog.logs.messages.pixels import drive_levels, grey, spread
from vplog.logs.messages.records import BadMessageError, ImageMessage
from vplog.logs.sidecar_files import SidecarFiles
from vplog.logs.stamps import increasing, rate_hz, rows_of

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator
    from pathlib import Path

    from vplog.data import Bytes, Camera, Gps, Ints, Odometry
    from vplog.logs.formats.container import Notes
    from vplog.logs.formats.loss_account import Account, Loss
    from vplog.logs.messages.pixels import Levels
    from vplog.logs.topic_selection import TopicChoice

PERIOD_NS = 100_000_000
"""Time between images whose names hold no time: 10 Hz, KITTI's rate."""
_SIGNATURES = (b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n", b"BM", b"II*\0", b"MM\0*", b"P5", b"P6", b"P2", b"P3")
_SINCE_1970_S = (631_152_000, 4_102_444_800)
"""1990 to 2100: whole numbers of s, ms, us or ns in it have 9 to 19 digits, and never fit two of the units.
In ns since a start they come up after a week."""
_PERIODS_NS = (5_000_000, 5_000_000_000)
"""200 Hz down to 0.2 Hz, as cameras have it: in us and in ns two ranges that meet and do not overlap."""


_TRIED = 10
"""Images tried for the size of all."""


def is_image(path: Path) -> bool:
    """By the first bytes: JPEG, PNG, WebP, BMP, TIFF, PNM."""
    with path.open("rb") as file:
        head = file.read(12)
    return head.startswith(_SIGNATURES) or (head[:4] == b"RIFF" and head[8:] == b"WEBP")


def natural_order(path: Path) -> tuple:
    """Sorts `2.png` before `10.png`."""
    return tuple((int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"([0-9]+)", path.name))


def stamps_of(names: list[str]) -> list[int] | None:
    """ns from file stems that are times; None where they count the images.

    Times are decimal seconds, or whole s, ms, us or ns that all lie between 1990 and 2100. Others are us or ns since
    some start, as of a machine's boot, where their median step is the period of a camera in one of the two: counters
    go in steps of a few, with leading zeros or without.
    """
    if all(re.fullmatch(r"[0-9]{1,10}\.[0-9]{1,9}", name) for name in names):
        parts = [name.split(".") for name in names]
        return [int(whole) * 10**9 + int(fraction.ljust(9, "0")) for whole, fraction in parts]
    if not all(re.fullmatch(r"[0-9]{1,30}", name) for name in names):
        return None
    values = sorted({int(name) for name in names})
    low_ns, high_ns = (bound * 10**9 for bound in _SINCE_1970_S)
    units = (10**9, 10**6, 10**3, 1)
    unit = next((ns for ns in units if low_ns <= values[0] * ns and values[-1] * ns < high_ns), 0)
    if not unit and len(values) > 1:
        step = statistics.median(b - a for a, b in pairwise(values))
        unit = next((ns for ns in (10**3, 1) if _PERIODS_NS[0] <= step * ns < _PERIODS_NS[1]), 0)
    return [int(name) * unit for name in names] if unit and values[-1] * unit < 2**63 else None


@dataclass(eq=False)
class FileFrame:
    """One image file, read when decoded."""

    stamp_ns: int
    camera: Camera
    path: Path
    notes: Notes
    """Notes of the folder, where what does not decode is counted."""
    levels: Levels | None = None
    """Black and white of the folder, where its images have 16 bits."""

    def decode(self) -> Frame:
        """Raises LogError where the file is not an image."""
        name, at = self.path.parent.name, self.stamp_ns
        try:
            image = _read(self.path, self.levels)
            affine = affine_to_camera(name, image, self.camera, None, self.notes)
        except LogError as error:
            self.notes.account.add("undecodable_image", {name: 1}, (name, at), [(at, at)], str(error))
            raise
        return Frame(at, self.camera, warped(image, affine, self.camera))


class ImageFolder:
    """The images of one folder, in natural order of their names or in order of the times in them."""

    def __init__(
        self, path: Path, files: list[Path], notes: Notes, choice: TopicChoice, damaged: Collection[Path] = ()
    ) -> None:
        """`damaged` are those of `files` that are named like images, and are none: they had their time all the same."""
        files = of_one_camera(path, sorted(files, key=natural_order), choice.image)
        times = stamps_of([file.stem for file in files])
        if times is None:
            notes.add(f"The names in {path.name} are not times; its images are assumed to be 0.1 s apart.")
            times = [i * PERIOD_NS for i in range(len(files))]
        notes.account.know(path.name, {path.name: len(files)}, min(times))
        lost = [(time_ns, time_ns) for file, time_ns in zip(files, times, strict=True) if file in damaged]
        if lost:
            notes.account.add("empty_image", {path.name: len(lost)}, (path.name, 0), lost)
        sound = [(file, time_ns) for file, time_ns in zip(files, times, strict=True) if file not in damaged]
        files = [file for file, _ in sound]
        stamp_ns, rows = increasing(np.array([time_ns for _, time_ns in sound], np.int64), path.name, notes)
        if len(rows) < len(files):
            notes.account.add("repeated_stamp", {path.name: len(files) - len(rows)}, (path.name, 0), [])
        self._path, self._notes, self._sidecar = path, notes, SidecarFiles(choice, notes)
        self._stamp_ns, self._files = stamp_ns, [files[row] for row in rows.tolist()]

    @property
    def name(self) -> str:
        return self._path.name

    @property
    def warnings(self) -> list[str]:
        return list(self._notes.lines)

    @property
    def account(self) -> Account:
        """Account of what could not be used so far."""
        return self._notes.account

    @property
    def losses(self) -> list[Loss]:
        return self._notes.account.losses

    def info(self) -> LogInfo:
        count = len(self._files)
        kind = self._files[0].suffix.lstrip(".").lower()
        topic = Topic(self.name, "image", kind, count, "image", True, "image", kind, rate_hz=rate_hz(self._stamp_ns))
        start_ns, end_ns = int(self._stamp_ns[0]), int(self._stamp_ns[-1])
        return LogInfo(str(self._path), "images", start_ns, end_ns, count, [topic], self.warnings)

    def camera(self) -> Camera:
        return self._camera

    def stamps(self) -> Ints:
        return self._stamp_ns

    def frames(self, stamp_ns: Ints) -> Iterator[FileFrame]:
        for row in rows_of(self._stamp_ns, stamp_ns, self.name):
            yield FileFrame(int(self._stamp_ns[row]), self._camera, self._files[row], self._notes, self._levels)

    def odometry(self) -> Odometry | None:
        return self._sidecar.odometry

    def gps(self) -> Gps | None:
        return None

    @cached_property
    def _levels(self) -> Levels | None:
        return drive_levels(map(_message, self._files[:: spread(len(self._files))]))

    @cached_property
    def _camera(self) -> Camera:
        height, width = self._first_image().shape
        known = self._sidecar.camera(self.name)
        camera = camera_of(self.name, known.calibration if known else None, (width, height), self._notes)
        if known is None or known.body_from_camera is None:
            return camera
        return replace(camera, body_from_camera=known.body_from_camera)

    def _first_image(self) -> Bytes:
        """The first that decodes; raises LogError where none of the first few does."""
        reason = ""
        for file in self._files[:_TRIED]:
            try:
                return _read(file)
            except LogError as error:
                reason = reason or str(error)
        raise LogError(f"{self._path} has no image that can be decoded. The first: {reason}")


def _message(path: Path) -> ImageMessage:
    return ImageMessage(0, "", path.suffix, path.read_bytes(), True)


def _read(path: Path, levels: Levels | None = None) -> Bytes:
    try:
        return grey(_message(path), levels)
    except (OSError, BadMessageError) as error:
        raise LogError(f"{path} cannot be decoded: {error}.") from None
