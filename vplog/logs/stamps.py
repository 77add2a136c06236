"""Header stamps of a topic: repaired, ordered, found again and paired with those of another."""

from __future__ import annotations

from array import array
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from vplog.data import Floats, Ints
from vplog.errors import LogError, plural
from vplog.logs.clocks import (
    GAP_NS,
    GAP_PERIODS,
    LATE_NS,
    LEAST_JUMP_NS,
    LEAST_STEP_NS,
    STEP_PERIODS,
    AlignedStamps,
    Clock,
    align_clock,
)
from vplog.logs.formats.container import Notes
from vplog.logs.formats.loss_account import runs_of

NONE: Ints = np.zeros(0, np.int64)
LAST_NS = 2**63 - 1
"""Last time that 64 bits hold, in the year 2262. A log time after it or before 1970 is damage, and is set to the
nearest time in between."""
_SECOND_NS = 10**9
_COARSE_NS = 3 * 10**8
"""ns by which the delay of stamps in whole seconds varies at least where they are not taken on the second."""
_UNITS_OF_S = 10**6
"""ms or us are fewer than these in a second."""
_TIMES_SLOWER = 500
"""Times that log times advance faster than stamps in us or ms do; simulations and estimators run up to a hundred times
slower than the time."""
_STANDING = 10
"""A topic whose stamps have fewer values than a tenth of its messages has a clock that stands."""
_REPEATS = 3
"""Messages at several log times with one stamp: fewer may be one message that was recorded twice."""
_FASTEST_HZ = 1e6
"""Hz; stamps that are less than a microsecond apart are counters, not times."""
_NAMED = 4
"""Jumps of a clock that are named."""


def longest_gap_ns(stamp_ns: Ints) -> int:
    """The time between two samples up to which they follow each other: a second, or three of their median periods."""
    return max(_SECOND_NS, 3 * int(np.median(np.diff(stamp_ns)))) if len(stamp_ns) > 1 else _SECOND_NS


@dataclass
class Stamps:
    """Header stamps of one topic in file order, with the log times they fall back to."""

    header_ns: array[int] = field(default_factory=partial(array, "q"))
    log_ns: array[int] = field(default_factory=partial(array, "q"))
    xyz_m: Floats | None = None
    """(M, 3) positions in the messages, where they have one: they tell a message from its duplicate."""
    common: Clock | None = None
    """The clock that all topics of the log are to be on, where that is known."""
    _positions: array[int] = field(default_factory=partial(array, "q"))
    _found: tuple[int, AlignedStamps | None] | None = None
    """The one clock of so many messages."""

    def add(self, header_ns: int, log_ns: int, position: int | None = None) -> None:
        self._positions.append(len(self.log_ns) if position is None else position)
        self.header_ns.append(header_ns)
        self.log_ns.append(min(max(log_ns, 0), LAST_NS))

    def extend(self, header_ns: list[int], log_ns: list[int], positions: list[int] | None = None) -> None:
        """Add messages by their stamps, log times and positions in the file; None is one behind the other."""
        self._positions.extend(positions or range(len(self.log_ns), len(self.log_ns) + len(log_ns)))
        self.header_ns.extend(header_ns)
        self.log_ns.extend([min(max(time_ns, 0), LAST_NS) for time_ns in log_ns])

    def offset_ns(self) -> int | None:
        """Log time less header stamp, the median; None where the header stamps follow no clock."""
        found = self._aligned()
        return found.offset_ns if found is not None and found.valid.any() else None

    def positions(self) -> Ints:
        """(M,) where the messages lie among all of the file, in its order."""
        return np.array(self._positions, np.int64)

    def shift_log_times(self, by_ns: Ints) -> None:
        """Add (M,) ns to the log times."""
        log_ns = np.array(self.log_ns, np.int64)
        self.log_ns, self._found = array("q", (np.minimum(log_ns, LAST_NS - by_ns) + by_ns).tolist()), None

    def clocks(self) -> dict[int, int]:
        """Messages by the offset of the clock that they came on; several where it was set."""
        found = self._aligned()
        return {} if found is None else found.counts

    def _aligned(self) -> AlignedStamps | None:
        if self._found is None or self._found[0] != len(self.log_ns):
            header_ns, log_ns = np.array(self.header_ns, np.int64), np.array(self.log_ns, np.int64)
            stamped = _stamped(header_ns, log_ns)
            header_ns, log_ns = header_ns[stamped], log_ns[stamped]
            none = not len(log_ns) or _no_clock(header_ns, log_ns)
            self._found = len(self.log_ns), None if none else align_clock(header_ns, log_ns)
        return self._found[1]

    def order(self, topic: str, notes: Notes) -> tuple[Ints, Ints]:
        """Strictly increasing stamps in ns and the row each came from. What was repaired is noted.

        Header stamps align data; log times are later by the transport. Where most messages have no header stamp, or
        the stamps follow no clock, the log times stand in; where some have none or a stray one, those messages are
        lost; where the clock was set on the way, the stamps are shifted to the one of most messages.
        """
        header_ns, log_ns = np.array(self.header_ns, np.int64), np.array(self.log_ns, np.int64)
        stamped = _stamped(header_ns, log_ns)
        rows = np.flatnonzero(stamped)
        if not len(header_ns):
            return NONE, NONE
        if 2 * len(rows) < len(header_ns):
            return self._by_log_times(topic, notes, "has no header stamps")
        _lose("no_stamp", topic, ~stamped, log_ns, notes)
        if why := _no_clock(header_ns[rows], log_ns[rows]):
            return self._by_log_times(topic, notes, why)
        common_ns = self.common.offset_ns if self.common else None
        found = align_clock(header_ns[rows], log_ns[rows], common_ns)
        if found is None:
            return self._by_log_times(topic, notes, "has header stamps that follow no clock")
        if found.jumps_ns:
            steps = ", ".join(f"{jump / 1e9:+.3f} s" for jump in found.jumps_ns[:_NAMED])
            steps += f" and {len(found.jumps_ns) - _NAMED} times more" if len(found.jumps_ns) > _NAMED else ""
            notes.add(f"{topic}: the clock of the header stamps was set by {steps}; the stamps are shifted back.")
        if found.log_jumps:
            times = plural(found.log_jumps, "place")
            notes.add(f"{topic}: the log times jump in {times}; the header stamps do not, and are used.")
        for change in found.unclear_ns:
            notes.add(
                f"{topic}: after a gap the log times are {change / 1e9:+.3f} s further from the header stamps. Was a "
                "clock set, or is the transport slower since? The stamps are not changed."
            )
        _lose("stray_stamp", topic, ~found.valid, log_ns[rows], notes)
        rows, stamp_ns = rows[found.valid], found.stamp_ns[found.valid]
        stamp_ns = _on_common(stamp_ns, found.offset_ns, self.common, topic, notes)
        return _in_order(topic, notes, stamp_ns, rows, log_ns)

    def _by_log_times(self, topic: str, notes: Notes, why: str) -> tuple[Ints, Ints]:
        """The log times in place of the header stamps."""
        log_ns = np.array(self.log_ns, np.int64)
        notes.add(f"{topic} {why}; its log times are used instead.")
        return _in_order(topic, notes, log_ns, np.arange(len(log_ns)), log_ns)


def rate_hz(stamp_ns: Ints) -> float | None:
    """Messages a second of (T,) increasing stamps; None where they span no time, or none that a sensor would."""
    span_ns = int(stamp_ns[-1]) - int(stamp_ns[0]) if len(stamp_ns) else 0
    rate = (len(stamp_ns) - 1) * 1e9 / span_ns if span_ns else None
    return round(rate, 3) if rate is not None and rate < _FASTEST_HZ else None


def _stamped(header_ns: Ints, log_ns: Ints) -> np.ndarray:
    """(M,) bool: a stamp of 0 is one that nobody set, except at the start of a clock that begins at 0."""
    return np.asarray((header_ns != 0) | (log_ns == 0))


def _no_clock(header_ns: Ints, log_ns: Ints) -> str:
    """Why header stamps are no times, as it follows the topic's name; empty where they may be."""
    values = len(np.unique(header_ns))
    if values * _STANDING < len(header_ns) or (values == 1 and len(np.unique(log_ns)) >= _REPEATS):
        return "has header stamps that do not advance"
    ordered = header_ns[np.argsort(log_ns, kind="stable")]
    steps, part = np.diff(ordered), len(ordered) // 4  # those of a link's bursts are in no order, and yet advance
    falls = part and np.median(ordered[-part:]) < np.median(ordered[:part])
    if len(steps) >= _STANDING and falls and 2 * int((steps < 0).sum()) > len(steps):
        return "has header stamps that run backwards"
    late_ns = log_ns - header_ns  # whole seconds are later by up to one; a receiver's on the second, by as much always
    spread_ns = float(np.subtract(*np.quantile(late_ns, (0.9, 0.1))))
    rest_ns = header_ns % _SECOND_NS
    # or with ms or us where ns belong; a camera that is triggered each second may be stamped just behind it
    if (
        len(steps) >= _STANDING and _COARSE_NS < spread_ns < _SECOND_NS and (rest_ns < _UNITS_OF_S).all()
        and (not rest_ns.any() or np.median(steps) < 0.9 * _SECOND_NS)
    ):  # fmt: skip
        return "has header stamps in whole seconds"
    ahead, log_ahead = (one[one > 0].astype(np.float64) for one in (steps, np.diff(np.sort(log_ns))))
    if min(len(ahead), len(log_ahead)) >= _STANDING and all(
        _TIMES_SLOWER * of(ahead) < of(log_ahead) for of in (np.sum, np.median)
    ):
        return "has header stamps in another unit than ns"
    return ""


def set_common_clock(topics: Iterable[Stamps], shared: Iterable[Stamps] = ()) -> None:
    """Set the common clock of all topics of a log: that of most messages, by log time less stamp, of the `shared` ones
    where these have any: the logs of the cameras of one body have these in common, and then one clock."""
    topics = [one for one in topics if len(one.header_ns)]
    pooled: dict[int, int] = {}
    pool = [one for one in shared if one.clocks()] or topics
    steady = [one for one in pool if len(one.clocks()) == 1]
    for one in steady or pool:  # a clock that was set is moved to one that was not
        for offset, count in sorted(one.clocks().items()):
            known = next((other for other in pooled if abs(other - offset) <= LEAST_JUMP_NS), offset)
            pooled[known] = pooled.get(known, 0) + count
    if not pooled:
        return
    offset_ns = max(pooled, key=lambda offset: (pooled[offset], -offset))
    covered = [one for one in topics if any(abs(offset - offset_ns) <= LEAST_JUMP_NS for offset in one.clocks())]
    log_ns = [int(ns) - offset_ns for one in covered for ns in (min(one.log_ns), max(one.log_ns))]
    for one in topics:
        one.common = Clock(offset_ns, min(log_ns), max(log_ns))


def _on_common(stamp_ns: Ints, offset_ns: int, common: Clock | None, topic: str, notes: Notes) -> Ints:
    """Stamps of another clock than the common one moved to it by the log times, where they cover no time of it, or are
    those of a future; else they may be right and only recorded late."""
    if common is None or not len(stamp_ns) or abs(offset_ns - common.offset_ns) <= LATE_NS:
        return stamp_ns
    shift = offset_ns - common.offset_ns
    first_ns, last_ns = int(stamp_ns.min()), int(stamp_ns.max())
    apart = first_ns > common.last_ns or last_ns < common.first_ns
    apart |= offset_ns < -LATE_NS and abs(common.offset_ns) <= LATE_NS  # GPS time: nothing is recorded before its time
    if not apart or first_ns + shift < 0 or last_ns + shift > LAST_NS:
        notes.add(
            f"{topic}: by the log times, the header stamps are {abs(shift) / 1e9:.1f} s "
            f"{'earlier' if shift > 0 else 'later'} than those of other topics. Were they recorded late, or is a "
            "clock wrong?"
        )
        return stamp_ns
    notes.add(
        f"{topic}: the header stamps come from another clock than most messages', {abs(shift) / 1e9:.3f} s apart by "
        "the log times; they are shifted to it, to within the jitter of the log times."
    )
    return stamp_ns + shift


def _in_order(topic: str, notes: Notes, stamp_ns: Ints, rows: Ints, log_ns: Ints) -> tuple[Ints, Ints]:
    ordered, order = increasing(stamp_ns, topic, notes)
    repeated = np.ones(len(stamp_ns), bool)
    repeated[order] = False
    _lose("repeated_stamp", topic, repeated, log_ns[rows], notes)
    _note_gaps(topic, ordered, notes)
    return ordered, rows[order]


def _lose(reason: str, topic: str, lost: np.ndarray, log_ns: Ints, notes: Notes) -> None:
    if lost.any():
        notes.account.add(reason, {topic: int(lost.sum())}, (topic, 0), runs_of(lost, log_ns))


def _note_gaps(topic: str, stamp_ns: Ints, notes: Notes) -> None:
    steps = np.diff(stamp_ns)
    if not len(steps):
        return
    gaps = np.flatnonzero(steps > max(GAP_NS, GAP_PERIODS * float(np.median(steps))))
    if len(gaps):
        longest = gaps[np.argmax(steps[gaps])]
        at_s = (stamp_ns[longest] - stamp_ns[0]) / 1e9
        notes.add(
            f"{topic}: {plural(len(gaps), 'gap')}, the longest {steps[longest] / 1e9:.1f} s, {at_s:.1f} s after its "
            "first message."
        )


def increasing(stamp_ns: Ints, what: str, notes: Notes) -> tuple[Ints, Ints]:
    """The stamps sorted, the first of equal ones, and the row each came from; sorting is noted."""
    step = np.diff(stamp_ns)
    if late := int((step < 0).sum()):
        back_ns = -int(step.min())
        far = back_ns > max(LEAST_STEP_NS, STEP_PERIODS * float(np.median(np.abs(step))))
        how = f"by up to {back_ns / 1e9:.3f} s (late, or was a clock changed?); sorted." if far else "; sorted."
        notes.add(f"{what}: {plural(late, 'stamp')} out of order{' ' * far}{how}")
    order = np.argsort(stamp_ns, kind="stable")
    ordered = stamp_ns[order]
    first = np.ones(len(ordered), bool)
    first[1:] = np.diff(ordered) > 0
    return ordered[first], order[first]


def rows_of(known_ns: Ints, wanted_ns: Ints, log: str) -> list[int]:
    """Rows of the wanted stamps, in order of time, each once. Raises LogError where one is not known."""
    wanted = np.unique(np.asarray(wanted_ns, np.int64))
    rows = np.searchsorted(known_ns, wanted)
    found = rows < len(known_ns)
    found[found] = known_ns[rows[found]] == wanted[found]
    if not found.all():
        raise LogError(f"{log} has no frame at {wanted[~found][0]} ns. Take stamps from stamps().")
    return rows.tolist()


def nearest(stamp_ns: Ints, other_ns: Ints) -> Ints:
    """For each stamp the row of the nearest other stamp, -1 where it is further than half the median period, that of
    the others for a single stamp. Both increase."""
    if not len(other_ns):
        return np.full(len(stamp_ns), -1)
    right = np.searchsorted(other_ns, stamp_ns).clip(0, len(other_ns) - 1)
    left = (right - 1).clip(0)
    row = np.where(np.abs(other_ns[left] - stamp_ns) <= np.abs(other_ns[right] - stamp_ns), left, right)
    periods = np.diff(stamp_ns) if len(stamp_ns) > 1 else np.diff(other_ns)
    limit = float(np.median(periods)) / 2 if len(periods) else 0.0
    return np.where(np.abs(other_ns[row] - stamp_ns) <= limit, row, -1)
