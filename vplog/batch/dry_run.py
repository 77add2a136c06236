"""The drives that a batch would compute and the time and bytes of that, without reading or writing a drive."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

from vplog import logs
from vplog.batch.log_hashes import BESIDE, hashes_beside
from vplog.batch.map_library import check_plan, known_library
from vplog.batch.plan import DriveInput, Hashes, PlannedDrive, common_record, plan_drives, with_topics
from vplog.batch.worker import made_by
from vplog.errors import LogError, ResultError, VplogError
from vplog.execution.execution import Execution
from vplog.maps.storage import map_store
from vplog.maps.storage.map_store import Store
from vplog.pipeline import Pipeline
from vplog.results import run_record
from vplog.run.provenance import stat_of
from vplog.storage.input_hashes import bytes_of, files_of, hash_inputs
from vplog.storage.urls import shown

_CPU_S_PER_IMAGE = 0.35
"""s of a core for each image where the map has no drive that says it: KITTI 00 at 5 Hz takes 0.33 (850 images)."""


def dry_run(
    inputs: Sequence[DriveInput], root: Path, pipeline: Pipeline, library: Path | None, topics: logs.TopicChoice | None,
    execution: Execution, cost_per_cpu_hour: float | None = None,
) -> dict[str, Any]:  # fmt: skip
    """The drives of a batch, which of them it would compute, and bytes, images, CPU hours and cost of these.

    A log whose place, length and times are those of a drive of the map is not read; files beside it are. CPU hours are
    those of the map's drives for as many images; `cpu_seconds_from` is how many drives say so. Raises VplogError as the
    batch does before it begins.
    """
    given = with_topics(inputs, topics)
    with map_store.reading(root) as store, ThreadPoolExecutor(execution.threads) as pool:
        digest, drives = known_library(store, len(given), library, pipeline), store.drives()
        hashes = list(pool.map(partial(_hashes, store, {one["log"]: drive for drive, one in drives.items()}), given))
        common = common_record(pipeline, digest) | made_by()
        plan = plan_drives(store, given, common, hashes)
        check_plan(plan, drives, pipeline, common)
        each, measured = _cpu_s_per_image(store)
        found = []
        for one in pool.map(_sizes, plan):
            found.append(one)
            execution.progress("look", len(found), len(plan))
    to_compute = [one for one in found if one["state"] == "compute"]
    images, seconds, size = (sum(one[name] for one in to_compute) for name in ("images", "seconds", "bytes"))
    hours = each * images / 3600
    return {
        "map": str(root),
        "drives": found,
        "compute": len(to_compute),
        "bytes": size,
        "images": images,
        "seconds": round(seconds, 1),
        "cpu_seconds_per_image": round(each, 3),
        "cpu_seconds_from": measured,
        "cpu_hours": round(hours, 3),
        "cost": None if cost_per_cpu_hour is None else round(hours * cost_per_cpu_hour, 2),
    }


def _hashes(store: Store, drives: dict[str, str], given: DriveInput) -> Hashes | VplogError:
    """Hashes of the files of a log and of those beside it, where the log is as it was when its drive was computed; the
    error where it is no log."""
    try:
        logs.check(given.log)
        if drive := drives.get(shown(given.url)):
            known = run_record.read_run_json(store.file(drive, "run.json")).get("log_stat")
            if known == stat_of(files_of(given.log)):
                own = {
                    name: text for name, text in store.record(drive)["inputs"].items() if not name.startswith(BESIDE)
                }
                return own | hashes_beside(given.topics, hash_inputs)
    except ResultError:  # it is damaged, and computed again
        pass
    except VplogError as error:
        return error
    except OSError as error:
        return LogError(f"Cannot read {given.log}: {error.strerror or error}.")
    return {}


def _sizes(one: PlannedDrive) -> dict[str, Any]:
    images, seconds, error, size = 0, 0.0, one.error, 0
    if one.state == "compute":
        try:
            images, seconds = logs.open(one.given.log, one.given.topics).summary()
            size = bytes_of(one.given.log, remote=True)
        except (VplogError, OSError) as problem:
            error = str(problem)
    about = {"bytes": size, "images": images, "seconds": round(seconds, 1), "error": error}
    state = "failed" if error else one.state
    return {"drive": one.drive, "log": one.record["log"], "state": state, "tags": one.record.get("tags", {}), **about}


def _cpu_s_per_image(store: Store) -> tuple[float, int]:
    """s of a core for an image, by the drives of a map, and how many drives say so."""
    seconds, images, drives = 0.0, 0, 0
    for drive in store.drives():
        with suppress(ResultError, AttributeError, KeyError, TypeError):
            record = store.figures(drive)
            more, count = record["totals"]["cpu_seconds"], record["counts"]["frames"]
            if all(one["result"] == "computed" for one in record.get("stages", {}).values()):
                seconds, images, drives = seconds + more, images + count, drives + 1
    return (seconds / images, drives) if seconds and images else (_CPU_S_PER_IMAGE, 0)
