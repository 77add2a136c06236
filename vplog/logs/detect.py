"""The kind of a log, told by magic bytes and by what is in a folder; names only order the files of one bag."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from vplog.errors import LogError
from vplog.logs import image_folder, mcap_file, ros1_bag, sqlite_bag
from vplog.logs.containers import Notes, plural
from vplog.logs.image_folder import ImageFolder
from vplog.logs.mcap_file import McapFile
from vplog.logs.recorded import RecordedLog
from vplog.logs.ros1_bag import Ros1Bag
from vplog.logs.ros2_folder import Chain, MetadataError, ZstdMessages, split_parts, storage_files
from vplog.logs.sqlite_bag import SqliteBag

if TYPE_CHECKING:
    from vplog.logs.containers import Container
    from vplog.logs.select import TopicChoice
    from vplog.stages import Log

_MAGIC = {mcap_file.MAGIC: "mcap", ros1_bag.MAGIC: "ros1", sqlite_bag.MAGIC: "db3", b"\x28\xb5\x2f\xfd": "zstd"}
_READERS = {"mcap": McapFile, "ros1": Ros1Bag, "db3": SqliteBag}
_KINDS = {"mcap": "mcap", "ros1": "ros1", "db3": "ros2-db3"}
_LISTED = 5
"""Files that an error lists."""
_KNOWN = "an MCAP file, a ROS 1 bag, a ROS 2 bag (file or folder) or a folder of images"


def open_log(path: Path, choice: TopicChoice) -> Log:
    """The log at `path`. Raises LogError where there is none that vplog reads."""
    path, notes = Path(path), Notes()
    try:
        if not path.exists():
            raise LogError(f"No log at {path}: there is no such file or folder.")
        return _open_folder(path, choice, notes) if path.is_dir() else _open_file(path, choice, notes)
    except OSError as error:
        raise LogError(f"Cannot read {path}: {error.strerror or error}.") from None


def _open_file(path: Path, choice: TopicChoice, notes: Notes) -> Log:
    kind = _magic(path)
    if kind == "zstd":
        raise LogError(f"{path} is compressed as a whole. Unpack it with `zstd -d {path.name}` and give that file.")
    if not kind:
        raise LogError(_no_log(path))
    return RecordedLog(path, path.stem, _KINDS[kind], _READERS[kind](path, notes), notes, choice)


def _open_folder(path: Path, choice: TopicChoice, notes: Notes) -> Log:
    problem = None
    if (path / "metadata.yaml").is_file():
        try:
            files, mode = storage_files(path, notes)
            return _open_bag(path, files, mode, choice, notes)
        except MetadataError as error:
            problem = str(error)
    files = sorted((file for file in path.iterdir() if file.is_file()), key=image_folder.natural_order)
    logs = [file for file in files if _magic(file) in _READERS]
    if logs:
        return _open_found(path, logs, problem or f"{path.name} has no metadata.yaml", choice, notes)
    if problem:
        raise LogError(f"{problem} Copy the whole bag folder, or give a storage file itself.")
    images = [file for file in files if image_folder.is_image(file)]
    if images:
        return ImageFolder(path, images, notes)
    found = plural(len(files), "file") if files else "nothing"
    raise LogError(f"{path} holds {found}, but no log and no images. A log is {_KNOWN}.")


def _open_found(path: Path, logs: list[Path], problem: str, choice: TopicChoice, notes: Notes) -> Log:
    """The logs of a folder whose metadata do not say which belong to the bag."""
    if len(logs) == 1 and _magic(logs[0]) == "ros1":
        return _open_file(logs[0], choice, notes)
    parts = logs if len(logs) == 1 else split_parts(logs)
    if parts is None:
        names = ", ".join(file.name for file in logs[:_LISTED])
        raise LogError(f"{problem.rstrip('.')}, and the folder holds {len(logs)} logs. Give one of them: {names}.")
    notes.add(f"{problem.rstrip('.')}; {plural(len(parts), 'storage file')} found by content.")
    return _open_bag(path, parts, "", choice, notes)


def _open_bag(folder: Path, files: list[Path], mode: str, choice: TopicChoice, notes: Notes) -> Log:
    """A ROS 2 bag of several storage files. An unreadable one is left out as long as another is sound."""
    name = folder.resolve().name
    parts: list[Container] = []
    kinds: set[str] = set()
    failures: list[LogError] = []
    for file in files:
        try:
            container, kind = _open_part(file, notes)
            parts.append(container)
            kinds.add(kind)
        except LogError as error:
            failures.append(error)
    if not parts:
        raise failures[0]
    for failure in failures:
        notes.add(f"Left out: {failure}")
    chain = Chain(parts)
    container = ZstdMessages(chain, notes) if mode == "message" else chain
    return RecordedLog(folder, name, "ros2-mcap" if "mcap" in kinds else "ros2-db3", container, notes, choice)


def _open_part(file: Path, notes: Notes) -> tuple[Container, str]:
    kind = _magic(file)
    if kind in ("mcap", "db3"):
        return _READERS[kind](file, notes), kind
    raise LogError(_no_log(file) if kind != "zstd" else f"{file} is compressed as a whole. Unpack it with `zstd -d`.")


def _magic(path: Path) -> str:
    with path.open("rb") as file:
        head = file.read(max(map(len, _MAGIC)))
    return next((kind for magic, kind in _MAGIC.items() if head.startswith(magic)), "")


def _no_log(path: Path) -> str:
    if path.stat().st_size == 0:
        return f"{path} is empty (0 bytes). Was the recording stopped before anything was written?"
    with path.open("rb") as file:
        head = file.read(8)
    return f"{path} starts with {head!r}, which no log does. A log is {_KNOWN}."
