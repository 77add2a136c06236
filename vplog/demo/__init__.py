"""A drive made on the spot: a rendered street, a car that circles a block, and the log its sensors write.

It needs no download, so `vplog demo` and the tests run on it. The same settings give the same bytes.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from vplog.demo.settings import SMALL, DemoSettings
from vplog.execution.cores import allowed
from vplog.execution.execution import Execution

if TYPE_CHECKING:
    from pathlib import Path

    from vplog.demo.record import Drive

__all__ = ["SMALL", "DemoSettings", "make_drive"]


def make_drive(folder: Path, settings: DemoSettings | None = None, execution: Execution | None = None) -> Drive:
    """Write `folder`/drive.mcap and `folder`/truth.tum and say what is in them.

    Frames are rendered on all cores where `execution` is None. Raises ResultError where the folder cannot be written.
    """
    from vplog.demo.record import record_drive  # numba, OpenCV, mcap and rosbags load here, not with the package

    return record_drive(folder, settings or DemoSettings(), execution or Execution(allowed()))
