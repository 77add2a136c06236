"""vplog: from a recorded drive to an optimised trajectory, with loop closures found by bag of bounding boxes.

    import vplog

    run = vplog.run("drive.mcap", "out")          # as `vplog run drive.mcap -o out`
    run.closures.to_pylist()                      # tables are Arrow tables
    vplog.evaluate(run, "truth.tum")["ate_after"]

Files and folders are a str, a Path or a URL: s3://, gs://, az://, http(s):// to read. What cannot be done raises a
VplogError, whose message says what, where and what next. Where it names an option of the command line, as --min-gap,
the keyword argument is min_gap; `settings` is --set, and `topics` has what --image-topic and its like choose. No call
needs an `if __name__ == "__main__"` guard.
"""

from __future__ import annotations

import sys
from importlib import import_module
from types import ModuleType
from typing import Any

from vplog.version import __version__ as __version__

TYPE_CHECKING = False  # for type checkers it is true, and typing takes most of the time of this import
if TYPE_CHECKING:
    from vplog.api import (
        Answers,
        Map,
        RunFolder,
        batch,
        compare,
        evaluate,
        localize,
        open_log,
        open_map,
        open_run,
        run,
    )
    from vplog.errors import (
        GraphError,
        LibraryError,
        LogError,
        NewerError,
        ResultError,
        SettingsError,
        TruthError,
        VplogError,
    )

__all__ = [
    "Answers", "GraphError", "LibraryError", "LogError", "Map", "NewerError", "ResultError", "RunFolder",
    "SettingsError", "TruthError", "VplogError", "batch", "compare", "evaluate", "localize", "open_log", "open_map",
    "open_run", "run",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    """A name of the API, whose modules are imported with its first use."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module("vplog.errors" if name.endswith("Error") else "vplog.api"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


class _Package(ModuleType):
    """The package itself: `vplog.run` stays the function when the folder of that name is imported."""

    def __setattr__(self, name: str, value: object) -> None:
        if not (name in __all__ and isinstance(value, ModuleType)):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package
