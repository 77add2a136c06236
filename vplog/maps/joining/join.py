"""Closures between the drives of a map, and one graph of those that they join; results that are up to date stay.

A drive is searched in all that came before it: first by its places, then, in the drives that hold most like them,
by geometry. Drives come in order of their IDs within a batch, and after all that were there.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, cast

from vplog.data import ACCEPTED
from vplog.errors import VplogError
from vplog.execution.cores import limited
from vplog.execution.execution import Execution
from vplog.execution.tasks import run_tasks
from vplog.execution.timing import StageTimer
from vplog.maps.joining import drive_pairs
from vplog.maps.joining.candidate_drives import candidates_of, places_of
from vplog.maps.joining.components import Drives, PairLedger, solve_groups
from vplog.maps.joining.drive_pairs import PairTask
from vplog.maps.joining.inter_session import DrivePair, likely_pairs
from vplog.maps.joining.join_states import JoinState, read_states, write_states
from vplog.maps.joining.members import CameraTrust, Member, member_of
from vplog.maps.storage.contents import damage_warnings, skip_damaged
from vplog.maps.storage.damage import damaged_table
from vplog.maps.storage.layout import PICTURES, PLACES_ONLY, folder_name
from vplog.maps.storage.map_store import Store, writing
from vplog.maps.storage.snapshot import LostRaceError
from vplog.pipeline import Pipeline
from vplog.results import tables
from vplog.stages import PlaceState

_FLUSH_EVERY_S = 300.0
"""Interval at which ledgers are sent to a map on an object store."""
_TRIES = 5
"""Joins of a map on an object store that other writers join too."""


@dataclass(frozen=True)
class _Work:
    """Inputs that all steps of a join take."""

    store: Store
    drives: Drives
    new: list[int]
    """Numbers of the drives that are new or changed."""
    pipeline: Pipeline
    execution: Execution
    executor: Executor | None
    whole: bool
    """Whether components that have grown are solved again as a whole."""

    @property
    def quiet(self) -> Execution:
        """The threads, without progress."""
        return Execution(self.execution.threads)


def load_places(library: Path, pipeline: Pipeline, execution: Execution = Execution()) -> PlaceState:
    """The map's library, by which `join` compares places: it can be loaded while drives are still computed.

    The code hashes that joins depend on are read along, once. Raises LibraryError.
    """
    drive_pairs.search_key(pipeline)
    return cast("PlaceState", pipeline.places.load(library, Execution(execution.threads)))


def join(
    store: Store, pipeline: Pipeline, execution: Execution = Execution(), executor: Executor | None = None,
    places: Callable[[], PlaceState] | None = None, urls: Mapping[str, str] = MappingProxyType({}),
    *, whole: bool = False,
) -> dict[str, Any]:  # fmt: skip
    """Verify the pairs of drives that are new or changed, solve the groups that have them, and return the record.
    `urls` open the logs of drives given now: a map stores URLs without their queries.

    The caller writes to the map. Where another writer joins drives of a map on an object store at the same time, what
    it has done is taken over and the rest joined again. With an executor its processes verify, pair by pair; they must
    see the map and the logs under the same paths. It does not count for the result. `places` gives the state of
    `load_places`, where that was begun before. A pair that cannot be verified, as where a log is gone, is left out with
    a reason, and tried again the next time. Raises VplogError where the map as a whole cannot be read or written.
    """
    if store.mirror is not None:  # what joins drives goes to and from an object store as a whole
        lean = pipeline.join.model_copy(update={"keep_features": False})
        pipeline = pipeline.model_copy(update={"join": lean})

    def joined() -> dict[str, Any]:
        store.fetch_beside(["joint.json"])  # for `send_rest` to see whether others have changed it
        drives = read_drives(store, urls)
        new = _out_of_date(store, drives, pipeline)
        return _join(_Work(store, drives, new, pipeline, execution, executor, whole), places)

    def attempt() -> dict[str, Any]:
        if store.mirror is not None:
            store.mirror.refresh()  # with the drives of other writers
        record = skip_damaged(store, joined)
        store.flush()
        return record

    for _ in range(_TRIES - 1):
        with suppress(LostRaceError):
            return attempt()
    return attempt()


def join_map(root: Path, execution: Execution = Execution(), *, whole: bool = False) -> dict[str, Any]:
    """`join` of a map as it is, with the settings of its last batch; `whole`: joint graphs to which drives were added
    are solved again as a whole. Raises VplogError."""
    with writing(root, there=True) as store:
        pipeline = Pipeline.read(store.head().settings, f"{root}/map.json")
        return {"map": str(root), **join(store, pipeline, execution, whole=whole)}


def _join(work: _Work, places: Callable[[], PlaceState] | None) -> dict[str, Any]:
    store, drives, pipeline, watch = work.store, work.drives, work.pipeline, StageTimer()
    with watch.stage("search"):
        wanted = _search(work, places)
    with watch.stage("verify"):
        computed, reasons = _verify(work, wanted)
        _record_pairs(work, wanted, reasons)
    with watch.stage("solve"), limited(work.execution.threads):
        pair_ledgers = _current_ledgers(work)
        record = solve_groups(store, drives, pair_ledgers, pipeline, work.execution, whole=work.whole)
    unjoined = [f"{later} and {earlier} were not verified. {reason}" for (later, earlier), reason in reasons.items()]
    for group in record["groups"]:
        if "reason" in group:
            of_all = "" if group["components"] else f"{', '.join(group['drives'])} cannot be solved. "
            unjoined.append(of_all + group["reason"])
        unjoined += [
            f"Closures of {one['query_drive']} to {one['match_drive']} were not enough to join them. {one['reason']}"
            for one in group["apart"]
        ]
    unjoined += pipeline.rating.false_rate.warnings_between()
    searched = [drives.names[at] for at in work.new]
    cameras = [(drives.names[at], drive_pairs.known_camera(store, drives.member(at), pipeline)) for at in work.new]
    if uncalibrated := [drive for drive, known in cameras if known is not None and known.camera["matrix"] is None]:
        unjoined.append(f"No camera calibration, so no metric closure joins these drives: {', '.join(uncalibrated)}.")
    return {
        "searched": searched,
        "pairs": len(pair_ledgers),
        "pairs_computed": computed,
        "components": [component for group in record["groups"] for component in group["components"]],
        "alone": record["alone"],
        "warnings": [*damage_warnings(store), *drives.excluded.values(), *unjoined],
        "stages": watch.stages,
    }


def read_drives(store: Store, urls: Mapping[str, str]) -> Drives:
    """Give new drives their place in the order, which stays: a killed join goes on as it began."""
    library = store.head().library or ""
    reasons, known = dict[str, str](), store.drives()
    stored, states = read_states(store), dict[str, JoinState]()

    def read(drive: str) -> Member:
        return member_of(store, known[drive], urls.get(drive))

    for drive, about in known.items():
        state = stored.get(drive)
        if about.get(PICTURES):
            reasons[drive] = f"{drive} has no odometry: it can be found, and is joined with no other drive."
            continue
        if PLACES_ONLY in about:
            reasons[drive] = f"{drive} has places alone: it can be found, and is joined with no other drive."
            continue
        if state is None or state.key != about["key"]:
            try:
                member = read(drive)
            except VplogError as error:
                reasons[drive] = f"{drive} is joined with no other drive. {error}"
                continue
            fields = {"member": member.key, "key": about["key"], "gps": member.pipeline.gps.use}
            state = JoinState(drive, -1, **fields) if state is None or state.member != member.key else state
            state = replace(state, **fields)
        states[drive] = state
        if why := state.why_apart(library, about["library"]):
            reasons[drive] = why
    last = max((one.position for one in states.values()), default=-1)
    for number, drive in enumerate([drive for drive, one in states.items() if one.position < 0], start=last + 1):
        states[drive] = replace(states[drive], position=number)
    changed = {drive for drive, one in states.items() if one is not stored.get(drive)}
    gone = [one for drive, one in stored.items() if drive not in states]
    if changed or gone:
        write_states(store, states.values(), changed, gone)
    order = sorted(states.keys() - reasons.keys(), key=lambda drive: (states[drive].position, drive))
    others = [one for drive, one in states.items() if drive in reasons]
    return Drives([states[one] for one in order], known, reasons, library, cache(lambda at: read(order[at])), others)


def _out_of_date(store: Store, drives: Drives, pipeline: Pipeline) -> list[int]:
    """Numbers of the drives whose candidates are to be searched again: new and changed ones, and those with a pair
    whose other drive was removed, as that took candidates from others. Of more drives than `join.judged_anew` no ledger
    is read for that: a damaged one is made again when a solve needs it."""
    made_from = drive_pairs.search_key(pipeline)
    new = [
        at
        for at, joins in enumerate(drives.joins)
        if joins.made_from != made_from or not all(drives.counts(at, pair) and pair["ledger"] for pair in joins.pairs)
    ]
    left = sorted(set(range(len(drives.joins))) - set(new))
    if len(drives.joins) > pipeline.join.judged_anew:
        names = store.names_beside("joins")
        new += [at for at in left if drives.joins[at].pairs and folder_name(drives.names[at]) not in names]
        return sorted(new)
    pairs = {at: [(drives.names[at], pair["match"]) for pair in drives.joins[at].pairs] for at in left}
    drive_pairs.fetch_inputs(store, [pair for own in pairs.values() for pair in own], ())
    paths = {at: [drive_pairs.ledger_path(store, *pair) for pair in own] for at, own in pairs.items()}
    return sorted([*new, *(at for at, own in paths.items() if any(map(damaged_table, own)))])


def _search(work: _Work, places: Callable[[], PlaceState] | None) -> list[DrivePair]:
    store, drives, pipeline = work.store, work.drives, work.pipeline
    later = [at for at in work.new if at]  # the first has none before it
    if not later:
        return []
    state = places() if places else load_places(store.library(drives.library), pipeline, work.quiet)
    records = {drive: drives.records[drive] for drive in drives.names}
    found = candidates_of(store, records, later, state, pipeline, work.execution)
    return likely_pairs(found, lambda at: places_of(store, drives.names[at], state), state, pipeline.join)


def _verify(work: _Work, wanted: Sequence[DrivePair]) -> tuple[int, dict[tuple[str, str], str]]:
    """Compute and store the ledgers that are missing; their number, and why others failed, by later and earlier
    drive."""
    store, drives, progress = work.store, work.drives, work.execution.progress
    names = [(drives.names[one.later], drives.names[one.earlier]) for one in wanted]
    drive_pairs.fetch_inputs(store, names, [drives.names[at] for at in _paired(work, wanted)])
    cameras, failed = _cameras(work, wanted)
    reasons: dict[tuple[str, str], str] = {}

    def tasks() -> Iterator[PairTask]:
        for at, one in enumerate(wanted):
            later, earlier = drives.member(one.later), drives.member(one.earlier)
            progress("verify between drives", at, len(wanted))
            if why := failed.get(one.later, "") or failed.get(one.earlier, ""):
                reasons[later.drive, earlier.drive] = why
                continue
            task = drive_pairs.PairTask(
                later, earlier, cameras[one.later], cameras[one.earlier], one.proposals, one.shared, work.pipeline,
                work.drives.library, work.quiet,
            )  # fmt: skip
            if not drive_pairs.is_stored(store, task):
                yield task

    computed, flushed_at = 0, time.monotonic()
    for task, data, why in run_tasks(drive_pairs.compute_pair, tasks(), work.executor):
        if data is None:
            reasons[task.later.drive, task.earlier.drive] = why
        else:
            drive_pairs.put_ledger(store, task, data)
            computed += 1
        if time.monotonic() - flushed_at > _FLUSH_EVERY_S:
            store.flush()
            flushed_at = time.monotonic()
    progress("verify between drives", len(wanted), len(wanted))
    return computed, reasons


def _cameras(work: _Work, wanted: Sequence[DrivePair]) -> tuple[dict[int, CameraTrust], dict[int, str]]:
    """Cameras of the drives that are verified, by number, and why others have none.

    New drives are included, paired or not, while their features are in the caches of their runs.
    """
    store, member, pipeline = work.store, work.drives.member, work.pipeline
    numbers = sorted(_paired(work, wanted) | {at for at in work.new if member(at).cache.is_dir()})
    known = {at: drive_pairs.known_camera(store, member(at), pipeline) for at in numbers}
    cameras = {at: camera for at, camera in known.items() if camera is not None}
    missing, failed = [at for at in numbers if at not in cameras], dict[int, str]()
    compute = partial(drive_pairs.compute_camera, pipeline=pipeline, execution=work.quiet)
    done = run_tasks(compute, [member(at) for at in missing], work.executor)
    for at, (one, camera, why) in zip(missing, done, strict=True):
        if camera is None:
            failed[at] = why
        else:
            cameras[at] = camera
            drive_pairs.put_camera(store, one, pipeline, camera)
    return cameras, failed


def _paired(work: _Work, wanted: Sequence[DrivePair]) -> set[int]:
    return {at for one in wanted for at in (one.later, one.earlier)}.union(work.new)


def _record_pairs(work: _Work, wanted: Sequence[DrivePair], reasons: dict[tuple[str, str], str]) -> None:
    store, drives, made_from = work.store, work.drives, drive_pairs.search_key(work.pipeline)
    earlier: dict[int, list[int]] = {at: [] for at in work.new}
    for one in wanted:
        earlier[one.later].append(one.earlier)
    for at in work.new:
        own, pairs = drives.joins[at], []
        for other in (drives.joins[number] for number in earlier[at]):
            why = reasons.get((own.drive, other.drive), "")
            path = drive_pairs.ledger_path(store, own.drive, other.drive)
            ledger = None if why else tables.read_joins(path).get((own.drive, other.drive))
            verdicts = () if ledger is None else ledger.verdict
            pairs.append({
                "match": other.drive,
                "match_key": other.member,
                "candidates": len(verdicts),
                "verified": sum(verdict in ACCEPTED for verdict in verdicts),
                "ledger": "" if why else tables.read_metadata(path).get("vplog.made_from", ""),
            })  # fmt: skip
        drives.joins[at] = replace(own, made_from=made_from, pairs=tuple(pairs))
        held, before = ({pair["match"] for pair in one.pairs if pair["ledger"]} for one in (drives.joins[at], own))
        drive_pairs.remove_stale_ledgers(store, own.drive, held, before)
    drives.write(store, {drives.names[at] for at in work.new})


def _current_ledgers(work: _Work) -> list[PairLedger]:
    """The pairs that count; what joins drives that are gone is removed."""
    store, drives, pair_ledgers = work.store, work.drives, []
    for at, (drive, joins) in enumerate(zip(drives.names, drives.joins, strict=True)):
        for pair in joins.pairs:
            if pair["ledger"] and pair["candidates"] and drives.counts(at, pair):
                path = drive_pairs.ledger_path(store, drive, pair["match"])
                pair_ledgers.append(PairLedger(drive, pair["match"], path, pair["ledger"], pair["verified"]))
    known = {folder_name(drive) for drive in [*drives.records, *store.damaged]}
    for name in store.names_beside("joins") - known:
        if name.startswith("drive="):
            store.remove_beside(f"joins/{name}")
    return pair_ledgers
