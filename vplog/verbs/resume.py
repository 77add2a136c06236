"""The request of an unfinished run, read from its cache, for `vplog run --resume`."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vplog import logs
from vplog.errors import LogError, ResultError, SettingsError
from vplog.pipeline import Pipeline
from vplog.results import run_record
from vplog.results.run_record import CACHE, REQUEST, recorded
from vplog.results.staging import recover
from vplog.run.cache.stage_cache import inputs_of, key_of
from vplog.run.provenance import OWN_LIBRARY, UNNAMED, stat_of, stored_log
from vplog.storage.folders import check_regular
from vplog.storage.remote_path import is_elsewhere, located


@dataclass(frozen=True)
class ResumeRequest:
    """The logs and options of a run."""

    logs: list[Path]
    """The parts of one recording, or the drives of one map."""
    several: bool
    """Whether they are drives, each of its own."""
    pipeline: Pipeline
    library: Path | None
    topics: logs.TopicChoice


def resume_request(out: Path, given: Sequence[Path] = ()) -> ResumeRequest:
    """The request of the unfinished run in `out`; logs `given` must be its logs.

    Raises ResultError where there is nothing to go on with, SettingsError where the logs are others.
    """
    check_regular(out, "run.json")
    check_regular(out / CACHE)
    recover(out)
    file = out / REQUEST if (out / REQUEST).is_file() else out / "run.json"
    if not file.is_file():
        raise ResultError(f"Nothing to resume: {out} has no run.json. Start a run: vplog run LOG -o {out}")
    account = run_record.read_run_json(file)
    if account.get("finished") is not False:
        raise ResultError(f"Nothing to resume: the run in {out} is finished. Without --resume it is run again.")
    known = [str(located(text).resolve()) for text in _recorded_logs(account, file)]
    paths = sorted(given, key=lambda path: _place(known, path))  # a URL that is given has its query
    if not given:
        again = f"Give it again: vplog run --resume LOG -o {out}"
        paths = [stored_log(text, out, f"The log of the run in {out}", again) for text in known]
    if sorted(str(path.resolve()) for path in paths) != sorted(known):
        raise SettingsError(
            f"The run in {out} is of {' '.join(known)}, not of {given[0]}. Leave out the log, or choose another -o."
        )
    _check_unchanged(paths, account, out)
    where = str(file)
    pipeline = Pipeline.read(recorded(account, file, dict, "settings"), where)
    library = recorded(account, file, str, "library", "from")
    if is_elsewhere(library, out):
        raise SettingsError(
            f"The library of the run in {out} {library} {UNNAMED}. Start the run again, its finished stages are kept: "
            f"vplog run LOG -o {out} --library {library}"
        )
    return ResumeRequest(
        paths,
        "logs" in account,
        pipeline,
        None if library == OWN_LIBRARY else located(library),
        logs.TopicChoice.read(recorded(account, file, dict, "topics"), where),
    )


def _check_unchanged(paths: Sequence[Path], account: dict[str, Any], out: Path) -> None:
    """Raises LogError where a log is not what it was when the run began, by its stat, or by its content if known."""
    about = account.get("log_stat")
    if not isinstance(about, dict) or not all(path.exists() for path in paths) or stat_of(paths) == about:
        return  # the run reports what is missing
    now = inputs_of(paths, out / CACHE)
    if now.token == key_of(now.signature):  # the cache does not know it either: nothing of it would be found
        given = shlex.join(map(str, paths))
        raise LogError(f"{given} changed since the run in {out} began. Begin it again: vplog run {given} -o {out}")


def _place(known: list[str], path: Path) -> int:
    """Row of a log among those of the run; behind all where it is none of them."""
    text = str(path.resolve())
    return known.index(text) if text in known else len(known)


def _recorded_logs(account: dict[str, Any], file: Path) -> list[str]:
    name = next((name for name in ("logs", "parts") if account.get(name)), "log")
    named = recorded(account, file, str if name == "log" else list, name)
    return [recorded({name: path}, file, str, name) for path in ([named] if name == "log" else named)]
