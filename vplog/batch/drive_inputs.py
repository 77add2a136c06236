"""Inputs of a batch: logs, folders of them, patterns, lists of these, and manifests with a row for each drive."""

from __future__ import annotations

import glob
import re
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path, PurePosixPath
from typing import Any, cast

from vplog import logs
from vplog.batch.plan import DriveInput, absolute_log
from vplog.errors import LogError, SettingsError
from vplog.evaluate.truth_tables import read_lines
from vplog.logs.image_folder import natural_order
from vplog.logs.topic_selection import OPTIONS, TopicChoice
from vplog.results.tables import reading
from vplog.storage.parquet_limits import open_table, read_table
from vplog.storage.remote_path import RemotePath, local_copy, located, objects_below

MANIFESTS = (".csv", ".parquet")
"""Endings of the names of manifests."""
_COLUMNS = {option.replace("-", "_"): name for name, option in OPTIONS.items()}
_COLUMNS |= {"odometry": "odometry", "mask": "masks"}
"""Field of TopicChoice for each column that is called as an option of the command line."""
_FILES = ("odometry_file", "calibration_file", "masks")
_FORM = (
    "A manifest has a column `log`, the columns that it needs of `name`, `truth` and the options of the log "
    "(`image_topic`, `odometry`, `calibration`, ...), and any others, which are tags."
)
_MOST_BYTES = 2**28
"""Longest list that is read: a million paths."""


def drive_inputs(places: Iterable[Path | DriveInput]) -> list[DriveInput]:
    """The drives that these places are or list: a log, a folder or prefix with logs below it, a pattern with `*`, a
    `@FILE` of any of them with one a line, or a manifest, FILE.csv or FILE.parquet.

    Names in a list or a manifest are relative to its folder. Raises SettingsError, LogError or ResultError.
    """
    return [drive for place in places for drive in _drives_of(place)]


def _drives_of(place: Path | DriveInput) -> list[DriveInput]:
    if isinstance(place, DriveInput):
        return [place]
    if place.suffix.lower() in MANIFESTS:
        return manifest(place)
    if str(place).startswith("@") and not place.exists():
        file = Path(str(place)[1:])
        return [DriveInput(log) for line in _lines(file) for log in _logs_at(_beside(file, line))]
    return [DriveInput(log) for log in _logs_at(place)]


def manifest(path: Path) -> list[DriveInput]:
    """The drives of a manifest. Raises SettingsError with the row and column that does not fit, or ResultError."""
    found, rows = [], list(_rows(path))
    names = Counter(row["name"] for _, row in rows if row.get("name"))
    for where, row in rows:
        if not row["log"]:
            raise SettingsError(f"{where}, column log: is empty. {_FORM}")
        if names[name := row.get("name", "")] > 1:
            raise SettingsError(f"{where}, column name: {name!r} is that of another drive, too. Choose another.")
        topics = {_COLUMNS[one]: _topic(path, where, one, row[one]) for one in _COLUMNS if row.get(one)}
        topics |= {"cameras": None} if "image" in topics else {}  # those of the command are beside its own image topic
        about = dict[str, Any]()
        if tags := row.keys() - {"log", "name", "truth", *_COLUMNS}:
            about["tags"] = {one: row[one] for one in sorted(tags) if row[one]}
        if truth := row.get("truth"):
            about["truth"] = truth if truth in ("gps", "auto") else absolute_log(_beside(path, truth))
        found.append(DriveInput(_beside(path, row["log"]), name, TopicChoice(**topics), about))
    return found


def _topic(path: Path, where: str, column: str, text: str) -> Any:
    """The value of a field of TopicChoice in a manifest's cell."""
    name = _COLUMNS[column]
    if name in _FILES:
        file = _beside(path, text)
        if isinstance(file, RemotePath):
            raise SettingsError(
                f"{where}, column {column}: {file} is not on this machine. Name a local file, in a local manifest."
            )
        return {"": file.resolve()} if name == "masks" else file.resolve()
    return getattr(TopicChoice.read({name: text}, f"{where}, column {column}"), name)


def _rows(path: Path) -> Iterator[tuple[str, dict[str, str]]]:
    """Where each row of a manifest is, and its cells by column, empty where there is none."""
    with local_copy(path) as file:
        if path.suffix.lower() == ".csv":
            lines = read_lines(file, (), _FORM, SettingsError)
            _, header = next(lines, ("", []))
            _check_header(path, header)
            for where, cells in lines:
                yield where.replace(str(file), str(path)), dict(zip(header, cells, strict=True))
            return
        with reading(path, _FORM), open_table(file) as table:
            rows = read_table(file, table)
        _check_header(path, rows.column_names)
        for number, row in enumerate(rows.to_pylist(), 1):
            yield f"{path}, row {number}", {key: "" if one is None else str(one).strip() for key, one in row.items()}


def _check_header(path: Path, header: list[str]) -> None:
    if "log" not in header:
        raise SettingsError(f"{path} has no column log. {_FORM}")
    if twice := [repr(name) for name, count in Counter(header).items() if count > 1 or not name]:
        raise SettingsError(f"{path}: column {twice[0]} has no name, or that of another. {_FORM}")


def _lines(file: Path) -> Iterator[str]:
    try:
        if file.stat().st_size > _MOST_BYTES:
            raise SettingsError(f"{file} is larger than {_MOST_BYTES >> 20} MB, so it is no list of logs.")
        text = file.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        why = getattr(error, "strerror", None) or "it is not text"
        raise SettingsError(f"Cannot read the list of logs {file}: {why}.") from None
    lines = (line.strip() for line in text.splitlines())
    yield from (line for line in lines if line and not line.startswith("#"))


def _beside(file: Path, text: str) -> Path:
    """The place that a list or a manifest names. Raises SettingsError where one of a server names a file here."""
    if isinstance(file, RemotePath) and text.startswith("/"):
        raise SettingsError(f"{file} names {text[:80]!r}, a file of this machine. Name what lies beside it, or URLs.")
    if "://" in text or text.startswith("/"):
        return located(text)
    return located(f"{file.url.rpartition('/')[0]}/{text}") if isinstance(file, RemotePath) else file.parent / text


def _logs_at(place: Path) -> list[Path]:
    """The log at a place, those below it, or those that match it."""
    text = place.url if isinstance(place, RemotePath) else str(place)
    if "*" not in text or place.exists():
        return logs.logs_below(place)
    if not (found := _matching(text)):
        raise LogError(f"No log matches {place}. Check the pattern; * stands for any part of a name, ** for folders.")
    return [log for one in sorted(found, key=lambda one: natural_order(str(one))) for log in logs.logs_below(one)]


def _matching(pattern: str) -> list[Path]:
    if "://" not in pattern:
        return [Path(name) for name in glob.glob(pattern, recursive=True)]  # noqa: PTH207 (of absolute patterns, too)
    folder, _, below = pattern.partition("*")
    folder, _, begins = folder.rpartition("/")
    parts, words = re.split(r"(\*\*/|\*)", f"{begins}*{below}"), {"**/": "(?:.*/)?", "*": "[^/]*"}
    fits = re.compile("".join(words.get(part) or re.escape(part) for part in parts))
    root = cast("RemotePath", located(folder))
    places = map(PurePosixPath, objects_below(root))
    names = dict.fromkeys(str(place) for one in places for place in (one, *list(one.parents)[:-1]))
    return [located(root / name) for name in names if fits.fullmatch(name)]
