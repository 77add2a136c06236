"""Clock steps of header stamps, found against the log times and removed.

The log time is late by the transport but steady: between two messages of a topic both should advance alike, and their
difference, the offset, stays at one level.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from vplog.data import Ints

LEAST_JUMP_NS = 1_000_000_000
"""ns; their difference changes by less than a second when a computer is busy, and by hours when a clock is set."""
LATE_NS = 2_000_000_000
"""ns that messages may be later than others of the log: slow estimators, and links that send again what was lost."""
_PERIODS = 10
"""A jump is also longer than so many periods of the topic: slow topics may be late by one."""
_LEAST_RUN = 5
"""Messages of one clock in a row; fewer are damaged stamps, not a clock that was set."""
STEP_PERIODS = 3
"""A step back is at least so many periods of the topic: less is within what messages come out of order by."""
_LEVEL = 30
"""Messages before and behind a step by which the offset is known: a burst is over by then."""
LEAST_STEP_NS = 128_000_000
"""ns; a smaller offset NTP slews, a larger one it steps (RFC 5905, STEPT)."""
GAP_NS = 10**9
"""ns without a message that count as a gap, where it is also GAP_PERIODS of the topic's own."""
GAP_PERIODS = 10
LONGEST_PAUSE_NS = 3600 * 10**9
"""Longest time in ns between two parts of one drive: odometry is seldom kept running through a longer pause."""
_SHORT = 10
"""Small steps count as clock steps where less than a tenth of the messages are in runs too short to show a clock."""
_NEAR = 4
"""Neighbours of a short run whose clock it may be on: reordered messages at a step make a few short runs."""
_MOST_CLOCKS = 20
"""A clock is set a few times in a drive; what jumps to more values than these is none."""


@dataclass(frozen=True)
class Clock:
    """The clock of a topic's header stamps, by the log times, and the time its stamps cover."""

    offset_ns: int
    """Log time less header stamp, the median."""
    first_ns: int
    last_ns: int


@dataclass(frozen=True, eq=False)
class AlignedStamps:
    """Stamps of one topic on one clock."""

    stamp_ns: Ints
    """(M,) in file order."""
    valid: np.ndarray
    """(M,) bool, false for outliers, whose time is not known."""
    offset_ns: int
    """Offset of the clock that all are on."""
    jumps_ns: list[int]
    """By how much the header's clock was set each time; the stamps behind are shifted back by as much."""
    log_jumps: int
    """Times that the recorder's clock was set; the stamps are right without it."""
    unclear_ns: list[int]
    """By how much the offset changes over gaps, where the clock may have been set or the messages be later since."""
    counts: dict[int, int]
    """Messages by the offset of the clock that they came on."""


def align_clock(header_ns: Ints, log_ns: Ints, reference_ns: int | None = None) -> AlignedStamps | None:
    """The header stamps without jumps of their clock; None where they follow no clock. Both (M,) in ns, M >= 1. Of
    several clocks, `reference_ns` is the offset of the one to end on; None takes that of most messages."""
    step, log_step = np.diff(header_ns), np.diff(log_ns)
    period = float(np.median(np.minimum(np.abs(step), np.abs(log_step)))) if len(step) else 0.0
    jump_ns = max(LEAST_JUMP_NS, _PERIODS * period)
    # what steps without end, late messages for one, has no small steps
    found = _levels(header_ns, log_ns, LEAST_STEP_NS) or _levels(header_ns, log_ns, jump_ns)
    if found is None:
        return None
    runs, clocks, limit, unclear = found
    counts: Counter[int] = Counter()
    for run, clock in zip(runs, clocks, strict=True):
        if clock is not None:
            counts[clock] += run.stop - run.start
    chosen = max(counts, key=lambda offset: (counts[offset], -offset))
    if reference_ns is not None and len(counts) > 1:
        near = min(counts, key=lambda offset: (abs(offset - reference_ns), offset))
        chosen = near if abs(near - reference_ns) <= limit else reference_ns
    stamp_ns, valid = header_ns.copy(), np.zeros(len(header_ns), bool)
    for number, run in enumerate(runs):
        offset = _offset_of(int(np.median(log_ns[run] - header_ns[run])), clocks, number, limit)
        if offset is not None:
            shifted = [int(extreme) + offset - chosen for extreme in (header_ns[run].min(), header_ns[run].max())]
            valid[run] = min(shifted) >= 0 and max(shifted) < 2**63
            stamp_ns[run] += offset - chosen if valid[run.start] else 0
    order = [clock for clock in clocks if clock is not None]
    jumps = [before - behind for before, behind in pairwise(order) if before != behind]
    log_jumps = _log_jumps(header_ns, log_ns, jump_ns)
    return AlignedStamps(stamp_ns, valid, chosen, jumps, log_jumps, unclear, counts)


def _runs(header_ns: Ints, log_ns: Ints, least_ns: float) -> tuple[list[slice], set[int]]:
    """Messages between steps of the headers by `least_ns` or more that the log times do not take, and steps back; and
    the first message of each run that follows a gap."""
    step, log_step = np.diff(header_ns), np.diff(log_ns)
    size = np.abs(step - log_step)
    usual, log_usual = (float(np.median(one[one > 0])) if (one > 0).any() else 0.0 for one in (step, log_step))
    rows = np.flatnonzero((size > least_ns) & ((step < 0) | (2 * np.abs(step - usual) >= size))) + 1
    gaps = rows[(step[rows - 1] >= 0) & (2 * np.abs(log_step - log_usual) > size)[rows - 1]]
    return [slice(a, b) for a, b in pairwise([0, *rows.tolist(), len(header_ns)])], set(gaps.tolist())


def _levels(
    header_ns: Ints, log_ns: Ints, least_ns: float
) -> tuple[list[slice], list[int | None], float, list[int]] | None:
    """Runs of messages between steps of `least_ns` or more, the offset of the clock that each is on (None of runs too
    short to show one), half the least step, and the ns by which the offset changes over gaps by no more than messages
    may be late; None where the offset stays at no level. The clock of a run is another than that before where the
    offset stays at another level, by more than it varies."""
    runs, gaps = _runs(header_ns, log_ns, least_ns)
    offset, lengths = log_ns - header_ns, [run.stop - run.start for run in runs]
    least = min(_LEAST_RUN, max(lengths))
    if least_ns < LEAST_JUMP_NS and sum(length for length in lengths if length < least) * _SHORT > len(offset):
        return None
    levels: list[list[Ints]] = []
    sizes, unclear = [2 * max(LEAST_JUMP_NS, least_ns)], []
    place: list[int | None] = []
    for run in runs:
        own = offset[run]
        if len(own) < least:
            place.append(None)
            continue
        last = levels[-1][-1] if levels else own
        change = _change(last[-_LEVEL:], own[:_LEVEL])
        if not levels or abs(change) >= (LATE_NS if run.start in gaps else least_ns):
            sizes += [abs(change)] if levels else []
            levels.append([])
        elif abs(change) >= least_ns:
            unclear.append(int(change))
        elif abs(np.median(own) - np.median(last)) > max(least_ns, float(np.ptp(last))):
            return None
        levels[-1].append(own)
        place.append(len(levels) - 1)
    if len(levels) > _MOST_CLOCKS:
        return None
    clocks: list[int] = []
    for level in levels:
        median = int(np.median(np.concatenate(level)))
        clocks.append(next((known for known in clocks if abs(known - median) <= least_ns), median))
    return runs, [None if one is None else clocks[one] for one in place], min(sizes) / 2, unclear


def _change(before_ns: Ints, behind_ns: Ints) -> float:
    """By how much the median of the offset changes; 0 where it varies by as much."""
    low, level, high = np.transpose([np.quantile(window, (0.1, 0.5, 0.9)) for window in (before_ns, behind_ns)])
    change = float(level[1] - level[0])
    return change if abs(change) > 2 * float((high - low).max()) else 0.0


def _offset_of(own: int, clocks: list[int | None], number: int, limit: float) -> int | None:
    """The offset that a run is shifted by: that of its clock, or of a neighbouring one that it is late on; its own
    where the clock was set before and behind it; None for outliers."""
    clock = clocks[number]
    if clock is not None:
        return clock
    before = next((one for one in clocks[number::-1] if one is not None), None)
    behind = next((one for one in clocks[number:] if one is not None), None)
    nearby = [one for one in (before, behind, *clocks[max(number - _NEAR, 0) : number + _NEAR]) if one is not None]
    near = min(nearby, key=lambda one: (abs(own - one), one))
    if abs(own - near) <= limit:
        return near
    if min(nearby) < own < max(nearby):
        return own
    return near if 0 < own - near <= max(limit, LATE_NS) else None


def _log_jumps(header_ns: Ints, log_ns: Ints, limit: float) -> int:
    """The number of times that the recorder's clock was set while the headers' went on."""
    step, log_step = np.diff(header_ns), np.diff(log_ns)
    set_at = (
        np.flatnonzero((np.abs(step - log_step) > limit) & (np.abs(step) <= limit) & (np.abs(log_step) > limit)) + 1
    )
    least_ns = np.minimum.reduceat(log_ns - header_ns, np.append(0, set_at))  # the last of a burst is as late as ever
    return int((np.abs(np.diff(least_ns)) > limit).sum())
