"""Random clock faults of a camera and an odometry topic, and how many stamps are recovered.

`python -m tests.logs.simulated_clocks 300` prints the figures for 300 draws.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tests.logs.drives import START_NS
from vplog.logs.formats.container import Notes
from vplog.logs.recorder_clock import correct_clock_steps
from vplog.logs.stamps import Stamps, set_common_clock

if TYPE_CHECKING:
    from vplog.data import Floats, Ints

SECOND = 10**9
WITHIN_NS = 50_000_000
"""Largest error of a recovered stamp."""
FAULTS = ("none", "steps", "reset", "drift", "unit", "simulation", "recorder", "strays")
UNITS_PER_S = {"s": 1, "ms": 10**3, "us": 10**6}


@dataclass
class Topic:
    """One topic in the order of receipt, all (M,) in ns."""

    true_ns: Ints
    header_ns: Ints
    log_ns: Ints
    received_ns: Ints
    expected_ns: Ints
    """Times on the clock that the header stamps should be on."""


@dataclass
class Outcome:
    fault: str
    stamps: int
    recovered: int
    """Stamps within WITHIN_NS of the expected times, up to one constant for the drive."""
    lost: int
    """Stamps that are left out, and counted as lost."""
    is_said: bool
    """A warning says that header stamps are not used, or that a clock may be wrong."""
    lines: list[str]


def draw(seed: int) -> tuple[str, dict[str, Topic]]:
    """Draw a fault and a drive of 20 to 120 s."""
    rng = np.random.default_rng(seed)
    fault, affected = FAULTS[seed % len(FAULTS)], rng.choice(["both", "camera", "odometry"])
    seconds, lateness, lost = rng.uniform(20, 120), rng.choice(["small", "tail", "bursts"]), rng.choice([0, 0.1])
    at_s = np.cumsum(rng.uniform(0.15, 0.3, int(rng.integers(1, 4)))) * seconds
    sizes_s = rng.choice([-1, 1], len(at_s)) * 10 ** rng.uniform(np.log10(0.3), 5, len(at_s))
    rate = rng.uniform(0.2, 3.0) if rng.random() < 0.7 else 1.0
    drift = rng.choice([-1, 1]) * 10 ** rng.uniform(-5, -2.7)
    unit = UNITS_PER_S[rng.choice(list(UNITS_PER_S))]
    topics = {}
    for name, hz in (("camera", rng.uniform(5, 30)), ("odometry", rng.uniform(15, 100))):
        true_ns = START_NS + (np.arange(int(seconds * hz)) * SECOND / hz + rng.uniform(0, 5e6)).astype(np.int64)
        true_ns = true_ns[rng.random(len(true_ns)) >= lost]
        received_ns = true_ns + (rng.uniform(0.001, 0.02, len(true_ns)) * SECOND).astype(np.int64)
        if lateness == "tail":
            received_ns += ((rng.random(len(true_ns)) < 0.05) * rng.uniform(0, 0.5, len(true_ns)) * SECOND).astype(int)
        elif lateness == "bursts":
            received_ns = received_ns + -received_ns % (SECOND // 4) + np.arange(len(true_ns)) * 1000
        order = np.argsort(received_ns, kind="stable")
        true_ns, received_ns = true_ns[order], received_ns[order]
        since_ns, steps_ns = true_ns - START_NS, _steps(true_ns, at_s, sizes_s)
        header_ns, log_ns, expected_ns = true_ns, received_ns, true_ns
        if fault == "recorder":
            back_ns = _steps(received_ns, at_s, -np.abs(sizes_s.clip(-0.2 * seconds, 0.2 * seconds)))
            log_ns = received_ns + back_ns
            header_ns = true_ns + _steps(true_ns, at_s, -np.abs(sizes_s.clip(-0.2 * seconds, 0.2 * seconds)))
        elif fault == "simulation":
            header_ns = expected_ns = (since_ns * rate).astype(np.int64)
        elif affected in ("both", name):
            if fault == "steps":
                header_ns = true_ns + steps_ns
            elif fault == "reset":
                begin_s = np.append(0.0, at_s)[np.searchsorted(at_s, since_ns / SECOND, "right")]
                header_ns = since_ns - (begin_s * SECOND).astype(np.int64)
            elif fault == "drift":
                header_ns = true_ns + (since_ns * drift).astype(np.int64)
                expected_ns = header_ns if affected == "both" else true_ns
            elif fault == "unit":
                header_ns = true_ns // (SECOND // unit)
            elif fault == "strays":
                wrong = rng.random(len(true_ns)) < 0.03
                header_ns = np.where(wrong, true_ns + (rng.uniform(-9, 9, len(true_ns)) * SECOND).astype(int), true_ns)
        topics[name] = Topic(true_ns, header_ns, log_ns, received_ns, expected_ns)
    return fault, topics


def _steps(times_ns: Ints, at_s: Floats, sizes_s: Floats) -> Ints:
    is_after = times_ns[:, None] >= START_NS + (at_s * SECOND).astype(np.int64)
    return is_after @ (sizes_s * SECOND).astype(np.int64)


def recover(seed: int) -> Outcome:
    """Read the drawn topics as a log's are read, and compare their stamps with the expected times."""
    fault, topics = draw(seed)
    stamps, notes = {}, Notes()
    for name, topic in topics.items():
        stamps[name] = Stamps()
        stamps[name].extend(topic.header_ns.tolist(), topic.log_ns.tolist(), topic.received_ns.tolist())
    correct_clock_steps(stamps.values(), notes)
    set_common_clock(stamps.values())
    errors = []
    for name, topic in topics.items():
        stamp_ns, rows = stamps[name].order(f"/{name}", notes)
        errors.append(stamp_ns - topic.expected_ns[rows])
    errors_ns = np.sort(np.concatenate(errors))
    recovered = int((np.searchsorted(errors_ns, errors_ns + 2 * WITHIN_NS, "right") - np.arange(len(errors_ns))).max())
    lost = sum(loss.messages or 0 for loss in notes.account.losses)
    is_said = any("are used instead" in line or ("clock" in line and "?" in line) for line in notes.lines)
    return Outcome(fault, sum(len(topic.true_ns) for topic in topics.values()), recovered, lost, is_said, notes.lines)


def main(draws: int) -> None:
    """Print, for each fault, the share of stamps recovered and the draws that go wrong without a warning."""
    outcomes = defaultdict[str, list[Outcome]](list)
    for seed in range(draws):
        outcome = recover(seed)
        outcomes[outcome.fault].append(outcome)
        outcomes["all"].append(outcome)
    print(f"{'fault':>11} draws  stamps recovered  recovered draws  not recovered, said  not recovered, silent")
    for fault, group in outcomes.items():
        good = [outcome.recovered + outcome.lost >= 0.99 * outcome.stamps for outcome in group]
        said = sum(outcome.is_said and not is_good for outcome, is_good in zip(group, good, strict=True))
        share = sum(outcome.recovered for outcome in group) / sum(outcome.stamps for outcome in group)
        print(f"{fault:>11} {len(group):5} {share:17.1%} {sum(good):16} {said:20} {len(group) - sum(good) - said:22}")


if __name__ == "__main__":
    main(int(sys.argv[1]))
