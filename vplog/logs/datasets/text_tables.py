"""Text tables of data sets: a row a line, columns by commas or blanks, comments behind `#`."""

from __future__ import annotations

import re
from collections.abc import Iterator
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np

from vplog.data import Floats, Ints, Trajectory
from vplog.errors import LogError
from vplog.geometry import se3
from vplog.logs.tf_odometry import are_usable

_UNIT = re.compile(r"[(\[](s|ms|us|ns)[)\]]")
_NS = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}
_LINE_LIMIT = 65536
"""Characters; a line of COLMAP's images.txt has some thousand, and a file without line ends is not read whole."""


def lines_of(path: Path, comments: bool = False) -> Iterator[tuple[int, str]]:
    """Lines with their numbers, those that are blank left out, and comments unless asked for. Raises LogError."""
    try:
        with path.open(encoding="utf-8-sig") as stream:
            number = 0
            while line := stream.readline(_LINE_LIMIT):
                number += 1
                if "\0" in line:
                    raise LogError(f"{path}:{number} is not text. Copy the data set again.")
                if line.strip() and (comments or not line.startswith("#")):
                    yield number, line.strip()
    except (OSError, UnicodeDecodeError) as error:
        raise LogError(f"Cannot read {path}: {error}. Copy the data set again.") from None


def rows_of(path: Path, least: int) -> list[list[str]]:
    """Rows of at least so many columns; a line of names at the top is left out, and a last line that is cut off. Raises
    LogError at the first other line that has fewer."""
    found: list[list[str]] = []
    short = 0
    for number, line in lines_of(path):
        if short:
            raise LogError(f"{path}:{short} has too few columns; {least} are expected. Copy the data set again.")
        fields = [field.strip() for field in line.split(",")] if "," in line else line.split()
        if not found and fields and re.match(r"(?!nan|inf)[a-z]", fields[0], re.IGNORECASE):
            continue
        short = 0 if len(fields) >= least else number
        if not short:
            found.append(fields)
    if not found:
        raise LogError(f"{path} holds no row. Copy the data set again.")
    return found


def unit_ns(name: str) -> int:
    """ns of the unit in brackets in the name of a column of stamps, as `ts (s)`; 1 without one."""
    named = _UNIT.search(name)
    return 1 if named is None else _NS[named[1]]


def table_unit_ns(path: Path) -> int:
    """ns of the unit of the stamps, by the last line before the numbers, a comment or not; 1 without one. Raises
    LogError."""
    head = ""
    for _, line in lines_of(path, comments=True):
        if re.match(r"[-+.\d]", line):
            break
        head = line
    return unit_ns(head.split(",")[0])


def header_of(path: Path) -> list[str]:
    """Names of the columns, where the first line has names; else its values. Raises LogError."""
    _, head = next(lines_of(path), (0, ""))
    return [name.strip() for name in head.split(",")]


def stamps_ns(path: Path, texts: list[str], unit_ns: int) -> Ints:
    """Stamps in units of so many ns, kept to the ns. Raises LogError at the first that is no time."""
    return np.array([_stamp_ns(path, text, unit_ns) for text in texts], np.int64)


def _stamp_ns(path: Path, text: str, unit_ns: int) -> int:
    try:
        value = Decimal(text)
        if value.is_finite() and value.adjusted() < 20 and 0 <= (stamp_ns := int(value * unit_ns)) < 2**63:
            return stamp_ns
    except InvalidOperation:
        pass
    raise LogError(f"{path}: {text[:40]!r} is not a stamp. Copy the data set again.")


def numbers_of(path: Path, rows: list[list[str]], first: int, count: int) -> Floats:
    """(K, count) numbers of columns from `first` on. Raises LogError where one is none."""
    try:
        return np.array([row[first : first + count] for row in rows], np.float64).reshape(-1, count)
    except ValueError as error:
        raise LogError(f"{path}: {error}. Copy the data set again.") from None


def poses_of(path: Path, unit_ns: int, scalar_first: bool = False) -> Trajectory:
    """`stamp x y z` and a quaternion a line, x y z w or, scalar first, w x y z; rows without a pose are left out.
    Raises LogError."""
    rows = rows_of(path, 8)
    values = numbers_of(path, rows, 1, 7)
    quaternion = values[:, [4, 5, 6, 3]] if scalar_first else values[:, 3:]
    usable = are_usable(np.concatenate([values[:, :3], quaternion], axis=1))
    if not usable.any():
        raise LogError(f"{path} holds no pose. Copy the data set again.")
    stamp_ns, first = np.unique(stamps_ns(path, [row[0] for row in rows], unit_ns)[usable], return_index=True)
    values, quaternion = values[usable][first], quaternion[usable][first]
    return Trajectory(stamp_ns, se3.pose(se3.rotation(quaternion), values[:, :3]))


def listed_images(path: Path, folder: Path, unit_ns: int, columns: tuple[int, int] = (0, 1)) -> tuple[Ints, list[Path]]:
    """Stamps and files by the columns of a list of images. Raises LogError, also where a path leads elsewhere."""
    rows = rows_of(path, max(columns) + 1)
    names = [row[columns[1]] for row in rows]
    for name in names:
        if name.startswith("/") or ".." in name.split("/"):
            raise LogError(f"{path} names {name[:60]}, which is outside {folder}. Copy it there.")
    files = [folder / name for name in names]
    if not any(file.is_file() for file in files):
        raise LogError(
            f"{path} names {names[0][:60]} and others, none of which is in {folder}. Copy the data set again."
        )
    return stamps_ns(path, [row[columns[0]] for row in rows], unit_ns), files
