"""What two places share, told apart by reference, adds up to the recogniser's score."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from tests.places.pictures import noisy, nothing
from vplog.execution.execution import Execution
from vplog.places.bobb import BobbSettings
from vplog.places.bovf import BovfSettings
from vplog.places.hybrid import HybridSettings
from vplog.stages import BoxState

if TYPE_CHECKING:
    from vplog.data import Reference
    from vplog.places.bobb_paper import PaperBobbState

TINY = BobbSettings(references=4, features=250)


def pairs(count: int) -> tuple[np.ndarray, np.ndarray]:
    query, match = np.divmod(np.arange(count * count, dtype=np.int32), count)
    return query, match


@pytest.mark.parametrize("pairing", ["best", "same", "both"])
def test_parts_of_the_score_add_up(references: list[Reference], pairing: Any) -> None:
    state = TINY.model_copy(update={"pairing": pairing}).learn(references, Execution())
    places = [state.describe(noisy(r.features, 3)) for r in references] + [state.describe(nothing())]
    query, match = pairs(len(places))
    found = state.shared(places, query, match)
    scores = np.concatenate([state.index(places).scores(place) for place in places])
    several = 0
    for q, m, numbers, overlap, score in zip(query, match, found.references, found.overlap, scores, strict=True):
        mine, theirs = places[q], places[m]
        assert set(numbers.tolist()) == set(mine.references.tolist()) & set(theirs.references.tolist()) - {65_535}
        weights = [[p.weights[np.flatnonzero(p.references == n)[0]] for n in numbers] for p in (mine, theirs)]
        worth = np.array(weights, np.float64).reshape(2, -1).prod(axis=0) * overlap
        lengths = [np.linalg.norm(p.weights.astype(np.float64)) for p in (mine, theirs)]
        assert worth.sum() / max(np.prod(lengths), 1.0) == pytest.approx(score, abs=1e-6)
        assert np.all(np.diff(worth) <= 1e-6 * worth.max(initial=0.0))  # what counts most comes first
        assert np.all((overlap >= 0) & (overlap <= 1))
        several += len(numbers) > 1
    assert several > len(places)
    own = [found.overlap[row] for row in np.flatnonzero(query == match)]
    assert max(map(np.max, own[:-1])) == 1.0
    assert own[-1].size == 0


def test_parts_of_eq_1_add_up(state: PaperBobbState, references: list[Reference]) -> None:
    places = [state.describe(noisy(r.features, 3)) for r in references] + [state.describe(nothing())]
    query, match = pairs(len(places))
    found = state.shared(places, query, match)
    scores = np.concatenate([state.index(places).scores(place) for place in places])
    s = state.settings
    for q, numbers, overlap, score in zip(query, found.references, found.overlap, scores, strict=True):
        rank = [int(np.flatnonzero(places[q].references == n)[0]) for n in numbers]
        boxes = places[q].boxes[rank].astype(np.float64)
        area = (boxes[..., 2:] - boxes[..., :2]).prod(axis=-1).sum(axis=-1)
        assert (area * overlap).sum() / (s.references * s.boxes * s.grid**2) == pytest.approx(score, abs=1e-6)
        assert np.all((overlap >= 0) & (overlap <= 1))


def test_pairs_are_compared_alike_however_many_at_once(
    references: list[Reference], monkeypatch: pytest.MonkeyPatch
) -> None:
    state = TINY.learn(references, Execution())
    places = [state.describe(noisy(r.features, 3)) for r in references]
    query, match = pairs(len(places))
    whole = state.shared(places, query, match)
    monkeypatch.setattr("vplog.places.overlap._PAIRS", 5)
    parts = state.shared(places, query, match)
    for one, other in ((whole.references, parts.references), (whole.overlap, parts.overlap)):
        assert len(one) == len(other) == len(query)
        assert all(np.array_equal(a, b) and a.dtype == b.dtype for a, b in zip(one, other, strict=True))
    nothing_asked = state.shared(places, query[:0], match[:0])
    assert nothing_asked.references == nothing_asked.overlap == []


def test_only_recognisers_with_boxes_share_references(references: list[Reference]) -> None:
    hybrid = HybridSettings(bobb=TINY, words=2, bits=8).learn(references, Execution())
    assert isinstance(hybrid, BoxState)
    places = [hybrid.describe(r.features) for r in references]
    query, match = pairs(len(places))
    found = hybrid.shared(places, query, match)
    boxes = hybrid.bobb.shared(places, query, match)
    assert all(map(np.array_equal, found.references, boxes.references))
    assert not isinstance(BovfSettings(features=250).learn(references, Execution()), BoxState)
