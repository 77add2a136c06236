"""Closures between the drives of a map, and one graph of those that they join; results that are up to date stay.

A drive is searched in all that came before it: first by its places, then, in the drives that hold most like them,
by geometry. Drives come in order of their IDs within a batch, and after all that were there.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, cast

from vplog.data import ACCEPTED
from vplog.errors import VplogError
from vplog.execution.cores import limited
from vplog.execution.execution import Execution
from vplog.execution.tasks import run_tasks
from vplog.execution.timing import StageTimer
from vplog.maps.joining import drive_pairs
from vplog.maps.joining.candidate_drives import candidates_of, places_of
from vplog.maps.joining.components import Drives, PairLedger, solve_groups
from vplog.maps.joining.inter_session import DrivePair, likely_pairs
from vplog.maps.joining.members import CameraTrust, Member, member_of, why_not_joined
from vplog.maps.storage.contents import damage_warnings, skip_damaged
from vplog.maps.storage.damage import damaged_table
from vplog.maps.storage.layout import PICTURES, folder_name
from vplog.maps.storage.map_store import Store, reading, writing
from vplog.maps.storage.snapshot import LostRaceError
from vplog.pipeline import Pipeline
from vplog.results import tables

if TYPE_CHECKING:
    from vplog.maps.joining.drive_pairs import PairTask
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
    """The map's library as `join` compares places by it: what can be done while the drives are still computed.

    The code hashes that joins depend on are read along, once. Raises LibraryError.
    """
    drive_pairs.depends(pipeline)
    drive_pairs.search_code()
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
        if store.mirror is not None:
            store.mirror.rest()
        drives = read_drives(store, urls)
        new = [at for at in range(len(drives.members)) if not _is_up_to_date(store, drives, at, pipeline)]
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
    with reading(root) as store:  # not a map: nothing is made
        head = store.head()
    pipeline = Pipeline.read(head.settings, f"{root}/map.json")
    with writing(root) as store:
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
    searched = [drives.members[at] for at in work.new]
    cameras = [(member.drive, drive_pairs.known_camera(store, member, pipeline)) for member in searched]
    if uncalibrated := [drive for drive, known in cameras if known is not None and known.camera["matrix"] is None]:
        unjoined.append(f"No camera calibration, so no metric closure joins these drives: {', '.join(uncalibrated)}.")
    return {
        "searched": [member.drive for member in searched],
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
    members: dict[str, Member] = {}
    reasons, known = dict[str, str](), store.drives()
    for drive, about in known.items():
        if about.get(PICTURES):
            reasons[drive] = f"{drive} has no odometry: it can be found, and is joined with no other drive."
            continue
        try:
            member = member_of(store, {**about, "log": urls.get(drive, about["log"])})
        except VplogError as error:
            reasons[drive] = f"{drive} is joined with no other drive. {error}"
            continue
        if why := why_not_joined(member, library, about["library"]):
            reasons[drive] = why
        else:
            members[drive] = member
    stored = {drive: drive_pairs.read_joins(store, drive) for drive in members}
    last = max((one.position for one in stored.values() if one is not None), default=-1)
    placed = {drive: own for drive, own in stored.items() if own is not None and own.member == members[drive].key}
    for number, drive in enumerate([drive for drive in members if drive not in placed], start=last + 1):
        placed[drive] = drive_pairs.JoinState(number, members[drive].key)
        drive_pairs.put_joins(store, drive, placed[drive])
    order = sorted(placed, key=lambda drive: (placed[drive].position, drive))
    keys = {drive: about["key"] for drive, about in known.items()}
    number = {drive: at for at, drive in enumerate(order)}
    return Drives([members[one] for one in order], [placed[one] for one in order], keys, reasons, library, number)


def _is_up_to_date(store: Store, drives: Drives, at: int, pipeline: Pipeline) -> bool:
    """Whether a drive need not be searched again: a drive that is gone has taken candidates that others might have. Of
    many drives no ledger is read for that: of joint graphs that grow, one that is damaged is made again once it is."""
    member, joins = drives.members[at], drives.joins[at]
    few = len(drives.members) <= pipeline.join.judged_anew
    return joins.made_from == drive_pairs.search_key(member, pipeline) and all(
        drives.counts(at, pair)
        and pair["ledger"]
        and _is_there(drive_pairs.ledger_path(store, member.drive, pair["match"]), whole=few)
        for pair in joins.pairs
    )


def _is_there(ledger: Path, *, whole: bool) -> bool:
    return not damaged_table(ledger) if whole else ledger.is_file()


def _search(work: _Work, places: Callable[[], PlaceState] | None) -> list[DrivePair]:
    store, members, pipeline = work.store, work.drives.members, work.pipeline
    later = [at for at in work.new if at]  # the first has none before it
    if not later:
        return []
    state = places() if places else load_places(store.library(work.drives.library), pipeline, work.quiet)
    found = candidates_of(store, members, later, state, pipeline, work.execution)
    return likely_pairs(found, lambda at: places_of(store, members[at], state), state, pipeline.join)


def _verify(work: _Work, wanted: Sequence[DrivePair]) -> tuple[int, dict[tuple[str, str], str]]:
    """Store the ledgers that are not there yet; how many those were, and why others could not be made, by drives."""
    store, members, progress = work.store, work.drives.members, work.execution.progress
    cameras, failed = _cameras(work, wanted)
    reasons: dict[tuple[str, str], str] = {}

    def tasks() -> Iterator[PairTask]:
        for at, one in enumerate(wanted):
            later, earlier = members[one.later], members[one.earlier]
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
    store, members, pipeline = work.store, work.drives.members, work.pipeline
    paired = {at for one in wanted for at in (one.later, one.earlier)}
    numbers = sorted(paired | {at for at in work.new if members[at].cache.is_dir()})
    known = {at: drive_pairs.known_camera(store, members[at], pipeline) for at in numbers}
    cameras = {at: camera for at, camera in known.items() if camera is not None}
    missing, failed = [at for at in numbers if at not in cameras], dict[int, str]()
    compute = partial(drive_pairs.compute_camera, pipeline=pipeline, execution=work.quiet)
    done = run_tasks(compute, [members[at] for at in missing], work.executor)
    for at, (member, camera, why) in zip(missing, done, strict=True):
        if camera is None:
            failed[at] = why
        else:
            cameras[at] = camera
            drive_pairs.put_camera(store, member, pipeline, camera)
    return cameras, failed


def _record_pairs(work: _Work, wanted: Sequence[DrivePair], reasons: dict[tuple[str, str], str]) -> None:
    store, drives = work.store, work.drives
    for at in work.new:
        member, pairs = drives.members[at], []
        for earlier in (drives.members[one.earlier] for one in wanted if one.later == at):
            why = reasons.get((member.drive, earlier.drive), "")
            path = drive_pairs.ledger_path(store, member.drive, earlier.drive)
            ledger = None if why else tables.read_joins(path).get((member.drive, earlier.drive))
            verdicts = () if ledger is None else ledger.verdict
            pairs.append({
                "match": earlier.drive,
                "match_key": earlier.key,
                "candidates": len(verdicts),
                "verified": sum(verdict in ACCEPTED for verdict in verdicts),
                "ledger": "" if why else tables.read_metadata(path).get("vplog.made_from", ""),
                **({"reason": why} if why else {}),
            })  # fmt: skip
        key = drive_pairs.search_key(member, work.pipeline)
        drives.joins[at] = drive_pairs.JoinState(drives.joins[at].position, member.key, key, tuple(pairs))
        drive_pairs.put_joins(store, member.drive, drives.joins[at])


def _current_ledgers(work: _Work) -> list[PairLedger]:
    """The pairs that count; the ledgers of others, as of drives that are gone, are removed."""
    store, drives, new, pair_ledgers = work.store, work.drives, set(work.new), []
    for at, (member, joins) in enumerate(zip(drives.members, drives.joins, strict=True)):
        held = [pair for pair in joins.pairs if pair["ledger"] and drives.counts(at, pair)]
        if at in new:
            drive_pairs.remove_stale_ledgers(store, member.drive, {pair["match"] for pair in held})
        for pair in held:
            path = drive_pairs.ledger_path(store, member.drive, pair["match"])
            if pair["candidates"]:
                pair_ledgers.append(PairLedger(member.drive, pair["match"], path, pair["ledger"], pair["verified"]))
    known = {folder_name(drive) for drive in [*drives.keys, *store.damaged]}
    for folder in store.root.glob("joins/drive=*"):
        if folder.name not in known:
            shutil.rmtree(folder, ignore_errors=True)
    return pair_ledgers
