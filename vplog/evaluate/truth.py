"""Ground truth from a file of poses."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vplog.data import Trajectory
from vplog.errors import TruthError
from vplog.geometry.tum import read_tum
from vplog.storage.remote_path import located

if TYPE_CHECKING:
    from pathlib import Path


def read_truth(place: str | Path) -> Trajectory:
    """A TUM file, here or by URL: world_from_body, s and m, in any order.

    Raises TruthError with the first line that does not fit, SettingsError for a URL of no known kind.
    """
    return Trajectory(*read_tum(located(place), TruthError, "--truth"))
