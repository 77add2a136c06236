"""Detection of data sets in a folder, by its content."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vplog.logs.datasets import colmap, euroc, kitti, tum_rgbd, utm_images, vslam_lab
from vplog.logs.image_folder import below

if TYPE_CHECKING:
    from pathlib import Path

    from vplog.logs.datasets.streams import DataSet

_FOLDERS = (kitti, euroc, vslam_lab, tum_rgbd, colmap, utm_images)


def roots_of(path: Path) -> list[Path]:
    """The drives of data sets in a folder: itself, or what its layout has below it. Raises OSError."""
    return next((found for one in _FOLDERS if (found := one.roots(path))), [])


def find_roots(path: Path) -> list[Path]:
    """Roots of data sets in a folder, or else in the folders right below it. Raises OSError."""
    return roots_of(path) or [root for folder in below(path) for root in roots_of(folder)]


def read_folder(root: Path) -> DataSet:
    """One of `find_roots`. Raises LogError."""
    return next(one.read(root) for one in _FOLDERS if one.roots(root))
