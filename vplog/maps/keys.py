"""What a drive of a map is called, and what its results depend on."""

from __future__ import annotations

import hashlib
import re
from functools import cache
from pathlib import Path
from typing import Any

import vplog
from vplog.maps.store import sha256_of
from vplog.results import run_record


def drive_names(names: list[str], logs: list[str], known: dict[str, dict[str, Any]], inputs: list[Any]) -> list[str]:
    """The ID of each log: that under which the map knows it, by its path or else by its content; else its name, with
    a number where others have the same. Logs given in the same order to an empty map get the same IDs."""
    result: list[str | None] = [None] * len(names)
    taken: set[str] = set()
    for told, given in (("log", logs), ("inputs", inputs)):
        places: dict[str, list[str]] = {}
        for drive, record in known.items():
            places.setdefault(run_record.canonical_json(record[told]), []).append(drive)
        for at, name in enumerate(names):
            own = re.compile(re.escape(name) + r"(-\d+)?")
            for drive in places.get(run_record.canonical_json(given[at]), []):
                if result[at] is None and drive not in taken and own.fullmatch(drive):
                    result[at] = drive
                    taken.add(drive)
    for at, name in enumerate(names):
        number, free = 2, name
        while result[at] is None:
            if free not in taken and free not in known:
                result[at] = free
                taken.add(free)
            free, number = f"{name}-{number}", number + 1
    return [drive for drive in result if drive is not None]


@cache
def code_hash() -> str:
    """sha256 over every .py file of the package, by name: any change of the code counts as one of the result."""
    package, digest = Path(vplog.__file__).parent, hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        digest.update(f"{path.relative_to(package).as_posix()} {sha256_of(path)}\n".encode())
    return digest.hexdigest()


def key_of(made_from: dict[str, Any]) -> str:
    """sha256 over all that a drive's results depend on."""
    return hashlib.sha256(run_record.canonical_json(made_from).encode()).hexdigest()
