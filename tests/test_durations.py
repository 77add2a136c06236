"""What the tests cost, as it is written for the next run of them."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

from tests import durations

if TYPE_CHECKING:
    from pathlib import Path

    import pytest


def test_those_that_share_a_fixture_share_what_it_takes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Files of which no test ran keep their numbers; tests that are gone from the others go, as files that are gone."""
    (file := tmp_path / "tests" / "durations.json").parent.mkdir()
    (tmp_path / "b.py").touch()
    file.write_text(json.dumps({"a.py::gone": 5.0, "b.py::other": 3.0, "c.py::gone": 1.0}))
    monkeypatch.setattr(durations, "FILE", file)
    recorder = durations.Recorder()
    recorder.functions.update({"a.py::first": 1.0, "a.py::second": 0.5, "a.py::short": 0.02})  # type: ignore[arg-type]
    recorder.fixtures.update({"a.py::map": 4.0})  # type: ignore[arg-type]
    recorder.users["a.py::map"] = ["a.py::first", "a.py::second", "a.py::second", "a.py::second"]
    recorder._write()
    assert json.loads(file.read_text()) == {"a.py::first": 2.0, "a.py::second": 3.5, "b.py::other": 3.0}
    assert durations.by_file(durations.known()) == {"a.py": 5.5, "b.py": 3.0}
