"""What a map holds."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pyarrow as pa
import pyarrow.parquet as pq

from vplog.errors import ResultError
from vplog.maps import keys
from vplog.maps import store as map_store
from vplog.places.stored import read_library_record
from vplog.results import run_record

if TYPE_CHECKING:
    from pathlib import Path

    from vplog.maps.store import Store


def describe_map(root: Path) -> dict[str, Any]:
    """Drives, places, bytes, library and failures of a map, without reading a descriptor. Raises ResultError."""
    store = map_store.Store(root)
    head, drives, problems = store.head(), [], []
    now, other = (keys.key_of(head.settings), keys.code_hash()), []
    for drive, about in store.drives().items():
        if about["library"] != head.library:
            problems.append(other_library(store, drive, about["library"], head.library))
        if (about.get("settings"), about.get("code")) != now:
            other.append(about["log"])
        record = run_record.read_run_json(store.run(drive) / "run.json")
        path = store.run(drive) / "descriptors.parquet"
        drives.append({
            "drive": drive,
            "log": about["log"],
            "keyframes": row_count(path),
            "candidates": row_count(store.run(drive) / "closures.parquet"),
            "accepted": record.get("counts", {}).get("verdicts", {}).get("accepted", 0),
            "descriptor_bytes": path.stat().st_size,
            "descriptor_bits": record.get("descriptor_bits"),
            "bytes": sum(file.stat().st_size for file in store.run(drive).rglob("*") if file.is_file()),
            "seconds": record.get("totals", {}).get("seconds"),
            "peak_memory_mb": record.get("totals", {}).get("peak_memory_mb"),
        })  # fmt: skip
    if other:
        problems.append(
            f"{len(other)} of {len(drives)} drives were made with other settings than the last batch had, or by "
            f"another version of vplog. `vplog batch` with their logs makes them anew; the first is {other[0]}."
        )
    known = {map_store.folder_name(one["drive"]) for one in drives}
    for name in map_store.TABLES:
        left = sorted(path.name for path in root.glob(f"{name}/drive=*") if path.name not in known)
        problems += [f"{root}/{name}/{folder} is of no drive in the map: remove it." for folder in left]
    places = sum(one["keyframes"] for one in drives)
    stored = sum(one["descriptor_bytes"] for one in drives)
    about_library = read_library_record(store.library(head.library)) if head.library else {}
    return {
        "map": str(root),
        "library": {
            "hash": head.library,
            **{name: about_library.get(name) for name in ("references", "features")},
        },
        "places": places,
        "descriptor_bytes": stored,
        "bytes_per_place": round(stored / places, 1) if places else None,
        "bytes": sum(one["bytes"] for one in drives),
        "drives": drives,
        "failures": store.failures(),
        "problems": problems,
    }


def other_library(store: Store, drive: str, found: str, wanted: str | None) -> str:
    """Why a drive's places may not be mixed with those of the map, in one line."""
    return (
        f"{store.run(drive)} was described with library {found[:12]}, and the map's is {str(wanted)[:12]}: their "
        f"places do not compare. Remove the drive's folders (rm -r {store.root}/*/{map_store.folder_name(drive)}), or "
        "add its log with `vplog batch`."
    )


def row_count(path: Path) -> int:
    """Rows of a table, by its footer. Raises ResultError."""
    try:
        return pq.read_metadata(path).num_rows
    except (OSError, pa.ArrowException) as error:
        raise ResultError(f"{path} cannot be read: {str(error).splitlines()[0]} Remove the drive's folders.") from None
