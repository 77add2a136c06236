"""run.json: what was run, on what, and how it went."""

from __future__ import annotations

import json
import shlex
from itertools import takewhile
from pathlib import Path
from typing import Any

from vplog.errors import ResultError, nearest_path
from vplog.results.staging import recover
from vplog.storage.folders import check_regular
from vplog.storage.json_records import CHECKSUM, has_checksum, parse_json, with_checksum
from vplog.storage.parquet_limits import check_file, check_version
from vplog.storage.scratch import replacing

FORMAT = 1
"""Version of the records of runs and maps, as `format` in them. A new value does not raise it, another meaning does."""
CACHE = ".cache"
"""Folder of the stage results in a run folder, unless another place is named."""
REQUEST = f"{CACHE}/run.json"
"""Request of a run that is not finished; run.json of its folder is that of the finished run before, if any."""
_MOST_DEPTH = 100
"""Values within values, of which ours have ten; Python follows a few hundred."""


def write_run_json(path: Path, record: dict[str, Any]) -> None:
    """Write a record of plain values, numpy scalars and paths, with its checksum. Keys keep the order given, NaN
    becomes null. The folder is made where it is not there."""
    text = json.dumps(with_checksum(record), indent=2, ensure_ascii=False, allow_nan=False) + "\n"
    with replacing(path, parents=True) as stream:
        stream.write(text.encode())


def is_ours(path: Path) -> bool:
    """Whether a file is a sound record that vplog wrote, by fields that only vplog writes: others may have one of the
    same name."""
    try:
        return "vplog" in read_run_json(path) or CHECKSUM.encode() in path.read_bytes()
    except ResultError:
        return False


def read_run_json(path: Path) -> dict[str, Any]:
    """A record of a run or a map, without its checksum. Raises ResultError where the file is missing, is no JSON object
    or does not have its checksum, and NewerError where it is of a newer version."""
    try:
        check_file(path)
        record = _sound_json(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ResultError(
            f"Cannot read {path}: {error.strerror or error}. Is {path.parent} the output of `vplog run`?"
            f"{_run_meant(path.parent)}"
        ) from None
    except (ValueError, RecursionError):
        raise ResultError(f"{path} is not JSON: it is damaged. Copy it back from a backup, or run again.") from None
    if not isinstance(record, dict):
        raise ResultError(f"{path} must hold one JSON object. Run `vplog run` again.")
    if not has_checksum(record):
        raise ResultError(f"{path} is damaged: its checksum does not match. Copy it back from a backup, or run again.")
    if type(version := record.get("format")) is int:
        check_version(path, version, FORMAT, record.get("vplog"))
    return record


def _run_meant(folder: Path) -> str:
    """` Did you mean FOLDER?`: for a file in a run that run, else the folder with the nearest name."""
    if folder.is_file() and (folder.parent / "run.json").is_file():
        return f" Did you mean {folder.parent}?"
    return nearest_path(folder)


def _sound_json(text: str) -> Any:
    """The value of a JSON text, if it can be written again. Raises ValueError or RecursionError."""
    tree = parse_json(text)
    if "\\u" in text:  # half a character that takes two, which no file or terminal can hold
        json.dumps(tree, ensure_ascii=False).encode()
    level, depth = [tree] if text.count("[") + text.count("{") > _MOST_DEPTH else [], 0
    while level:
        within = [one.values() if isinstance(one, dict) else one for one in level]
        level = [one for values in within for one in values if isinstance(one, dict | list)]
        if (depth := depth + 1) > _MOST_DEPTH:
            raise ValueError(f"values are nested in more than {_MOST_DEPTH} others")
    return tree


def read_finished_run(folder: Path) -> dict[str, Any]:
    """The record of the run in a folder that came to its end. Raises ResultError, also where something in the folder is
    not its own file. Results that a killed process had only to move into place are moved."""
    check_regular(folder, "run.json")
    recover(folder)
    begun = (folder / REQUEST).is_file() and not (folder / "run.json").is_file()
    record = read_run_json(folder / (REQUEST if begun else "run.json"))
    if not record.get("finished"):
        of_log = f" of {record['log']}" if isinstance(record.get("log"), str) else ""
        command = f"vplog run --resume -o {shlex.quote(str(folder))}"
        raise ResultError(f"The run{of_log} in {folder} did not finish. Go on with it: {command}")
    return record


def read_single_run(folder: Path) -> dict[str, Any]:
    """The record of a finished run of one drive. Raises ResultError, also where the folder holds several drives."""
    record = read_finished_run(folder)
    drives = record.get("drives")
    if "maps" in record and isinstance(drives, list) and drives and isinstance(drives[0], dict):
        raise ResultError(f"{folder} holds {len(drives)} drives. Give one of them: {folder}/{drives[0].get('folder')}")
    return record


def check_own_folder(folder: Path, what: str) -> None:
    """Raises ResultError where a run folder is that of a drive of a map, for `what` is to be written into it."""
    if (folder / "drive.json").is_file():
        raise ResultError(f"{folder} is a drive of a map, whose files stay as they are. Name another {what} with -o.")


def has_metres(record: dict[str, Any]) -> bool:
    """Whether the lengths of a run are metres, by its run.json."""
    return record.get("scale") != "unknown"


def unit_warnings(record: dict[str, Any]) -> list[str]:
    """A warning beside lengths of a run that are not metres."""
    return [] if has_metres(record) else ["This run has no metres: lengths in m here are in its own unit."]


def piece_warnings(record: dict[str, Any]) -> list[str]:
    """A warning beside poses of a run whose pieces nothing relates to each other."""
    pieces = (record.get("solution") or {}).get("pieces", 1)
    if pieces == 1:
        return []
    return [f"The trajectory has {pieces} pieces that no closure relates: where they lie to each other is not known."]


def command_of(record: dict[str, Any], out: str | Path, *more: str | Path) -> str:
    """The command that runs a drive again into a folder, by its run.json; of older ones its log alone."""
    known = record.get("arguments")
    words = list(map(str, known if isinstance(known, list) else [record.get("log")]))
    logs = sum(1 for _ in takewhile(lambda word: not word.startswith("--"), words))
    return shlex.join(["vplog", "run", *words[:logs], "-o", str(out), *words[logs:], *map(str, more)])


def recorded(record: Any, path: Path, kind: type, *names: str) -> Any:
    """The value of a record under these names. Raises ResultError where there is none, or one of another kind."""
    for name in names:
        record = record.get(name) if isinstance(record, dict) else None
    if not isinstance(record, kind):
        raise ResultError(f"{path} lacks {'.'.join(names)}. Compute it again with `vplog run`.")
    return record
