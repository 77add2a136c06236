"""The messages of a log that could not be used, by reason and topic, with log times and a sentence per reason."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from itertools import groupby

import numpy as np

from vplog.data import Ints
from vplog.errors import plural

Span = tuple[int, int]
"""First and last ns of something, both included."""

REASONS = {
    "cut": "after the place where the file is cut off or unreadable to its end",
    "appended": "behind the end of the recording",
    "missing_file": "in storage files that are missing or unreadable",
    "damaged_bytes": "in bytes that hold no record",
    "damaged_chunk": "in damaged chunks or pages",
    "unknown_channel": "of channels without a definition",
    "packed": "that do not unpack",
    "undecodable": "that cannot be decoded",
    "empty_image": "without image data",
    "undecodable_image": "whose image cannot be decoded",
    "no_stamp": "without a header stamp",
    "stray_stamp": "with a header stamp far from its neighbours'",
    "repeated_stamp": "with the same stamp as an earlier one",
}
"""Every reason a message is lost for, as it follows `3 messages`."""
_MOST_SPANS = 64
"""Spans that one loss lists; the last of more reaches over the rest."""
_FARTHEST_NS = 86_400 * 10**9
"""ns before and behind a log in which messages may be lost that it began or ended with: a day."""
_NAMED = 4
"""Topics that a sentence names."""


@dataclass(frozen=True)
class TopicLoss:
    """Messages of one topic that were lost for one reason."""

    reason: str
    """One of REASONS."""
    topic: str
    """Empty where it is not known whose messages they were."""
    messages: int | None
    """None where it is not known how many: nothing whole in the log counted them."""
    of: int | None
    """Messages of the topic that were recorded, by the index, the statistics or the metadata; None where unknown."""
    spans_ns: tuple[Span, ...]
    """Log times of the first and last message of each run of lost ones, in order; empty where not known."""
    detail: str = ""
    """The first such loss in a sentence."""


@dataclass
class _Lost:
    messages: int | None
    spans: list[Span]
    detail: str


_OPEN = ("cut", "missing_file", "damaged_bytes", "unknown_channel", "damaged_chunk")
"""Reasons that may leave the number of lost messages open, the most serious first."""


@dataclass
class LossAccount:
    """The losses of one log while it is read. A loss that two passes over a file find is counted once."""

    start_ns: int | None = None
    """Log time that sentences count from."""
    end_ns: int = 0
    """Log time of the last message that was found."""
    _recorded: dict[str, dict[str, int]] = field(default_factory=dict)
    """Messages by topic of each file, as far as known."""
    _found: dict[tuple[str, str], dict[tuple[str, int], _Lost]] = field(default_factory=dict)

    def add(
        self,
        reason: str,
        counts: Mapping[str, int] | None,
        key: tuple[str, int],
        spans: list[Span],
        detail: str = "",
    ) -> None:
        """Add lost messages by topic. `counts` is None if their number is unknown, and {"": 0} if none is lost. `key`
        is a file or topic and a place in it; a loss with the same reason and key is replaced."""
        self._found.get((reason, ""), {}).pop(key, None)  # their topic, or how many, may be known by now
        spans = [(min(span), max(span)) for span in spans]  # damage may have turned them around
        for topic, count in ({"": None} if counts is None else counts).items():
            self._found.setdefault((reason, topic), {})[key] = _Lost(count, spans, detail)

    def add_appended(self, file: str, at: int, length: int) -> None:
        """Add the bytes after the end of a recording, from `at` to the file's `length`: an appended recording."""
        detail = (
            f"{file} ends at byte {at} of {length}, and another recording follows, which is not read. Split it there."
        )
        self.add("appended", None, (file, at), [], detail)

    def extend(self, other: LossAccount) -> None:
        """Add what another found."""
        for (reason, topic), places in other._found.items():
            for key, lost in places.items():
                counts = None if lost.messages is None else {topic: lost.messages}
                self.add(reason, counts, key, lost.spans, lost.detail)

    def undecodable(self, stamp_ns: Collection[int]) -> list[tuple[str, int]]:
        """Topic and stamp of the images of frames with these stamps that were found not to decode."""
        wanted, found = set(stamp_ns), self._copy().items()
        places = (key for (reason, _), places in found if reason == "undecodable_image" for key in places)
        return sorted(key for key in places if key[1] in wanted)

    def _copy(self) -> dict[tuple[str, str], dict[tuple[str, int], _Lost]]:
        """A copy of the losses so far; workers that decode images may add to it meanwhile."""
        return {key: places.copy() for key, places in self._found.copy().items()}

    def set_recorded(self, file: str, recorded: Mapping[str, int], start_ns: int, end_ns: int = 0) -> None:
        """Set how many messages of each topic a file recorded, by its own statistics, and the first and last log
        time."""
        self._recorded[file] = dict(recorded)
        self.end_ns = max(self.end_ns, end_ns)
        if start_ns:
            self.start_ns = start_ns if self.start_ns is None else min(self.start_ns, start_ns)

    def reconcile(
        self, files: Collection[str], recorded: Mapping[str, int], found: Mapping[str, int], end_ns: int | None = None
    ) -> dict[str, int]:
        """Make the losses in these files add up to the messages that were recorded less those `found`, by topic. If the
        numbers that are known do not exceed that, the losses of unknown number share the rest; else all losses do.
        `end_ns` is the end of the recording. Returns the messages that no loss explains."""
        if not recorded:
            return {}
        short = Counter({topic: max(count - found.get(topic, 0), 0) for topic, count in recorded.items()})
        losses = [
            (_OPEN.index(reason), key, topic, lost)
            for (reason, topic), places in self._found.items()
            for key, lost in places.items()
            if key[0] in files and reason in _OPEN
        ]
        counted = Counter[str]()
        for *_, topic, lost in losses:
            counted[topic] += lost.messages or 0 if topic else 0
        if counted <= short:
            short -= counted
            losses = [loss for loss in losses if not loss[2]]
        if not losses:
            return dict(+short)
        spans = merged([span for *_, lost in losses for span in lost.spans])
        order, key, *_ = min(losses, key=lambda loss: loss[:2])
        if _OPEN[order] == "cut" and spans and end_ns is not None:
            spans[-1] = spans[-1][0], max(spans[-1][1], end_ns)
        for place, loss_key, topic, _ in losses:
            del self._found[_OPEN[place], topic][loss_key]
        beside = {topic: places[key].messages for (reason, topic), places in self._found.items()
                  if reason == _OPEN[order] and key in places}  # fmt: skip
        detail = " ".join(dict.fromkeys(lost.detail for *_, lost in losses if lost.detail))
        self.add(_OPEN[order], +(short + Counter(beside)) or {"": 0}, key, spans, detail)
        return {}

    @property
    def losses(self) -> list[TopicLoss]:
        """By reason in the order of REASONS, then topic; the same for any order of reading."""
        recorded: Counter[str] = Counter()
        for counts in self._recorded.values():
            recorded.update(counts)
        order, found, result, log = list(REASONS), self._copy(), [], self._span
        for reason, topic in sorted(found, key=lambda key: (order.index(key[0]), key)):
            places = found[reason, topic]
            lost = [places[key] for key in sorted(places)]
            if lost:
                messages = None if None in (counts := [one.messages for one in lost]) else sum(n or 0 for n in counts)
                spans = tuple(merged([span for one in lost for span in _in_log(reason, one.spans, log)]))
                result.append(TopicLoss(reason, topic, messages, recorded.get(topic), spans, lost[0].detail))
        return result

    @property
    def _span(self) -> Span:
        """Log times of the first and last message; where none was found, where most of the lost ones lie."""
        if self.start_ns is not None:
            return self.start_ns, max(self.start_ns, self.end_ns)
        found = [
            ns for places in self._copy().values() for lost in places.values() for span in lost.spans for ns in span
        ]
        return confirmed_span([ns for ns in found if ns])

    @property
    def sentences(self) -> list[str]:
        """One for each reason."""
        groups = groupby(self.losses, key=lambda loss: loss.reason)
        return [self._sentence(reason, list(group)) for reason, group in groups]

    def _sentence(self, reason: str, group: list[TopicLoss]) -> str:
        known = [loss.messages for loss in group if loss.messages is not None]
        total = sum(known)
        is_counted = len(known) == len(group)
        what = plural(total, "message") if total else "no message" if is_counted else "an unknown number of messages"
        if total and not is_counted:
            what = f"at least {what}"
        named = [f"{loss.topic}{_count(loss)}" for loss in group if loss.topic]
        which, more = ", ".join(named[:_NAMED]), len(named) - _NAMED
        which += "" if more <= 0 else " and another topic" if more == 1 else f" and {more} more topics"
        spans = merged([span for loss in group for span in loss.spans_ns])
        when = f", {self._when(spans)}" if spans else ""
        detail = next((f" {loss.detail}" for loss in group if loss.detail), "")
        return f"Lost: {what} {REASONS[reason]}{when}{f': {which}' if which else ''}.{detail}"

    def _when(self, spans: list[Span]) -> str:
        first, last = (f"{(ns - (self.start_ns or 0)) / 1e9:.3f}" for ns in (spans[0][0], spans[-1][1]))
        where = f" in {len(spans)} places" if len(spans) > 1 else ""
        return f"at t={first} s" if first == last else f"from t={first} to {last} s{where}"


def _in_log(reason: str, spans: list[Span], log: Span) -> list[Span]:
    """Return the spans without what is far from those of the log, because damage has changed these stamps."""
    if reason not in _OPEN:
        return spans
    spans = [(a or b, b) for a, b in spans if b]  # 0 is no time
    start, end = log
    least, most = start - _FARTHEST_NS, end + _FARTHEST_NS
    ends = [(max(a, min(start, b)) if a < least else a, min(b, max(end, a)) if b > most else b) for a, b in spans]
    return [(a, b) for a, b in ends if a <= most and b >= least]


def _count(loss: TopicLoss) -> str:
    if loss.messages is None:
        return ""
    return f" {loss.messages}" + (f" of {loss.of}" if loss.of is not None else "")


def sampled(log_ns: Collection[int]) -> list[int]:
    """Return the first, the middle and the last time of a chunk, one of which may be damaged."""
    ordered = sorted(log_ns)
    return [ordered[at] for at in (0, len(ordered) // 2, -1)] if ordered else []


def confirmed_span(times: Collection[int]) -> Span:
    """Return the first and last of these log times. A time that is a day from all others is left out, because damage
    has changed it, unless there are no others."""
    runs: list[list[int]] = []
    for time_ns in sorted(times):
        if runs and time_ns - runs[-1][-1] <= _FARTHEST_NS:
            runs[-1].append(time_ns)
        else:
            runs.append([time_ns])
    several = [run for run in runs if run[0] < run[-1]] or [max(runs, key=len, default=[0])]
    return several[0][0], several[-1][-1]


def merged(spans: list[Span]) -> list[Span]:
    """Return the spans in order, with overlapping ones joined, at most _MOST_SPANS."""
    result: list[Span] = []
    for start, stop in sorted(spans):
        if result and (start <= result[-1][1] or len(result) == _MOST_SPANS):
            result[-1] = result[-1][0], max(stop, result[-1][1])
        else:
            result.append((start, stop))
    return result


def runs_of(lost: np.ndarray, log_ns: Ints) -> list[Span]:
    """Return the log times of the runs of lost messages; `lost` (M,) bool and log_ns (M,) are in file order."""
    edges = np.diff(np.concatenate([[0], lost.astype(np.int8), [0]]))
    starts, stops = np.flatnonzero(edges > 0), np.flatnonzero(edges < 0)
    times = [log_ns[a:b] for a, b in zip(starts, stops, strict=True)]
    return merged([(int(run.min()), int(run.max())) for run in times])


@dataclass
class LossRuns:
    """Runs of lost messages among the sound ones of one topic, collected message by message."""

    messages: int = 0
    spans: list[Span] = field(default_factory=list)
    _open: bool = False

    def add_lost(self, log_ns: int) -> None:
        self.messages += 1
        if self.spans and (self._open or len(self.spans) == _MOST_SPANS):
            self.spans[-1] = min(self.spans[-1][0], log_ns), max(self.spans[-1][1], log_ns)
        else:
            self.spans.append((log_ns, log_ns))
        self._open = True

    def add_sound(self) -> None:
        self._open = False
