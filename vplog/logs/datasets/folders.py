"""Folders of data sets: their images in order, and what is below them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vplog.logs.image_folder import is_image, natural_order

if TYPE_CHECKING:
    from pathlib import Path


def below(path: Path) -> list[Path]:
    """The folders right below, by name; none where there is no such folder."""
    return sorted(folder for folder in path.iterdir() if folder.is_dir()) if path.is_dir() else []


def image_files(folder: Path) -> list[Path]:
    """The images of a folder in natural order, and files that are only named like them; none where there is no such
    folder."""
    files = sorted(folder.iterdir(), key=lambda file: natural_order(file.name)) if folder.is_dir() else []
    files = [file for file in files if file.is_file() and not file.name.startswith(".")]
    endings = {file.suffix for file in files if file.suffix and is_image(file)}
    return [file for file in files if file.suffix in endings or is_image(file)]
