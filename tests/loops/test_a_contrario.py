from __future__ import annotations

from math import comb, log10

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vplog.loops.verify_metric import log10_false_alarms


@given(st.integers(8, 300), st.data(), st.sampled_from([(3, 4), (7, 3)]), st.floats(1e-6, 1.0))
def test_agrees_with_the_formula_in_whole_numbers(n: int, data: st.DataObject, kind: tuple[int, int], p: float) -> None:
    sample, models = kind
    k = data.draw(st.integers(sample + 1, n)) if n > sample + 1 else n
    expected = log10(models * (n - sample)) + log10(comb(n, k)) + log10(comb(k, sample)) + (k - sample) * log10(p)
    assert log10_false_alarms(n, k, sample, models, p) == pytest.approx(expected, abs=1e-6)


def test_more_agreement_is_less_chance_and_the_sample_alone_is_none() -> None:
    alarms = [log10_false_alarms(60, k, 3, 4, 1e-3) for k in range(10, 61)]
    assert alarms == sorted(alarms, reverse=True)
    assert log10_false_alarms(60, 3, 3, 4, 1e-3) > 0
    assert log10_false_alarms(0, 0, 3, 4, 1e-3) >= 0
