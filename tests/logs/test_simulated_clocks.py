"""Most stamps of random clock faults are recovered, or a warning says that they are not."""

from __future__ import annotations

import numpy as np
import pytest

from tests.logs.drives import START_NS
from tests.logs.simulated_clocks import FAULTS, SECOND, UNITS_PER_S, recover
from vplog.logs.formats.container import Notes
from vplog.logs.stamps import Stamps, set_common_clock


@pytest.mark.parametrize("fault", FAULTS)
def test_stamps_are_recovered_or_a_warning_says_that_they_are_not(fault: str) -> None:
    outcomes = [recover(seed) for seed in range(FAULTS.index(fault), 10 * len(FAULTS), len(FAULTS))]
    good = [outcome.recovered + outcome.lost >= 0.99 * outcome.stamps for outcome in outcomes]
    silent = [outcome for outcome, is_good in zip(outcomes, good, strict=True) if not is_good and not outcome.is_said]
    assert {outcome.fault for outcome in outcomes} == {fault}
    assert sum(good) >= (6 if fault in ("unit", "recorder") else 9)
    assert len(silent) <= (fault == "drift"), [outcome.lines for outcome in silent]


@pytest.mark.parametrize("unit", UNITS_PER_S)
def test_stamps_in_another_unit_are_converted_if_they_are_fine_enough(unit: str) -> None:
    true_ns = START_NS + SECOND // 10 * np.arange(200)
    log_ns = true_ns + np.random.default_rng(0).integers(0, SECOND // 2, 200)
    stamps = Stamps()
    stamps.extend((true_ns // (SECOND // UNITS_PER_S[unit])).tolist(), log_ns.tolist())
    stamp_ns, rows = stamps.order("/t", notes := Notes())
    if unit == "s":
        np.testing.assert_array_equal(stamp_ns, np.sort(log_ns))
        assert "whole seconds" in notes.lines[0]
    else:
        np.testing.assert_array_equal(stamp_ns, true_ns[rows])
        assert notes.lines[0] == f"/t: the header stamps are in {unit}, not in ns; they are converted."


def test_a_simulation_that_starts_at_0_keeps_its_first_message() -> None:
    true_ns = SECOND // 10 * np.arange(100)
    stamps = Stamps()
    stamps.extend(true_ns.tolist(), (START_NS + 2 * true_ns).tolist())
    np.testing.assert_array_equal(stamps.order("/t", notes := Notes())[0], true_ns)
    assert notes.lines == []


def test_a_simulation_that_is_restarted_loses_no_message() -> None:
    """The second part is longer; on its clock the stamps of the first would be negative."""
    true_ns = SECOND // 10 * np.arange(300)
    restarted = Stamps()
    restarted.extend(
        np.where(true_ns < 10 * SECOND, true_ns, true_ns - 10 * SECOND).tolist(), (START_NS + true_ns).tolist()
    )
    set_common_clock([restarted])
    np.testing.assert_array_equal(restarted.order("/t", notes := Notes())[0], true_ns)
    assert notes.lines == ["/t: the clock of the header stamps was set by -10.000 s; the stamps are shifted back."]
