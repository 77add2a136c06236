"""Header stamps of a topic: put on one clock and in order, and paired with those of another topic."""

from __future__ import annotations

from array import array
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from vplog.data import Bools, Floats, Ints
from vplog.errors import LogError, plural
from vplog.logs.clocks import LAST_NS, MAX_DELAY_NS, MIN_STEP_NS, OUTLIER_FACTOR, SECOND_NS, AlignedStamps, align_clock
from vplog.logs.formats.container import Notes
from vplog.logs.formats.loss_account import runs_of

NONE: Ints = np.zeros(0, np.int64)
_MAX_RATE_HZ = 1e6
"""Stamps that are less than a microsecond apart are counters, not times."""


@dataclass(frozen=True)
class CommonClock:
    """The clock that all topics of a log are put on."""

    offset_ns: int
    """Log time minus header stamp."""
    first_ns: int
    last_ns: int
    """Time that the topics on this clock cover."""


def gap_ns(stamp_ns: Ints) -> float:
    """Return the time between messages that counts as a gap: a second, or OUTLIER_FACTOR times the median period."""
    return max(SECOND_NS, OUTLIER_FACTOR * float(np.median(np.diff(stamp_ns)))) if len(stamp_ns) > 1 else SECOND_NS


def longest_gap_ns(stamp_ns: Ints) -> int:
    """Return the time between two samples up to which motion is interpolated: a second, or three median periods."""
    return max(SECOND_NS, 3 * int(np.median(np.diff(stamp_ns)))) if len(stamp_ns) > 1 else SECOND_NS


@dataclass
class Stamps:
    """Header stamps of one topic in file order, with the log times that replace them if they are unusable."""

    header_ns: array[int] = field(default_factory=partial(array, "q"))
    log_ns: array[int] = field(default_factory=partial(array, "q"))
    xyz_m: Floats | None = None
    """(M, 3) positions in the messages, which distinguish a message from its duplicate. None if there are none."""
    common: CommonClock | None = None
    _positions: array[int] = field(default_factory=partial(array, "q"))
    _aligned: tuple[int, AlignedStamps | str] | None = None
    """Number of messages and result of the last alignment without a common clock."""

    def add(self, header_ns: int, log_ns: int, position: int | None = None) -> None:
        """Add a message by its stamp, its log time and its position in the file (default: the next)."""
        self._positions.append(len(self.log_ns) if position is None else position)
        self.header_ns.append(header_ns)
        self.log_ns.append(min(max(log_ns, 0), LAST_NS))

    def extend(self, header_ns: list[int], log_ns: list[int], positions: list[int] | None = None) -> None:
        """Add messages. Log times before 1970 or after 2262 are damage, and are moved into that range."""
        self._positions.extend(positions or range(len(self.log_ns), len(self.log_ns) + len(log_ns)))
        self.header_ns.extend(header_ns)
        self.log_ns.extend([min(max(time_ns, 0), LAST_NS) for time_ns in log_ns])

    def positions(self) -> Ints:
        """Return the (M,) positions of the messages among all messages of the file."""
        return np.array(self._positions, np.int64)

    def shift_log_times(self, by_ns: Ints) -> None:
        """Add (M,) ns to the log times."""
        log_ns = np.array(self.log_ns, np.int64)
        self.log_ns, self._aligned = array("q", (np.minimum(log_ns, LAST_NS - by_ns) + by_ns).tolist()), None

    def offset_ns(self) -> int | None:
        """Return the median log time minus header stamp, or None if the stamps follow no clock."""
        aligned = self._align(None)
        return None if isinstance(aligned, str) else aligned.offset_ns

    def clocks(self) -> dict[int, int]:
        """Return the number of messages on each clock by its offset. There are several if the clock was set."""
        aligned = self._align(None)
        return {} if isinstance(aligned, str) else aligned.counts

    def _align(self, reference_ns: int | None) -> AlignedStamps | str:
        """Align the messages that have a stamp; if fewer than half have one, return the reason."""
        if reference_ns is None and self._aligned is not None and self._aligned[0] == len(self.log_ns):
            return self._aligned[1]
        header_ns, log_ns = np.array(self.header_ns, np.int64), np.array(self.log_ns, np.int64)
        stamped = _are_set(header_ns, log_ns)
        if 2 * int(stamped.sum()) < max(len(stamped), 1):
            aligned: AlignedStamps | str = "has no header stamps"
        else:
            aligned = align_clock(header_ns[stamped], log_ns[stamped], reference_ns)
        if reference_ns is None:
            self._aligned = len(self.log_ns), aligned
        return aligned

    def order(self, topic: str, notes: Notes) -> tuple[Ints, Ints]:
        """Return strictly increasing stamps in ns and the row of each. Repairs and losses are noted.

        Header stamps are used because log times are later by the transport. If the stamps are unusable, log times
        replace them. Messages without a stamp or with an outlier are lost. If the clock was set, stamps are shifted.
        """
        header_ns, log_ns = np.array(self.header_ns, np.int64), np.array(self.log_ns, np.int64)
        if not len(log_ns):
            return NONE, NONE
        aligned = self._align(self.common.offset_ns if self.common and len(self.clocks()) > 1 else None)
        if isinstance(aligned, str):
            notes.add(f"{topic} {aligned}; its log times are used instead.")
            return _in_order(topic, notes, log_ns, np.arange(len(log_ns)), log_ns)
        stamped = _are_set(header_ns, log_ns)
        rows = np.flatnonzero(stamped)
        for remark in aligned.remarks:
            notes.add(f"{topic}: {remark}")
        _lose("no_stamp", topic, ~stamped, log_ns, notes)
        _lose("stray_stamp", topic, ~aligned.valid, log_ns[rows], notes)
        stamp_ns = _on_common(aligned.stamp_ns[aligned.valid], aligned.offset_ns, self.common, topic, notes)
        return _in_order(topic, notes, stamp_ns, rows[aligned.valid], log_ns)


def _are_set(header_ns: Ints, log_ns: Ints) -> Bools:
    """Return (M,) whether each stamp is set. A stamp of 0 is not, unless the clock starts at 0."""
    starts = np.zeros(len(header_ns), bool)
    starts[:-1] = (header_ns[1:] > 0) & (header_ns[1:] < SECOND_NS)
    return (header_ns != 0) | (log_ns == 0) | starts


def rate_hz(stamp_ns: Ints) -> float | None:
    """Return the messages per second of (T,) increasing stamps, or None if they span no time or are counters."""
    span_ns = int(stamp_ns[-1]) - int(stamp_ns[0]) if len(stamp_ns) else 0
    rate = (len(stamp_ns) - 1) * 1e9 / span_ns if span_ns else None
    return round(rate, 3) if rate is not None and rate < _MAX_RATE_HZ else None


def set_common_clock(topics: Iterable[Stamps], shared: Iterable[Stamps] = ()) -> None:
    """Set the common clock of all topics of a log: the clock of most messages.

    If some of the `shared` topics have a clock, only these count. The logs of all cameras of a robot contain them, so
    the cameras end on one clock.
    """
    topics = [topic for topic in topics if len(topic.header_ns)]
    pool = [topic for topic in shared if topic.clocks()] or topics
    messages = Counter[int]()
    for topic in [topic for topic in pool if len(topic.clocks()) == 1] or pool:  # clocks that were not set come first
        for offset_ns, count in sorted(topic.clocks().items()):
            messages[next((ns for ns in messages if abs(ns - offset_ns) <= SECOND_NS), offset_ns)] += count
    if not messages:
        return
    first_ns = min(min(topic.log_ns) for topic in topics)  # no stamp is negative on a clock with an offset up to this
    common_ns = max(messages, key=lambda ns: (ns <= first_ns + MAX_DELAY_NS, messages[ns], -ns))
    on_common = [topic for topic in topics if any(abs(ns - common_ns) <= SECOND_NS for ns in topic.clocks())]
    first_ns, last_ns = min(min(topic.log_ns) for topic in on_common), max(max(topic.log_ns) for topic in on_common)
    for topic in topics:
        topic.common = CommonClock(common_ns, first_ns - common_ns, last_ns - common_ns)


def _on_common(stamp_ns: Ints, offset_ns: int, common: CommonClock | None, topic: str, notes: Notes) -> Ints:
    """Shift stamps of another clock to the common clock, by the log times.

    Stamps are only shifted if they cover no time of the common clock, or if they are later than the log times and those
    of the common clock are not (GPS time). Otherwise they may be right and recorded late, which is noted.
    """
    if common is None or not len(stamp_ns) or abs(offset_ns - common.offset_ns) <= MAX_DELAY_NS:
        return stamp_ns
    shift_ns = offset_ns - common.offset_ns
    first_ns, last_ns = int(stamp_ns.min()), int(stamp_ns.max())
    is_apart = first_ns > common.last_ns or last_ns < common.first_ns
    is_future = offset_ns < -MAX_DELAY_NS and abs(common.offset_ns) <= MAX_DELAY_NS
    if not (is_apart or is_future) or first_ns + shift_ns < 0 or last_ns + shift_ns > LAST_NS:
        notes.add(
            f"{topic}: by the log times, the header stamps are {abs(shift_ns) / 1e9:.1f} s "
            f"{'earlier' if shift_ns > 0 else 'later'} than those of other topics. Were they recorded late, or is a "
            "clock wrong?"
        )
        return stamp_ns
    notes.add(
        f"{topic}: the header stamps come from another clock than most messages', {abs(shift_ns) / 1e9:.3f} s apart by "
        "the log times; they are shifted to it, to within the jitter of the log times."
    )
    return stamp_ns + shift_ns


def _in_order(topic: str, notes: Notes, stamp_ns: Ints, rows: Ints, log_ns: Ints) -> tuple[Ints, Ints]:
    ordered, order = increasing(stamp_ns, topic, notes)
    repeated = np.ones(len(stamp_ns), bool)
    repeated[order] = False
    _lose("repeated_stamp", topic, repeated, log_ns[rows], notes)
    steps = np.diff(ordered)
    if count := int((steps > gap_ns(ordered)).sum()):
        longest = int(np.argmax(steps))
        at_s = (ordered[longest] - ordered[0]) / 1e9
        notes.add(
            f"{topic}: {plural(count, 'gap')}, the longest {steps[longest] / 1e9:.1f} s, {at_s:.1f} s after its first "
            "message."
        )
    return ordered, rows[order]


def _lose(reason: str, topic: str, lost: Bools, log_ns: Ints, notes: Notes) -> None:
    if lost.any():
        notes.account.add(reason, {topic: int(lost.sum())}, (topic, 0), runs_of(lost, log_ns))


def increasing(stamp_ns: Ints, what: str, notes: Notes) -> tuple[Ints, Ints]:
    """Return the sorted stamps without duplicates, and the row of the first of each. Stamps out of order are noted."""
    steps = np.diff(stamp_ns)
    if late := int((steps < 0).sum()):
        back_ns = -int(steps.min())
        is_far = back_ns > max(MIN_STEP_NS, 3 * float(np.median(np.abs(steps))))
        how = f"by up to {back_ns / 1e9:.3f} s (late, or was a clock changed?); sorted." if is_far else "; sorted."
        notes.add(f"{what}: {plural(late, 'stamp')} out of order{' ' * is_far}{how}")
    return np.unique(stamp_ns, return_index=True)


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
