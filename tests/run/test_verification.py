"""The ledger of closures in parts."""

from __future__ import annotations

import shutil
from dataclasses import fields, replace
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from tests.results.example import make_run
from vplog.data import Closures, Verdict
from vplog.loops.candidate import VerifySettings
from vplog.loops.propose import Proposals
from vplog.results import tables
from vplog.run import verification
from vplog.run.cache.codecs import closures_codec
from vplog.run.cache.stage_cache import digest_of

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from conftest import Said

    from vplog.verbs.demo.record import Demo


@pytest.mark.parametrize("size", [1, 3, 100])
def test_a_ledger_in_parts_is_the_ledger(size: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """A part has all candidates of its map frames; written, read back and put together they are what they were."""
    monkeypatch.setattr(verification, "_PART_CANDIDATES", size)
    known, codec = make_run(size).closures, closures_codec()
    rows = verification._parts(known.match)
    assert (len(rows) == 1) == (size == 100)
    assert sorted(np.concatenate(rows).tolist()) == list(range(len(known)))
    matches = [set(known.match[part].tolist()) for part in rows]
    assert sum(map(len, matches)) == len(set.union(*matches))
    taken = [_taken(known, part) for part in rows]
    found = verification.merged([codec.from_bytes(codec.to_bytes(part)) for part in taken], rows)
    assert digest_of(found) == digest_of(known)
    assert found.verdict == known.verdict
    nothing = _taken(known, np.empty(0, np.int64))
    assert len(codec.from_bytes(codec.to_bytes(nothing))) == 0


def test_candidates_behind_the_best_are_verified_where_better_ones_show_the_view(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Of six keyframes with four candidates each the third has one that shares enough matches, at rank 1."""
    query, rank = (grid.ravel().astype(np.int32) for grid in np.mgrid[10:16, 0:4])
    proposals = Proposals(query, rank * 2, rank, np.ones(24, np.float32), rank)

    def verdicts(part: Proposals) -> list[Verdict]:
        alike = (part.query == 12) & (part.rank == 1)
        return [Verdict.TOO_FEW_INLIERS if one else Verdict.TOO_FEW_MATCHES for one in alike]

    for always, expected in ((1, {0}), (2, {0, 1}), (9, {0, 1, 2, 3})):
        found = _verified(proposals, VerifySettings(always=always), verdicts, monkeypatch)
        ranks = {one: set(found.rank[found.query == one].tolist()) for one in range(10, 16)}
        near = {0, 1, 2, 3} if always > 1 else expected
        assert [ranks[one] for one in range(10, 16)] == [expected, near, near, near, expected, expected]
        assert np.lexsort((found.rank, found.query)).tolist() == list(range(len(found)))


@pytest.mark.parametrize("enough", [0, 1, 2, 3])
def test_where_enough_of_the_best_are_accepted_the_others_are_left_out(
    enough: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Three keyframes have four candidates each, of whose best two 0, 1 and 2 are accepted."""
    query, rank = (grid.ravel().astype(np.int32) for grid in np.mgrid[10:13, 0:4])
    proposals = Proposals(query, rank * 2, rank, np.ones(12, np.float32), rank)

    def verdicts(part: Proposals) -> list[Verdict]:
        return [Verdict.ACCEPTED if one else Verdict.TOO_FAR for one in part.rank < part.query - 10]

    found = _verified(proposals, VerifySettings(always=2, enough=enough), verdicts, monkeypatch)
    counts = np.bincount(found.query)[10:].tolist()
    assert counts == [2 if enough and accepted >= enough else 4 for accepted in range(3)]


def _verified(
    proposals: Proposals, settings: VerifySettings, verdicts: Callable[[Proposals], list[Verdict]],
    monkeypatch: pytest.MonkeyPatch,
) -> Closures:  # fmt: skip
    """The ledger of candidates whose verdicts are given."""
    known = make_run(3).closures

    def ledgers(_: Any, parts: list[Any]) -> list[Closures]:
        return [
            replace(known.rows(np.zeros(len(part.query), np.int64)), **vars(part), verdict=verdicts(part))
            for part, *_ in parts
        ]

    monkeypatch.setattr(verification, "calibrated", lambda *_: 0.0)
    drive: Any = SimpleNamespace(settings=settings, keyframes=SimpleNamespace(stamp_ns=range(16)))
    steps: Any = SimpleNamespace(in_parts=ledgers)
    return verification.verify(proposals, drive, steps=steps)


def _taken(closures: Closures, rows: Any) -> Closures:
    columns: dict[str, Any] = {field.name: getattr(closures, field.name) for field in fields(Closures)}
    taken: dict[str, Any] = {
        name: column[rows] if isinstance(column, np.ndarray) else [column[row] for row in rows]
        for name, column in columns.items()
    }
    return Closures(**taken)


@pytest.mark.parametrize("rate", [0.05, 0.5])
def test_false_rate_bounds_what_is_accepted(
    rate: float, finished: Path, drive: Demo, verb: Callable[..., Said], tmp_path: Path
) -> None:
    """Whatever no null pair is as good as needs many of them to be that certain, and a line says so."""
    folder = tmp_path / "run"
    shutil.copytree(finished, folder)
    before = tables.read_closures(folder / "closures.parquet")
    assert before.accepted.any()
    said = verb("run", drive.log, "-o", folder, "--false-rate", rate, "--threads", 2, "--json")
    assert said.code == 0
    after = tables.read_closures(folder / "closures.parquet")
    assert (after.p_false[after.accepted] <= rate).all()
    verified = after.of(Verdict.ACCEPTED, Verdict.NOT_SIGNIFICANT)
    assert (after.p_false[after.of(Verdict.NOT_SIGNIFICANT)] > rate).all()
    assert verified.sum() == before.accepted.sum()
    warned = f"--false-rate {rate:g}: no closure is that certain" in " ".join(said.json["warnings"])
    assert warned != after.accepted.any()
