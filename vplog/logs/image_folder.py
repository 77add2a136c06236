"""The images of one folder: which are of one camera, and what times their names hold."""

from __future__ import annotations

import re
import statistics
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Sequence
from contextlib import suppress
from datetime import datetime
from functools import partial
from itertools import combinations, pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from vplog.data import Ints
from vplog.errors import LogError
from vplog.logs.recorder_clock import LONGEST_PAUSE_NS
from vplog.logs.topic_selection import EVERY_IMAGE
from vplog.storage.image_file import PNG

PERIOD_NS = 100_000_000
"""Time between images whose names hold no time: 10 Hz, KITTI's rate."""
_SIGNATURES = (b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n", b"BM", b"II*\0", b"MM\0*", b"P5", b"P6", b"P2", b"P3")
_SINCE_1970_S = (631_152_000, 4_102_444_800)
"""1990 to 2100: whole numbers of s, ms, us or ns in it have 9 to 19 digits, and never fit two of the units."""
_PERIODS_NS = (5_000_000, 5_000_000_000)
"""200 Hz down to 0.2 Hz, as cameras have it: in us and in ns two ranges that meet and do not overlap."""
_LEAST_DECIMAL_NS = 2_000_000
"""Least step of decimal seconds, which are hardly anything else: 500 Hz."""
_DATE = re.compile(r"(?<!\d)(20\d{6})[_-]?(\d{9})(?!\d)")
"""A day and a time to the ms, as phones name their pictures."""
_LEAST = 3
"""Images of a camera, at least: fewer may be strays."""
_SHARE = 0.5
"""Share of a group's images whose numbers lie within another's, from which the two were taken at the same time."""
_IN_GROUPS = 0.9
"""Share of a folder's images that cameras by name have together: names of random letters make groups of few."""


def is_image(path: Path) -> bool:
    """By the first bytes: JPEG, PNG, WebP, BMP, TIFF, PNM."""
    head = first_bytes(path, 12)
    return head.startswith(_SIGNATURES) or (head[:4] == b"RIFF" and head[8:] == b"WEBP")


def first_bytes(path: Path, count: int) -> bytes:
    with path.open("rb") as file:
        return file.read(count)


def below(path: Path) -> list[Path]:
    """The folders right below, by name; none where there is no such folder."""
    return sorted(folder for folder in path.iterdir() if folder.is_dir()) if path.is_dir() else []


def image_files(folder: Path) -> list[Path]:
    """The images of a folder in natural order, and files that are only named like them; none where there is no such
    folder."""
    files = sorted(folder.iterdir(), key=lambda file: natural_order(file.name)) if folder.is_dir() else []
    files = [file for file in files if file.is_file() and not file.name.startswith(".")]
    endings = {file.suffix for file in files if file.suffix and is_image(file)}
    return [file for file in files if file.suffix in endings or is_image(file)]


def natural_order(name: str) -> tuple:
    """Key that sorts `2.png` before `10.png`, whatever the length of a number."""
    parts = ((part.lstrip("0"), part.isdecimal()) for part in re.split(r"([0-9]+)", name))
    return tuple((len(part), part) if number else (-1, part) for part, number in parts)


def stamps_of(names: list[str]) -> list[int] | None:
    """ns from file stems that are times, or hold one beside words that all have (`frame_1403715273262142976`); None
    where they count the images.

    Times are a date and a time of day to the ms (`PXL_20230512_143015123`), decimal seconds, or whole numbers, whose
    unit `_unit_of` chooses. Numbers in small steps count the images, with leading zeros or without, also behind the
    number of a camera and a dot (`cam0.17`).
    """
    if not names:
        return None
    dates = [_DATE.search(name) for name in names]
    with suppress(ValueError):  # no such day
        found = [datetime.strptime(f"{one[1]}{one[2]}Z", "%Y%m%d%H%M%S%f%z") for one in dates if one]
        if 2 * len({*found}) > len(found):  # else of a burst, or of the clip that they are the frames of
            return [round(at.timestamp() * 1e3) * 10**6 for at in found] if len(found) == len(names) else None
    names = _changing(names)
    if all(re.fullmatch(r"[0-9]{1,10}\.[0-9]{1,9}", name) for name in names):
        parts = [name.split(".") for name in names]
        if len({whole for whole, _ in parts}) == 1 and int(parts[0][0]) < _SINCE_1970_S[0]:
            return None  # a camera's number before a counter, rather than a drive of less than a second
        values = [int(whole + fraction.ljust(9, "0")) for whole, fraction in parts]
        unit_ns = int(_is_since_1970(values, 1) or _median_step(values) >= _LEAST_DECIMAL_NS)
    elif all(re.fullmatch(r"[0-9]{1,30}", name) for name in names):
        values = [int(name) for name in names]
        unit_ns = _unit_of(values)
    else:
        return None
    return [value * unit_ns for value in values] if unit_ns and max(values) * unit_ns < 2**63 else None


def _unit_of(values: list[int]) -> int:
    """Return the ns in the unit of whole numbers that are times, or 0 if they count the images.

    Times since 1970 have the unit that puts all of them between 1990 and 2100, if images follow each other within
    LONGEST_PAUSE_NS. Times of a simulation in ns may lie between these years as ms, but hours apart. Other times, since
    the start of a computer or of a simulation, have the unit that gives a frame rate of a camera. Only us and ns are
    told from counters by this.
    """
    step = _median_step(values)
    dated = next((unit for unit in (10**9, 10**6, 10**3, 1) if _is_since_1970(values, unit)), 0)
    if dated and step * dated < LONGEST_PAUSE_NS:
        return dated
    return next((unit for unit in (10**3, 1) if _PERIODS_NS[0] <= step * unit < _PERIODS_NS[1]), dated)


def _is_since_1970(values: list[int], unit_ns: int) -> bool:
    first_ns, last_ns = (bound * 10**9 for bound in _SINCE_1970_S)
    return first_ns <= min(values) * unit_ns and max(values) * unit_ns < last_ns


def _median_step(values: list[int]) -> float:
    """Return the median difference between numbers in order; 0 for a single one, or if two are the same."""
    steps = [b - a for a, b in pairwise(sorted(values))]
    return statistics.median(steps) if steps and min(steps) else 0


def frame_rate_remarks(folder: Path, stamp_ns: Sequence[int]) -> list[str]:
    """Return a remark on times in names that are further apart than the images of a camera; none without."""
    period_s = _median_step([*stamp_ns]) / 1e9
    if period_s * 1e9 < _PERIODS_NS[1]:
        return []
    return [
        f"The names of the images in {folder.name} are read as times, which are {period_s:.4g} s apart. No unit gives "
        "a frame rate of a camera, so speeds and gaps are wrong if this is not how the images were taken. If the names "
        "are not times, number the images: 0001, 0002, ..."
    ]


def _changing(names: list[str]) -> list[str]:
    """The one number of each name that is not the same in all; the names where there is none or more change."""
    parts = [re.split(r"([0-9]+(?:\.[0-9]+)?)", name) for name in names]
    if len({len(part) for part in parts}) > 1:
        return names
    changing = [column for column in zip(*parts, strict=True) if len({*column}) > 1]
    return list(changing[0]) if len(changing) == 1 else names


Group = dict[str, list["Path"]]
_NUMBER = re.compile(r"((?:cam(?:era)?|infra|fisheye)[_-]?\d(?!\d))|(\d+)", re.IGNORECASE)
"""The number of a camera, with its word, or any other."""


def select_camera(folder: Path, files: list[Path], choice: str | None) -> list[Path]:
    """Return the files of one camera, in order. Names and bits tell cameras apart; of several cameras `choice` names
    the one to use, as `left_*.png`. Raises LogError if it names none of them."""
    splits = (partial(by_folder, folder), _by_name, _by_bits)
    groups = next((found for split in splits if len(found := split(files)) > 1), {})
    if not groups:
        return files
    if choice in groups:
        return groups[choice]
    found = ", ".join(f"{name} ({len(group)})" for name, group in sorted(groups.items()))
    raise LogError(
        f"{folder} holds images of several cameras: {found}. Choose one with --image-topic {min(groups)!r}, give a "
        f"folder with the images of one, or take all as they are with --image-topic {EVERY_IMAGE!r}."
    )


def grouped(files: list[Path], name: Callable[[Path], str]) -> Group:
    """Files by a name of theirs, without those of an empty one."""
    groups: Group = {}
    for file in files:
        groups.setdefault(name(file), []).append(file)
    groups.pop("", None)
    return groups


def by_folder(root: Path, files: list[Path]) -> Group:
    """Groups by the folder below `root`, where these are fewer than the images of each and run side by side. Empty
    where they follow each other, or hold a few views of a place each."""
    groups = grouped(files, lambda file: file.relative_to(root).parent.as_posix())
    numbers = _numbers_of_large(groups)
    large = [*numbers.values()]
    pairs = [*pairwise(large), *((large[0], other) for other in large[2:])]
    return groups if 2 * len(large) > len(groups) and any(_are_parallel(a, b) for a, b in pairs) else {}


def _by_name(files: list[Path]) -> Group:
    """Groups whose names differ in more than numbers and whose numbers run side by side: `left_*.png`, `right_*.png`.
    Empty where there is one, or one follows the other."""
    groups = grouped(files, lambda file: _pattern(file.name))
    numbers = _numbers_of_large({name: group for name, group in groups.items() if len(group) >= _LEAST})
    pairs = ((a, b) for a, b in combinations(numbers, 2) if _are_parallel(numbers[a], numbers[b]))
    parallel = {name for pair in pairs for name in pair}
    found = {name: group for name, group in groups.items() if name in parallel}
    return found if sum(map(len, found.values())) >= _IN_GROUPS * len(files) else {}


def _pattern(name: str) -> str:
    """With `*` for the numbers that tell the images of one camera apart."""
    return _NUMBER.sub(lambda found: found[1] or "*", name)


class _Numbers(NamedTuple):
    """The numbers in the names of a group of images."""

    pattern: str
    """Of the names, without their endings."""
    values: list[tuple[int, ...]]
    """In order."""


def _numbers_of_large(groups: Group) -> dict[str, _Numbers]:
    """Return the numbers of the groups that have at least as many images as there are groups, because a drive has more
    images than cameras. All of these can be compared with each other in about the time that their names take."""
    large = {name: group for name, group in groups.items() if len(group) >= max(len(groups), _LEAST)}
    return {
        name: _Numbers(
            _pattern(group[0].stem), sorted(tuple(int(n) for _, n in _NUMBER.findall(file.stem) if n) for file in group)
        )
        for name, group in large.items()
    }


def _are_parallel(a: _Numbers, b: _Numbers) -> bool:
    x, y = a.values, b.values
    if a.pattern == b.pattern:  # one camera's, in two formats
        return len({*x} & {*y}) >= _SHARE * min(len(x), len(y))
    within = [(bisect_right(own, other[-1]) - bisect_left(own, other[0])) / len(own) for own, other in ((x, y), (y, x))]
    return max(within) >= _SHARE


def _by_bits(files: list[Path]) -> Group:
    """PNGs of 8 and of 16 bits: pictures and depth."""
    groups = grouped(files, _bits)
    return groups if all(len(group) >= _LEAST for group in groups.values()) else {}


def _bits(file: Path) -> str:
    """`16 bits`, `8 bits`, or nothing where the file is damaged or of another kind."""
    head = first_bytes(file, 25)
    return "" if head[:8] != PNG or len(head) < 25 else "16 bits" if head[24] == 16 else "8 bits"


def named_stamps(files: Sequence[Path]) -> tuple[Ints, bool]:
    """Stamps by the names of files, and whether these are times; else PERIOD_NS apart."""
    found = stamps_of([file.stem for file in files])
    return np.arange(len(files)) * PERIOD_NS if found is None else np.array(found, np.int64), found is not None
