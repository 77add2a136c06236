"""A smaller map of the same drives, without the places that recognition can do without.

Every drive keeps its trajectory, closures, pose graph and what joins it with others; of descriptors.parquet the rows
that stay are as they were. So the new map is searched, localised in, joined, merged and exported as any other.
"""

from __future__ import annotations

import math
import os
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vplog.errors import SettingsError
from vplog.execution.execution import Execution
from vplog.maps.condensation.own_queries import OwnAnswers, OwnPlaces, query_own_places, read_own_places, search_of
from vplog.maps.condensation.redundancy import remove_redundant
from vplog.maps.merge import copy_library
from vplog.maps.search.query import open_map
from vplog.maps.storage import layout, map_store
from vplog.maps.storage.contents import damage_warnings, skip_damaged
from vplog.results import run_record, tables
from vplog.stages import CodedState
from vplog.storage.remote_path import RemotePath
from vplog.storage.scratch import copy_folder

if TYPE_CHECKING:
    from vplog.data import Bools
    from vplog.maps.storage.map_store import Store
    from vplog.stages import PlaceState

LOSS = 0.01
"""Loss of recall at rank one of the map's own queries."""
_SPACINGS = 3.0
"""Right is within so many times the distance of keyframes that follow each other: 3 m of keyframes a metre apart."""


@dataclass(frozen=True, eq=False)
class Condensed:
    """The places of a map that stay."""

    places: OwnPlaces
    answers: OwnAnswers
    distance_m: float
    retained: Bools
    """(N,) places that the new map has."""
    lost: int
    """Queries that are not answered rightly any more."""


def condense_map(
    root: Path, target: Path, loss: float = LOSS, distance_m: float | None = None, execution: Execution = Execution()
) -> dict[str, Any]:
    """Write the map `target`: the drives of a map with the places that still decide something, as long as the recall at
    rank one of the map's own queries falls by no more than `loss`. Returns an account of it.

    A place is right within `distance_m` of the query, which None sets by the spacing of places. Raises VplogError, as
    where the target is a map already.
    """
    if isinstance(root, RemotePath) or isinstance(target, RemotePath):
        raise SettingsError("Maps are condensed from folder to folder. Copy the map to this machine.")
    if root.resolve() == target.resolve():
        raise SettingsError(f"{root} is given as its own target. Choose another map with -o.")
    with map_store.reading(root) as store:

        def attempt() -> tuple[Condensed, PlaceState, list[str]]:
            drives, _, state = open_map(store, execution)
            places = read_own_places(store, drives, state)
            search, warnings = search_of(store, drives, places, state, execution)
            within = distance_m or _SPACINGS * places.spacing_m
            answers = query_own_places(places, search, state, within, execution)
            return choose_places(places, answers, within, loss, execution), state, warnings

        found, state, warnings = skip_damaged(store, attempt)
        _write(store, target, found)
        warnings += damage_warnings(store)
    return {"map": str(root), "written": str(target), "loss": loss, **_account(found, state, root, target, warnings)}


def choose_places(
    places: OwnPlaces, answers: OwnAnswers, distance_m: float, loss: float, execution: Execution = Execution()
) -> Condensed:
    """The places that stay. One that no other shows is among them, unless it has faded, and one of each drive."""
    count = len(places.drive)
    posed = places.frame >= 0
    answered = np.isin(np.arange(count), answers.place)
    removable = posed & (answered | answers.faded)
    most_lost = math.floor(loss * int(posed.sum()) + 1e-9)  # .01 of 300 is 3
    total = int(removable.sum())
    removal = remove_redundant(
        answers.queries, places.drive, np.cumsum(places.steps_m()), removable, answers.faded, most_lost,
        lambda done: execution.progress("remove", done, total),
    )  # fmt: skip
    lost = int(removal.lost[-1]) if len(removal.lost) else 0
    return Condensed(places, answers, distance_m, ~np.isin(np.arange(count), removal.places), lost)


def _write(store: Store, target: Path, found: Condensed) -> None:
    """The new map. Raises ResultError or SettingsError."""
    records, first = store.drives(), found.places.first
    with map_store.writing(target) as new:
        if new.drives() or new.damaged:
            raise SettingsError(f"{target} holds a map already. Choose another folder with -o.")
        copy_library(new, store, str(store.head().library))
        for number, drive in enumerate(found.places.drives):
            retained = np.flatnonzero(found.retained[first[number] : first[number + 1]])
            _write_drive(store, new, records[drive], retained)
        for name in ("joins", "joint"):  # they name the drives by keys that they still have
            if (store.root / name).is_dir():
                copy_folder(store.root / name, target / name, f"{name} of {store} to {target}", **_LINKED)
        if (store.root / "joint.json").is_file():
            layout.link(store.root / "joint.json", target / "joint.json")


_LINKED: dict[str, Callable[..., Any]] = {"copy_function": layout.link}


def _write_drive(store: Store, new: Store, record: Mapping[str, Any], retained: Any) -> None:
    drive, made = record["drive"], new.staging / f"{os.getpid()}-condense"

    def copied(run: Path) -> None:
        shutil.rmtree(made, ignore_errors=True)
        ignored = shutil.ignore_patterns("drive.json")  # it comes last: what has it is whole
        copy_folder(run, made, f"{drive} of {store} to {new}", ignore=ignored, **_LINKED)
        if len(retained) < store.rows("descriptors", drive):
            table = made / "descriptors.parquet"
            table.unlink()
            tables.write_some_descriptors(run / table.name, table, retained)

    store.read(drive, copied, ())
    run_record.write_run_json(made / "drive.json", dict(record))
    map_store.publish(new, drive, made)


def _account(found: Condensed, state: PlaceState, root: Path, target: Path, warnings: list[str]) -> dict[str, Any]:
    """The places removed and what that costs, as plain values."""
    places, answers, retained = found.places, found.answers, found.retained
    posed, answered = int((places.frame >= 0).sum()), len(answers.place)
    best = np.array([one.rows[0] for one in answers.queries.best], np.int64)
    others = int((places.drive[best] != places.drive[answers.place]).sum())
    drives: list[dict[str, Any]] = []
    for number, drive in enumerate(places.drives):
        own, files = places.drive == number, [f"runs/{layout.folder_name(drive)}/descriptors.parquet"] * 2
        before, after = ((top / file).stat().st_size for top, file in zip((root, target), files, strict=True))
        drives.append({
            "drive": drive,
            "places": {"before": int(own.sum()), "after": int((own & retained).sum())},
            "descriptor_bytes": {"before": before, "after": after},
            "faded": int((own & answers.faded & ~retained).sum()),
        })  # fmt: skip
    recall = [round((answered - lost) / max(posed, 1), 6) for lost in (0, found.lost)]
    if len(set(places.frame.tolist())) == len(places.drives) > 1:
        warnings.append(
            "No drives are joined in one frame, so none stands in for another: places are compared within each. Join "
            f"the drives first: vplog map join {root}"
        )
    return {
        "distance_m": round(found.distance_m, 3),
        "queries": {
            "places": posed,
            "by_other_drives": others,
            "by_own_drive": answered - others,
            "alone": posed - answered,
        },
        "recall": {"before": recall[0], "after": recall[1], "loss": round(found.lost / max(posed, 1), 6)},
        "faded": {"found": int(answers.faded.sum()), "removed": int((answers.faded & ~retained).sum())},
        **{
            name: {end: sum(one[name][end] for one in drives) for end in ("before", "after")}
            for name in ("places", "descriptor_bytes")
        },
        "references": _references(places, retained, state),
        "drives": drives,
        "warnings": warnings,
    }


def _references(places: OwnPlaces, retained: Bools, state: PlaceState) -> dict[str, int] | None:
    """References that some place names, of the library's; None where places name none."""
    if not isinstance(state, CodedState):
        return None
    named = np.zeros((2, state.shape[0]), np.bool_)
    for number, column in enumerate(places.columns):
        own = retained[places.drive == number]
        for row, rows in enumerate((np.ones(len(own), np.bool_), own)):
            start = state.lists(column.filter(rows)).start
            named[row] |= start[:, -1] > start[:, 0]
    before, after = named.sum(1).tolist()
    return {"library": state.shape[0], "before": before, "after": after}
