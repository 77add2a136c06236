"""The ledger as a table that sorts by any column, its rows as data in the page."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import numpy as np

from vplog.data import Verdict
from vplog.results.report.parts import KEPT

if TYPE_CHECKING:
    from vplog.data import Floats
    from vplog.results.report.content import Content

_MOST_ROWS = 20_000
"""Rows in the page: 1.5 MB. Accepted ones first, then by score; the table file has them all."""


def ledger(content: Content, pictures: list[int]) -> str:
    """The table, its filter by verdict, and the data; `pictures` are the rows that have one in the page."""
    closures = content.closures
    if not len(closures):
        return "<p>Nothing was proposed.</p>"
    rows = _chosen(content)
    judged = content.judged
    columns: list[tuple[str, list[Any]]] = [
        ("row", rows),
        ("verdict", [closures.verdict[row].value for row in rows]),
        ("query", closures.query[rows].tolist()),
        ("match", closures.match[rows].tolist()),
        ("rank", closures.rank[rows].tolist()),
        ("score", _rounded(closures.score[rows], 4)),
        ("support", closures.support[rows].tolist()),
        ("matches", closures.matches[rows].tolist()),
        ("inliers", closures.inliers[rows].tolist()),
        ("other way", [value if value >= 0 else None for value in closures.reverse_inliers[rows].tolist()]),
        ("spread", _rounded(closures.spread[rows], 3)),
        ("metres", _rounded(np.linalg.norm(closures.match_from_query[rows, :3, 3], axis=1), 2)),
        ("sigma before", _rounded(closures.residual_before[rows], 2)),
        ("sigma after", _rounded(closures.residual_after[rows], 2)),
        ("weight", _rounded(closures.weight[rows], 3)),
    ]
    if judged is not None and judged.true is not None and judged.known is not None:
        told = np.where(judged.known, np.where(judged.true, "yes", "no"), "")
        columns.append(("true", [one or None for one in told[rows].tolist()]))
        if judged.at_place is not None:
            columns.append(("same place", ["yes" if one else None for one in judged.at_place[rows].tolist()]))
    heads = "".join(f'<th scope="col"><button type="button">{name}</button></th>' for name, _ in columns)
    kinds = [verdict.value for verdict in Verdict if verdict in closures.verdict]
    options = "".join(f'<option value="{kind}">{kind}</option>' for kind in kinds)
    missing = f" Of {len(closures)} candidates, {len(rows)} are in this page." if len(rows) < len(closures) else ""
    data = {
        "columns": [name for name, _ in columns],
        "rows": list(map(list, zip(*(values for _, values in columns), strict=True))),
        "pictures": pictures,
        "kept": [verdict.value for verdict in KEPT],
    }
    return (
        "<h3>The ledger</h3>\n"
        f'<p class="quiet">Every candidate. A heading sorts; a number that is a link leads to its picture.{missing} '
        f'<label>Verdict <select id="filter"><option value="">all</option>{options}</select></label> '
        '<span id="count"></span></p>\n<noscript><p>The table needs JavaScript; closures.parquet has the same '
        f'rows.</p></noscript>\n<div class="box tall"><table id="closures"><thead><tr>{heads}</tr></thead>'
        '<tbody id="rows"></tbody></table></div>\n<p><button type="button" id="more" hidden>More</button></p>\n'
        f'<script type="application/json" id="ledger">{_as_data(data)}</script>'
    )


def _chosen(content: Content) -> list[int]:
    closures = content.closures
    if len(closures) <= _MOST_ROWS:
        return list(range(len(closures)))
    accepted = np.array([verdict in KEPT for verdict in closures.verdict], bool)
    order = np.lexsort((-closures.score.astype(np.float64), ~accepted))
    return sorted(order[:_MOST_ROWS].tolist())


def _rounded(values: Floats | Any, digits: int) -> list[float | None]:
    """What JSON can hold: null where a value is not known."""
    return [round(value, digits) if np.isfinite(value) else None for value in values.astype(np.float64).tolist()]


def _as_data(tree: Any) -> str:
    """JSON that cannot end the script it stands in (html.spec.whatwg.org, 4.12.1.3)."""
    dense = json.dumps(tree, separators=(",", ":"), allow_nan=False)
    return dense.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")
