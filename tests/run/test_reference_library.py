"""Libraries of several logs: each gets as many references as it needs."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from vplog.execution.execution import Execution
from vplog.places.reference_choice import LibrarySettings
from vplog.run import reference_library


def test_a_drive_whose_references_are_recognised_gets_no_more(monkeypatch: pytest.MonkeyPatch) -> None:
    opened: Any = [SimpleNamespace(name=name, stamps=lambda: np.arange(400)) for name in ("street", "tower")]

    def extracted(logs: Any, stamps: Any, *_: object) -> list[Any]:
        return [SimpleNamespace(drive=log.name) for log, one in zip(logs, stamps, strict=True) for _ in one]

    monkeypatch.setattr(reference_library, "_extracted", extracted)
    monkeypatch.setattr(reference_library, "lacking", lambda *_: {"tower"})
    first, pipeline = [np.arange(0, 400, 40)] * 2, cast("Any", SimpleNamespace(library=LibrarySettings()))
    references = extracted(opened, first)
    reference_library._add_until_enough(references, opened, first, pipeline, Execution())
    drives = [one.drive for one in references]
    assert (drives.count("street"), drives.count("tower")) == (10, 90), "an eighth of all frames at most"
