"""What every recogniser of the union must do, whatever its descriptors are."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from tests.places.pictures import nothing
from vplog.data import THUMBNAIL_SIDE
from vplog.errors import LibraryError
from vplog.execution.execution import Execution
from vplog.places import KINDS
from vplog.places.bobb import BobbSettings
from vplog.places.bobb_paper import PaperBobbSettings
from vplog.places.bovf import BovfSettings
from vplog.places.fabmap import FabmapSettings
from vplog.places.gist import GistSettings
from vplog.places.hybrid import HybridSettings
from vplog.places.thumbnail import ThumbnailSettings
from vplog.places.vlad import VladSettings
from vplog.stages import BoxState, CodedState
from vplog.testing.recogniser_contract import RecogniserContract

if TYPE_CHECKING:
    from pathlib import Path

    from vplog.data import Reference
    from vplog.settings import Settings

CASES: dict[str, Any] = {
    "bobb": BobbSettings(references=4, features=150),
    "bobb, reduced": BobbSettings(references=3, features=150, windows_along=2, popularity=0, pairing="best"),
    "bobb_paper": PaperBobbSettings(partitions=5, features=150),
    "bovf": BovfSettings(words=200, features=150),
    "bovf, cut": BovfSettings(words=200, features=150, max_bytes=64),
    "fabmap": FabmapSettings(words=100, features=150),
    "gist": GistSettings(blocks=2),
    "hybrid": HybridSettings(bobb=BobbSettings(references=4, features=150), words=4),
    "thumbnail": ThumbnailSettings(),
    "vlad": VladSettings(centres=8, features=150),
    "vlad, whole": VladSettings(centres=8, features=150, dimensions=None),
}
"""Settings that are quick."""
WHOLE_IMAGE = ("gist", "thumbnail")
"""Kinds that look at no features."""
BLANK = replace(nothing(), thumbnail=np.full((THUMBNAIL_SIDE, THUMBNAIL_SIDE), 77, np.uint8))
"""A grey wall."""


ELSEWHERE = ("onnx", "plugin", "vectors")
"""Kinds that need a file or a package, tested in test_network_places.py and test_plugin.py."""


def contract(name: str) -> type[RecogniserContract]:
    return type(f"Test_{re.sub('[^a-z]+', '_', name)}", (RecogniserContract,), {"settings": CASES[name]})


CONTRACTS = {name: contract(name) for name in CASES}
globals().update({one.__name__: one for one in CONTRACTS.values()})  # where pytest finds them


@pytest.fixture(params=CASES)
def case(request: pytest.FixtureRequest) -> RecogniserContract:
    return CONTRACTS[request.param]()


@pytest.mark.parametrize("settings", KINDS.values(), ids=KINDS)
def test_every_member_is_tested_under_its_kind(settings: type[Settings]) -> None:
    kind = settings.model_fields["kind"].default
    tested = any(type(quick) is settings and name.split(",")[0] == kind for name, quick in CASES.items())
    assert tested != (kind in ELSEWHERE)


def test_settings_that_differ_give_other_hashes() -> None:
    assert len({one().learned.state.hash for one in CONTRACTS.values()}) == len(CASES)


def test_a_library_has_settings_of_its_own(case: RecogniserContract, tmp_path: Path) -> None:
    case.learned.state.save(tmp_path)
    assert type(case.settings)().load(tmp_path, Execution()).settings == case.settings


def test_an_image_without_features_is_described(case: RecogniserContract, references: list[Reference]) -> None:
    state = case.learned.state
    blank = state.describe(BLANK)
    column = state.to_arrow([blank, case.learned.places[0]])
    assert state.to_arrow(state.from_arrow(column)).equals(column)
    index = state.index(state.from_arrow(column))
    assert index.query(case.learned.places[0], 1).rows.tolist() == [1]
    if case.settings.kind in WHOLE_IMAGE:
        assert index.query(blank, 1).rows.tolist() == [0]
        with pytest.raises(LibraryError, match="whole images"):
            state.describe(nothing())
    else:
        assert len(index.query(blank, 5).rows) == 0
        assert index.query(case.learned.places[0], 5).rows.tolist() == [1]
        with pytest.raises(LibraryError, match="feature"):
            case.settings.learn([replace(reference, features=BLANK) for reference in references[:3]], Execution())


def test_boxes_of_any_recogniser_that_has_them(case: RecogniserContract, references: list[Reference]) -> None:
    state = case.learned.state
    assert isinstance(state, BoxState) == case.settings.kind.startswith(("bobb", "hybrid"))
    assert isinstance(state, CodedState) == (case.settings.kind == "bobb")
    if not isinstance(state, BoxState):
        return
    assert [one.stamp_ns for one in state.references] == [one.stamp_ns for one in references]
    places = [*case.learned.places, state.describe(BLANK)]
    found = [state.boxes(place) for place in places]
    assert not len(found[-1].references)
    for one in found:
        assert one.corners.shape[:2] == (len(one.references), len(state.windows(0)))
        inside = one.corners[~np.isnan(one.corners).any(axis=2)]
        assert np.all((inside >= 0) & (inside <= 1))
        assert np.all(inside[:, :2] < inside[:, 2:])
    query, match = np.divmod(np.arange(len(places) ** 2, dtype=np.int32), len(places))
    shared = state.shared(places, query, match)
    for q, m, numbers in zip(query, match, shared.references, strict=True):
        assert set(numbers.tolist()) == set(found[q].references.tolist()) & set(found[m].references.tolist())
    features = references[0].features
    [votes, again] = state.voting_maps(features, [int(found[0].references[0])] * 2)
    np.testing.assert_array_equal(votes, again)
    assert votes.min() >= 0
    assert votes.max() == 1.0
    assert not state.voting_maps(BLANK, [0])[0].any()


def test_columns_of_another_kind_are_refused(case: RecogniserContract) -> None:
    own = case.learned.column.type
    columns = [one().learned.column for one in CONTRACTS.values() if not one().learned.column.type.equals(own)]
    assert len(columns) >= len({settings.kind for settings in CASES.values()}) - 1
    for column in columns:
        with pytest.raises(LibraryError, match="not fit"):
            case.learned.state.from_arrow(column)
