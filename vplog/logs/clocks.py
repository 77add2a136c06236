"""Clock steps of header stamps, estimated from their difference to the log times.

A message is logged at most MAX_DELAY_NS after its header stamp. The offset, log time minus header stamp, is therefore
piecewise constant. It leaves its level for a moment if a delay changes, and for good if a clock is set.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from vplog.data import Bools, Floats, Ints
from vplog.errors import plural

LAST_NS = int(np.iinfo(np.int64).max)
SECOND_NS = 10**9
MIN_STEP_NS = 128_000_000
"""Smallest clock step: NTP changes the rate of a clock for smaller errors (RFC 5905, STEPT)."""
MAX_DELAY_NS = 2 * SECOND_NS
"""Longest delay between header stamp and log time: slow estimators, and links that repeat lost packets."""
MAX_STEPS = 20
"""Largest number of clock steps in a drive. Times that jump more often follow no clock."""
OUTLIER_FACTOR = 10
"""Ratio to the usual value from which a change is a step, a pause is a gap, and repeated stamps are a stopped clock."""
_MIN_RUN = 5
"""Messages in a row that show a level. Fewer have damaged stamps."""
_NS_PER_UNIT = {1: "ns", 10**3: "us", 10**6: "ms", 10**9: "s"}


@dataclass(frozen=True, eq=False)
class AlignedStamps:
    """Header stamps of one topic on one clock."""

    stamp_ns: Ints
    """(M,) in file order."""
    valid: Bools
    """(M,) False for outliers, whose time is unknown."""
    offset_ns: int
    """Median log time minus header stamp, on the clock of `stamp_ns`."""
    counts: dict[int, int]
    """Number of messages logged on each clock, by the offset of the clock. There are several if it was set."""
    remarks: list[str]
    """What was changed or is unclear, each as a sentence without the name of the topic."""


def align_clock(header_ns: Ints, log_ns: Ints, reference_ns: int | None = None) -> AlignedStamps | str:
    """Remove clock steps from the header stamps, or return the reason why the stamps are not times.

    `header_ns` and `log_ns` are (M,) in file order, M >= 1. If the clock was set, stamps are shifted to the clock of
    most messages, or to the one with offset `reference_ns`.
    """
    unit_ns = _unit_ns(header_ns, log_ns)
    if isinstance(unit_ns, str):
        return unit_ns
    header_ns = header_ns * unit_ns
    offset_ns = log_ns.astype(np.float64) - header_ns  # to 256 ns, and without overflow
    is_calm = len(offset_ns) < 2 or np.abs(np.diff(offset_ns)).max() <= MIN_STEP_NS  # nearly always, and faster
    level_ns = offset_ns if is_calm else _running_median(offset_ns)
    noise_ns = float(np.median(np.abs(offset_ns - level_ns))) / 2  # the running median has less than half of it
    change_ns = float(np.median(np.abs(np.diff(level_ns)))) if len(level_ns) > 1 else 0.0
    threshold_ns = max(MIN_STEP_NS, OUTLIER_FACTOR * noise_ns, OUTLIER_FACTOR * change_ns)
    longest_ns = max(MAX_DELAY_NS, threshold_ns)
    # messages that changed places at a step belong to the level that their own offset is nearest to
    each = np.arange(len(offset_ns))
    rows = np.clip(each + np.array([[0], [1 - _MIN_RUN], [_MIN_RUN - 1]]), 0, len(offset_ns) - 1)
    rows = rows[np.abs(level_ns[rows] - offset_ns).argmin(0), each]
    late_ns = offset_ns - level_ns[rows]
    valid = (late_ns <= longest_ns) & (late_ns >= -max(MAX_DELAY_NS / 2, threshold_ns))
    if not valid.all():  # the log times may be damaged instead
        valid |= 2 * np.abs(header_ns - _running_median(header_ns)) < np.abs(late_ns)
    regular_ns = np.where(np.abs(offset_ns - level_ns) <= threshold_ns, header_ns, log_ns - level_ns)
    starts, sizes_ns, unclear_ns = _steps(regular_ns, log_ns, level_ns, threshold_ns, longest_ns)
    if len(starts) > MAX_STEPS or not valid.any():
        return "has header stamps that follow no clock"
    clock_ns = [0.0]  # offset after each step; a clock that is set back to an earlier offset is the same one
    for size_ns in sizes_ns.tolist():
        after_ns = clock_ns[-1] + size_ns
        clock_ns.append(next((known_ns for known_ns in clock_ns if abs(known_ns - after_ns) <= threshold_ns), after_ns))
    clocks = np.array(clock_ns)[np.searchsorted(starts, rows, "right")]
    values, inverse, counts = np.unique(clocks[valid], return_inverse=True, return_counts=True)
    # if a simulation begins again at 0, stamps before it would be negative on its last clock
    fits = values <= (header_ns + clocks)[valid].min()
    longest = np.argmax(counts * fits if fits.any() else counts)
    target_ns = values[longest]
    base_ns = np.median((log_ns - header_ns)[valid][inverse == longest]) - target_ns
    if reference_ns is not None and len(values) > 1:
        nearest_ns = values[np.argmin(np.abs(values + base_ns - reference_ns))]
        is_near = abs(nearest_ns + base_ns - reference_ns) <= MAX_DELAY_NS
        target_ns = nearest_ns if is_near else reference_ns - base_ns
    shift_ns = clocks - target_ns
    valid &= (header_ns + shift_ns >= 0) & (header_ns + shift_ns < LAST_NS) & (np.abs(shift_ns) < LAST_NS)
    stamp_ns = header_ns + np.where(valid, shift_ns, 0).astype(np.int64)
    if _are_whole_seconds(header_ns, (log_ns - stamp_ns)[valid]):
        return "has header stamps in whole seconds"
    remarks = _remarks(unit_ns, -np.diff(clock_ns), _count_log_steps(header_ns, log_ns, offset_ns), unclear_ns)
    of_clock = {int(value + base_ns): int(count) for value, count in zip(values, counts, strict=True)}
    return AlignedStamps(stamp_ns, valid, int(target_ns + base_ns), of_clock, remarks)


def _unit_ns(header_ns: Ints, log_ns: Ints) -> int | str:
    """Return the ns per unit of the stamps, or the reason why the stamps are not times."""
    count, distinct = len(header_ns), len(np.unique(header_ns))
    if distinct * OUTLIER_FACTOR < count or (distinct == 1 and len(np.unique(log_ns)) > 2):
        return "has header stamps that do not advance"
    if count <= OUTLIER_FACTOR:
        return 1
    order = np.argsort(log_ns, kind="stable")
    header_ns, log_ns = header_ns[order], log_ns[order]
    # a clock that is set back advances between, and the messages of a burst in any order advance on the whole
    if np.median(np.diff(header_ns)) < 0 and np.median(header_ns[count // 2 :]) < np.median(header_ns[: count // 2]):
        return "has header stamps that run backwards"
    lag = min(_window(log_ns), count // 4)
    advance, passed_ns = (np.median(times[lag:] - times[:-lag]) for times in (header_ns, log_ns))
    unit_ns = next((unit for unit in _NS_PER_UNIT if passed_ns < 2 * unit * advance < 4 * passed_ns), 1)
    fits = unit_ns * float(np.abs(header_ns).max()) <= LAST_NS
    return unit_ns if fits else "has header stamps in another unit than ns"


def _are_whole_seconds(header_ns: Ints, late_ns: Ints) -> bool:
    """Return whether stamps were cut to whole seconds, or have us or ms in the place of ns.

    The delays of such stamps vary by up to a second. Those of a receiver that measures on the second do not.
    """
    rest_ns = header_ns % SECOND_NS
    if len(late_ns) <= OUTLIER_FACTOR or (rest_ns >= SECOND_NS // 1000).any():
        return False
    if rest_ns.any() and np.median(np.diff(header_ns)) > SECOND_NS / 2:  # a camera that is triggered every second
        return False
    return SECOND_NS / 3 < float(np.subtract(*np.quantile(late_ns, (0.9, 0.1)))) < SECOND_NS


def _running_median(times_ns: Ints | Floats) -> Floats:
    """Return the median (M,) of the messages around each, from which runs shorter than _MIN_RUN disappear."""
    padded = np.pad(times_ns.astype(np.float64), _MIN_RUN - 1, mode="reflect")
    return np.asarray(np.median(sliding_window_view(padded, 2 * _MIN_RUN - 1), axis=1))  # SciPy's import takes 17 MB


def _window(log_ns: Ints) -> int:
    """Return the number of messages that are logged within MAX_DELAY_NS, at least _MIN_RUN."""
    lag = max(len(log_ns) // MAX_STEPS, 1)  # so that few differences span a step
    period_ns = float(np.median(np.abs(log_ns[lag:] - log_ns[:-lag]))) / lag if len(log_ns) > lag else 0.0
    return max(_MIN_RUN, int(min(MAX_DELAY_NS / max(period_ns, 1.0), len(log_ns))))


def _candidates(
    header_ns: Ints | Floats, log_ns: Ints, level_ns: Floats, threshold_ns: float
) -> tuple[Ints, Ints, Bools]:
    """Find the places where the header's clock may have been set, given the running median (M,) of the offset.

    Returns the first message after the old level and the first on the new level (K,), and whether a gap lies between.
    """
    rows = np.flatnonzero(np.abs(np.diff(level_ns)) > threshold_ns) + 1
    if not len(rows):
        return rows, rows, np.zeros(0, bool)
    # of the two clocks, the one whose own step is unusual was set; the running median may move the place of a step
    steps_ns = np.stack([np.diff(header_ns), np.diff(log_ns)])
    change_ns = np.abs(steps_ns[1] - steps_ns[0])
    near = np.clip(rows[:, None] - 1 + np.arange(1 - _MIN_RUN, _MIN_RUN), 0, len(change_ns) - 1)
    places = near[np.arange(len(near)), change_ns[near].argmax(1)]
    usual_ns = [np.median(steps[steps > 0]) if (steps > 0).any() else 0 for steps in steps_ns]
    is_header, is_log = (2 * np.abs(steps_ns.T - usual_ns)[places] >= change_ns[places, None]).T
    is_back = steps_ns[0, places] < 0
    rows, is_gap = rows[is_header | is_back], (is_log & ~is_back)[is_header | is_back]
    is_first = np.diff(rows, prepend=-_MIN_RUN) >= _MIN_RUN  # a few messages between two changes show no level
    return rows[is_first], rows[np.append(is_first[1:], True)[: len(rows)]], is_gap[is_first]


def _steps(
    header_ns: Ints | Floats, log_ns: Ints, level_ns: Floats, threshold_ns: float, longest_ns: float
) -> tuple[Ints, Floats, list[float]]:
    """Estimate the steps of the header's clock, given the running median (M,) of the offset.

    Returns the first message (K,) and the change of the offset (K,) of each step, and the changes over gaps that are a
    step or a longer delay.
    """
    first, last, is_gap = _candidates(header_ns, log_ns, level_ns, threshold_ns)
    offset_ns = np.asarray(log_ns - header_ns, np.float64)
    changes_ns = spread_ns = np.zeros(len(first))
    window, unclear_ns = _window(log_ns), list[float]()
    for _ in range(MAX_STEPS if len(first) else 0):  # without changes that are no steps, windows beside steps grow
        starts, stops = np.append(0, last), np.append(first, len(offset_ns))
        # without a step, the offset changes by more than the longest delay only if a simulation has another rate
        longest = int(np.argmax(stops - starts))
        moved_ns, passed_ns = (times[stops[longest] - 1] - times[starts[longest]] for times in (level_ns, log_ns))
        if abs(moved_ns) > MAX_DELAY_NS and passed_ns > 0:
            offset_ns = np.asarray(log_ns - header_ns - moved_ns / passed_ns * (log_ns - log_ns[0]), np.float64)
        before = _quantiles(offset_ns, np.maximum(starts[:-1], first - window), first)
        after = _quantiles(offset_ns, last, np.minimum(stops[1:], last + window))
        changes_ns = after[:, 0] - before[:, 0]  # transport only adds to the offset, so low quantiles show the clocks
        spread_ns = np.maximum(np.ptp(before, axis=1), np.ptp(after, axis=1))
        is_clear = np.abs(changes_ns) > np.clip(spread_ns, threshold_ns, longest_ns)
        is_long = np.abs(changes_ns) > longest_ns
        unclear_ns += changes_ns[is_clear & is_gap & ~is_long].tolist()
        # if the offset changes over most gaps, delays vary as much as small steps
        is_step = is_long if len(unclear_ns) > int((is_clear & ~is_gap).sum()) else is_clear & (is_long | ~is_gap)
        first, last, is_gap = first[is_step], last[is_step], is_gap[is_step]
        changes_ns, spread_ns = changes_ns[is_step], spread_ns[is_step]
        if is_step.all():
            break
    by_period_ns = _changes_by_period(header_ns, first, last)
    is_regular = ~is_gap & (np.abs(by_period_ns - changes_ns) <= spread_ns / 3)
    return first, np.where(is_regular, by_period_ns, changes_ns), unclear_ns


def _changes_by_period(header_ns: Ints | Floats, first: Ints, last: Ints) -> Floats:
    """Return the changes (K,) of the offset if no message is missing, which do not depend on the delays."""
    steps_ns, each = np.diff(header_ns), np.arange(_MIN_RUN)
    period_ns = float(np.median(steps_ns[steps_ns > 0])) if (steps_ns > 0).any() else 0.0
    before = header_ns[(first[:, None] - 1 - each).clip(0)] + period_ns * (each + 1 + (last - first)[:, None])
    after = header_ns[(last[:, None] + each).clip(max=len(header_ns) - 1)] - period_ns * each
    return np.asarray(np.median(before, axis=1) - np.median(after, axis=1))


def _quantiles(offset_ns: Floats, starts: Ints, stops: Ints) -> Floats:
    """Return the 10 % and 90 % quantiles (K, 2) of the offset between the rows `starts` and `stops` (K,)."""
    ordered = (np.sort(offset_ns[start:stop]) for start, stop in zip(starts, stops, strict=True))
    return np.array([part[[len(part) // 10, -1 - len(part) // 10]] for part in ordered]).reshape(-1, 2)


def _count_log_steps(header_ns: Ints, log_ns: Ints, offset_ns: Floats) -> int:
    """Count the steps of the recorder's clock: the offset changes by more than a delay, and the header has no step."""
    header_step_ns, log_step_ns = np.diff(header_ns), np.diff(log_ns.astype(np.float64))
    is_step = (np.abs(header_step_ns) <= MAX_DELAY_NS) & (np.abs(log_step_ns - header_step_ns) > MAX_DELAY_NS)
    least_ns = np.minimum.reduceat(offset_ns, np.append(0, np.flatnonzero(is_step) + 1))
    return int((np.abs(np.diff(least_ns)) > MAX_DELAY_NS).sum())


def _remarks(unit_ns: int, steps_ns: Floats, log_steps: int, unclear_ns: list[float]) -> list[str]:
    remarks = []
    if unit_ns != 1:
        remarks.append(f"the header stamps are in {_NS_PER_UNIT[unit_ns]}, not in ns; they are converted.")
    if len(steps_ns):
        largest = ", ".join(f"{step_ns / 1e9:+.3f} s" for step_ns in steps_ns[:_MIN_RUN].tolist())
        more = f" and {len(steps_ns) - _MIN_RUN} times more" if len(steps_ns) > _MIN_RUN else ""
        remarks.append(f"the clock of the header stamps was set by {largest}{more}; the stamps are shifted back.")
    if log_steps:
        places = plural(log_steps, "place")
        remarks.append(f"the log times jump in {places}; the header stamps do not, and are used.")
    if unclear_ns:
        remarks.append(
            f"after {plural(len(unclear_ns), 'gap')} the log times are further from the header stamps, by up to "
            f"{max(unclear_ns, key=abs) / 1e9:+.3f} s. Was a clock set, or is the transport slower since? The stamps "
            "are not changed."
        )
    return remarks
