"""Header stamps whose clock jumps, stands, is another or was never set, against the true times."""

from __future__ import annotations

from array import array
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.logs.drives import START_NS, Drive, ros_messages, write_ros2
from vplog import logs
from vplog.logs.clocks import AlignedStamps, align_clock
from vplog.logs.formats.container import Notes
from vplog.logs.stamps import Stamps, rate_hz, set_common_clock

if TYPE_CHECKING:
    from pathlib import Path

SECOND = 10**9
PERIOD_NS = 100_000_000
JITTER_NS = 20_000_000
"""Log times are up to this later than the true ones."""


def times(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """True times and log times of a topic."""
    true_ns = START_NS + PERIOD_NS * np.arange(count)
    return true_ns, true_ns + np.random.default_rng(seed).integers(0, JITTER_NS, count)


def stamps(header_ns: np.ndarray, log_ns: np.ndarray) -> Stamps:
    return Stamps(array("q", header_ns.tolist()), array("q", log_ns.tolist()))


steps = st.integers(2, 10**8).flatmap(lambda s: st.sampled_from([s * SECOND, -s * SECOND]))


@given(st.integers(20, 80), st.lists(st.tuples(st.integers(1, 9), steps), max_size=3))
def test_a_clock_that_is_set_is_followed(count: int, jumps: list[tuple[int, int]]) -> None:
    """After the repair all stamps differ from the true times by one constant, up to the jitter of the log times."""
    jumps = [(8 * at, step) for at, step in jumps if 8 * at <= count - 8]
    true_ns, log_ns = times(count)
    header_ns = true_ns.copy()
    for at, step in jumps:
        header_ns[at:] += step
    found = align_clock(header_ns, log_ns)
    assert isinstance(found, AlignedStamps)
    assert found.valid.all()
    errors = found.stamp_ns - true_ns
    assert errors.max() - errors.min() <= JITTER_NS
    assert any("was set by" in remark for remark in found.remarks) == (len(np.unique(header_ns - true_ns)) > 1)


@given(st.integers(20, 80), st.data())
def test_stray_stamps_are_told_and_nothing_else(count: int, data: st.DataObject) -> None:
    true_ns, log_ns = times(count)
    stray = sorted(data.draw(st.sets(st.integers(0, count // 6 - 1), max_size=4)))
    rows = [6 * row for row in stray]
    header_ns = true_ns.copy()
    for row in rows:
        step = data.draw(steps)
        header_ns[row] += step + step // 4  # by less than 2 s a message may be late
    header_ns = np.maximum(header_ns, 1)
    found = align_clock(header_ns, log_ns)
    assert isinstance(found, AlignedStamps)
    assert np.flatnonzero(~found.valid).tolist() == rows
    np.testing.assert_array_equal(found.stamp_ns[found.valid], true_ns[found.valid])


@given(st.integers(-(10**18), 10**18), st.floats(0.2, 5.0))
def test_any_clock_that_runs_is_left_as_it_is(offset_ns: int, rate: float) -> None:
    """A simulation's, at any rate, and one far from the recorder's."""
    true_ns, log_ns = times(50)
    header_ns = ((true_ns - START_NS) * rate).astype(np.int64) + START_NS + offset_ns
    found = align_clock(header_ns, log_ns)
    assert isinstance(found, AlignedStamps)
    assert found.valid.all()
    np.testing.assert_array_equal(found.stamp_ns, header_ns)


def test_a_recorder_whose_clock_is_set_changes_no_stamp() -> None:
    true_ns, log_ns = times(50)
    log_ns[25:] += 3600 * SECOND
    stamp_ns, rows = stamps(true_ns, log_ns).order("/t", notes := Notes())
    np.testing.assert_array_equal(stamp_ns, true_ns)
    assert len(rows) == 50
    assert notes.lines == ["/t: the log times jump in 1 place; the header stamps do not, and are used."]


def test_a_real_gap_is_no_jump_and_is_told() -> None:
    true_ns, log_ns = times(50)
    true_ns[25:] += 60 * SECOND
    log_ns[25:] += 60 * SECOND
    stamp_ns, _ = stamps(true_ns, log_ns).order("/t", notes := Notes())
    np.testing.assert_array_equal(stamp_ns, true_ns)
    assert notes.lines == ["/t: 1 gap, the longest 60.1 s, 2.4 s after its first message."]


@pytest.mark.parametrize(("messages", "kept"), [(2, 1), (3, 3), (5, 5), (11, 11)])
def test_few_messages_with_one_stamp_have_a_clock_that_stands(messages: int, kept: int) -> None:
    """Two may be one message, recorded twice."""
    true_ns, log_ns = times(messages)
    stamp_ns, _ = stamps(np.full(messages, true_ns[0]), log_ns).order("/t", Notes())
    assert len(stamp_ns) == kept


@pytest.mark.parametrize(
    ("header", "said"),
    [
        (lambda true: np.where(np.arange(len(true)) % 3 == 0, true, 0), "has no header stamps"),
        (lambda true: np.full(len(true), true[0]), "has header stamps that do not advance"),
        (lambda true: true // SECOND * SECOND + true % SECOND // 1000, "has header stamps in whole seconds"),
        (lambda true: true // SECOND * SECOND + true % SECOND // 10**6, "has header stamps in whole seconds"),
        (lambda true: true[0] + (true - true[0]) // 1000, "has header stamps in another unit than ns"),
        (lambda true: true + 50 * SECOND * (np.arange(len(true)) // 10) ** 2, "has header stamps that follow no clock"),
    ],
)
def test_stamps_that_are_none_give_way_to_the_log_times(header: object, said: str) -> None:
    true_ns, log_ns = times(300)
    topic, other = stamps(header(true_ns), log_ns), stamps(true_ns[::2], log_ns[::2])  # type: ignore[operator]
    set_common_clock([topic, other])
    stamp_ns, _ = topic.order("/t", notes := Notes())
    np.testing.assert_array_equal(stamp_ns, log_ns)
    assert said in notes.lines[0]
    np.testing.assert_array_equal(other.order("/other", notes := Notes())[0], true_ns[::2])
    assert notes.lines == []


@pytest.mark.parametrize("rate", [0.01, 0.05, 0.3, 20.0])
def test_a_simulation_keeps_its_stamps(rate: float) -> None:
    """Slow or fast, and of transforms that come in bursts with one stamp."""
    true_ns, log_ns = times(300)
    header_ns = ((true_ns - START_NS) * rate).astype(np.int64) + SECOND
    np.testing.assert_array_equal(stamps(header_ns, log_ns).order("/t", Notes())[0], header_ns)
    bursts, at_ns = np.repeat(header_ns, 3), (log_ns[:, None] + [0, 20_000, 40_000]).ravel()
    np.testing.assert_array_equal(stamps(bursts, at_ns).order("/t", Notes())[0], header_ns)


@given(st.integers(0, 2**32 - 1), st.floats(0.2, 3.0), st.booleans())
def test_links_that_stall_lose_nothing_and_are_no_clock_that_was_set(seed: int, stall_s: float, again: bool) -> None:
    """Messages wait for the link, or are sent again one by one, by less than 2 s."""
    rng = np.random.default_rng(seed)
    true_ns = START_NS + int(rng.uniform(0.005, 0.1) * SECOND) * np.arange(400)
    ends_ns = START_NS + (np.cumsum(rng.uniform(0.05, stall_s, 2000)) * SECOND).astype(np.int64)
    log_ns = ends_ns[np.searchsorted(ends_ns, true_ns)] + 1000 * np.arange(400)
    if again:
        log_ns = true_ns + (rng.random(400) < 0.1) * rng.integers(0, int(1.9 * SECOND), 400)
    received = log_ns <= max(true_ns[-1], ends_ns[0])
    order = np.argsort(log_ns[received], kind="stable")
    stamp_ns, _ = stamps(true_ns[received][order], log_ns[received][order]).order("/t", notes := Notes())
    np.testing.assert_array_equal(stamp_ns, true_ns[received])
    assert not [line for line in notes.lines if "jump" in line or "Lost" in line]


def test_what_is_dropped_is_counted_and_placed() -> None:
    true_ns, log_ns = times(50)
    header_ns = true_ns.copy()
    header_ns[7], header_ns[20], header_ns[30] = 0, header_ns[19], 5 * SECOND
    stamp_ns, rows = stamps(header_ns, log_ns).order("/t", notes := Notes())
    np.testing.assert_array_equal(stamp_ns, np.delete(true_ns, [7, 20, 30]))
    np.testing.assert_array_equal(rows, np.delete(np.arange(50), [7, 20, 30]))
    found = {loss.reason: (loss.messages, loss.spans_ns) for loss in notes.account.losses}
    assert found == {
        "no_stamp": (1, ((log_ns[7], log_ns[7]),)),
        "repeated_stamp": (1, ((log_ns[20], log_ns[20]),)),
        "stray_stamp": (1, ((log_ns[30], log_ns[30]),)),
    }


def test_topics_end_on_the_clock_that_most_messages_are_on() -> None:
    """The camera's clock is set back early on, the odometry's never: most of the images are on the wrong one."""
    true_ns, log_ns = times(100)
    camera = stamps(np.where(np.arange(100) < 20, true_ns, true_ns - 50 * SECOND), log_ns)
    true2_ns, log2_ns = times(200, seed=1)
    odometry = stamps(true2_ns, log2_ns)
    set_common_clock([camera, odometry])
    assert np.abs(camera.order("/camera", Notes())[0] - true_ns).max() <= JITTER_NS
    np.testing.assert_array_equal(odometry.order("/odometry", Notes())[0], true2_ns)


def test_a_topic_on_another_clock_is_moved_where_it_fits_nowhere_and_told_of_where_it_may_be_right() -> None:
    true_ns, log_ns = times(100)
    for offset, moved in ((-1_000_000 * SECOND, True), (-5 * SECOND, False), (18 * SECOND, True)):
        camera, odometry = stamps(true_ns, log_ns), stamps(true_ns[::2] + offset, log_ns[::2])
        set_common_clock([camera, odometry])
        camera.order("/camera", quiet := Notes())
        stamp_ns, _ = odometry.order("/odometry", notes := Notes())
        assert (np.abs(stamp_ns - true_ns[::2]).max() <= JITTER_NS) == moved
        assert quiet.lines == []
        assert ("from another clock" if moved else "Were they recorded late") in notes.lines[0]


@pytest.mark.parametrize("offset_s", [-1_000_000, 0])
def test_the_cameras_of_a_body_end_on_the_clock_of_its_odometry(offset_s: int) -> None:
    """Of few messages: the log of each camera holds it, and other images."""
    true_ns, log_ns = times(100)
    camera, odometry = stamps(true_ns + offset_s * SECOND, log_ns), stamps(true_ns[::2], log_ns[::2])
    set_common_clock([camera, odometry], [odometry])
    np.testing.assert_array_equal(odometry.order("/odometry", Notes())[0], true_ns[::2])
    assert np.abs(camera.order("/camera", Notes())[0] - true_ns).max() <= JITTER_NS


def test_a_clock_that_is_set_in_a_whole_log(tmp_path: Path) -> None:
    """Every topic's clock is set an hour ahead in the middle: images and odometry stay together."""
    messages = []
    for turn in range(8):
        for m in ros_messages(Drive(), 2):
            m.stamp_ns += turn * SECOND // 2
            if m.topic != "/tf_static":
                stamp_ns = m.stamp_ns + 3600 * SECOND * (turn >= 4)
                m.message.header.stamp.sec, m.message.header.stamp.nanosec = divmod(stamp_ns, SECOND)
            messages.append(m)
    log = logs.open(write_ros2(tmp_path / "drive", messages))
    odometry = log.odometry()
    assert odometry is not None
    np.testing.assert_array_equal(np.diff(log.stamps()), PERIOD_NS)
    np.testing.assert_array_equal(odometry.stamp_ns, log.stamps())
    assert "the clock of the header stamps was set by +3600.000 s" in " ".join(log.warnings)


@pytest.mark.parametrize(
    ("header_ns", "log_ns", "hz"),
    [
        # 4 periods in 7.6 s, however short most of them are
        (
            START_NS + np.array([0, 80, 160, 240, 7600]) * 10**6,
            START_NS + np.array([1, 81, 161, 241, 7601]) * 10**6,
            0.526,
        ),
        (START_NS + np.arange(10), START_NS + np.arange(10), None),  # counters, no times
        (np.full(20, START_NS), START_NS + SECOND // 4 * np.arange(20), 4.0),  # stamps that stand
        (np.array([START_NS]), np.array([START_NS]), None),
    ],
)
def test_the_rate_is_that_of_the_time_between_first_and_last(
    header_ns: np.ndarray, log_ns: np.ndarray, hz: float | None
) -> None:
    assert rate_hz(stamps(header_ns, log_ns).order("", Notes())[0]) == hz
