"""Records as JSON: plain values, one text for each value, and a checksum against damage."""

from __future__ import annotations

import hashlib
import json
import math
from pathlib import PurePath
from typing import Any

CHECKSUM = "record_sha256"
"""Field of a record: sha256 of `canonical_json` of all others. One without it is taken as it is: an editor
wrote it."""


def with_checksum(record: dict[str, Any]) -> dict[str, Any]:
    """A record as plain values, with its checksum in place of the one that it may have."""
    record = {name: value for name, value in record.items() if name != CHECKSUM}
    return {**plain(record), CHECKSUM: key_of(record)}


def has_checksum(record: dict[str, Any]) -> bool:
    """Whether a record has the checksum in it, which is taken out, or none at all."""
    return CHECKSUM not in record or record.pop(CHECKSUM) == key_of(record)


def key_of(made_from: Any) -> str:
    """sha256 over a tree of values, as all that a result depends on."""
    return hashlib.sha256(canonical_json(made_from).encode()).hexdigest()


def canonical_json(tree: Any) -> str:
    """One text per value: sorted keys, no blanks. What a hash or a file header may hold."""
    return json.dumps(plain(tree), sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)


def parse_json(text: str | bytes) -> Any:
    """Return the value of a JSON text. Raises ValueError if the text is damaged or holds a number that is not finite or
    does not fit 64 bits, and RecursionError if its values are nested too deeply."""
    return json.loads(text, parse_int=_integer, parse_float=_finite, parse_constant=_finite)


def _integer(text: str) -> int:
    number = int(text)
    if not -(2**63) <= number < 2**64:
        raise ValueError(f"an integer of {len(text)} characters does not fit 64 bits")
    return number


def _finite(text: str) -> float:
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(f"{text[:20]} is not finite")
    return number


def plain(value: Any) -> Any:
    """The value with numpy scalars, arrays and paths as JSON has them."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if hasattr(value, "tolist"):  # numpy scalars and arrays
        return plain(value.tolist())
    if isinstance(value, PurePath):
        return str(value)
    if isinstance(value, float) and not math.isfinite(value):
        return None  # JSON has no NaN
    return value


def differences(one: Any, other: Any, name: str = "") -> dict[str, list[Any]]:
    """Leaves of two trees that differ, by their dotted names; None where one tree lacks it."""
    if not (isinstance(one, dict) or isinstance(other, dict)):
        return {} if one == other else {name.removeprefix("settings."): [one, other]}
    left, right = (tree if isinstance(tree, dict) else {} for tree in (one, other))
    found: dict[str, list[Any]] = {}
    for key in dict.fromkeys([*left, *right]):
        found |= differences(left.get(key), right.get(key), f"{name}.{key}" if name else key)
    return found
