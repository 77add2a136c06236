"""Backward steps of the recorder's clock, found by the order of the file and removed from the log times of all topics.

A clock that was set back passes a time twice, so messages after the step lie between those before it. Parts of a
recording in another order do not overlap, and a part that was written twice contains the same messages. If a clock was
set back into a gap, the motion continues in the order of the file and jumps in the order of time.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterable
from itertools import accumulate
from typing import NamedTuple

import numpy as np

from vplog.data import Bools, Floats, Ints
from vplog.logs.clocks import LAST_NS, MAX_STEPS, OUTLIER_FACTOR, SECOND_NS
from vplog.logs.formats.container import Notes
from vplog.logs.stamps import Stamps

LONGEST_PAUSE_NS = 3600 * SECOND_NS
"""Longest pause between two parts of one drive: odometry is seldom kept running through a longer one."""
_NEIGHBOURS = 3
"""Steps back, in periods, and changes between both sides of a step, in messages, that neighbours which changed places
cause. Motion goes on if it is at most as many times longer than 90 % of the drive's steps."""


class _Drop(NamedTuple):
    """A place where the log times of one topic go back."""

    before: int
    """Position in the file of the last message before it."""
    after: int
    period_ns: int
    size_ns: int
    """By how much the clock was set back: by how much the log times go back, and the time that passed."""
    size_by_motion_ns: int
    """The same if the motion measures the time that passed, else 0."""
    overlap: int
    """Number of changes between both sides in the order of time that no neighbours which changed places cause."""
    is_continuous: bool
    """Whether the motion goes on, or no drive pauses for as long."""


def correct_clock_steps(topics: Iterable[Stamps], notes: Notes) -> None:
    """Shift all log times after each backward step of the recorder's clock forward by its size."""
    topics = [topic for topic in topics if len(topic.log_ns)]
    drops = sorted(drop for topic in topics for drop in _drops(topic))
    positions_after = [*accumulate((drop.after for drop in reversed(drops)), min)][::-1]
    steps = list[tuple[int, int]]()
    start = 0
    while start < len(drops):  # all topics go back at the same place, so a group shares its first message after it
        position = positions_after[start]
        stop = max(bisect_left(drops, position, key=lambda drop: drop.before), start + 1)  # a path has one position
        group, start = drops[start:stop], stop
        # one message more between neighbours makes two changes
        if sum(drop.overlap for drop in group) >= 2 or any(drop.is_continuous for drop in group):
            fastest = min(group, key=lambda drop: drop.period_ns)
            steps.append((position, max(fastest.size_ns, *(drop.size_by_motion_ns for drop in group))))
    if not 0 < len(steps) <= MAX_STEPS or sum(size_ns for _, size_ns in steps) > LAST_NS:
        return  # a forged time steps further than any clock
    positions, sizes_ns = np.transpose(np.array(steps, np.int64))
    total_ns = np.append(0, np.cumsum(sizes_ns))
    for topic in topics:
        topic.shift_log_times(total_ns[np.searchsorted(positions, topic.positions(), "right")])
    for size_ns in sizes_ns.tolist():
        notes.add(
            f"The recorder's clock was set back by {size_ns / 1e9:.3f} s; the log times from there on are shifted by "
            "as much."
        )


def _drops(topic: Stamps) -> list[_Drop]:
    """Return the places where the log times of a topic go back further than messages come out of order."""
    log_ns, header_ns, positions = (
        np.array(topic.log_ns, np.int64),
        np.array(topic.header_ns, np.int64),
        topic.positions(),
    )
    steps = np.diff(log_ns)
    if not (steps < 0).any() or not (steps > 0).any():
        return []
    period_ns = int(np.median(steps[steps > 0]))
    rows = np.flatnonzero(-steps >= _NEIGHBOURS * period_ns) + 1
    if len(rows) > MAX_STEPS:
        return []
    gaps = np.flatnonzero(steps > max(SECOND_NS, OUTLIER_FACTOR * period_ns)) + 1
    bounds = np.append(np.union1d(rows, gaps), len(log_ns))
    drops = []
    for row in rows.tolist():
        after = np.arange(row, bounds[np.searchsorted(bounds, row, "right")])
        first_ns, last_ns = log_ns[after].min(), log_ns[after].max()
        before = np.flatnonzero((log_ns[:row] >= first_ns) & (log_ns[:row] <= last_ns))
        after = after[~_are_duplicates(topic, before, after)]
        changes = np.diff(np.argsort(np.append(log_ns[before], log_ns[after]), kind="stable") < len(before))
        back_ns, elapsed_ns = -int(steps[row - 1]), int(header_ns[row] - header_ns[row - 1])
        by_motion_ns = 0
        if elapsed_ns <= 0:  # the header's clock was set back as well
            elapsed_ns, by_motion_ns = period_ns, back_ns + _time_by_motion(topic.xyz_m, row, period_ns)
        is_continuous = last_ns < log_ns[:row].min() - LONGEST_PAUSE_NS or _is_continuous(log_ns, topic.xyz_m, row)
        drops.append(
            _Drop(
                int(positions[row - 1]), int(positions[row]), period_ns, back_ns + elapsed_ns, by_motion_ns,
                max(int(changes.sum()) - _NEIGHBOURS, 0), is_continuous,
            )
        )  # fmt: skip
    return drops


def _are_duplicates(topic: Stamps, before: Ints, after: Ints) -> Bools:
    """Return which rows `after` a step repeat the times and the position of a row `before` it."""
    rows = np.append(before, after)
    columns = [np.array(topic.log_ns, np.int64)[rows], np.array(topic.header_ns, np.int64)[rows]]
    if topic.xyz_m is not None:
        columns += [*topic.xyz_m[rows].T.copy().view(np.int64)]
    _, first, inverse = np.unique(np.stack(columns), axis=1, return_index=True, return_inverse=True)
    return first[inverse.ravel()[len(before) :]] < len(before)


def _time_by_motion(xyz_m: Floats | None, row: int, period_ns: int) -> int:
    """Return the ns that the motion to this row takes at the speed around it, or 0 if it is unknown or a jump."""
    if xyz_m is None:
        return 0
    steps_m = np.linalg.norm(np.diff(xyz_m[max(row - OUTLIER_FACTOR, 0) : row + OUTLIER_FACTOR], axis=0), axis=1)
    usual_m = float(np.median(steps_m[steps_m > 0])) if steps_m.any() else np.inf
    elapsed_ns = int(period_ns * np.linalg.norm(xyz_m[row] - xyz_m[row - 1]) / usual_m)
    return elapsed_ns if elapsed_ns < OUTLIER_FACTOR * SECOND_NS else 0


def _is_continuous(log_ns: Ints, xyz_m: Floats | None, row: int) -> bool:
    """Return whether the motion goes on from the row before, and would jump to this row in the order of time."""
    if xyz_m is None:
        return False
    steps_m = np.linalg.norm(np.diff(xyz_m, axis=0), axis=1)
    longest_m = _NEIGHBOURS * float(np.quantile(steps_m, 0.9))
    earlier = np.flatnonzero(log_ns < log_ns[row])
    previous = earlier[np.argmax(log_ns[earlier])] if len(earlier) else None
    jumps = previous is None or float(np.linalg.norm(xyz_m[row] - xyz_m[previous])) > longest_m
    return bool(steps_m[row - 1] <= longest_m) and jumps
