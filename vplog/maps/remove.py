"""Drives taken out of a map."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from vplog.errors import ResultError, SettingsError
from vplog.maps.joining.joint_record import components_in
from vplog.maps.storage import map_store
from vplog.maps.storage.contents import damage_warnings


def remove_drives(root: Path, drives: Sequence[str]) -> dict[str, Any]:
    """Take drives out of a map, all of them or none; what is left. Failures of these names are forgotten too.

    Raises SettingsError, before anything is touched, where a drive is not in the map.
    """
    with map_store.reading(root) as store:
        store.head()
        _check(store, drives)
    with map_store.writing(root) as store:
        _check(store, drives)
        map_store.remove(store, list(dict.fromkeys(drives)))
        return {
            "map": str(store),
            "removed": list(dict.fromkeys(drives)),
            "drives": list(store.drives()),
            "still_joined": _still_joined(store, drives),
            "warnings": damage_warnings(store),
        }


def _still_joined(store: map_store.Store, drives: Sequence[str]) -> list[str]:
    """Removed drives that the joint graphs hold until they are solved again."""
    try:
        joined = {drive for one in components_in(store) or [] for drive in one["drives"]}
    except ResultError:  # damaged: the next join writes it again
        return []
    return sorted(joined & set(drives))


def _check(store: map_store.Store, drives: Sequence[str]) -> None:
    known = [*store.drives(), *store.damaged, *store.failures()]
    for drive in drives:
        if drive not in known:
            raise SettingsError(f"{store} has no drive {drive!r}. Drives: {', '.join(known) or 'none'}.")
