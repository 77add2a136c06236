"""Damaged drives: a drive with a damaged file is named and left out of an answer, and the rest of the map is not."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from vplog.errors import LibraryError, NewerError, ResultError
from vplog.maps.geo_bounds import earth_of_run, earth_record
from vplog.maps.storage.layout import ADD_AGAIN, FORMAT, RUN_TABLES, drive_record, sha256_of
from vplog.results import run_record, tables
from vplog.storage.folders import is_below
from vplog.storage.parquet_limits import open_table, read_footer
from vplog.storage.scratch import files_in


class UnreachableError(ResultError):
    """An object store refuses a request or cannot be reached: no drive is damaged."""


class DamagedDriveError(ResultError):
    """A file of one drive is damaged or missing."""

    def __init__(self, message: str, drive: str = "") -> None:
        super().__init__(message)
        self.drive = drive


@contextmanager
def reading_drive(drive: str) -> Iterator[None]:
    """Raises DamagedDriveError where a file of the drive cannot be read."""
    try:
        yield
    except (DamagedDriveError, NewerError, UnreachableError):
        raise
    except (ResultError, LibraryError) as error:
        raise DamagedDriveError(str(error), drive) from None


def check_run_tables(folder: Path, record: dict[str, Any]) -> None:
    """Raises ResultError where run.json or a table of a drive is missing or, tables by their length, not as drive.json
    has it. Without lengths in drive.json damage is found when the file is read."""
    files = files_of(record)
    for name in RUN_TABLES if files else ():
        if wrong := _difference(folder / name, files.get(name, {}), hashed=name == "run.json"):
            raise ResultError(wrong)


def damaged_files(folder: Path) -> list[str]:
    """A line for each file of a run folder in a map that does not have the length and sha256 that drive.json names."""
    try:
        files = files_of(drive_record(folder))
    except ResultError as error:
        return [str(error)]
    lines = (_difference(folder / name, files.get(name, {})) for name in sorted({*RUN_TABLES, *files}))
    return [line for line in lines if line]


def damaged_table(path: Path) -> str:
    """Why a table cannot be read or is not as it was written, in one line; empty where it is sound."""
    try:
        with tables.reading(path, "", ""):
            open_table(path).close()
    except ResultError as error:
        return str(error)
    return ""


def rows_of(path: Path) -> int:
    """Rows of a table, by its footer. Raises ResultError."""
    with tables.reading(path, again := f"Check its permissions, or {ADD_AGAIN}", again):
        return read_footer(path).num_rows


def complete_record(made: Path, hashed: bool) -> None:
    """Note in drive.json of a finished run folder where the drive is on earth and, if `hashed`, length and sha256 of
    each file. Raises ResultError."""
    about = {**drive_record(made), "format": FORMAT}
    about.pop("files", None)  # of the map that it comes from
    if "earth" not in about:
        about["earth"] = earth_record(earth_of_run(made), tables.read_keyframes(made / "keyframes.parquet")[1])
    try:
        if hashed:
            about["files"] = {
                name: {"bytes": (made / name).stat().st_size, "sha256": sha256_of(made / name)}
                for name in files_in(made)
                if name != "drive.json"
            }
    except OSError as error:
        raise ResultError(f"Cannot read {error.filename or made}: {error.strerror or error}.") from None
    run_record.write_run_json(made / "drive.json", about)


def _difference(path: Path, wanted: dict[str, Any], hashed: bool = True) -> str:
    """The difference of a file from its entry in drive.json; empty where it does not."""
    try:
        if not path.is_file():
            return f"{path} is not a file." if path.exists() else f"{path} is not there."
        if wanted.get("bytes") not in (None, size := path.stat().st_size):
            return f"{path} has {size} bytes instead of {wanted['bytes']}."
        if hashed and wanted.get("sha256") not in (None, sha256_of(path)):
            return f"{path} does not have the sha256 that drive.json names."
    except OSError as error:
        return f"{path} cannot be read: {error.strerror or error}."
    return ""


def files_of(record: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """`bytes` and `sha256` of each file of a run folder, by its drive.json; empty where that lacks them."""
    files = record.get("files")
    sound = isinstance(files, dict) and all(isinstance(files[name], dict) and is_below(name) for name in files)
    return files if isinstance(files, dict) and sound else {}
