"""How well the references of a library are recognised by each other: evidence on recognition that needs no truth.

A reference is recognised where, of all others, one that its drive passed just before or after explains it most. In a
tower of equal storeys that is seldom so, and patches, which see the layout, are misled more often than keypoints.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
import scipy

from vplog.data import Bools, Floats, Ints, Reference
from vplog.places.matches import PATCH_WEIGHT, WeighedMatchSettings, index_references
from vplog.places.reference_choice import PAPER_SIZE, LibrarySettings, choose

if TYPE_CHECKING:
    from vplog.execution.execution import Execution

RECOGNISED = 0.8
"""Share of recognised references from which on they are enough. A drive that comes back to a part of its way has
.92 to 1 of them by a hundred references, where the other pass counts as a miss; a tower of storeys has .45, and .72 by
all of its frames."""
MOST = 16 * PAPER_SIZE
"""Largest number of references that is taken unasked: their features are 80 MB, and indexed in a minute."""
_NEAR = 2
"""References before and after one that count as its neighbours: a random choice leaves gaps in between."""
_SIGNIFICANT = 0.05
"""Level of the test that patches mislead."""
_STRONGEST = 200
"""Keypoints that count for a library's size: half of what describes a place, for half of the time."""
NO_IMAGE = np.zeros((1, 1), np.uint8)
"""In place of a reference's image, where its features are all that counts."""


def neighbours(references: Sequence[Reference]) -> Bools:
    """(L, L) pairs of one drive that are at most two stamps of references apart, none with itself."""
    near = np.zeros((len(references), len(references)), bool)
    names = np.array([one.drive for one in references])
    for name in np.unique(names):
        rows = np.flatnonzero(names == name)
        _, order = np.unique([references[row].stamp_ns for row in rows.tolist()], return_inverse=True)
        near[np.ix_(rows, rows)] = np.abs(order[:, None] - order) <= _NEAR
    np.fill_diagonal(near, False)
    return near


def recognised(votes: Floats, near: Bools) -> Bools:
    """(L,) references that most `votes` (L, L) of go to a neighbour; an image's votes for itself do not count."""
    others = np.where(np.eye(len(votes), dtype=bool), 0.0, votes)
    best = np.arange(len(votes)), others.argmax(axis=1)
    return near[best] & (others[best] > 0)


def patches_mislead(keypoints: Floats, patches: Floats, references: Sequence[Reference]) -> bool:
    """Whether significantly fewer references are recognised with patches than without, by the (L, L) votes of each
    kind: McNemar's test in its exact form, on the references that one of the two recognises alone."""
    near = neighbours(references)
    without, together = recognised(keypoints, near), recognised(keypoints + PATCH_WEIGHT * patches, near)
    lost, gained = int((without & ~together).sum()), int((together & ~without).sum())
    return bool(lost > gained and scipy.special.bdtrc(lost - 1, lost + gained, 0.5) < _SIGNIFICANT)


def recognised_share(references: Sequence[Reference], execution: Execution) -> float:
    """Share of references that are recognised by their keypoints; 1 where they have none."""
    if not any(len(one.features) for one in references):
        return 1.0
    matcher = index_references(references, WeighedMatchSettings(features=_STRONGEST, patch_weight=0.0))
    votes = execution.map(lambda one: matcher.match(one.features, (1.0, 0.0)).votes(), matcher.references)
    return float(recognised(np.array(list(votes)), neighbours(references)).mean())


def add_until_enough(
    rows: Ints, stamp_ns: Ints, settings: LibrarySettings, most: int, reference: Callable[[int], Reference],
    execution: Execution,
) -> Ints:  # fmt: skip
    """Rows, increasing, of the frames with these stamps (N,) that become references: those given, and twice as many, as
    long as they recognise each other too seldom, up to `most`."""
    most = min(most, MOST)
    while len(rows) < most and not suffices([reference(row) for row in rows.tolist()], execution):
        rows = np.union1d(rows, further(stamp_ns, rows, settings, min(len(rows), most - len(rows))))
    return rows


def suffices(references: Sequence[Reference], execution: Execution) -> bool:
    """Whether so many references recognise each other that more are not needed."""
    return recognised_share(references, execution) >= RECOGNISED


def further(stamp_ns: Ints, rows: Ints, settings: LibrarySettings, count: int) -> Ints:
    """`count` rows more, increasing, of frames with these stamps (N,), chosen among the others as the first were."""
    rest = np.setdiff1d(np.arange(len(stamp_ns)), rows)
    return rest[choose(stamp_ns[rest], settings.model_copy(update={"size": count}))] if count > 0 else rest[:0]
