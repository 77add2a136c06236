"""Backward steps of the recorder's clock: found by the order of the file and undone in all topics.

A clock that was set back passes a time twice: the messages behind it fall between those before it. Parts of a recording
in another order do not overlap, and a part that was written twice holds the same messages. Where a clock was set back
into a gap the motion decides, which leads on from one message to the next in the order in which they were received.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import accumulate

import numpy as np

from vplog.data import Floats, Ints
from vplog.logs.clocks import GAP_NS, GAP_PERIODS, LONGEST_PAUSE_NS, STEP_PERIODS
from vplog.logs.formats.container import Notes
from vplog.logs.stamps import LAST_NS, Stamps

_ALTERNATIONS = 3
"""Turns from one side of a step to the other in the order of time that mere neighbours make: A B A B."""
_OVERLAP = 2
"""Turns beyond these, of all topics together, by which a time was passed twice; one message more makes two."""
_MOST_STEPS = 20
"""A clock is set a few times in a drive; times that go back more often are in no order."""
_AROUND = 10
"""Messages on either side of a step by which its speed is known."""
_LONGEST_GAP_NS = 10 * 10**9
"""ns; a way that takes longer at that speed is a jump of the poses."""
_FURTHEST_STEP = 3
"""Times nine tenths of the steps from one message to the next: a drive that goes on does not step further."""


@dataclass(frozen=True)
class _Drop:
    """A place where the log times of one topic go back."""

    before: int
    """Position in the file of the topic's last message before it."""
    behind: int
    period_ns: int
    back_ns: int
    """By how much the log times go back: less than the clock was set back by, as time passed."""
    elapsed_ns: int
    """Time between the two messages in ns, by the header stamps or the period."""
    moved_ns: int
    """Time between them in ns by the motion over the step; 0 if unknown."""
    overlap: int
    """Turns from one side to the other beyond those of neighbours."""
    continuous: bool
    """The motion leads on over it in the order of the file and not in that of time, or no drive pauses for so long."""


def correct_clock_steps(topics: Iterable[Stamps], notes: Notes) -> None:
    """Shift all log times behind each step back of the recorder's clock on by its size."""
    topics = [one for one in topics if len(one.log_ns)]
    drops = sorted((drop for one in topics for drop in _drops(one)), key=lambda drop: drop.before)
    behind = [*accumulate((drop.behind for drop in reversed(drops)), min)][::-1]
    steps: list[tuple[int, int]] = []
    start = 0
    while start < len(drops):  # all topics go back at the same place: each group has its first message behind
        position = behind[start]
        stop = max(bisect_left(drops, position, key=lambda drop: drop.before), start + 1)  # a path has one position
        group, start = drops[start:stop], stop
        if sum(drop.overlap for drop in group) >= _OVERLAP or any(drop.continuous for drop in group):
            fastest = min(group, key=lambda drop: (drop.period_ns, drop.elapsed_ns, drop.behind))
            sizes = (drop.back_ns + drop.moved_ns for drop in group)
            steps.append((position, max(fastest.back_ns + fastest.elapsed_ns, *sizes)))
    if not 0 < len(steps) <= _MOST_STEPS or sum(size_ns for _, size_ns in steps) > LAST_NS:
        return  # a forged time steps further than any clock
    positions, sizes = np.transpose(np.array(steps, np.int64))
    total_ns = np.append(0, np.cumsum(sizes))
    for one in topics:
        one.shift_log_times(total_ns[np.searchsorted(positions, one.positions(), "right")])
    for size_ns in sizes.tolist():
        notes.add(
            f"The recorder's clock was set back by {size_ns / 1e9:.3f} s; the log times from there on are shifted by "
            "as much."
        )


def _drops(one: Stamps) -> list[_Drop]:
    """Where the log times of a topic go back by more than messages come out of order by."""
    log_ns, header_ns, positions = np.array(one.log_ns, np.int64), np.array(one.header_ns, np.int64), one.positions()
    step = np.diff(log_ns)
    back = step < 0
    if not back.any() or not (step > 0).any():  # nearly always
        return []
    period = int(np.median(step[step > 0]))
    rows = np.flatnonzero(-step > (STEP_PERIODS - 1) * period) + 1
    if len(rows) > _MOST_STEPS:
        return []
    gaps = np.flatnonzero(step > max(GAP_NS, GAP_PERIODS * period)) + 1
    bounds = np.unique([0, *rows.tolist(), *gaps.tolist(), len(log_ns)])
    found = []
    for row in rows.tolist():
        at = int(np.searchsorted(bounds, row))
        behind = np.arange(row, bounds[at + 1])
        first_ns, last_ns = log_ns[behind].min(), log_ns[behind].max()
        before = np.flatnonzero((log_ns[:row] >= first_ns) & (log_ns[:row] <= last_ns))
        behind = behind[~_duplicates(one, log_ns, header_ns, before, behind)]
        elapsed = int(header_ns[row] - header_ns[row - 1])  # by a header's clock that went on
        found.append(
            _Drop(
                int(positions[row - 1]), int(positions[row]), period,
                -int(step[row - 1]), elapsed if elapsed > 0 else period,
                0 if elapsed > 0 or one.xyz_m is None else _time_by_motion(one.xyz_m, row, period),
                max(_alternations(log_ns[before], log_ns[behind]) - _ALTERNATIONS, 0),
                last_ns < log_ns[:row].min() - LONGEST_PAUSE_NS or _is_continuous(log_ns, one.xyz_m, row),
            )
        )  # fmt: skip
    return found


def _time_by_motion(xyz_m: Floats, row: int, period_ns: int) -> int:
    """How long the way from the row before takes at the speed around it, in ns; 0 where that is a jump, no motion."""
    near = slice(max(row - _AROUND, 0), row + _AROUND)
    step_m = np.linalg.norm(np.diff(xyz_m[near], axis=0), axis=1)
    usual_m = float(np.median(step_m[step_m > 0])) if step_m.any() else np.inf
    elapsed_ns = int(period_ns * np.linalg.norm(xyz_m[row] - xyz_m[row - 1]) / usual_m)
    return elapsed_ns if elapsed_ns < _LONGEST_GAP_NS else 0


def _duplicates(one: Stamps, log_ns: Ints, header_ns: Ints, before: Ints, behind: Ints) -> np.ndarray:
    """Which messages behind a step duplicate one before it, by times and position."""
    numbers = [log_ns, header_ns] if one.xyz_m is None else [log_ns, header_ns, *one.xyz_m.T.copy().view(np.int64)]
    rows = np.concatenate([before, behind])
    _, first, inverse = np.unique(
        np.stack([each[rows] for each in numbers]), axis=1, return_index=True, return_inverse=True
    )
    return first[inverse.ravel()[len(before) :]] < len(before)


def _alternations(before_ns: Ints, behind_ns: Ints) -> int:
    """The number of times that messages in order of time change from one side of a step to the other."""
    side = np.repeat([False, True], [len(before_ns), len(behind_ns)])
    return int((np.diff(side[np.argsort(np.concatenate([before_ns, behind_ns]), kind="stable")]) != 0).sum())


def _is_continuous(log_ns: Ints, xyz_m: Floats | None, row: int) -> bool:
    """Whether the motion goes on from the row before, and would jump at this row in the order of time."""
    if xyz_m is None:
        return False
    step_m = np.linalg.norm(np.diff(xyz_m, axis=0), axis=1)
    limit = _FURTHEST_STEP * float(np.quantile(step_m, 0.9))
    earlier = np.flatnonzero(log_ns < log_ns[row])
    last = earlier[np.argmax(log_ns[earlier])] if len(earlier) else None
    apart = last is None or float(np.linalg.norm(xyz_m[row] - xyz_m[last])) > limit
    return bool(step_m[row - 1] <= limit) and apart
