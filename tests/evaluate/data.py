"""Where the real data is."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

DATA = Path(os.environ.get("VPLOG_DATA", Path(__file__).parents[3] / "shared" / "data"))


def data(name: str) -> Path:
    """A file of the real data; skips the test where it is absent."""
    path = DATA / name
    if not path.exists():
        pytest.skip(f"{name} is not in {DATA}; VPLOG_DATA names the folder of real data")
    return path
