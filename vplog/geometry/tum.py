"""TUM files, one pose a line, as the TUM RGB-D benchmark and evo have them."""

from __future__ import annotations

import io
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np

from vplog.data import Floats, Ints, Trajectory
from vplog.errors import VplogError, nearest_path
from vplog.geometry import se3
from vplog.storage.remote_path import reason
from vplog.storage.scratch import replacing

_LINE_LIMIT = 4096
"""Characters; eight numbers take about 200, and a file without line ends is not read whole."""
_UNIT_TOLERANCE = 0.1
"""Rounded quaternions are off by 1e-3 at most; more than this and the columns are something else."""
_FORMAT = "A line is `timestamp tx ty tz qx qy qz qw` in s and m (TUM)."


def read_tum(path: Path, failure: type[VplogError], option: str) -> tuple[Ints, Floats]:
    """(T,) increasing stamps in ns and (T, 4, 4) poses of `timestamp tx ty tz qx qy qz qw` in s and m, in any order.

    Blank lines and what follows `#` are skipped, stamps are kept to the ns, the first of equal stamps is kept.
    Raises `failure` with the number of the first line that does not fit; `option` is where the file was named.
    """
    stamps: list[int] = []
    rows: list[list[float]] = []
    try:
        with io.TextIOWrapper(path.open("rb"), encoding="utf-8-sig") as lines:
            number = 0
            while line := lines.readline(_LINE_LIMIT):
                number += 1
                if len(line) >= _LINE_LIMIT:
                    raise failure(f"{path}:{number} is longer than {_LINE_LIMIT} characters. {_FORMAT}")
                fields = line.partition("#")[0].split()
                if fields:
                    stamp_ns, row = _pose(fields, f"{path}:{number}", failure)
                    stamps.append(stamp_ns)
                    rows.append(row)
    except OSError as error:
        raise failure(
            f"Cannot read {path}: {reason(error)}. Give a TUM file with {option}.{nearest_path(path)}"
        ) from None
    except UnicodeDecodeError:
        raise failure(f"{path} is not text. {_FORMAT}") from None
    if not rows:
        raise failure(f"{path} holds no pose. {_FORMAT}")
    stamp_ns, first = np.unique(np.array(stamps, np.int64), return_index=True)
    values = np.array(rows)[first]
    return stamp_ns, se3.from_vectors(values)


def _pose(fields: list[str], where: str, failure: type[VplogError]) -> tuple[int, list[float]]:
    if len(fields) != 8:
        raise failure(f"{where} has {len(fields)} values instead of 8. {_FORMAT}")
    try:
        stamp = Decimal(fields[0])
        row = [float(field) for field in fields[1:]]
    except (InvalidOperation, ValueError):
        raise failure(f"{where} holds something that is not a number. {_FORMAT}") from None
    if not stamp.is_finite() or not np.isfinite(row).all():
        raise failure(f"{where} holds a value that is not finite. {_FORMAT}")
    # 2^63 ns are 9.2e9 s; checked by exponent first, as a Decimal may name a number that no memory can hold.
    if stamp.adjusted() > 10 or abs(stamp) >= Decimal(2**63) / 10**9:
        raise failure(f"{where}: the stamp {fields[0][:40]} is not in seconds. {_FORMAT}")
    norm = float(np.linalg.norm(row[3:]))
    if abs(norm - 1.0) > _UNIT_TOLERANCE:
        raise failure(f"{where}: the quaternion has length {norm:.3g} instead of 1. {_FORMAT}")
    return int((stamp * 10**9).to_integral_value()), row


def write_tum(path: Path, trajectory: Trajectory) -> None:
    """`stamp tx ty tz qx qy qz qw` in s, m and 1; 9 decimals, the stamp's exact to the ns."""
    values = se3.vectors(trajectory.world_from_body)
    with replacing(path) as stream:
        stream.write(b"# timestamp tx ty tz qx qy qz qw (world_from_body)\n")
        for stamp_ns, row in zip(trajectory.stamp_ns.tolist(), values.tolist(), strict=True):
            stream.write(f"{seconds(stamp_ns)} {' '.join(f'{value:.9f}' for value in row)}\n".encode())


def seconds(stamp_ns: int) -> str:
    """A stamp in s with all its digits; a float has too few for the clock of today."""
    whole, rest = divmod(abs(stamp_ns), 1_000_000_000)
    return f"{'-' if stamp_ns < 0 else ''}{whole}.{rest:09d}"
