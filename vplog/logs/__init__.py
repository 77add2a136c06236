"""Readers of MCAP, ROS 1 and ROS 2 bags, videos, folders of images and data sets as one Log, by `open(path)`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from vplog.logs.topic_selection import EVERY_IMAGE, TopicChoice
from vplog.stages import Log

__all__ = ["EVERY_IMAGE", "TopicChoice", "below", "check", "is_image_file", "open", "open_drive", "open_images"]
__all__ += ["summary"]


def open(path: Path, topics: TopicChoice | None = None) -> Log:
    """The drive at `path`, its kind found by content, its topics by the rules of `topic_selection.py` or by name.
    Raises LogError where there is no log, or where a topic of `topics` is not in it."""
    from vplog.logs.detect import open_log  # OpenCV, rosbags and mcap load here, not with the package

    return open_log(path, topics or TopicChoice())


def check(path: Path) -> None:
    """Raises LogError where there is nothing at `path` that looks like a log; of a file a few bytes are read."""
    from vplog.logs.detect import check_log

    check_log(path)


def below(path: Path) -> list[Path]:
    """The logs in a folder, or on an object store under a prefix; the path itself where it is one drive."""
    from vplog.logs.detect import logs_below

    return logs_below(path)


def open_drive(paths: Sequence[Path], topics: TopicChoice | None = None) -> Log:
    """One drive recorded in several files, in any order. Raises LogError where they overlap in time, lie far apart,
    differ in kind or have no topic in common."""
    from vplog.logs.detect import open_drive as open_parts

    return open_parts(paths, topics or TopicChoice())


def summary(path: Path, topics: TopicChoice | None = None) -> tuple[int, float]:
    """Images of the camera in use and s of the log at `path`, as its index has them. Raises LogError."""
    from vplog.logs.detect import open_log

    return open_log(path, topics or TopicChoice()).summary()


def open_images(files: Sequence[Path], topics: TopicChoice | None = None) -> Log:
    """Files of images of one camera, in any folders. Raises LogError where one is no image."""
    from vplog.logs.detect import open_images as open_files

    return open_files(files, topics or TopicChoice())


def is_image_file(path: Path) -> bool:
    """Whether a file is an image by its first bytes; not where it cannot be read."""
    from vplog.logs.image_folder import is_image

    try:
        return path.is_file() and is_image(path)
    except OSError:
        return False
