"""Header stamps of a topic: repaired, ordered, found again and paired with those of another."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from vplog.errors import LogError
from vplog.logs.containers import plural

if TYPE_CHECKING:
    from vplog.data import Ints
    from vplog.logs.containers import Notes

NONE: Ints = np.zeros(0, np.int64)


@dataclass
class Stamps:
    """Header stamps of one topic in file order, with the log times they fall back to."""

    header_ns: list[int] = field(default_factory=list)
    log_ns: list[int] = field(default_factory=list)

    def add(self, header_ns: int, log_ns: int) -> None:
        self.header_ns.append(header_ns)
        self.log_ns.append(log_ns)

    def order(self, topic: str, notes: Notes) -> tuple[Ints, Ints]:
        """Strictly increasing stamps in ns and the row each came from. What was repaired is noted.

        Header stamps align data; log times are later by the transport. Where no message has a header stamp, the log
        times stand in; where some have none, those messages are dropped.
        """
        stamp_ns = np.array(self.header_ns, np.int64)
        rows = np.arange(len(stamp_ns))
        if len(stamp_ns) and not stamp_ns.any():
            notes.add(f"{topic} has no header stamps; its log times are used instead.")
            stamp_ns = np.array([min(t, 2**63 - 1) for t in self.log_ns], np.int64)
        elif (unset := int((stamp_ns == 0).sum())) > 0:
            notes.add(f"{topic}: {plural(unset, 'message')} without a header stamp dropped.")
            rows = rows[stamp_ns != 0]
            stamp_ns = stamp_ns[rows]
        stamp_ns, order = increasing(stamp_ns, topic, notes)
        return stamp_ns, rows[order]


def increasing(stamp_ns: Ints, what: str, notes: Notes) -> tuple[Ints, Ints]:
    """The stamps sorted, the first of equal ones kept, and the row each came from; both repairs are noted."""
    if late := int((np.diff(stamp_ns) < 0).sum()):
        notes.add(f"{what}: {plural(late, 'stamp')} out of order; sorted.")
    order = np.argsort(stamp_ns, kind="stable")
    ordered = stamp_ns[order]
    first = np.ones(len(ordered), bool)
    first[1:] = np.diff(ordered) > 0
    if repeated := int((~first).sum()):
        notes.add(f"{what}: {plural(repeated, 'message')} with the stamp of an earlier one dropped.")
    return ordered[first], order[first]


def rows_of(known_ns: Ints, wanted_ns: Ints, log: str) -> list[int]:
    """Rows of the stamps asked for, in order of time, each once. Raises LogError where one is not known."""
    wanted = np.unique(np.asarray(wanted_ns, np.int64))
    rows = np.searchsorted(known_ns, wanted)
    found = rows < len(known_ns)
    found[found] = known_ns[rows[found]] == wanted[found]
    if not found.all():
        raise LogError(f"{log} has no frame at {wanted[~found][0]} ns. Take stamps from stamps().")
    return rows.tolist()


def nearest(stamp_ns: Ints, other_ns: Ints) -> Ints:
    """For each stamp the row of the nearest other stamp, -1 where it is further than half the median period.

    Both increase. A single stamp has no period of its own; half the others' period is its limit.
    """
    if not len(other_ns):
        return np.full(len(stamp_ns), -1)
    right = np.searchsorted(other_ns, stamp_ns).clip(0, len(other_ns) - 1)
    left = (right - 1).clip(0)
    row = np.where(np.abs(other_ns[left] - stamp_ns) <= np.abs(other_ns[right] - stamp_ns), left, right)
    periods = np.diff(stamp_ns) if len(stamp_ns) > 1 else np.diff(other_ns)
    limit = float(np.median(periods)) / 2 if len(periods) else 0.0
    return np.where(np.abs(other_ns[row] - stamp_ns) <= limit, row, -1)
