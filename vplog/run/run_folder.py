"""The folder of a run: the log that its results are of, and how a new run replaces them."""

from __future__ import annotations

import shlex
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from glob import escape
from pathlib import Path, PurePath
from typing import Any

from vplog.errors import ResultError, SettingsError, was_interrupted
from vplog.logs import TopicChoice
from vplog.results import run_record
from vplog.results.run_record import CACHE, REQUEST
from vplog.results.staging import check_contents, staged
from vplog.run import provenance
from vplog.run.cache.stage_cache import CACHE_FILES, ENDING
from vplog.storage.folders import check_no_picture, check_regular, check_replaceable
from vplog.storage.input_hashes import bytes_of, hash_inputs
from vplog.storage.remote_path import RemotePath, located, original, stands_for

_RUN_FILES = (
    "run.json", "report.html", "result.mcap", "graph.g2o", "trajectory.tum", "keyframes.parquet", "descriptors.parquet",
    "closures.parquet", "edges.parquet", "trajectory.parquet", "library/library.json", "library/features.parquet",
    "library/references.parquet", "map[0-9]*.g2o", "joins.parquet", "joint_keyframes.parquet",
    "joint_trajectory.parquet", "joint_trajectory.tum", "landmarks*.parquet",
    *(f"closure-{'[0-9]' * digits}.png" for digits in range(1, 10)),
)  # fmt: skip
"""Glob patterns of all files that runs and `explain` write into the folder of a run and into those of its drives."""
_RECORDS = ("run.json", "drive.json", "library.json")


def check_output(path: Path) -> None:
    """Raises ResultError where a file to write is a recorded log, a photograph or a video, or belongs to a run, a
    library or a map."""
    check_replaceable(path)
    if not path.is_file():
        return
    check_no_picture(path)
    written = [*_RECORDS, *(PurePath(name).name for name in _RUN_FILES if not name.endswith((".html", ".png")))]
    if any((path.parent / name).exists() for name in _RECORDS) and any(map(path.match, written)):
        raise ResultError(f"{path} is a file of the results in {path.parent}. Name another.")
    for above in path.absolute().parents:
        inside = above != path.absolute().parent or path.suffix == ".json"
        if inside and (above / "map.json").is_file() and (above / "runs").is_dir():
            raise ResultError(f"{path} is a file of the map {above}. Name another.")


@dataclass(frozen=True)
class CacheOptions:
    """Cache of the results of stages, and whether an existing run may be replaced."""

    folder: Path | None = None
    """A folder of this drive alone; None for `.cache` in the run folder."""
    use: bool = True
    """Whether results are found there, and stay."""
    force: bool = False
    """Whether the run of another log is replaced."""


@contextmanager
def staged_run(
    out: Path,
    head: dict[str, Any],
    files: Sequence[Path],
    library: Path | None = None,
    topics: TopicChoice | None = None,
    drives: Collection[str] = (),
    cache: CacheOptions = CacheOptions(),
) -> Iterator[Path]:
    """A folder for the results of a run, which become those of `out` when the block ends well (vplog/results/staging).

    A run with a cache in `out` is resumable: its request is there until then, and stays if stages are cached. `head` is
    its provenance.head, `files` are its logs, `drives` the names of the drives of a joint run.
    Raises SettingsError where `out` holds other things, or without `cache.force` the run of another log.
    """
    folder, request, resumable = out / CACHE, out / REQUEST, cache.use and cache.folder is None
    record = {
        **head,
        "finished": False,
        "topics": (topics or TopicChoice()).model_dump(mode="json"),
        "library": {"from": provenance.library_of(library)},
    }

    def check_folder() -> list[str]:
        check_regular(out, "run.json")
        above = out.absolute().parent
        if out.absolute().name in _drives_in(_read(above / "run.json") or {}) or (out / "drive.json").exists():
            raise SettingsError(f"{out} is a drive of the run or map in {above}. Choose another folder with -o.")
        for file in files:
            local = file.is_dir() and not isinstance(file, RemotePath)
            if local and out.resolve().is_relative_to(file.resolve()):
                raise SettingsError(f"{out} is within the log {file}, which would change by it. Name another with -o.")
        if not cache.force:
            _check_same_logs(out, files)
        return _results_in(out, library, drives, resumable)

    with staged(out, check_folder) as made, stands_for(made, out):
        resumed = request.is_file()
        before = set() if resumed else set(folder.rglob(f"*{ENDING}"))
        try:
            if resumable:
                folder.mkdir(exist_ok=True)
                run_record.write_run_json(request, record)
            yield made
        except BaseException as error:
            cached = set(folder.rglob(f"*{ENDING}")) - before if resumable else ()
            interrupted = was_interrupted(error)
            again = bool(cached or resumed) and (interrupted or isinstance(error, OSError | MemoryError | ResultError))
            if notes := [_cached_results(out, cached)] * bool(cached) + [f"Go on with: {_resume(out)}"] * again:
                error.add_note(" ".join(notes))
            if not again:
                request.unlink(missing_ok=True)  # resumed, it would fail again
                with suppress(OSError):  # not there, or it holds what was kept of this and other runs
                    folder.rmdir()
                if resumable and interrupted:
                    error.add_note("no stage was finished, so nothing is kept. Run the same command again")
            raise


def _cached_results(out: Path, cached: Collection[Path]) -> str:
    """Stages and bytes that an unfinished run leaves."""
    stages = ", ".join(sorted({file.name.split("-")[0] for file in cached}))
    return (
        f"{sum(file.stat().st_size for file in cached) / 1e6:.1f} MB of results of stages ({stages}) are kept in "
        f"{out / CACHE}."
    )


def _resume(out: Path) -> str:
    return f"vplog run --resume -o {shlex.quote(str(out))}"


def _results_in(out: Path, library: Path | None, drives: Collection[str], resumable: bool) -> list[str]:
    """Glob patterns of what an earlier run may have left in `out` that is not of a new one of these drives.

    A library that the new run is given stays, and the cache of each of its drives if it is `resumable`. Raises
    SettingsError where `out` holds other things than a run.
    """
    record = _run_json(out)
    check_contents(out, "a run", record is not None)
    record = record or {}
    given = library is not None and library.resolve() == (out / "library").resolve()
    earlier = [escape(name) for name in _drives_in(record)]
    caches = [f"{CACHE}/{escape(one.name)}" for one in (out / CACHE).glob("*/") if one.name not in drives]
    caches += [f"{name}/{CACHE}" for name in earlier] + ([CACHE] if drives or not resumable else [])
    return [
        REQUEST,
        *(file for file in _RUN_FILES if not (given and file.startswith("library/"))),
        *(f"{name}/{file}" for name in earlier for file in _RUN_FILES),
        *(f"{cache}/{file}" for cache in caches for file in CACHE_FILES),
    ]


def _check_same_logs(out: Path, files: Sequence[Path]) -> None:
    """Raises SettingsError where `out` holds the run of a log that is not among these."""
    given, record, unfinished = " ".join(map(str, files)), _run_json(out), _read(out / REQUEST) or {}
    if record == {}:
        raise SettingsError(
            f"{out}/run.json is damaged, so the log of that run is not known. Choose another folder with -o, or "
            "replace the run with --force."
        )
    if record and record.get("finished") is False:  # as older versions left it
        record, unfinished = None, unfinished or record
    if unfinished and not _has_paths(unfinished, files, several="logs" in unfinished):
        raise SettingsError(
            f"{out} keeps an unfinished run of {_named(unfinished)}, not of {given}. Go on with that: {_resume(out)}. "
            "Or choose another folder with -o, or drop it with --force."
        )
    drives = [_read(out / name / "run.json") or record for name in _drives_in(record or {})]
    for one in drives or [record]:
        if one and not _is_of(one, files, several=bool(drives)):
            raise SettingsError(
                f"{original(out)} is the run of {_named(one)}, and {given} is another log, or has changed since. "
                "Choose another folder with -o, or replace that run with --force."
            )


def _is_of(record: dict[str, Any], files: Sequence[Path], several: bool) -> bool:
    """Whether the log of a finished run is this one, or among those of `several` drives, by its content. That is read
    only where paths, lengths and times leave it open."""
    known, about, content = _logs_in(record), record.get("log_stat"), record.get("inputs")
    about, content = (one if isinstance(one, dict) else {} for one in (about, content))
    same_paths = _has_paths(record, files, several)
    if same_paths and provenance.stat_of(known) == about:
        return True
    for tried in [known] if same_paths else [files, *([file] for file in files if several)]:
        if not content or bytes_of(tried) != about.get("bytes", bytes_of(tried)):
            continue
        if sorted(hash_inputs(tried).values()) == sorted(map(str, content.values())):
            return True
    return False


def _has_paths(record: dict[str, Any], files: Sequence[Path], several: bool) -> bool:
    known, given = {log.resolve() for log in _logs_in(record)}, {file.resolve() for file in files}
    return known <= given if several else known == given


def _run_json(out: Path) -> dict[str, Any] | None:
    """run.json of a folder, empty where it is damaged; None where it has none of vplog."""
    record = _read(out / "run.json")
    return record if not record or "vplog" in record else None


def _read(path: Path) -> dict[str, Any] | None:
    """A run.json, empty where it is damaged; None where there is none."""
    try:
        return run_record.read_run_json(path) if path.is_file() else None
    except ResultError:
        return {}


def _logs_in(record: dict[str, Any]) -> list[Path]:
    """The logs that a run.json names."""
    named = record.get("logs") or record.get("parts") or [record.get("log")]
    return [located(str(path)) for path in named if path] if isinstance(named, list) else []


def _named(record: dict[str, Any]) -> str:
    return " ".join(map(str, _logs_in(record)))


def _drives_in(record: dict[str, Any]) -> list[str]:
    """Folders of the drives of a run of several, by its run.json."""
    drives = record.get("drives")
    names = [drive.get("folder") for drive in drives if isinstance(drive, dict)] if isinstance(drives, list) else []
    return [name for name in names if isinstance(name, str) and PurePath(name).name == name != ".."]
