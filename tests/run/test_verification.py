"""The ledger of closures in parts."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import numpy as np
import pytest

from tests.results.example import make_run
from vplog.data import Closures
from vplog.run import verification
from vplog.run.cache.codecs import closures_codec
from vplog.run.cache.stage_cache import digest_of


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


def _taken(closures: Closures, rows: Any) -> Closures:
    columns: dict[str, Any] = {field.name: getattr(closures, field.name) for field in fields(Closures)}
    taken: dict[str, Any] = {
        name: column[rows] if isinstance(column, np.ndarray) else [column[row] for row in rows]
        for name, column in columns.items()
    }
    return Closures(**taken)
