"""The rows of the ledger as the page's script sorts and filters them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from vplog.results.report import TAKEN

if TYPE_CHECKING:
    from vplog.data import Floats
    from vplog.results.report.content import Content

_MOST_ROWS = 20_000
"""Rows in the page: 1.5 MB. Accepted ones first, then by score; the table file has them all."""


def ledger(content: Content, pictures: list[int]) -> dict[str, Any] | None:
    """Columns and rows as JSON, None without candidates; `pictures` are the rows that have one in the page."""
    if not len(content.closures):
        return None
    rows = _chosen(content)
    columns = _columns(content, rows)
    return {
        "columns": list(columns),
        "rows": list(map(list, zip(*columns.values(), strict=True))),
        "pictures": pictures,
        "kept": [verdict.value for verdict in TAKEN],
    }


def _columns(content: Content, rows: list[int]) -> dict[str, list[Any]]:
    """Values of these rows by the name of their column; those of the truth beside the verdict, in view on a phone."""
    closures, judged = content.closures, content.judged
    columns: dict[str, list[Any]] = {"row": rows, "verdict": [closures.verdict[row].value for row in rows]}
    if judged is not None and judged.true is not None and judged.known is not None:
        true = np.where(judged.true, "yes", "no")[rows].tolist()
        columns["true"] = [one if known else None for one, known in zip(true, judged.known[rows], strict=True)]
        if judged.at_place is not None:
            columns["same place"] = ["yes" if one else None for one in judged.at_place[rows].tolist()]
    reverse = closures.reverse_inliers[rows].tolist()
    return columns | {
        "query": closures.query[rows].tolist(),
        "match": closures.match[rows].tolist(),
        "rank": closures.rank[rows].tolist(),
        "score": _rounded(closures.score[rows], 4),
        "support": closures.support[rows].tolist(),
        "matches": closures.matches[rows].tolist(),
        "inliers": closures.inliers[rows].tolist(),
        "reverse inliers": [value if value >= 0 else None for value in reverse],
        "spread": _rounded(closures.spread[rows], 3),
        "metres": _rounded(np.linalg.norm(closures.match_from_query[rows, :3, 3], axis=1), 2),
        "sigma before": _rounded(closures.residual_before[rows], 2),
        "sigma after": _rounded(closures.residual_after[rows], 2),
        "weight": _rounded(closures.weight[rows], 3),
    }


def _chosen(content: Content) -> list[int]:
    closures = content.closures
    if len(closures) <= _MOST_ROWS:
        return list(range(len(closures)))
    order = np.lexsort((-closures.score.astype(np.float64), ~closures.of(*TAKEN)))
    return sorted(order[:_MOST_ROWS].tolist())


def _rounded(values: Floats | Any, digits: int) -> list[float | None]:
    """What JSON can hold: null where a value is not known."""
    return [round(value, digits) if np.isfinite(value) else None for value in values.astype(np.float64).tolist()]
