"""What is made when it is first asked for, and a library that is read for its places alone."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

import numpy as np
import pytest

from vplog.execution.execution import Execution
from vplog.places import matches
from vplog.places.bobb import BobbSettings
from vplog.places.matches import Once

if TYPE_CHECKING:
    from pathlib import Path

    from vplog.data import Reference

pytestmark = pytest.mark.usefixtures("computed_anew")


def test_threads_that_ask_at_once_get_one_value() -> None:
    made, begun = [], threading.Barrier(4)

    def make() -> object:
        made.append(object())
        return made[-1]

    once = Once(make)

    def ask(_: int) -> object:
        begun.wait()
        return once()

    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(ask, range(4)))
    assert len(made) == 1
    assert all(one is made[0] for one in found)


def test_what_fails_is_tried_again() -> None:
    answers = [ValueError("not yet"), None]

    def make() -> str:
        if (error := answers.pop(0)) is not None:
            raise error
        return "made"

    once = Once(make)
    with pytest.raises(ValueError, match="not yet"):
        once()
    assert once() == "made"


def test_places_are_compared_without_an_index_of_the_library(
    references: list[Reference], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = BobbSettings(references=4, features=100)
    learned = settings.learn(references[:6], Execution())
    learned.save(tmp_path / "library")
    places = [learned.describe(reference.features) for reference in references[:6]]
    column = learned.to_arrow(places)
    indexed = []
    monkeypatch.setattr(matches, "hnsw", lambda *told: indexed.append(told))
    loaded = settings.load(tmp_path / "library", Execution(2))
    known = loaded.from_arrow(column)
    np.testing.assert_array_equal(loaded.index(known).scores(known[0]), learned.index(places).scores(places[0]))
    assert loaded.hash == learned.hash
    assert not indexed
    monkeypatch.undo()
    again = [loaded.describe(reference.features) for reference in references[:6]]
    assert loaded.to_arrow(again).equals(column)


def test_a_library_of_patches_alone_is_known_by_its_images(references: list[Reference], tmp_path: Path) -> None:
    settings = BobbSettings(references=4, features=0)
    one, other = (settings.prepare(references[rows], Execution()) for rows in (slice(6), slice(6, 12)))
    assert one.hash != other.hash
    one.save(tmp_path / "library")
    assert settings.load(tmp_path / "library", Execution()).hash == one.hash
