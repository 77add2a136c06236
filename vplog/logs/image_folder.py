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
from vplog.logs.calibration_file import SidecarFiles
from vplog.logs.cameras import camera_of
from vplog.logs.frames import affine_to_camera, warped
from vplog.logs.messages.pixels import drive_levels, grey, spread
from vplog.logs.messages.records import BadMessageError, ImageMessage
from vplog.logs.stamps import increasing, rate_hz, rows_of
from vplog.storage.image_file import PNG, image_size

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterator
    from pathlib import Path

    from vplog.data import Bytes, Camera, Gps, Ints, Odometry
    from vplog.logs.formats.container import Notes
    from vplog.logs.formats.loss_account import Loss
    from vplog.logs.messages.pixels import Levels
    from vplog.logs.topic_selection import TopicChoice

PERIOD_NS = 100_000_000
"""Time between images whose names hold no time: 10 Hz, KITTI's rate."""
_SIGNATURES = (b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n", b"BM", b"II*\0", b"MM\0*", b"P5", b"P6", b"P2", b"P3")
_SINCE_1970_S = (631_152_000, 4_102_444_800)
"""1990 to 2100: whole numbers of s, ms, us or ns in it have 9 to 19 digits, and never fit two of the units."""
_PERIODS_NS = (5_000_000, 5_000_000_000)
"""200 Hz down to 0.2 Hz, as cameras have it: in us and in ns two ranges that meet and do not overlap."""
_TRIED = 10
"""Images tried for the size of all."""
_LEAST = 3
"""Images of a camera, at least: fewer may be strays."""
_SHARE = 0.5
"""Share of a group's images whose numbers lie within another's, from which the two were taken at the same time."""
_IN_GROUPS = 0.9
"""Share of a folder's images that cameras by name have together: names of random letters make groups of few."""
_OTHERS = 0.1
"""Share of a folder's images that a size has where it is another camera's; fewer are resampled, or left out, by one."""
_SIZED = 16
"""Images whose size is looked at, in pairs of neighbours spread over the folder."""


def is_image(path: Path) -> bool:
    """By the first bytes: JPEG, PNG, WebP, BMP, TIFF, PNM."""
    head = _head(path, 12)
    return head.startswith(_SIGNATURES) or (head[:4] == b"RIFF" and head[8:] == b"WEBP")


def _head(path: Path, count: int) -> bytes:
    with path.open("rb") as file:
        return file.read(count)


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


Group = dict[str, list["Path"]]


def of_one_camera(folder: Path, files: list[Path], choice: str | None) -> list[Path]:
    """The files in order, of one camera, by names, bits or size: of several, that which `choice` names, as
    `left_*.png`. Raises LogError where none of them is chosen."""
    groups = next((found for split in (_by_name, _by_bits, _by_size) if len(found := split(files)) > 1), {})
    if not groups:
        return files
    if choice in groups:
        return groups[choice]
    found = ", ".join(f"{name} ({len(group)})" for name, group in sorted(groups.items()))
    raise LogError(
        f"{folder} holds images of several cameras: {found}. Choose one with --image-topic {min(groups)!r}, or give a "
        "folder with the images of one."
    )


def _grouped(files: list[Path], name: Callable[[Path], str]) -> Group:
    """Files by a name of theirs, without those of an empty one."""
    groups: Group = {}
    for file in files:
        groups.setdefault(name(file), []).append(file)
    groups.pop("", None)
    return groups


def _by_name(files: list[Path]) -> Group:
    """Groups whose names differ in more than numbers and whose numbers run side by side: `left_*.png`, `right_*.png`.
    Empty where there is one, or one follows the other."""
    groups = _grouped(files, lambda file: re.sub(r"\d+", "*", file.name))
    groups = {name: group for name, group in groups.items() if len(group) >= _LEAST}
    beside = {a for a in groups for b in groups if a != b and _side_by_side(groups[a], groups[b])}
    found = {name: group for name, group in groups.items() if name in beside}
    return found if sum(map(len, found.values())) >= _IN_GROUPS * len(files) else {}


def _side_by_side(a: list[Path], b: list[Path]) -> bool:
    x, y = ([tuple(map(int, re.findall(r"\d+", file.stem))) for file in group] for group in (a, b))
    if re.sub(r"\d+", "*", a[0].stem) == re.sub(r"\d+", "*", b[0].stem):  # one camera's, in two formats
        return len({*x} & {*y}) >= _SHARE * min(len(x), len(y))
    within = [sum(min(other) <= one <= max(other) for one in own) / len(own) for own, other in ((x, y), (y, x))]
    return max(within) >= _SHARE


def _by_bits(files: list[Path]) -> Group:
    """PNGs of 8 and of 16 bits: pictures and depth."""
    groups = _grouped(files, _bits)
    return groups if all(len(group) >= _LEAST for group in groups.values()) else {}


def _bits(file: Path) -> str:
    """`16 bits`, `8 bits`, or nothing where the file is damaged or of another kind."""
    head = _head(file, 25)
    return "" if head[:8] != PNG or len(head) < 25 else "16 bits" if head[24] == 16 else "8 bits"


def _by_size(files: list[Path]) -> Group:
    """Groups by width and height, where a few images spread over the folder have several sizes."""
    step = max(2 * len(files) // _SIZED, 1)
    if len({size for file in {*files[::step], *files[1::step]} if (size := _size(file))}) < 2:
        return {}
    groups = _grouped(files, _size)
    return {name: group for name, group in groups.items() if len(group) >= max(_LEAST, _OTHERS * len(files))}


def _size(file: Path) -> str:
    size = image_size(file.read_bytes())
    return "" if size is None else f"{size[0]}x{size[1]}"


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
        named = list(zip(files, times, strict=True))
        if lost := [(time_ns, time_ns) for file, time_ns in named if file in damaged]:
            notes.account.add("empty_image", {path.name: len(lost)}, (path.name, 0), lost)
        sound = [(file, time_ns) for file, time_ns in named if file not in damaged]
        self._stamp_ns, rows = increasing(np.array([time_ns for _, time_ns in sound], np.int64), path.name, notes)
        self._files = [sound[row][0] for row in rows.tolist()]
        if repeated := len(sound) - len(rows):
            notes.account.add("repeated_stamp", {path.name: repeated}, (path.name, 0), [])
        self.name, self.account = path.name, notes.account
        self._path, self._notes, self._sidecar = path, notes, SidecarFiles(choice, notes)

    @property
    def warnings(self) -> list[str]:
        return self._notes.lines

    @property
    def losses(self) -> list[Loss]:
        return self.account.losses

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
        camera = camera_of(self.name, known and known.calibration, (width, height), self._notes)
        placed = known and known.body_from_camera
        return camera if placed is None else replace(camera, body_from_camera=placed)

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
