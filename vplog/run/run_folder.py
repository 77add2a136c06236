"""The folder of a run: whose run it is, and how a new one takes its place."""

from __future__ import annotations

import shlex
from contextlib import contextmanager, suppress
from glob import escape
from pathlib import PurePath
from typing import TYPE_CHECKING, Any

from vplog.cache.input_hashes import bytes_of, hash_inputs
from vplog.cache.stage_cache import CACHE_FILES, ENDING
from vplog.errors import ResultError, SettingsError, was_interrupted
from vplog.logs import TopicChoice
from vplog.results import run_record
from vplog.results.run_record import CACHE, REQUEST
from vplog.results.staging import staged
from vplog.run import provenance
from vplog.storage.folders import check_regular
from vplog.storage.remote_path import located, stands_for

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Sequence
    from pathlib import Path

_RUN_FILES = (
    "run.json", "report.html", "result.mcap", "graph.g2o", "trajectory.tum", "keyframes.parquet", "descriptors.parquet",
    "closures.parquet", "edges.parquet", "trajectory.parquet", "library/library.json", "library/features.parquet",
    "library/references.parquet", "map[0-9]*.g2o", "joins.parquet", "joint_keyframes.parquet",
    "joint_trajectory.parquet", "joint_trajectory.tum",
    *(f"closure-{'[0-9]' * digits}.png" for digits in range(1, 10)),
)  # fmt: skip
"""All that runs and `explain` write into the folder of a run and into those of its drives, as glob patterns."""


@contextmanager
def begun(
    out: Path,
    head: dict[str, Any],
    files: Sequence[Path],
    library: Path | None = None,
    topics: TopicChoice | None = None,
    drives: Collection[str] = (),
    *,
    resumable: bool = True,
    force: bool = False,
) -> Iterator[Path]:
    """A folder for the results of a run, which become those of `out` when the block ends well (vplog/results/staging).

    The run's request is in the cache of `out` until then if it is `resumable`, and stays there if stages were kept:
    `head` is what provenance.head says of it, `files` are its logs, `drives` the names of those of a run of several.
    Raises SettingsError where `out` holds other things, or without `force` the run of another log.
    """
    cache, request = out / CACHE, out / REQUEST
    record = {
        **head,
        "finished": False,
        "topics": (topics or TopicChoice()).model_dump(mode="json"),
        "library": {"from": provenance.library_of(library)},
    }

    def begin() -> list[str]:
        check_regular(out, "run.json")
        above = out.absolute().parent
        if out.absolute().name in _drives_in(_read(above / "run.json") or {}) or (out / "drive.json").exists():
            raise SettingsError(f"{out} is a drive of the run or map in {above}. Choose another folder with -o.")
        if not force:
            _check_same_logs(out, files)
        return _results_in(out, library, drives, resumable)

    with staged(out, begin) as made, stands_for(made, out):
        before = set() if request.is_file() else set(cache.rglob(f"*{ENDING}"))
        try:
            if resumable:
                cache.mkdir(exist_ok=True)
                run_record.write_run_json(request, record)
            yield made
        except BaseException as error:
            kept = set(cache.rglob(f"*{ENDING}")) - before if resumable else ()
            interrupted = was_interrupted(error)
            if kept and (interrupted or isinstance(error, OSError | MemoryError | ResultError)):
                error.add_note(_what_is_kept(out, kept))
            else:
                request.unlink(missing_ok=True)  # resumed, it would fail again
                with suppress(OSError):  # not there, or it holds what was kept of this and other runs
                    cache.rmdir()
                if resumable and interrupted:
                    error.add_note("no stage was finished, so nothing is kept. Give the same command again")
            raise


def _what_is_kept(out: Path, kept: Collection[Path]) -> str:
    """Stages and bytes that an interrupted run leaves, and the command that resumes it."""
    stages = ", ".join(sorted({file.name.split("-")[0] for file in kept}))
    return (
        f"{sum(file.stat().st_size for file in kept) / 1e6:.1f} MB of results of stages ({stages}) are kept in "
        f"{out / CACHE}. Go on with: {_resume(out)}"
    )


def _resume(out: Path) -> str:
    return f"vplog run --resume -o {shlex.quote(str(out))}"


def _results_in(out: Path, library: Path | None, drives: Collection[str], resumable: bool) -> list[str]:
    """Glob patterns of what an earlier run may have left in `out` that is not of a new one of these drives.

    A library that the new run is given stays, and the cache of each of its drives if it is `resumable`. Raises
    SettingsError where `out` holds other things than a run.
    """
    account = _account(out) if any(not file.name.startswith(".") for file in out.iterdir()) else {}
    if account is None:
        raise SettingsError(f"{out} is a folder with other things in it, not a run. Choose another with -o.")
    given = library is not None and library.resolve() == (out / "library").resolve()
    earlier = [escape(name) for name in _drives_in(account)]
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
    given, account, unfinished = " ".join(map(str, files)), _account(out), _read(out / REQUEST) or {}
    if account == {}:
        raise SettingsError(
            f"{out}/run.json is damaged, so the log of that run is not known. Choose another folder with -o, or "
            "replace the run with --force."
        )
    if account and account.get("finished") is False:  # as older versions left it
        account, unfinished = None, unfinished or account
    if not {log.resolve() for log in _logs_in(unfinished)} <= {file.resolve() for file in files}:
        raise SettingsError(
            f"{out} keeps an unfinished run of {_named(unfinished)}, not of {given}. Go on with that: {_resume(out)}. "
            "Or choose another folder with -o, or drop it with --force."
        )
    drives = [_read(out / name / "run.json") or account for name in _drives_in(account or {})]
    for one in drives or [account]:
        if one and not _is_of(one, files):
            raise SettingsError(
                f"{out} is the run of {_named(one)}, and {given} is another log, or has changed since. Choose another "
                "folder with -o, or replace that run with --force."
            )


def _is_of(account: dict[str, Any], files: Sequence[Path]) -> bool:
    """Whether the log of a finished run is among these, by its content. That is read only where paths, lengths and
    times leave it open."""
    known, about, content = _logs_in(account), account.get("log_stat"), account.get("inputs")
    about, content = (one if isinstance(one, dict) else {} for one in (about, content))
    same_paths = {log.resolve() for log in known} <= {file.resolve() for file in files}
    if same_paths and provenance.stat_of(known) == about:
        return True
    for tried in [known] if same_paths else [files, *([file] for file in files if len(files) > 1)]:
        if not content or bytes_of(tried) != about.get("bytes", bytes_of(tried)):
            continue
        if sorted(hash_inputs(tried).values()) == sorted(map(str, content.values())):
            return True
    return False


def _account(out: Path) -> dict[str, Any] | None:
    """run.json of a folder, empty where it is damaged; None where it has none of vplog."""
    account = _read(out / "run.json")
    return account if not account or "vplog" in account else None


def _read(path: Path) -> dict[str, Any] | None:
    """A run.json, empty where it is damaged; None where there is none."""
    try:
        return run_record.read_run_json(path) if path.is_file() else None
    except ResultError:
        return {}


def _logs_in(account: dict[str, Any]) -> list[Path]:
    """The logs that a run.json names."""
    named = account.get("logs") or account.get("parts") or [account.get("log")]
    return [located(str(path)) for path in named if path] if isinstance(named, list) else []


def _named(account: dict[str, Any]) -> str:
    return " ".join(map(str, _logs_in(account)))


def _drives_in(account: dict[str, Any]) -> list[str]:
    """Folders of the drives of a run of several, by its run.json."""
    drives = account.get("drives")
    names = [drive.get("folder") for drive in drives if isinstance(drive, dict)] if isinstance(drives, list) else []
    return [name for name in names if isinstance(name, str) and PurePath(name).name == name != ".."]
