"""A smaller map of the same drives, without the places and references that recognition can do without.

Every drive keeps its trajectory, closures, pose graph and what joins it with others; of descriptors.parquet the rows
that stay are as they were, but for references that are gone. So the new map is searched, localised in, joined, merged
and exported as any other. Its library has thumbnails in place of images, which recognition does not look at.
"""

from __future__ import annotations

import math
import os
import shutil
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vplog.data import Bools, Ints
from vplog.errors import ResultError, SettingsError
from vplog.execution.execution import Execution
from vplog.maps.condensation import own_queries
from vplog.maps.condensation.own_queries import OwnAnswers, OwnPlaces
from vplog.maps.condensation.redundancy import RemovalCandidates, remove_cross_validated
from vplog.maps.condensation.references import remove_references
from vplog.maps.merge import copy_library, copy_run, put_library
from vplog.maps.search.query import open_map
from vplog.maps.storage import layout, map_store
from vplog.maps.storage.contents import damage_warnings, skip_damaged
from vplog.maps.storage.map_store import Store
from vplog.places.library_files import ReferencesState, name_extractor, read_library_record
from vplog.results import run_record, tables
from vplog.run.provenance import library_of
from vplog.stages import CodedState, FrameState, PlaceState
from vplog.storage.input_hashes import bytes_of
from vplog.storage.scratch import copy_folder

LOSS = 0.01
"""Loss of recall at rank one of the map's own queries."""
_UNFINISHED = "The map was not condensed to its end. Run vplog map condense again."
_SPACINGS = 3.0
"""An answer is right within so many times the median distance of consecutive keyframes: 3 m of keyframes a metre
apart."""


@dataclass(frozen=True, eq=False)
class Condensed:
    """Outcome of a condensation: which places and references of a map stay."""

    places: OwnPlaces
    answers: OwnAnswers
    distance_m: float
    retained: Bools
    """(N,) places that the new map has."""
    lost: int
    """Queries that lose their right answer with the places removed, by cross-validation."""
    state: PlaceState
    """The recogniser with the references that stay."""
    references: Ints
    """The numbers that these had before, increasing; empty where it has none."""
    whole: PlaceState
    """The recogniser of the map before."""
    whole_answers: OwnAnswers
    """Answers of the map before."""


def condense_map(
    root: Path, target: Path, loss: float = LOSS, distance_m: float | None = None, execution: Execution = Execution()
) -> dict[str, Any]:
    """Write the map `target`: the drives of a map with the places and references that still decide something, as long
    as the recall at rank one of the map's own queries falls by no more than `loss`, half of it by references. Returns
    the record of it for JSON.

    A place is right within `distance_m` of the query, which None sets by the spacing of places. Raises VplogError, as
    where the target is a map already.
    """
    if str(root.resolve()) == str(target.resolve()):
        raise SettingsError(f"{root} is given as its own target. Choose another map with -o.")
    with map_store.reading(root) as store:

        def attempt() -> tuple[Condensed, list[str]]:
            drives, _, state = open_map(store, execution)
            places = own_queries.read_own_places(store, drives, state)
            search, warnings = own_queries.search_of(store, drives, places, state, execution)
            within = distance_m or _SPACINGS * places.spacing_m
            answers = own_queries.query_own_places(places, search, state, within, execution)
            if not len(answers.place):  # then no loss bounds what is removed
                raise ResultError(
                    f"No place of {root} finds another within {within:.3g} m, so what it can do without is not known. "
                    "Add drives with odometry that pass places again, or give a larger --distance-m."
                )
            return condense_places(places, answers, state, within, loss, execution), warnings

        found, warnings = skip_damaged(store, attempt)
        with map_store.writing(target) as new:
            _write(store, new, found)
            account = _account(found, store, new, warnings)
        warnings += damage_warnings(store)
    return {"map": str(root), "written": str(target), "loss": loss, **account}


def condense_places(
    places: OwnPlaces, answers: OwnAnswers, state: PlaceState, distance_m: float, loss: float,
    execution: Execution = Execution(),
) -> Condensed:  # fmt: skip
    """Choose the references that stay, and then the places: all without another within `distance_m`, unless faded, and
    at least one of each camera of a drive."""
    posed, whole_answers, small, references = places.frame >= 0, answers, state, np.zeros(0, np.int64)
    most_lost = math.floor(loss * int(posed.sum()) + 1e-9)  # .01 of 300 is 3
    if isinstance(state, CodedState):
        places, answers, small, references = remove_references(
            places, answers, state, distance_m, most_lost // 2, execution
        )
    every = np.arange(len(posed))
    removable = own_queries.near_another(places, distance_m) | (posed & answers.faded)
    along_m = np.cumsum(places.steps_m())
    total = int(removable.sum())
    most_lost -= len(whole_answers.place) - len(answers.place)
    _, track = np.unique(np.stack([places.drive, places.frame], 1), axis=0, return_inverse=True)  # drive and camera
    candidates = RemovalCandidates(track.ravel(), along_m, removable, answers.faded)
    removal, lost = remove_cross_validated(
        answers.queries, answers.place % 2 == 0, candidates, most_lost,
        lambda done: execution.progress("remove", done, total),
    )  # fmt: skip
    retained = ~np.isin(every, removal.places)
    return Condensed(places, answers, distance_m, retained, lost, small, references, state, whole_answers)


def _write(store: Store, new: Store, found: Condensed) -> None:
    """The new map, whose drives count as failed until all are there. Raises ResultError or SettingsError."""
    present, missing = {*new.drives(), *new.damaged}, {drive: one.get("error") for drive, one in new.failures().items()}
    if present and _UNFINISHED not in missing.values():
        raise SettingsError(f"{new} holds a map already. Choose another folder with -o.")
    if present:
        map_store.remove(new, sorted(present))
    if isinstance(found.state, ReferencesState) and not isinstance(found.state, FrameState):
        made = new.staging / "library"
        shutil.rmtree(made, ignore_errors=True)
        found.state.save_small(made)
        name_extractor(made, read_library_record(store.library(found.whole.hash)).get("extractor"))
        put_library(new, made, found.state.hash, store.head().settings)
    else:
        copy_library(new, store, found.state.hash)
    records = store.drives()
    failures = {drive: {"log": records[drive]["log"], "error": _UNFINISHED} for drive in found.places.drives}
    new.update_failures(dict(failures))
    for number, drive in enumerate(found.places.drives):
        _write_drive(store, new, records[drive], found, number)
        store.evict(drive)
    if store.mirror is not None:
        store.mirror.rest()
    for name in ("joins", "joint"):  # they name the drives by keys that they still have
        if (store.root / name).is_dir():
            shutil.rmtree(new.root / name, ignore_errors=True)
            copy_folder(store.root / name, new.root / name, f"{name} of {store} to {new}", copy_function=layout.link)
    if (store.root / "joint.json").is_file():
        layout.link(store.root / "joint.json", new.root / "joint.json")
    new.update_failures(dict.fromkeys(failures))


def _write_drive(store: Store, new: Store, record: Mapping[str, Any], found: Condensed, number: int) -> None:
    drive, made, first = record["drive"], new.staging / f"{os.getpid()}-condense", found.places.first
    retained, library = np.flatnonzero(found.retained[first[number] : first[number + 1]]), found.state.hash
    other, column = library != record["library"], found.places.columns[number]
    copy_run(store, drive, new, made)
    if other or len(retained) < len(column):
        table = made / "descriptors.parquet"
        tables.write_some_descriptors(table, table, retained, column, library)
    if other:
        numbers = np.full(int(found.references.max()) + 1, -1)
        numbers[found.references] = np.arange(len(found.references))
        with suppress(ResultError):  # a damaged one is copied as it is
            tables.renumber_references(made / "closures.parquet", numbers, library)
        about = {"hash": library, "from": library_of(new.library(library))}
        account = run_record.read_run_json(made / "run.json")
        run_record.write_run_json(made / "run.json", {**account, "library": about})
    named = {"library": library, layout.DESCRIBED_WITH: layout.described_with(dict(record))} if other else {}
    run_record.write_run_json(made / "drive.json", {**record, **named})
    map_store.publish(new, drive, made)


def _account(found: Condensed, store: Store, new: Store, warnings: list[str]) -> dict[str, Any]:
    """The places and references removed and what that costs, as plain values."""
    places, whole_answers, retained, faded = found.places, found.whole_answers, found.retained, found.answers.faded
    posed, answered = int((places.frame >= 0).sum()), len(whole_answers.place)
    best = np.array([one.rows[0] for one in whole_answers.queries.best], np.int64)
    others = int((places.drive[best] != places.drive[whole_answers.place]).sum())
    ends = ((store, found.whole), (new, found.state))
    drives: list[dict[str, Any]] = []
    for number, drive in enumerate(places.drives):
        own = places.drive == number
        before, after = (one.sizes(drive)["descriptors.parquet"] for one in (store, new))
        drives.append({
            "drive": drive,
            "places": {"before": int(own.sum()), "after": int((own & retained).sum())},
            "descriptor_bytes": {"before": before, "after": after},
            "faded": int((own & faded & ~retained).sum()),
        })  # fmt: skip
    recall = [round(right / max(posed, 1), 6) for right in (answered, len(found.answers.place) - found.lost)]
    frames = places.frame.tolist()
    if len(places.drives) > 1 and len(set(frames)) == len(set(zip(places.drive.tolist(), frames, strict=True))):
        warnings.append(
            "No drives are joined in one frame, so none stands in for another: places are compared within each. Join "
            f"the drives first: vplog map join {store}"
        )
    return {
        "distance_m": round(found.distance_m, 3),
        "queries": {
            "places": posed, "by_other_drives": others, "by_own_drive": answered - others, "alone": posed - answered,
        },
        "recall": {"before": recall[0], "after": recall[1], "loss": round(recall[0] - recall[1], 6)},
        "faded": {"found": int(faded.sum()), "removed": int((faded & ~retained).sum())},
        **{
            name: {end: sum(one[name][end] for one in drives) for end in ("before", "after")}
            for name in ("places", "descriptor_bytes")
        },
        "library_bytes": _ends([bytes_of(one.library(state.hash)) for one, state in ends]),
        "references": _ends([state.shape[0] for _, state in ends if isinstance(state, CodedState)]),
        "drives": drives,
        "warnings": warnings,
    }  # fmt: skip


def _ends(figures: Sequence[int]) -> dict[str, int] | None:
    return dict(zip(("before", "after"), figures, strict=True)) if figures else None
