"""A finished run in a viewer: rerun, Foxglove, or its report in a browser."""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys
import webbrowser
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from vplog.errors import ResultError
from vplog.results.run_record import read_single_run
from vplog.storage.scratch import scratch
from vplog.verbs.export import export

VIEWERS = ("rerun", "report", "foxglove")
_FOXGLOVE = ("foxglove-studio", "foxglove")
"""Its program, by the name that its Debian package gives it, or the one that others do."""


@dataclass(frozen=True)
class Opening:
    """A viewer, and the file that it shows."""

    viewer: str
    """One of `VIEWERS`."""
    path: Path
    """The file that the viewer shows."""
    start: Callable[[], bool] | None
    """Starts it, and waits where the file goes with the window; False where it does not start. None where nothing can
    be opened here."""
    why: str = ""
    """Why nothing can be opened."""


@contextmanager
def opening(folder: Path, viewer: str | None = None) -> Iterator[Opening]:
    """How the run in `folder` opens: in this viewer, or where None in rerun if it is installed, else as its report.

    The recording for rerun is there for the time of the block. Raises ResultError.
    """
    read_single_run(folder)
    installed, display = importlib.util.find_spec("rerun") is not None, _has_display()
    viewer = viewer or ("rerun" if installed and display else "report")
    if viewer == "rerun" and installed and display:
        with scratch("open") as made:
            recording = made / "run.rrd"
            export(folder, "rrd", recording)
            yield Opening(viewer, recording, lambda: _run(sys.executable, "-m", "rerun_cli", str(recording)))
        return
    path = folder / ("report.html" if viewer == "report" else "result.mcap")
    if not path.is_file():
        raise ResultError(f"{folder} has no {path.name}. Write it again with `vplog run`.")
    program = next(filter(None, map(shutil.which, _FOXGLOVE)), None)
    if not display:
        yield Opening(viewer, path, None, "there is no display here")
    elif viewer == "report":
        yield Opening(viewer, path, lambda: webbrowser.open(path.absolute().as_uri()))
    elif viewer == "foxglove" and program is not None:
        yield Opening(viewer, path, lambda: _run(program, str(path.absolute())))
    else:
        get = "pip install rerun-sdk" if viewer == "rerun" else "https://foxglove.dev/download"
        yield Opening(viewer, path, None, f"{viewer} is not installed ({get})")


def _has_display() -> bool:
    return sys.platform == "darwin" or any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))


def _run(*command: str) -> bool:
    """Whether a program ended well; what it says is its own."""
    try:
        return subprocess.run(command, check=False, stdout=subprocess.DEVNULL).returncode == 0  # noqa: S603 (no shell)
    except OSError:
        return False
