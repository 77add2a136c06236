"""What drives more cost in a map of many, by a small one."""

from __future__ import annotations

import pytest

from tests.benchmarks.night import Night
from vplog.maps.storage.catalogue import NAME

DRIVES = 48


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Night:
    return Night(tmp_path_factory.mktemp("night") / "map", DRIVES, fixes=True)


def test_drives_that_have_not_changed_are_not_opened(made: Night) -> None:
    """By a writer that joins nothing new; as many drives without a catalogue are read, and end in one."""
    assert made.add(0)["files"] < 15
    (made.root / NAME).unlink()
    assert made.add(0)["files"] > DRIVES
    assert made.add(0)["files"] < 15


def test_new_drives_are_joined_with_those_of_their_road(made: Night) -> None:
    told = made.add(2)
    assert told["warnings"] == []
    assert (told["pairs"] >= 24, told["largest"]) == (True, 13)
