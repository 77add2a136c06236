"""Whether the lines that sequences run along are those of the truth."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vplog.places.vocabulary import spread_rows

if TYPE_CHECKING:
    from vplog.evaluate.pairs import Pairs
    from vplog.places.sequence import SequenceSettings

_TRIED = 200
"""Queries that are looked at, spread evenly: a share of a half is then known within 7 % (two sigmas)."""
_OFF_ROWS = 1
"""Rows that a view may lie off the line: lines are rounded to rows."""


def sequence_warning(pairs: Pairs, settings: SequenceSettings, has_truth: bool) -> list[str]:
    """A sentence where most windows of the truth hold few true pairs on any line that is tried, or end off it, or
    nothing is known of it; none where sequences fit."""
    length = f"--sequence {settings.length}"
    if settings.length == 1:
        return []
    if not has_truth:
        return [f"{length} assumes that query and map advance alike, frame by frame; only a truth checks that."]
    queries = np.flatnonzero(pairs.positive)
    queries = queries[spread_rows(len(queries), _TRIED)]
    shares = np.array(
        [share for query in queries.tolist() if (share := _on_a_line(pairs, query, settings)) is not None]
    )
    ratio = _rows_a_view(pairs)
    off = 0.0 if ratio is None else max(settings.slowest - ratio, ratio - settings.fastest, 0.0)
    off *= settings.length // 2
    wide = float(np.median(pairs.stop - pairs.first)) / 2 if len(pairs.first) else 0.0
    if not len(shares) or (np.median(shares) >= 0.5 and off <= _OFF_ROWS + wide):
        return []
    advance = "run back or jump" if ratio is None else f"advance by {ratio:.2g} frames of the map a frame of the query"
    remedy = "Leave --sequence out"
    if ratio is not None and 0.1 <= ratio <= 9:
        remedy += f", or set sequence.slowest={0.9 * ratio:.2g} and sequence.fastest={1.1 * ratio:.2g}"
    tried = f"{settings.slowest:g} to {settings.fastest:g}"
    return [
        f"{length} harms here: true matches {advance}, and lines of {tried} are tried. In half of the windows "
        f"{np.median(shares):.0%} of the views or fewer are within a frame of such a line. {remedy}."
    ]


def _on_a_line(pairs: Pairs, query: int, settings: SequenceSettings) -> float | None:
    """Largest share of the other views of a window that lie on one line through a true row of its middle, of those with
    a true row; None where no other has one."""
    half = settings.length // 2
    views = [view for view in range(query - half, query + half + 1) if 0 <= view < len(pairs) and view != query]
    true = {view: rows for view in views if len(rows := pairs.rows(view))}
    if not true:
        return None
    runs = slice(pairs.start[query], pairs.start[query + 1])
    middles = (pairs.first[runs] + pairs.stop[runs] - 1) // 2
    best = 0
    for line in settings.offsets():
        for middle in middles.tolist():
            at = ((view, middle + line[view - query + half]) for view in true)
            best = max(best, sum(np.abs(true[view] - row).min() <= _OFF_ROWS for view, row in at))
    return best / len(true)


def _rows_a_view(pairs: Pairs) -> float | None:
    """Median rows that the first true run advances from a view to the next; None where it is no advance."""
    queries = np.flatnonzero(pairs.positive)
    first = pairs.start[queries]
    middle = (pairs.first[first] + pairs.stop[first] - 1) / 2
    steps = np.diff(middle)[np.diff(queries) == 1]
    ratio = float(np.median(steps)) if len(steps) else 0.0
    return ratio if ratio > 0 and np.mean(np.abs(steps - ratio) <= max(0.5 * ratio, 1.0)) >= 0.5 else None
