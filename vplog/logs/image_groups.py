"""The cameras of a folder of images: by names that differ in more than numbers, by bits, and by size."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from vplog.errors import LogError
from vplog.storage.image_file import PNG, image_size

if TYPE_CHECKING:
    from pathlib import Path

Group = dict[str, list["Path"]]

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


def of_one_camera(folder: Path, files: list[Path], choice: str | None) -> list[Path]:
    """The files in order, of one camera: of several, that which `choice` names, as `left_*.png`.

    Raises LogError where they are of several and none is chosen.
    """
    groups = _by_name(files)
    groups = groups if len(groups) > 1 else _by_bits(files)
    groups = groups if len(groups) > 1 else _by_size(files)
    if len(groups) < 2:
        return files
    if choice in groups:
        return groups[choice]
    found = ", ".join(f"{name} ({len(group)})" for name, group in sorted(groups.items()))
    raise LogError(
        f"{folder} holds images of several cameras: {found}. Choose one with --image-topic {sorted(groups)[0]!r}, or "
        "give a folder with the images of one."
    )


def _by_name(files: list[Path]) -> Group:
    """Groups whose names differ in more than numbers and whose numbers run side by side: `left_*.png`, `right_*.png`.
    Empty where there is one, or one follows the other."""
    groups = _grouped(files, [re.sub(r"\d+", "*", file.name) for file in files])
    groups = {name: group for name, group in groups.items() if len(group) >= _LEAST}
    beside = {a for a in groups for b in groups if a != b and _side_by_side(groups[a], groups[b])}
    found = {name: group for name, group in groups.items() if name in beside}
    return found if sum(map(len, found.values())) >= _IN_GROUPS * len(files) else {}


def _side_by_side(a: list[Path], b: list[Path]) -> bool:
    x, y = ([_numbers(file) for file in group] for group in (a, b))
    if re.sub(r"\d+", "*", a[0].stem) == re.sub(r"\d+", "*", b[0].stem):  # one camera's, in two formats
        return len({*x} & {*y}) >= _SHARE * min(len(x), len(y))
    within = [sum(min(other) <= one <= max(other) for one in own) / len(own) for own, other in ((x, y), (y, x))]
    return max(within) >= _SHARE


def _numbers(file: Path) -> tuple[int, ...]:
    return tuple(int(digits) for digits in re.findall(r"\d+", file.stem))


def _by_bits(files: list[Path]) -> Group:
    """PNGs of 8 and of 16 bits: pictures and depth."""
    groups = _grouped(files, [_bits(file) for file in files])
    groups.pop("", None)
    return groups if all(len(group) >= _LEAST for group in groups.values()) else {}


def _bits(file: Path) -> str:
    """`16 bits`, `8 bits`, or nothing where the file is damaged or of another kind."""
    with file.open("rb") as opened:
        head = opened.read(25)
    if head[:8] != PNG or len(head) < 25:
        return ""
    return "16 bits" if head[24] == 16 else "8 bits"


def _by_size(files: list[Path]) -> Group:
    """Groups by width and height, where a few images spread over the folder have several sizes."""
    step = max(2 * len(files) // _SIZED, 1)
    if len({size for file in {*files[::step], *files[1::step]} if (size := _size(file))}) < 2:
        return {}
    groups = _grouped(files, [_size(file) for file in files])
    groups.pop("", None)
    return {name: group for name, group in groups.items() if len(group) >= max(_LEAST, _OTHERS * len(files))}


def _size(file: Path) -> str:
    size = image_size(file.read_bytes())
    return "" if size is None else f"{size[0]}x{size[1]}"


def _grouped(files: list[Path], names: list[str]) -> Group:
    groups: Group = {}
    for file, name in zip(files, names, strict=True):
        groups.setdefault(name, []).append(file)
    return groups
