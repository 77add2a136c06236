"""Closures between the drives of a map, and one graph of those that they join; results that are up to date stay.

A drive is searched in all that came before it: first by its places, then, in the drives that hold most like them,
by geometry. Drives come in order of their IDs within a batch, and after all that were there.
"""

from __future__ import annotations

import time
from functools import partial
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, cast

from vplog.execution.cores import limited
from vplog.execution.execution import Execution
from vplog.execution.tasks import each_done
from vplog.execution.timing import Watch
from vplog.maps.joining import drive_pairs
from vplog.maps.joining.candidate_drives import candidates_of, places_of
from vplog.maps.joining.join_order import is_up_to_date, read_drives, settled_ties
from vplog.maps.joining.solve_components import solve_groups
from vplog.maps.storage.contents import left_out, without_damaged
from vplog.maps.storage.map_store import reading, writing
from vplog.pipeline import Pipeline
from vplog.sessions.inter_session import likely_pairs

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence
    from concurrent.futures import Executor
    from pathlib import Path

    from vplog.maps.joining.drive_features import CameraTrust
    from vplog.maps.joining.drive_pairs import PairTask
    from vplog.maps.joining.join_order import Drives
    from vplog.maps.storage.map_store import Store
    from vplog.sessions.inter_session import DrivePair
    from vplog.stages import PlaceState

    Progress = Callable[[str, int, int], None]

_KEEP_EVERY_S = 300.0
"""Interval at which ledgers are sent to a map on an object store, each time with a copy of those there."""


def load_places(library: Path, pipeline: Pipeline, threads: int = 1) -> PlaceState:
    """The map's library as `join` compares places by it: what can be done while the drives are still computed.

    What else is read once, as the code that joins depend on, is read along. Raises LibraryError.
    """
    drive_pairs.depends(pipeline)
    drive_pairs.search_code()
    return cast("PlaceState", pipeline.places.load(library, Execution(threads)))


def join(
    store: Store,
    pipeline: Pipeline,
    executor: Executor | None = None,
    threads: int = 1,
    progress: Progress = lambda *_: None,
    places: Callable[[], PlaceState] | None = None,
    urls: Mapping[str, str] = MappingProxyType({}),
) -> dict[str, Any]:
    """Verify the pairs of drives that are new or changed, solve the groups that have them, and return the record.
    `urls` open the logs of drives given now: a map stores URLs without their queries.

    The caller holds the map's lock. With an executor its processes verify, pair by pair, each with `threads`; they
    must see the map and the logs under the same paths. Neither counts for the result. `places` gives what `load_places`
    made of the map's library, where that was begun before. A pair that cannot be verified, as where a log is gone, is
    left out with a reason, and tried again the next time. Raises VplogError where the map as a whole cannot be read or
    written.
    """
    return without_damaged(store, lambda: _join(store, pipeline, executor, threads, progress, places, urls))


def _join(
    store: Store, pipeline: Pipeline, executor: Executor | None, threads: int, progress: Progress,
    places: Callable[[], PlaceState] | None, urls: Mapping[str, str],
) -> dict[str, Any]:  # fmt: skip
    watch = Watch()
    if store.mirror is not None:  # what joins drives goes to and from an object store as a whole
        lean = pipeline.join.model_copy(update={"keep_features": False})
        pipeline = pipeline.model_copy(update={"join": lean})
    drives = read_drives(store, urls)
    new = [at for at in range(len(drives.members)) if not is_up_to_date(store, drives, at, pipeline)]
    with watch.stage("search"):
        load = places or (lambda: load_places(store.library(drives.library), pipeline, threads))
        wanted = _search(store, drives, new, pipeline, threads, progress, load)
    with watch.stage("verify"):
        computed, reasons = _verify(store, drives, new, wanted, pipeline, executor, threads, progress)
        _remember(store, drives, new, wanted, reasons, pipeline)
    with watch.stage("solve"), limited(threads):
        ties = settled_ties(store, drives)
        record = solve_groups(store, drives, ties, pipeline, progress)
    unjoined = [f"{later} in {earlier} was left out. {reason}" for (later, earlier), reason in reasons.items()]
    for group in record["groups"]:
        unjoined += [f"{', '.join(group['drives'])} cannot be solved. {group['reason']}"] if "reason" in group else []
        unjoined += [
            f"Closures of {one['query_drive']} to {one['match_drive']} were not enough to join them. {one['reason']}"
            for one in group["apart"]
        ]
    uncalibrated = [
        member.drive
        for member in drives.members
        if (known := drive_pairs.known_camera(store, member, pipeline)) is not None and known.camera["matrix"] is None
    ]
    if uncalibrated:
        unjoined.append(f"No calibration, so no closure with metres that could join them: {', '.join(uncalibrated)}.")
    return {
        "searched": [drives.members[at].drive for at in new],
        "pairs": len(ties),
        "pairs_computed": computed,
        "components": [component for group in record["groups"] for component in group["components"]],
        "alone": record["alone"],
        "warnings": [*left_out(store), *drives.apart.values(), *unjoined],
        "stages": watch.stages,
    }


def _search(
    store: Store, drives: Drives, new: Sequence[int], pipeline: Pipeline, threads: int, progress: Progress,
    load: Callable[[], PlaceState],
) -> list[DrivePair]:  # fmt: skip
    """The candidates of new drives that are worth verifying."""
    later = [at for at in new if at]  # the first has none before it
    if not later:
        return []
    state = load()
    found = candidates_of(store, drives.members, later, state, pipeline, threads, progress)
    return likely_pairs(found, lambda at: places_of(store, drives.members[at], state), state, pipeline.join)


def _verify(
    store: Store,
    drives: Drives,
    new: Sequence[int],
    wanted: Sequence[DrivePair],
    pipeline: Pipeline,
    executor: Executor | None,
    threads: int,
    progress: Progress,
) -> tuple[int, dict[tuple[str, str], str]]:
    """Store the ledgers that are not there yet; how many those were, and why others could not be made, by drives."""
    cameras, failed = _cameras(store, drives, new, wanted, pipeline, executor, threads)
    reasons: dict[tuple[str, str], str] = {}

    def tasks() -> Iterator[PairTask]:
        for at, one in enumerate(wanted):
            later, earlier = drives.members[one.later], drives.members[one.earlier]
            progress("verify between drives", at, len(wanted))
            if why := failed.get(one.later, "") or failed.get(one.earlier, ""):
                reasons[later.drive, earlier.drive] = why
                continue
            task = drive_pairs.PairTask(
                later, earlier, cameras[one.later], cameras[one.earlier], one.proposals, one.shared, pipeline,
                drives.library, threads,
            )  # fmt: skip
            if not drive_pairs.is_stored(store, task):
                yield task

    computed, kept_at = 0, time.monotonic()
    for task, data, why in each_done(drive_pairs.compute_pair, tasks(), executor):
        if data is None:
            reasons[task.later.drive, task.earlier.drive] = why
        else:
            drive_pairs.put_ledger(store, task, data)
            computed += 1
        if time.monotonic() - kept_at > _KEEP_EVERY_S:
            store.keep()
            kept_at = time.monotonic()
    progress("verify between drives", len(wanted), len(wanted))
    return computed, reasons


def _cameras(
    store: Store, drives: Drives, new: Sequence[int], wanted: Sequence[DrivePair], pipeline: Pipeline,
    executor: Executor | None, threads: int,
) -> tuple[dict[int, CameraTrust], dict[int, str]]:  # fmt: skip
    """Cameras of the drives that are verified, by number, and why others have none.

    New drives are included, paired or not, while their features are in the caches of their runs.
    """
    paired = {at for one in wanted for at in (one.later, one.earlier)}
    cameras: dict[int, CameraTrust] = {}
    missing: list[int] = []
    for at in sorted(paired | {at for at in new if drives.members[at].cache.is_dir()}):
        known = drive_pairs.known_camera(store, drives.members[at], pipeline)
        if known is None:
            missing.append(at)
        else:
            cameras[at] = known
    failed: dict[int, str] = {}
    work = partial(drive_pairs.compute_camera, pipeline=pipeline, threads=threads)
    for at, (member, camera, why) in zip(
        missing, each_done(work, [drives.members[at] for at in missing], executor), strict=True
    ):
        if camera is None:
            failed[at] = why
        else:
            cameras[at] = camera
            drive_pairs.put_camera(store, member, pipeline, camera)
    return cameras, failed


def _remember(
    store: Store, drives: Drives, new: Sequence[int], wanted: Sequence[DrivePair],
    reasons: dict[tuple[str, str], str], pipeline: Pipeline,
) -> None:  # fmt: skip
    """Write the pairs of each new drive."""
    of_later: dict[int, list[DrivePair]] = {at: [] for at in new}
    for one in wanted:
        of_later[one.later].append(one)
    for at in new:
        member, known = drives.members[at], []
        for one in of_later[at]:
            earlier = drives.members[one.earlier]
            why = reasons.get((member.drive, earlier.drive), "")
            ledger = None if why else drive_pairs.read_ledger(store, member.drive, earlier.drive)
            known.append({
                "match": earlier.drive,
                "match_key": earlier.key,
                "candidates": 0 if ledger is None else len(ledger),
                "verified": drive_pairs.verified(ledger),
                "ledger": "" if why else drive_pairs.made_from(store, member.drive, earlier.drive),
                **({"reason": why} if why else {}),
            })  # fmt: skip
        position = drives.joins[at].position
        drives.joins[at] = drive_pairs.Joins(
            position, member.key, drive_pairs.search_key(member, pipeline), tuple(known)
        )
        drive_pairs.put_joins(store, member.drive, drives.joins[at])


def join_map(root: Path, threads: int = 1, progress: Progress = lambda *_: None) -> dict[str, Any]:
    """`join` of a map as it is, with the settings of its last batch. Raises VplogError."""
    with reading(root) as store:  # not a map: nothing is made
        head = store.head()
    pipeline = Pipeline.read(head.settings, f"{root}/map.json")
    with writing(root) as store:
        return {"map": str(root), **join(store, pipeline, None, threads, progress)}
