"""Answers of recognisers, a row for each query: what was found, whether it is right, and what would have been."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa
from pyarrow import csv

from vplog.data import Int32s
from vplog.evaluate.retrieval import Ranks
from vplog.storage.scratch import replacing

if TYPE_CHECKING:
    from vplog.benchmark.traversals import Traversal

COLUMNS = pa.schema({
    "method": pa.string(), "query": pa.int64(), "query_name": pa.string(), "match": pa.int64(),
    "match_name": pa.string(), "score": pa.float32(), "p_match": pa.float32(), "evidence": pa.string(),
    "right": pa.bool_(),
    "rank": pa.int64(), "true": pa.int64(), "true_name": pa.string(),
})  # fmt: skip
"""Frame numbers and file names of the query, its best answer and its true match that scores most; `rank` of that match,
1 the best, means over rows of equal score rounded up; `evidence` is what most of the score is of, see
`stages.EvidenceState`. Empty where there is none: no answer, no match in the map, a match that was not given, no truth,
no file names, no probability, a method with one kind of evidence."""


def answers_table(method: str, ranks: Ranks, query: Traversal, other: Traversal) -> pa.Table:
    """The answers of one method, in the order of the queries."""

    def of_map(rows: Int32s) -> tuple[list[int | None], list[str | None]]:
        numbers = [int(other.frames[row]) if row >= 0 else None for row in rows.tolist()]
        return numbers, [None if other.names is None or row < 0 else other.names[row] for row in rows.tolist()]

    positive, answered = ranks.positive, ranks.top_row >= 0
    rank = 1 + ranks.better + np.ceil(ranks.tied_false / (ranks.tied_true + 1)).astype(np.int64)
    probability = np.full(len(positive), np.nan) if ranks.p_match is None else ranks.p_match
    columns = [
        [method] * len(query),
        query.frames,
        query.names or [None] * len(query),
        *of_map(ranks.top_row),
        pa.array(ranks.top_score, mask=~answered),
        pa.array(probability.astype(np.float32), mask=np.isnan(probability)),
        pa.array([one or None for one in ranks.evidence or [""] * len(query)], pa.string()),
        pa.array(ranks.top_true > 0.5, mask=~positive),
        pa.array(rank, mask=~ranks.true_given),
        *of_map(ranks.true_row),
    ]
    return pa.table(dict(zip(COLUMNS.names, columns, strict=True)), schema=COLUMNS)


def write_answers(tables: Sequence[pa.Table], folder: Path | None) -> pa.Table:
    """All answers in one table; written as answers.csv where a folder is given."""
    table = pa.concat_tables(tables)
    if folder is not None:
        with replacing(folder / "answers.csv") as stream:
            csv.write_csv(table, stream)
    return table


def file_stem(number: int, name: str) -> str:
    """Part of the name of a file about a method: the number makes it unique where the allowed letters do not."""
    return f"{number:02d}-{re.sub(r'[^A-Za-z0-9.=+-]+', '_', Path(name).name)[:80]}"
