"""Closures between two drives of a map: a task that any process can do, and the file that keeps what came of it.

    MAP/joins/drive=NEW/camera.json          the drive's camera, for those that come after it
    MAP/joins/drive=NEW/features.parquet     the features of its keyframes for verification, likewise
    MAP/joins/drive=NEW/features-1.parquet   those of the pictures of a further camera
    MAP/joins/drive=NEW/match=OLD.parquet    the ledger of its keyframes in a drive before it
    MAP/joins/states-...                     after which drives each came (join_states.py)

What two drives have in common lies with the one that came later, so a new drive touches no folder but its own.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import TypeAdapter

from vplog.data import SharedReferences
from vplog.errors import ResultError
from vplog.maps.joining.inter_session import CameraDrive, DrivePair, closures_by_cameras
from vplog.maps.joining.members import CameraTrust, Member, camera_trust, keep_features, opened_drive
from vplog.maps.storage.damage import damaged_table
from vplog.maps.storage.layout import folder_name, quoted
from vplog.results import run_record, tables
from vplog.run.cache.code_hash import code_of
from vplog.storage.json_records import key_of
from vplog.storage.scratch import replacing

if TYPE_CHECKING:
    from vplog.execution.execution import Execution
    from vplog.loops.propose import Proposals
    from vplog.maps.storage.map_store import Store
    from vplog.pipeline import Pipeline

_CODE = ("vplog.maps.joining.inter_session", "vplog.features.extraction", "vplog.features.sift", "vplog.results.tables")
"""Modules that a ledger depends on, with all that they import. Versions of packages do not count: what they change is
less than another search of all drives is worth, and drive.json has them."""
DRIVE_FILES = ("camera.json", "features.parquet")
"""Files that depend on the drive alone, not on its name or the other drives."""
_CAMERA_TRUST = TypeAdapter(CameraTrust)
_SEARCH = "vplog.maps.joining.candidate_drives"
"""The module that chooses the drives that one is searched in."""


@dataclass(frozen=True)
class PairTask:
    """Candidates of one drive in another to verify, as a task for another process or machine."""

    later: Member
    earlier: Member
    later_camera: CameraTrust
    earlier_camera: CameraTrust
    proposals: Proposals
    shared: SharedReferences
    """One row for each proposal."""
    pipeline: Pipeline
    library: str
    execution: Execution

    @property
    def key(self) -> str:
        """sha256 over all that the ledger depends on."""
        proposed = [getattr(self.proposals, name).tolist() for name in ("query", "match", "rank", "score", "support")]
        members = [
            [one.drive, one.key, asdict(camera)]
            for one, camera in ((self.later, self.later_camera), (self.earlier, self.earlier_camera))
        ]
        return key_of({"members": members, "proposed": proposed, **depends(self.pipeline)})


def depends(pipeline: Pipeline) -> dict[str, Any]:
    """The settings and the code that the closures between two drives depend on, beside the drives."""
    settings = {
        name: getattr(pipeline, name).model_dump(mode="json")
        for name in ("propose", "sequence", "verify", "false_rate")
    }
    settings["join"] = pipeline.join.model_dump(mode="json", exclude={"keep_features", "judged_anew", "grown_share"})
    return {"settings": settings, "code": code_of(*_CODE)["code"]}


def compute_pair(task: PairTask) -> bytes:
    """The table of the ledger, the same on any machine and for any execution.

    Raises LogError where features have to be extracted again and a log is gone or another one.
    """
    ends = (task.later, task.later_camera), (task.earlier, task.earlier_camera)
    with ExitStack() as stack:

        def opened(member: Member, known: CameraTrust) -> CameraDrive:
            drive, fetch = stack.enter_context(opened_drive(member, known, task.pipeline.verify, task.execution))
            return CameraDrive(member.pictures.row, drive, fetch)

        later, earlier = (list(map(opened, member.each_camera, trust.each)) for member, trust in ends)

        def share(query: int, match: int) -> float:
            return max(task.later_camera.each[query].rotation_share, task.earlier_camera.each[match].rotation_share)

        pair = DrivePair(0, 0, task.proposals, task.shared)
        ledger = closures_by_cameras(pair, later, earlier, task.pipeline, share, task.execution)
        header = tables.TableMetadata(depends(task.pipeline)["settings"], task.library)
        ends_at = later[0].drive.keyframes, earlier[0].drive.keyframes
        return tables.joins_as_bytes([(*ends_at, ledger)], header, task.key)


def compute_camera(member: Member, pipeline: Pipeline, execution: Execution) -> CameraTrust:
    """The cameras of a drive, as a task; features in the cache of its run are stored for later drives."""
    each = member.each_camera
    for one in each if pipeline.join.keep_features else ():
        keep_features(one, pipeline.verify)
    first, *further = (camera_trust(one, pipeline.verify, execution) for one in each)
    return replace(first, further=tuple(further))


def folder_of(store: Store, drive: str) -> Path:
    """MAP/joins/drive=ID."""
    return store.root / "joins" / folder_name(drive)


def ledger_path(store: Store, later: str, earlier: str) -> Path:
    """The table of a pair's ledger."""
    return folder_of(store, later) / f"match={quoted(earlier)}.parquet"


def put_ledger(store: Store, task: PairTask, data: bytes) -> None:
    """Write the table of `compute_pair` as a whole. Raises ResultError."""
    with replacing(ledger_path(store, task.later.drive, task.earlier.drive), parents=True) as stream:
        stream.write(data)


def is_stored(store: Store, task: PairTask) -> bool:
    """Whether the ledger is stored whole, made from the same."""
    path = ledger_path(store, task.later.drive, task.earlier.drive)
    return not damaged_table(path) and tables.read_metadata(path).get("vplog.made_from") == task.key


def known_camera(store: Store, member: Member, pipeline: Pipeline) -> CameraTrust | None:
    """The stored camera of a drive, unless it was made from something else."""
    record = _read(folder_of(store, member.drive) / "camera.json")
    if record.get("made_from") != _camera_key(member, pipeline):
        return None
    try:
        known = _CAMERA_TRUST.validate_python(record)
    except ValueError:
        return None
    return known if len(known.each) == len(member.cameras) else None


def put_camera(store: Store, member: Member, pipeline: Pipeline, camera: CameraTrust) -> None:
    """Store the camera of a drive. Raises ResultError."""
    record = {"drive": member.drive, **asdict(camera), "made_from": _camera_key(member, pipeline)}
    run_record.write_run_json(folder_of(store, member.drive) / "camera.json", record)


def _camera_key(member: Member, pipeline: Pipeline) -> str:
    verify, code = pipeline.verify.model_dump(mode="json"), code_of("vplog.loops.verify", "vplog.features.extraction")
    return key_of({"member": member.key, "verify": verify, "code": code["code"]})


def search_key(pipeline: Pipeline) -> str:
    """sha256 over what the joins of every drive depend on, beside the drives; the code is read once, which takes half a
    second."""
    return key_of({**depends(pipeline), "search": code_of(*_CODE, _SEARCH)["code"]})


def remove_stale_ledgers(store: Store, drive: str, but: Collection[str], before: Collection[str] = ()) -> None:
    """Remove the ledgers of a drive in other drives than these, as those of `before`, and files that a killed writer
    left."""
    folder = folder_of(store, drive)
    known, stale = ({ledger_path(store, drive, earlier) for earlier in one} for one in (but, before))
    stale |= set(folder.glob("match=*.parquet"))
    for path in [*(stale - known), *folder.glob(".*.part")]:
        store.remove_beside(path.relative_to(store.root).as_posix())


def fetch_inputs(store: Store, pairs: Iterable[tuple[str, str]], drives: Iterable[str]) -> None:
    """Fetch the ledgers of these pairs, later and earlier drive, and the `DRIVE_FILES` of drives, as far as a map on an
    object store has them."""
    paths = [ledger_path(store, *pair) for pair in pairs]
    paths += [folder_of(store, drive) / name for drive in drives for name in DRIVE_FILES]
    store.fetch_beside(path.relative_to(store.root).as_posix() for path in paths)


def _read(path: Path) -> dict[str, Any]:
    """A record; empty where there is none or a damaged one, which is written again."""
    try:
        return run_record.read_run_json(path)
    except ResultError:
        return {}
