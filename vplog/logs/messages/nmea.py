"""Positions in sentences of NMEA 0183, as satellite receivers send them."""

from __future__ import annotations

import math
from functools import reduce
from operator import xor

import numpy as np

from vplog.logs.messages.records import BadMessageError, FixMessage

SENTENCES = ("GGA", "GNS", "RMC", "GLL")
"""Sentences with a position, the one with most of altitude, quality and dilution first; a receiver sends several
for each fix."""
_FIELDS = {"GGA": (2, 15), "GNS": (2, 13), "RMC": (3, 10), "GLL": (1, 7)}
"""Index of the latitude, and the least number of fields."""
_SIGMA_M = {"1": 3.0, "2": 1.0, "4": 0.02, "5": 0.5}
"""m at a dilution of 1, by the quality of GGA: alone, differential, RTK with whole wavelengths, RTK without; multiplied
by the dilution, as ROS's nmea_navsat_driver has it."""
_NO_FIX = ("0", "6")
"""Qualities without a measurement: none, and dead reckoning."""


def fix_of(stamp_ns: int, frame: str, sentence: str) -> FixMessage | None:
    """The fix of a sentence; None of one without a position. Raises BadMessageError or ValueError where it is damaged.

    Altitudes are above the ellipsoid where the sentence says how far the geoid lies above it.
    """
    text, star, checksum = sentence.strip().partition("*")
    if not text.startswith("$"):
        raise BadMessageError("it is not an NMEA sentence")
    if star and int(checksum, 16) != reduce(xor, text[1:].encode(), 0):
        raise BadMessageError("its NMEA checksum does not match")
    fields = text.split(",")
    kind = fields[0][-3:]
    if kind not in SENTENCES:
        return None
    at, least = _FIELDS[kind]
    if len(fields) < least:
        raise BadMessageError(f"its {kind} is cut")
    quality, dilution, altitude_m = _quality(kind, fields)
    latitude, longitude = (_degrees(*fields[first : first + 2]) for first in (at, at + 2))
    sigma_m = _SIGMA_M.get(quality, math.nan) * dilution
    covariance = np.diag([sigma_m**2, sigma_m**2, 4 * sigma_m**2]) if sigma_m > 0 else np.full((3, 3), np.nan)
    valid = quality not in _NO_FIX and bool(fields[at])
    return FixMessage(stamp_ns, valid, latitude, longitude, altitude_m, covariance, frame, kind)


def _quality(kind: str, fields: list[str]) -> tuple[str, float, float]:
    """Quality as GGA has it, horizontal dilution and altitude in m, NaN where unknown."""
    if kind == "GGA":
        return fields[6], _number(fields[8]), _number(fields[9]) + (_number(fields[11]) if fields[11] else 0.0)
    if kind == "GNS":  # a letter for each system: N for none
        height = _number(fields[9]) + (_number(fields[10]) if fields[10] else 0.0)
        return "0" if set(fields[6]) <= {"N"} else "", _number(fields[8]), height
    return "" if fields[2 if kind == "RMC" else 6] == "A" else "0", math.nan, math.nan


def _number(text: str) -> float:
    return float(text) if text else math.nan


def _degrees(text: str, side: str) -> float:
    """Degrees of `4807.038`, degrees and minutes, and N, S, E or W; NaN where it is empty."""
    if not text:
        return math.nan
    point = text.index(".") if "." in text else len(text)
    degrees = float(text[: point - 2] or 0) + float(text[point - 2 :]) / 60
    return -degrees if side in ("S", "W") else degrees
