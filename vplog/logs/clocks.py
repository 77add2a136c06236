"""Header stamps against log times: which of the two jumped, and what the stamps are without the jump.

A header stamp says when something was measured, and aligns topics; but clocks are set while a drive runs, simulations
start again at zero, and single stamps are damaged. The log time is late by the transport but steady, so it is the
check: between two messages of a topic both should advance alike. A clock that is set back shows by itself: it passes
the same time twice, so that messages lie twice as close there, which those that only come out of order do not.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from vplog.data import Floats, Ints

LEAST_JUMP_NS = 1_000_000_000
"""ns; stamps and log times part by less than a second when a computer is busy, and by hours when a clock is set."""
LATE_NS = 2_000_000_000
"""ns that messages may be later than others of the log: slow estimators, and links that send again what was lost."""
_PERIODS = 10
"""A jump is also longer than so many periods of the topic: slow topics may be late by one."""
_LEAST_RUN = 5
"""Messages of one clock in a row; fewer are damaged stamps, not a clock that was set."""
_STEP_PERIODS = 3
"""A step back is at least so many periods of the topic: less is within what messages come out of order by."""
_LEVEL = 30
"""Messages before and behind a step by which the skew is known: a burst is over by then."""
_TWICE = 1.5
"""Messages of a time that was passed twice, against those of one that was passed once: between 1 and 2."""
_ONWARD = 3
"""Times nine tenths of the steps from one message to the next: a drive that goes on does not step further."""
_MOST_CLOCKS = 20
"""A clock is set a few times in a drive; what jumps to more values than these is none."""


@dataclass(frozen=True)
class Clock:
    """The clock of a topic's header stamps, by the log times, and the time its stamps cover."""

    skew_ns: int
    """Log time less header stamp, the median."""
    first_ns: int
    last_ns: int


@dataclass(frozen=True, eq=False)
class Repaired:
    """Stamps of one topic on one clock."""

    stamp_ns: Ints
    """(M,) in file order."""
    kept: np.ndarray
    """(M,) bool, false where a stamp is far from those beside it, so that its time is not known."""
    skew_ns: int
    """Of the clock that all are on."""
    jumps_ns: list[int]
    """By how much the header's clock was set each time; the stamps behind are shifted back by as much."""
    log_jumps: int
    """Times that the recorder's clock was set; the stamps are right without it."""
    counts: dict[int, int]
    """Messages by the skew of the clock that they came on."""


def steps_back(times_ns: Ints, other_ns: Ints, content: Floats | None = None) -> tuple[Ints, Ints]:
    """Rows of times (M,) in the order of receipt before which their clock was set back, and by how many ns.

    `other_ns` and `content` (M,) tell messages apart: what comes again with the same of each was written twice.
    """
    others = [other_ns] if content is None else [other_ns, content]
    step = np.diff(times_ns)
    period = float(np.median(step[step > 0])) if (step > 0).any() else 0.0
    rows = np.flatnonzero(-step >= (_STEP_PERIODS - 1) * period) + 1 if period else np.zeros(0, np.int64)
    rows = rows[(rows >= _LEAST_RUN) & (rows <= len(times_ns) - _LEAST_RUN)]
    if not len(rows):
        return rows, rows
    each = np.unique(np.stack([times_ns, *(other.view(np.int64) for other in others)]), axis=1)[0]
    size = times_ns[rows - 1] - times_ns[rows] + int(period)
    found = np.searchsorted(each, times_ns[rows - 1], "right") - np.searchsorted(each, times_ns[rows], "left")
    around = rows[:, None] + np.arange(-_LEAST_RUN, _LEAST_RUN)
    before, behind = np.split(times_ns[around], 2, axis=1)
    advance = np.median(behind, axis=1) - np.median(before, axis=1)
    stays = advance < _LEAST_RUN * period - size / 2  # a message that is late alone leaves the median
    twice = found > _TWICE * size / period
    if content is not None:
        twice |= _over_a_gap(times_ns, rows, content, max(LEAST_JUMP_NS, _PERIODS * period))
    told = stays & twice
    return rows[told], size[told]


def _over_a_gap(times_ns: Ints, rows: Ints, content: Floats, limit_ns: float) -> np.ndarray:
    """(R,) bool: clocks that were set back by more than had passed since they were set, so that no time comes twice.

    Between parts of a recording that lie in another order the content does not lead on, or they leave no gap.
    """
    bounds = np.union1d(np.append(rows, 0), np.flatnonzero(np.diff(times_ns) > limit_ns) + 1)
    first, last = (extreme.reduceat(times_ns, bounds) for extreme in (np.minimum, np.maximum))
    part = np.searchsorted(bounds, rows)
    _, at, again = np.unique(times_ns, return_index=True, return_inverse=True)
    step = np.abs(np.diff(content))
    onward = (at[again[rows]] == rows) & (step[rows - 1] <= _ONWARD * np.quantile(step, 0.9))
    return onward & (first[part - 1] - last[part] > limit_ns)


def header_steps_back(header_ns: Ints, log_ns: Ints) -> Ints:
    """By how many ns the clock of header stamps (M,) was set back each time: the skew to the log times stays higher by
    as much, and by more than it varies, which a network that delivers in bursts does not bring about."""
    skew, found = log_ns - header_ns, []
    for row, size in zip(*(part.tolist() for part in steps_back(header_ns, log_ns)), strict=True):
        windows = skew[max(row - _LEVEL, 0) : row], skew[row : row + _LEVEL]
        low, level, high = np.transpose([np.quantile(window, (0.1, 0.5, 0.9)) for window in windows])
        if abs(level[1] - level[0] - size) < size / 2 and (high - low).max() < size / 2:
            found.append(size)
    return np.array(found, np.int64)


def on_one_clock(
    header_ns: Ints, log_ns: Ints, reference_ns: int | None = None, step_ns: int | None = None
) -> Repaired | None:
    """The header stamps without jumps of their clock; None where they follow no clock. Both (M,) in ns, M >= 1.

    Where there are several clocks, `reference_ns` is the skew of the one to end on, that of most messages of all
    topics; None takes that of most of these. `step_ns` is the least step back that some clock of the log was set by.
    """
    step, log_step = np.diff(header_ns), np.diff(log_ns)
    period = float(np.median(np.minimum(np.abs(step), np.abs(log_step)))) if len(step) else 0.0
    limit = max(LEAST_JUMP_NS, _PERIODS * period) if step_ns is None else step_ns / 2
    apart = np.abs(step - log_step) > limit
    steady, log_steady = np.abs(step) <= limit, np.abs(log_step) <= limit
    bounds = [0, *(np.flatnonzero(apart & log_steady & ~steady) + 1).tolist(), len(header_ns)]
    least = min(_LEAST_RUN, max(b - a for a, b in pairwise(bounds)))
    runs = [slice(a, b) for a, b in pairwise(bounds)]
    skews = [int(np.median(log_ns[run] - header_ns[run])) for run in runs]
    counts: dict[int, int] = {}
    clocks: list[int] = []
    long = [
        (run.stop - run.start, skew) for run, skew in zip(runs, skews, strict=True) if run.stop - run.start >= least
    ]
    for count, skew in long:  # a stray stamp parts one clock's run in two
        clocks.append(next((known for known in counts if abs(known - skew) <= limit), skew))
        counts[clocks[-1]] = counts.get(clocks[-1], 0) + count
        if len(counts) > _MOST_CLOCKS:
            return None
    chosen = max(counts, key=lambda skew: (counts[skew], -skew))
    if reference_ns is not None and len(counts) > 1:
        near = min(counts, key=lambda skew: (abs(skew - reference_ns), skew))
        chosen = near if abs(near - reference_ns) <= limit else reference_ns
    stamp_ns, kept = header_ns.copy(), np.zeros(len(header_ns), bool)
    for run, skew in zip(runs, skews, strict=True):
        clock = min(counts, key=lambda known: (abs(known - skew), known))
        if not -limit <= skew - clock <= max(limit, LATE_NS):  # too short to be a clock, and on none
            continue
        shift = 0 if clock == chosen else (skew if run.stop - run.start >= least else clock) - chosen
        shifted = [int(header_ns[run].min()) + shift, int(header_ns[run].max()) + shift]
        kept[run] = min(shifted) >= 0 and max(shifted) < 2**63
        if shift and kept[run.start]:
            stamp_ns[run] += shift
    jumps = [before - behind for before, behind in pairwise(clocks) if before != behind]
    late_ns, set_at = log_ns - header_ns, np.flatnonzero(apart & steady & ~log_steady) + 1
    least_ns = np.minimum.reduceat(late_ns, np.append(0, set_at))  # of a burst the last message is as late as ever
    log_jumps = int((np.abs(np.diff(least_ns)) > limit).sum())
    return Repaired(stamp_ns, kept, chosen, jumps, log_jumps, counts)
