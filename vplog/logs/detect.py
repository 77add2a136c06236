"""The kind of a log, by magic bytes and by what is in a folder; names only order the files of one bag."""

from __future__ import annotations

import os
import re
import weakref
from collections.abc import Collection, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import zstandard

from vplog.errors import LogError, nearest_path, plural
from vplog.logs import image_folder
from vplog.logs.calibration_file import read_calibrations
from vplog.logs.datasets import colmap, euroc, kitti, stereo_folders, tum_rgbd, utm_images, video, vslam_lab
from vplog.logs.datasets.images import read as read_images
from vplog.logs.datasets.streams import DataSet, DataSetContainer
from vplog.logs.formats import mcap_layout, ros1_layout, sqlite_bag
from vplog.logs.formats.budget import Budget
from vplog.logs.formats.compression import fetched, unpacked
from vplog.logs.formats.container import Container, Contents, Notes
from vplog.logs.formats.mcap_file import McapFile
from vplog.logs.formats.ros1_bag import Ros1Bag
from vplog.logs.formats.ros2_folder import (
    Chain,
    Metadata,
    MetadataError,
    read_metadata,
    split_parts,
)
from vplog.logs.formats.sqlite_bag import SqliteBag
from vplog.logs.messages.records import kind_of
from vplog.logs.recorded_log import RecordedLog
from vplog.logs.recorder_clock import LONGEST_PAUSE_NS
from vplog.logs.topic_selection import EVERY_IMAGE, TopicChoice
from vplog.storage.remote_path import RemotePath, located, names_below

_RESULTS = {"run.json": "a run", "map.json": "a map", "library.json": "a library"}
_MAGIC = {
    mcap_layout.MAGIC: "mcap", ros1_layout.MAGIC: "ros1", sqlite_bag.MAGIC: "ros2-db3", zstandard.FRAME_HEADER: "zstd",
}  # fmt: skip
_READERS = {"mcap": McapFile, "ros1": Ros1Bag, "ros2-db3": SqliteBag}
_DATA_SETS = (kitti, euroc, vslam_lab, tum_rgbd, colmap, utm_images, stereo_folders)
_LOG_NAME = re.compile(r"\.(mcap|bag|db3)(\.zstd?)?$", re.IGNORECASE)
"""Names of logs among other files: to look into each of a bucket costs a request."""
_NO_LOG = re.compile(r"\.|lost\+found$")
"""Names of hidden files, and of ext4's folder for root alone."""
_UNREAD = {".heic", ".heif", ".avif", ".jxl", ".jp2"}
"""Endings of other pictures than those of `image_folder.is_image`."""
_VIDEO_NAME = re.compile(r"\.(mp4|m4v|mov|mkv|webm|avi)$", re.IGNORECASE)
_OTHER_VIDEOS = {".ts", ".mts", ".m2ts", ".flv", ".mov", ".mpg", ".mpeg", ".wmv", ".gif"}
"""Endings of videos in containers that are not read; MOV without the mark of its kind is of before 2001."""
_LISTED = 5
"""Files that an error lists."""
_DEEPEST, _MOST_FILES = 4, 10**6
"""Levels of folders below the one given, and files in them, that are looked through for images."""
_OVERLAP_NS = 10**9
"""ns that one file may reach into the next: recorders split between messages that are a little out of order."""
_LFS = b"version https://git-lfs.github.com/spec/v1"
_LARGEST_POINTER = 1024
"""Size in bytes below which the specification of Git LFS keeps its pointers."""
_KNOWN = (
    "an MCAP file, a ROS 1 bag, a ROS 2 bag (file or folder), a video, a folder of images, or the folder of a data set "
    "(KITTI, EuRoC, TUM RGB-D, VSLAM-LAB, COLMAP)"
)


def open(path: Path, topics: TopicChoice | None = None) -> RecordedLog:
    """The drive at `path`, its kind found by content, its topics by the rules of `topic_selection.py` or by name. Image
    files without a calibration keep their sizes. Raises LogError where there is no log, or where a topic of `topics`
    is not in it."""
    path, choice, notes = located(path), topics or TopicChoice(), Notes()
    path = path.resolve() if path.name in ("", "..") else path  # it has a name
    with _reading(path):
        _check_there(path)
        return _open_folder(path, choice, notes) if path.is_dir() else _open_file(path, choice, notes)


def check(path: Path) -> None:
    """Raises LogError where there is nothing at `path` that looks like a log; of a file a few bytes are read."""
    path = located(path)
    with _reading(path):
        _check_there(path)
        if not path.is_dir():
            if not (_magic(path) or video.is_video(path)):
                raise LogError(_no_log(path))
        elif not (path / "metadata.yaml").is_file() and not _data_sets(path):
            files = [file for file in path.iterdir() if file.is_file()]
            found = any(_magic(file) or image_folder.is_image(file) for file in files)
            if not found and not any(map(image_folder.is_image, _files_below(path))):
                raise LogError(_no_folder(path, files))


def logs_below(path: Path) -> list[Path]:
    """The logs in a folder, or under a prefix of an object store, by their names, a few levels deep. The path itself
    where it is one drive, or nothing is found there or can be read, as opening it says."""
    path = located(path)
    try:
        if _LOG_NAME.search(path.name) or not path.is_dir():
            return [path]
        with suppress(OSError):  # of a folder in it, which is a log of its own
            if len(_data_sets(path)) == 1:
                return [path]
        found = _logs_below(path, _DEEPEST) or _videos_below(path)
    except OSError:
        return [path]
    alone = found and found == [path / found[0].name] and _LOG_NAME.search(found[0].name)  # its folder is opened
    return found if found and not alone else [path]


def _logs_below(folder: Path, levels: int) -> list[Path]:
    remote = isinstance(folder, RemotePath)
    inside = names_below(folder) if remote else {one.name: one.is_dir() for one in folder.iterdir()}
    names = sorted((name for name in inside if not _NO_LOG.match(name)), key=image_folder.natural_order)
    if "metadata.yaml" in names:
        return [folder]
    if _RESULTS.keys() & names:  # of vplog's own
        return []
    if roots := [] if remote else [root for one in _DATA_SETS for root in one.roots(folder)]:
        return roots
    logs = [folder / name for name in names if not inside[name] and _LOG_NAME.search(name)]
    if len(logs) > 1 and split_parts(logs) is not None:
        return [folder]
    for one in [folder / name for name in names if inside[name]] if levels else []:
        try:
            logs += _logs_below(one, levels - 1)
        except OSError:  # as opening it says
            logs.append(one)
    return logs


def _videos_below(folder: Path) -> list[Path]:
    """Videos in a folder without images, a few levels deep."""
    files = list[Path]()
    if not isinstance(folder, RemotePath):
        with suppress(LogError):  # too many to look at
            files = _files_below(folder)
    files = [one for one in files if not any(map(_NO_LOG.match, one.relative_to(folder).parts))]
    videos = [file for file in files if _VIDEO_NAME.search(file.name)]
    if not videos or any(map(image_folder.is_image, files)):
        return []
    return sorted(videos, key=lambda file: [image_folder.natural_order(part) for part in file.parts])


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Raises LogError in place of OSError."""
    try:
        yield
    except OSError as error:
        reason = error.strerror or " ".join(str(error).split())[:300].rstrip(".")
        raise LogError(f"Cannot read {path}: {reason}. Check the path and its permissions.") from None


def _check_there(path: Path) -> None:
    if not path.exists():
        raise LogError(f"No log at {path}: there is no such file or folder.{nearest_path(path)}")
    if not (path.is_dir() or path.is_file()):  # to open a pipe would wait for its writer
        raise LogError(f"{path} is neither a file nor a folder. A log is {_KNOWN}.")


def _open_file(path: Path, choice: TopicChoice, notes: Notes) -> RecordedLog:
    if not _magic(path) and video.is_video(path):
        if isinstance(path, RemotePath):
            raise LogError(f"{path} is a video, and videos are read from local files. Copy it to this machine.")
        return _published(path, path.stem, video.read(path), notes, choice)
    container, kind = open_container(path, notes)
    return _recorded(path, _name(path), kind, container, notes, choice)


def _published(path: Path, name: str, found: DataSet, notes: Notes, choice: TopicChoice) -> RecordedLog:
    return _recorded(path, name, found.kind, DataSetContainer(found, notes), notes, choice)


def _recorded(path: Path, name: str, kind: str, container: Container, notes: Notes, choice: TopicChoice) -> RecordedLog:
    log = RecordedLog(path, name, kind, container, notes, choice)
    if (losses := notes.account.sentences) and not container.contents().messages:
        raise LogError(f"{path}: nothing in it can be read. {losses[0]}")
    return log


def open_container(path: Path, notes: Notes, name: str = "") -> tuple[Container, str]:
    """The messages of one file, unpacked first where it is compressed as a whole, and its kind. `name` is what it is
    called in notes, its own name where empty. Raises LogError."""
    kind, inside = _magic(path), path
    budget = Budget(str(path), path.stat().st_size)
    with ExitStack() as copies:
        if kind == "zstd":
            inside = copies.enter_context(unpacked(path, budget))
            kind = _magic(inside)
        if kind not in _READERS:
            raise LogError(
                _no_log(path) if inside is path else f"{path} does not hold a log when unpacked. A log is {_KNOWN}."
            )
        if kind == "ros2-db3" and isinstance(inside, RemotePath):  # SQLite reads local files only
            inside = copies.enter_context(fetched(inside))
        container = _READERS[kind](inside, notes, name or path.name, budget)
        weakref.finalize(container, copies.pop_all().close)  # a process may read thousands of logs
    return container, kind


class _Part(NamedTuple):
    """One file of a drive."""

    path: Path
    kind: str
    container: Container
    contents: Contents


def open_drive(paths: Sequence[Path], topics: TopicChoice | None = None) -> RecordedLog:
    """Open one drive of one camera, recorded in one file or several in any order. Its images all have the size of the
    first. Raises LogError if there is no log, or the files overlap in time, lie far apart, differ in kind or have no
    topic in common."""
    log = open(paths[0], topics) if len(paths) == 1 else _open_parts(paths, topics)
    log.is_one_drive = True
    return log


def _open_parts(
    paths: Sequence[Path], topics: TopicChoice | None = None, folder: Path | None = None, notes: Notes | None = None
) -> RecordedLog:
    """Open the files of one drive, which is called like the first or like their `folder`; `notes` are remarks on
    that."""
    paths = [located(path) for path in paths]
    notes, parts = notes or Notes(), []
    for path in paths:
        with _reading(path):
            _check_there(path)
            if path.is_dir():
                raise LogError(f"{path} is a folder; give it by itself. Give a drive in several logs as its files.")
            if video.is_video(path):
                raise LogError(
                    f"{path} is a video, and one drive is one video. Join the clips first: "
                    "ffmpeg -f concat -i LIST -c copy DRIVE.mp4."
                )
            same_name = sum(other.name == path.name for other in paths) > 1
            try:
                container, kind = open_container(path, notes, str(path) if same_name else path.name)
                parts.append(_Part(path, kind, container, container.contents()))
            except LogError as error:
                notes.account.add("missing_file", None, (str(path), 0), [], f"Left out: {error}")
    if not parts:
        raise LogError(f"None of the {len(paths)} files can be read. {notes.account.sentences[0]}")
    parts = _in_order_of_time(parts)
    first, chain = parts[0], Chain([part.container for part in parts], notes)
    path, name = (first.path, _name(first.path)) if folder is None else (folder, folder.resolve().name)
    return _recorded(path, name, first.kind, chain, notes, topics or TopicChoice())


def _in_order_of_time(parts: list[_Part]) -> list[_Part]:
    """The files with messages by their first log time. Raises LogError where they overlap, lie far apart, differ in
    kind, or have no useful topic in common."""
    parts = [part for part in parts if part.contents.messages] or parts[:1]
    parts = sorted(parts, key=lambda part: (part.contents.start_ns, part.path))
    for a, b in pairwise(parts):
        if a.kind != b.kind:
            raise LogError(f"{a.path} ({a.kind}) and {b.path} ({b.kind}) are not one drive. Run each by itself.")
        overlap_ns = a.contents.end_ns - b.contents.start_ns
        if overlap_ns > _OVERLAP_NS:
            raise LogError(
                f"{a.path} and {b.path} overlap by {overlap_ns / 1e9:.1f} s, so they are not one drive in parts. "
                "Run each by itself."
            )
        if -overlap_ns > LONGEST_PAUSE_NS:
            raise LogError(
                f"{-overlap_ns / 3.6e12:.1f} hours lie between {a.path} and {b.path}, so they are two drives. "
                "Run each by itself."
            )
    useful = [{c.topic for c, count in part.contents.counts.items() if count and kind_of(c)} for part in parts]
    if len(parts) > 1 and not set.intersection(*useful):
        raise LogError(
            f"{parts[0].path} and the {len(parts) - 1} files after it have no topic in common that is of use, so they "
            "are not one drive in parts. Run each by itself."
        )
    return parts


def _open_folder(path: Path, choice: TopicChoice, notes: Notes) -> RecordedLog:
    problem = None
    if (path / "metadata.yaml").is_file():
        try:
            return _open_bag(path, read_metadata(path), choice, notes)
        except MetadataError as error:
            problem = str(error)
    files = [file for file in path.iterdir() if file.is_file()]
    files.sort(key=lambda file: image_folder.natural_order(file.name))
    logs = [file for file in files if _magic(file) in (*_READERS, "zstd")]
    if [log.name for log in logs] == ["result.mcap"] and (path / "run.json").is_file():
        raise LogError(_no_folder(path, files))
    databases = all(_magic(log) == "ros2-db3" and ".db3" not in log.name.lower() for log in logs)
    if logs and not (databases and (_data_sets(path) or _images_in(path, files))):  # COLMAP's, a catalogue of pictures
        return _open_found(path, logs, problem or f"{path.name} has no metadata.yaml", choice, notes)
    if problem:
        raise LogError(f"{problem} Copy the whole bag folder, or give a storage file itself.")
    roots = _data_sets(path)
    if len(roots) == 1:
        return _published(path, path.resolve().name, _read(roots[0], choice), notes, choice)
    if roots:
        names = ", ".join(str(root.relative_to(path)) for root in roots[:_LISTED])
        raise LogError(f"{path} holds {len(roots)} drives of data sets. Give one of them: {names}.")
    if (images := _images_in(path, files)) is not None:
        found = read_images(path, *images, choice)
        others = {*(files if images[0][0] in files else _files_below(path))}
        found.remarks.extend(_unread(others.difference(images[0])))
        return _published(path, path.name, found, notes, choice.model_copy(update={"image": None}))
    raise LogError(_no_folder(path, files))


def _read(root: Path, choice: TopicChoice) -> DataSet:
    """The drive of a data set; a calibration that is chosen may name the unit of its depth."""
    kind = next(one for one in _DATA_SETS if one.roots(root))
    with_depth = next((one for one in (vslam_lab, tum_rgbd) if one is kind), None)
    if with_depth is None:
        return kind.read(root)
    cameras = [] if choice.calibration_file is None else read_calibrations(choice.calibration_file)
    return with_depth.read(root, next((one.depth_per_m for one in cameras if one.depth_per_m), None))


def _data_sets(path: Path) -> list[Path]:
    """The drives of data sets in a folder or, by their layout, below it; else those right below. Raises OSError."""
    if isinstance(path, RemotePath):  # to look around costs a request each
        return []
    for folders in ([path], image_folder.below(path)):
        each = (next((found for one in _DATA_SETS if (found := one.roots(folder))), []) for folder in folders)
        if roots := [root for found in each for root in found]:
            return roots
    return []


def open_images(files: Sequence[Path], topics: TopicChoice | None = None) -> RecordedLog:
    """Files of images of one camera, in any folders, each once, in natural order of their names or by the times in
    them. Raises LogError where one is no image."""
    paths, choice = [located(file) for file in dict.fromkeys(files)], topics or TopicChoice()
    for path in paths:
        with _reading(path):
            _check_there(path)
            if isinstance(path, RemotePath) or path.is_dir() or not image_folder.is_image(path):
                raise LogError(f"{path} is no local file of an image. Give images, or one log by itself.")
    root = Path(os.path.commonpath([path.absolute().parent for path in paths]))
    found = read_images(root, [path.absolute() for path in paths], (), choice.model_copy(update={"image": EVERY_IMAGE}))
    return _published(root, root.name, found, Notes(), choice.model_copy(update={"image": None}))


def is_image_file(path: Path) -> bool:
    """Whether a file is an image by its first bytes; not where it cannot be read."""
    try:
        return path.is_file() and image_folder.is_image(path)
    except OSError:
        return False


def _images_in(path: Path, files: list[Path]) -> tuple[list[Path], set[Path]] | None:
    """The images among the files of a folder, or else of the folders below it, and those of them that are only named
    like images; None where there are none."""
    files = [file for file in files if not file.name.startswith(".")]
    images = [file for file in files if image_folder.is_image(file)]
    if not images:
        files = [file for file in _files_below(path) if not file.name.startswith(".")]
        images = [file for file in files if image_folder.is_image(file)]
    endings = {file.suffix for file in images if file.suffix}
    damaged = {file for file in files if file.suffix in endings}.difference(images)
    return ([*images, *damaged], damaged) if images else None


def _unread(files: Collection[Path]) -> list[str]:
    """A remark on pictures of kinds that are not read; none without."""
    kinds = [file.suffix[1:].upper() for file in files if file.suffix.lower() in _UNREAD]
    if not kinds:
        return []
    listed = ", ".join(sorted(set(kinds)))
    return [
        f"{plural(len(kinds), 'picture')} of kinds that are not read left out ({listed}). Convert them to JPEG or PNG."
    ]


def _to_convert(files: Collection[Path]) -> list[str]:
    """A line on videos in containers that are not read; none without."""
    first = next((file for file in files if file.suffix.lower() in _OTHER_VIDEOS), None)
    if first is None:
        return []
    copied = "" if first.suffix.lower() in (".gif", ".wmv") else "-c copy "  # whose codecs are none of MP4's
    return [f"Convert a video to MP4 first: ffmpeg -i {first.name} {copied}{first.stem}.mp4."]


def _files_below(path: Path) -> list[Path]:
    """Files of the folders in a folder, a few levels deep. Raises LogError where there are too many to look at."""
    found, folders = list[Path](), [path]
    for _ in range(_DEEPEST + 1):
        inside = [one for folder in folders for one in folder.iterdir()]
        folders = [one for one in inside if one.is_dir()]
        found += [one for one in inside if one.is_file()]
        if len(found) + len(folders) > _MOST_FILES:
            raise LogError(
                f"{path} holds more than {_MOST_FILES} files in its folders. Give the folder of one drive's images."
            )
    return sorted(found)


def _open_found(path: Path, logs: list[Path], problem: str, choice: TopicChoice, notes: Notes) -> RecordedLog:
    """The logs of a folder without usable metadata."""
    if len(logs) == 1 and (_magic(logs[0]) == "ros1" or ".bag" in logs[0].suffixes):  # packed, too
        return _open_file(logs[0], choice, notes)
    parts = logs if len(logs) == 1 else split_parts(logs)
    if parts is None:
        names = ", ".join(file.name for file in logs[:_LISTED])
        raise LogError(f"{problem.rstrip('.')}, and the folder holds {len(logs)} logs. Give one of them: {names}.")
    if not all(_magic(part) == "ros1" for part in parts):
        notes.add(f"{problem.rstrip('.')}; {plural(len(parts), 'storage file')} found by content.")
    if len(parts) > 1:  # several drives may be numbered, too
        return _open_parts(parts, choice, path, notes)
    return _open_bag(path, Metadata(parts, [], {}, 0, 0), choice, notes)


def _open_bag(folder: Path, metadata: Metadata, choice: TopicChoice, notes: Notes) -> RecordedLog:
    """A ROS 2 bag of several storage files. An unreadable one is left out as long as another is sound."""
    name = folder.resolve().name
    parts: list[tuple[Container, str]] = []
    failures: list[LogError] = []
    for file in metadata.files:
        try:
            container, kind = open_container(file, notes)
            if kind == "ros1":
                raise LogError(f"{file} is a ROS 1 bag in the folder of a ROS 2 bag. Give it by itself.")
            parts.append((container, kind))
        except LogError as error:
            failures.append(error)
            notes.account.add("missing_file", None, (file.name, 0), [], f"Left out: {error}")
    if not parts:
        raise failures[0]
    if metadata.unlisted:
        names = ", ".join(metadata.unlisted[:_LISTED])
        notes.add(f"metadata.yaml of {name} does not list {names}; they are read as the parts behind those it lists.")
    for missing in metadata.missing:
        detail = f"{name} lacks {missing}, which metadata.yaml names."
        notes.account.add("missing_file", None, (missing, 0), [], detail)
    chain = Chain([container for container, _ in parts], notes, metadata)
    kind = "ros2-mcap" if any(kind == "mcap" for _, kind in parts) else "ros2-db3"
    return _recorded(folder, name, kind, chain, notes, choice)


def _name(path: Path) -> str:
    """Without the endings of its format and of its compression."""
    return Path(path.stem).stem if path.suffix in (".zst", ".zstd") else path.stem


def _magic(path: Path) -> str:
    head = image_folder.first_bytes(path, max(map(len, _MAGIC)))
    return next((kind for magic, kind in _MAGIC.items() if head.startswith(magic)), "")


def _is_lfs_pointer(path: Path) -> bool:
    """Whether a file is what Git LFS leaves in place of a file that it has not downloaded."""
    return path.stat().st_size <= _LARGEST_POINTER and image_folder.first_bytes(path, len(_LFS)) == _LFS


def _no_folder(path: Path, files: list[Path]) -> str:
    if ours := [what for name, what in _RESULTS.items() if (path / name).is_file()]:
        return f"{path} is {ours[0]} that vplog wrote, not a log. Give the log of a drive."
    if pointers := sum(map(_is_lfs_pointer, files)):
        return f"{path} holds {plural(pointers, 'Git LFS pointer')} instead of data. Download it with: git lfs pull."
    found = f"{plural(len(files), 'file')}, but no log and no images" if files else "nothing"
    if videos := sum(video.is_video(file) and _VIDEO_NAME.search(file.name) is not None for file in files):
        holds = f"{path} holds {plural(videos, 'video')}. Give one of them, or the folder to `vplog batch`."
        return " ".join([holds, *_unread(files)])
    return " ".join([f"{path} holds {found}.", *_unread(files), *_to_convert(files), f"A log is {_KNOWN}."])


def _no_log(path: Path) -> str:
    if path.stat().st_size == 0:
        return f"{path} is empty (0 bytes). Was the recording stopped before anything was written?"
    if _is_lfs_pointer(path):
        return f"{path} is a Git LFS pointer instead of the file. Download it with: git lfs pull."
    found = f"{path} starts with {image_folder.first_bytes(path, 8)!r}, which no log does."
    return " ".join([found, *_unread([path]), *_to_convert([path]), f"A log is {_KNOWN}."])
