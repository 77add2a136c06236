"""Which candidates between two drives are looked at."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np

from tests.graph.drive import ledger
from vplog.data import Closures, Verdict
from vplog.execution.execution import Execution
from vplog.features.learned import OnnxFeatureSettings
from vplog.joint.graph import JoinSettings
from vplog.loops.false_rate import FalseRateSettings
from vplog.loops.propose import Proposals
from vplog.maps.joining import inter_session
from vplog.pipeline import Pipeline

if TYPE_CHECKING:
    import pytest

QUERIES, RANKS = 400, 3


def proposals() -> Proposals:
    """Three candidates of each query, whose scores fall with the number of the query and with the rank."""
    query, rank = np.divmod(np.arange(QUERIES * RANKS, dtype=np.int32), np.int32(RANKS))
    score = (1.0 - query / QUERIES - rank / 1e6).astype(np.float32)
    return Proposals(query=query, match=rank, rank=rank, score=score, support=np.ones_like(query))


def looked_at(
    monkeypatch: pytest.MonkeyPatch,
    same_place: set[int],
    calibrated: bool = True,
    settings: JoinSettings | None = None,
    pipeline: Pipeline | None = None,
) -> tuple[list[np.ndarray], Closures]:
    """The queries of each look, and the ledger, where geometry holds for the bests of these queries."""
    looks: list[np.ndarray] = []

    def verify(some: Proposals, *_: Any) -> Closures:
        looks.append(some.query)
        found = ledger(some.query, some.match, np.tile(np.eye(4), (len(some.query), 1, 1)))
        held = [int(query) in same_place and not rank for query, rank in zip(some.query, some.rank, strict=True)]
        verdict = [Verdict.ACCEPTED if h else Verdict.TOO_FEW_MATCHES for h in held]
        return replace(found, rank=some.rank, inliers=np.full(len(held), 50, np.int32), verdict=verdict)

    monkeypatch.setattr(inter_session, "verify_between", verify)
    drive: Any = SimpleNamespace(camera=SimpleNamespace(matrix=np.eye(3) if calibrated else None))

    def mirror(some: Proposals, *_: Any) -> np.ndarray:
        assert chosen.features.kind == "sift" or not len(some.query)
        return np.zeros(len(some.query), np.int64)

    monkeypatch.setattr(inter_session.false_rate, "mirrored_evidence", mirror)
    chosen = (pipeline or Pipeline()).model_copy(update={"join": settings or JoinSettings()})
    one = inter_session.CameraDrive(np.arange(0), drive)
    return looks, inter_session.closures_between(proposals(), one, one, chosen, 0.0, Execution())


def test_drives_that_do_not_meet_cost_one_look_at_the_highest_scores(monkeypatch: pytest.MonkeyPatch) -> None:
    looks, found = looked_at(monkeypatch, set())
    assert [look.tolist() for look in looks] == [list(range(QUERIES // 8))]
    assert len(found) == QUERIES // 8
    looks, _ = looked_at(monkeypatch, {100}, settings=JoinSettings(first_look=60))
    assert [len(look) for look in looks] == [60], "what is not among them is not found"


def test_where_drives_meet_every_best_is_looked_at_and_all_that_is_around(monkeypatch: pytest.MonkeyPatch) -> None:
    looks, found = looked_at(monkeypatch, {20, 300}, settings=JoinSettings(around=2))
    assert [len(look) for look in looks] == [50, 350, 2 * 5 * (RANKS - 1)]
    assert sorted(set(looks[2].tolist())) == [18, 19, 20, 21, 22, 298, 299, 300, 301, 302]
    order = found.query * RANKS + found.rank
    assert (np.diff(order) > 0).all(), "by query, then rank"
    assert len(found) == sum(len(look) for look in looks)


def test_without_metres_the_bests_are_all(monkeypatch: pytest.MonkeyPatch) -> None:
    looks, _ = looked_at(monkeypatch, {20}, calibrated=False)
    assert [len(look) for look in looks] == [50, 350]


def test_descriptors_of_networks_are_not_mirrored(monkeypatch: pytest.MonkeyPatch) -> None:
    """Closures have no `p_false` then, and are left out where a rate is to be held."""
    network = Pipeline(features=OnnxFeatureSettings())
    held = network.model_copy(update={"false_rate": FalseRateSettings(rate=0.1)})
    for pipeline, verdict in ((network, Verdict.ACCEPTED), (held, Verdict.NOT_SIGNIFICANT)):
        looks, found = looked_at(monkeypatch, {20}, calibrated=False, pipeline=pipeline)
        assert looks
        assert found.verdict[20] is verdict
        assert np.isnan(found.p_false[20]) == (pipeline is network)
