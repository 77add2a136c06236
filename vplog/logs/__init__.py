"""Readers of MCAP, ROS 1 and ROS 2 bags, videos, folders of images and data sets as one Log, by `open(path)`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from vplog.logs.topic_selection import EVERY_IMAGE, TopicChoice

if TYPE_CHECKING:
    from vplog.logs.detect import check, is_image_file, logs_below, open, open_drive, open_images

__all__ = ["EVERY_IMAGE", "TopicChoice", "check", "is_image_file", "logs_below", "open", "open_drive", "open_images"]


def __getattr__(name: str) -> Any:
    """OpenCV, rosbags and mcap load with the first log, not with the package."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from vplog.logs import detect

    return getattr(detect, name)
