"""Recognition of a library's references by each other: evidence on recognition that needs no truth.

A reference is recognised where, of all others, one that its drive passed just before or after explains it most. In a
tower of equal storeys that is seldom so, and patches, which see the layout, are misled more often than keypoints.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from vplog.data import Bools, Floats, Ints, Reference
from vplog.execution.execution import Execution
from vplog.places.matches import PATCH_WEIGHT, WeighedMatchSettings, index_references
from vplog.places.reference_choice import PAPER_SIZE, LibrarySettings, choose

RECOGNISED = 0.8
"""Share of recognised references from which on they are enough. A drive that comes back to a part of its way has
.92 to 1 of them by a hundred references, where the other pass counts as a miss; a tower of storeys has .45, and .72 by
all of its frames."""
MOST = 16 * PAPER_SIZE
"""Largest number of references that is taken unasked: their features are 80 MB, and indexed in a minute."""
_NEAR = 2
"""References before and after one that count as its neighbours: a random choice leaves gaps in between."""
_AROUND = 25, 50, 100
"""References before and after one whose evidence on patches is taken together, as many as tell most: few where a drive
or storey ends and another begins, many where each tells little."""
_SAME_PLACE = 0.5
"""Share of the keypoints' votes for the best neighbour with which another reference may show the same place."""
_SIGNIFICANT = 1.645
"""Standard deviations that chance exceeds in one of twenty cases."""
_STRONGEST = 200
"""Keypoints that count for a library's size: half of what describes a place, for half of the time."""
NO_IMAGE = np.zeros((1, 1), np.uint8)
"""In place of a reference's image, where its features are all that counts."""


def neighbours(references: Sequence[Reference], reach: int = _NEAR) -> Bools:
    """(L, L) pairs of one drive that are at most `reach` stamps of references apart, none with itself."""
    near = np.zeros((len(references), len(references)), bool)
    names = np.array([one.drive for one in references])
    for name in np.unique(names):
        rows = np.flatnonzero(names == name)
        _, order = np.unique([references[row].stamp_ns for row in rows.tolist()], return_inverse=True)
        near[np.ix_(rows, rows)] = np.abs(order[:, None] - order) <= reach
    np.fill_diagonal(near, False)
    return near


def margin(votes: Floats, near: Bools, place: Bools | None = None) -> Floats:
    """(L,) by how much the best neighbour explains a reference better than the best stranger does, -1..1 of their sum.

    A reference is recognised where that is positive. An image's votes (L, L) for itself do not count; strangers are
    those that are not of the same `place`, by default all but the neighbours.
    """
    others = np.where(np.eye(len(votes), dtype=bool), 0.0, votes)
    neighbour = np.where(near, others, 0.0).max(axis=1)
    stranger = np.where(near if place is None else place, 0.0, others).max(axis=1)
    return (neighbour - stranger) / np.maximum(neighbour + stranger, 1e-9)


def misleading_patches(keypoints: Floats, patches: Floats, references: Sequence[Reference]) -> Bools:
    """(L,) references around which significantly fewer are recognised with patches than without (McNemar's test), and
    with less margin, by the (L, L) votes of each kind.

    Of several drives in one map each is decided by itself: another may show the same places in other light, where
    patches alone find them. Nor is a reference a stranger that keypoints find: it may show the place on the way back.
    """
    near, names = neighbours(references), np.array([one.drive for one in references])
    neighbour = np.where(near, keypoints, 0.0).max(axis=1, keepdims=True)
    again = (keypoints > 0) & (keypoints >= _SAME_PLACE * neighbour)
    place = near | again | (names[:, None] != names)
    without, together = margin(keypoints, near, place), margin(keypoints + PATCH_WEIGHT * patches, near, place)
    gain, change = together - without, (np.sign(together) - np.sign(without)) / 2.0
    most, less = np.zeros(len(near)), np.zeros(len(near), bool)
    for reach in _AROUND:
        around = neighbours(references, reach) | np.eye(len(near), dtype=bool)
        mean, lost, changed = (np.where(around, one, 0.0).sum(axis=1) for one in (gain, -change, np.abs(change)))
        errors = np.sign(lost) * np.maximum(np.abs(lost) - 1.0, 0.0) / np.sqrt(np.maximum(changed, 1.0))
        most = np.where(np.abs(errors) > np.abs(most), errors, most)
        less = mean < 0.0 if reach == _AROUND[0] else less
    return less & (most > _SIGNIFICANT)


def recognised_shares(references: Sequence[Reference], execution: Execution) -> dict[str, float]:
    """Share of each drive's references that are recognised by their keypoints; none where they have none."""
    if not any(len(one.features) for one in references):
        return {}
    matcher = index_references(references, WeighedMatchSettings(features=_STRONGEST, patch_weight=0.0))
    votes = execution.map(lambda one: matcher.match(one.features, (1.0, 0.0)).votes(), matcher.references)
    found, drives = margin(np.array(list(votes)), neighbours(references)) > 0, np.array([r.drive for r in references])
    return {name: float(found[drives == name].mean()) for name in np.unique(drives).tolist()}


def add_until_enough(
    rows: Ints, stamp_ns: Ints, settings: LibrarySettings, most: int, reference: Callable[[int], Reference],
    execution: Execution,
) -> Ints:  # fmt: skip
    """Rows, increasing, of the frames with these stamps (N,) that become references: those given, and twice as many, as
    long as they recognise each other too seldom, up to `most`."""
    most = min(most, MOST)
    while len(rows) < most and lacking([reference(row) for row in rows.tolist()], execution):
        rows = np.union1d(rows, further(stamp_ns, rows, settings, min(len(rows), most - len(rows))))
    return rows


def lacking(references: Sequence[Reference], execution: Execution) -> set[str]:
    """Drives of which so few references are recognised that more are needed."""
    return {drive for drive, share in recognised_shares(references, execution).items() if share < RECOGNISED}


def further(stamp_ns: Ints, rows: Ints, settings: LibrarySettings, count: int) -> Ints:
    """`count` rows more, increasing, of frames with these stamps (N,), chosen among the others as the first were."""
    rest = np.setdiff1d(np.arange(len(stamp_ns)), rows)
    return rest[choose(stamp_ns[rest], settings.model_copy(update={"size": count}))] if count > 0 else rest[:0]
