"""Drawn drives whose clocks are set several times within seconds, with gaps, losses and bursts: the order stays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.logs.drives import START_NS
from vplog.logs.formats.container import Notes
from vplog.logs.messages.records import PoseMessage
from vplog.logs.recorder_clock import correct_clock_steps
from vplog.logs.stamps import Stamps, set_common_clock
from vplog.logs.tracks import PoseTrack

if TYPE_CHECKING:
    from vplog.data import Ints

SECOND = 10**9
LATE = ("none", "small", "large", "bursts")


@dataclass
class Received:
    """One topic in the order of receipt."""

    true_ns: Ints
    received_ns: Ints
    header_ns: Ints
    log_ns: Ints


def steps(rng: np.random.Generator, seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """When, in seconds, and by how many seconds clocks are set back, one to four times; at times one forward."""
    count = int(rng.integers(1, 5))
    at = rng.uniform(3, seconds - 8) + np.cumsum(np.append(0, rng.uniform(0.4, 4, count - 1)))
    at = at[at < seconds - 1.5]
    sizes = rng.uniform(0.3, 5, len(at))
    sizes[rng.integers(len(sizes))] *= rng.choice([1, 1, -1])
    return at, sizes


def drawn(seed: int) -> dict[str, Received]:
    rng = np.random.default_rng(seed)
    seconds = rng.uniform(15, 40)
    clock, late, lost = rng.choice(["header", "both", "log", "camera", "odom"]), rng.choice(LATE), rng.choice([0, 0.2])
    at, sizes = steps(rng, seconds)
    gap = rng.uniform(2, seconds - 4) + np.array([0, rng.uniform(0, 4)])
    rates = {"camera": rng.uniform(5, 30), "odom": rng.uniform(10, 60), "imu": rng.uniform(50, 100)}
    found = {}
    for name, hz in rates.items():
        true_ns = START_NS + (np.arange(int(seconds * hz)) * SECOND / hz).astype(np.int64)
        true_ns = true_ns[rng.random(len(true_ns)) >= lost]
        since = (true_ns - START_NS) / SECOND
        if rng.random() < 0.5:
            true_ns = true_ns[(since < gap[0]) | (since > gap[1])]
        received = true_ns + rng.integers(0, 50_000, len(true_ns))
        delay = rng.uniform(0, min(1.5 / hz, 0.06) if late == "large" else 0.005 * (late == "small"), len(true_ns))
        received += -true_ns % (SECOND // 8) if late == "bursts" else (delay * SECOND).astype(np.int64)
        order = np.argsort(received, kind="stable")
        true_ns, received = true_ns[order], received[order]
        back = [(ns[:, None] >= START_NS + at * SECOND) @ (sizes * SECOND) for ns in (true_ns, received)]
        header_ns = true_ns - back[0].astype(np.int64) * (clock in ("header", "both", name))
        log_ns = received - back[1].astype(np.int64) * (clock in ("log", "both"))
        found[name] = Received(true_ns, received, header_ns, log_ns)
    return found


@pytest.mark.parametrize("still", [True, False])
def test_nothing_is_interleaved(still: bool) -> None:
    """Images and poses come out in the order in which they were taken, each topic with all its messages."""
    for seed in range(12):
        topics = drawn(seed)
        track, camera, imu = PoseTrack("/odom"), Stamps(), Stamps()
        one = topics["odom"]
        for true_ns, position, header_ns, log_ns in zip(
            one.true_ns.tolist(), one.received_ns.tolist(), one.header_ns.tolist(), one.log_ns.tolist(), strict=True
        ):
            place = (0.0 if still else (true_ns - START_NS) / SECOND, 0.0, 0.0)
            track.add(PoseMessage(header_ns, "odom", "base_link", place, (0.0, 0.0, 0.0, 1.0), None), log_ns, position)
        one = topics["camera"]
        camera.extend(one.header_ns.tolist(), one.log_ns.tolist(), one.received_ns.tolist())
        one = topics["imu"]
        imu.extend([0] * len(one.log_ns), one.log_ns.tolist(), one.received_ns.tolist())
        track.set_xyz()
        correct_clock_steps([camera, track.stamps, imu], notes := Notes())
        set_common_clock([camera, track.stamps])
        for name, stamps in {"camera": camera, "odom": track.stamps}.items():
            _, rows = stamps.order(f"/{name}", notes)
            true_ns = topics[name].true_ns
            late_ns = np.maximum.accumulate(true_ns[rows]) - true_ns[rows]
            assert late_ns.max() <= 3 * np.median(np.diff(np.sort(true_ns))) + 1e8, (seed, name, notes.lines)
            assert len(rows) >= 0.97 * len(true_ns), (seed, name, notes.lines)
            if "log" not in " ".join(notes.lines) and "clock" not in " ".join(notes.lines):
                np.testing.assert_array_equal(topics[name].header_ns, true_ns)


@pytest.mark.parametrize("back_s", [0.75, 1.05, 1.55, 2.55])
def test_an_image_at_a_step_inside_a_gap_is_not_sorted_silently(back_s: float) -> None:
    """The one image in a gap is on a clock that was set back; by what surrounds it, it may also be late."""
    true_ns = START_NS + np.r_[0:100, 102, 130:230] * (SECOND // 10)
    header_ns = true_ns - (np.arange(len(true_ns)) == 100) * int(back_s * SECOND)
    stamps = Stamps()
    stamps.extend(header_ns.tolist(), true_ns.tolist())
    stamp_ns, _ = stamps.order("/camera", notes := Notes())
    said = " ".join(notes.lines)
    assert np.isin(stamp_ns, true_ns).all() or "clock" in said, said
