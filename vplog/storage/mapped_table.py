"""Tables of scores in a mapped file: larger than memory, and on a disk that has the room."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from vplog.data import Float32s
from vplog.errors import ResultError


def mapped_scores(path: Path, shape: tuple[int, int]) -> Float32s:
    """(Q, M) float32 to be filled, in a new .npy file. Its room is taken at once: a disk that is full when a page of a
    mapped file is written ends the process by SIGBUS. Raises ResultError where there is none."""
    try:
        found = np.lib.format.open_memmap(path, "w+", np.dtype("<f4"), shape)
        if hasattr(os, "posix_fallocate"):
            with path.open("r+b") as file:
                os.posix_fallocate(file.fileno(), 0, path.stat().st_size)
    except OSError as error:
        need = f"The scores of {shape[0]} views against {shape[1]} need {4e-9 * shape[0] * shape[1]:.1f} GB"
        raise ResultError(
            f"{need}, and {path.parent} cannot take them: {error.strerror}. Make room, or set TMPDIR."
        ) from None
    return found
