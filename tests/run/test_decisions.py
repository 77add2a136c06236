"""Decisions on closures: what the file may hold, what they change, and that geometry is heard all the same."""

from __future__ import annotations

import shutil
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.graph.drive import ledger, ring
from vplog.data import EdgeKind, Verdict
from vplog.errors import SettingsError
from vplog.pipeline import Pipeline
from vplog.results import tables
from vplog.results.run_record import read_run_json
from vplog.run.back_end import solve
from vplog.run.decisions import read_decisions

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from conftest import Said

    from vplog.run.back_end import BackEndResult
    from vplog.verbs.demo.record import Demo

HEADER = "query,match,decision,who,when,reason\n"
KEYFRAMES = ring(40).keyframes


def test_pairs_are_named_by_row_or_stamp_in_either_order(tmp_path: Path) -> None:
    path = tmp_path / "decisions.csv"
    stamps = KEYFRAMES.stamp_ns
    path.write_text(
        f'{HEADER}30,2,reject,me,2026-01-01,"no, another door"\n\n{stamps[1]},{stamps[35]},add,,,\n31,3,accept,,,\n'
    )
    found = read_decisions(path, KEYFRAMES)
    assert (found.accepted, found.rejected) == ([(31, 3), (35, 1)], [(30, 2)])
    path.write_text("query,match,decision\n31,3,accept\n32,4,same\n33,5,\n34,6,same\n35,7,reject\n36,8,same\n")
    found = read_decisions(path, KEYFRAMES)
    assert (found.accepted, found.rejected) == ([(31, 3), (32, 4)], [(35, 7), (36, 8)])  # and others are open
    path.write_text("query,match,decision\n30,2,reject\n30,2,reject\n")
    assert read_decisions(path, KEYFRAMES).rejected == [(30, 2)]


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("", "is empty"),
        ("a,b\n", ":1 is not the header"),
        (f"{HEADER}30,2,reject\n", ":2 does not hold 6 fields"),
        (f"{HEADER}30,2,perhaps,,,\n", ":2 does not hold a decision in the third field"),
        (f"{HEADER}30,40,reject,,,\n", ":2: '40' is no keyframe of ring. Its rows are 0..39"),
        (f"{HEADER}-1,2,reject,,,\n", "'-1' is no keyframe"),
        (f"{HEADER}2.0,9,reject,,,\n", "'2.0' is no keyframe"),
        (f"{HEADER}7,8,add,,,\n", "keyframes 7 and 8 are joined by odometry"),
        (f"{HEADER}30,2,reject,,,\n2,30,add,,,\n", ":3 decides otherwise than"),
        ("query,match,decision\n" + "x" * 5000, "longer than"),
    ],
)
def test_a_file_that_does_not_fit_is_refused_with_its_line(text: str, what: str, tmp_path: Path) -> None:
    (tmp_path / "decisions.csv").write_text(text)
    with pytest.raises(SettingsError) as error:
        read_decisions(tmp_path / "decisions.csv", KEYFRAMES)
    assert what in str(error.value)


def decided(row: int, verdict: Verdict, aside_m: float = 0.0) -> BackEndResult:
    """A drive of two laps with 60 true closures, one of which is decided and may be moved."""
    drive = ring(240, 60, seed=4)
    loops = ~drive.graph.odometry
    measured = drive.graph.a_from_b[loops].copy()
    measured[row, 0, 3] += aside_m
    closures = ledger(drive.graph.b[loops], drive.graph.a[loops], measured)
    verdicts = [verdict if at == row else one for at, one in enumerate(closures.verdict)]
    return solve(drive.odometry, drive.keyframes, replace(closures, verdict=verdicts), None, Pipeline())


def test_a_false_closure_goes_unless_it_is_accepted_by_decision() -> None:
    alone = decided(5, Verdict.ACCEPTED, 8.0)
    assert alone.closures.verdict[5] is Verdict.REJECTED_BY_SOLVER
    known = decided(5, Verdict.ACCEPTED_BY_DECISION, 8.0)
    assert known.closures.verdict[5] is Verdict.ACCEPTED_BY_DECISION
    assert (known.closures.weight[5], known.refined.graph.kind.count(EdgeKind.KNOWN_LOOP)) == (1.0, 1)
    [warning] = [text for text in known.warnings if "Decision" in text]
    query, match = known.closures.query[5], known.closures.match[5]
    assert f"accept keyframes {query} and {match}: the robust solve without decisions rejects" in warning


def test_a_true_closure_is_accepted_without_a_warning_and_rejected_with_one() -> None:
    known = decided(5, Verdict.ACCEPTED_BY_DECISION)
    assert not [text for text in known.warnings if "Decision" in text]
    gone = decided(5, Verdict.REJECTED_BY_DECISION)
    assert np.isnan(gone.closures.weight[5])
    [warning] = [text for text in gone.warnings if "Decision" in text]
    assert "seems to be a true closure" in warning


def test_a_run_follows_decisions_and_computes_no_image_again(
    finished: Path, drive: Demo, verb: Callable[..., Said], tmp_path: Path
) -> None:
    out, path = tmp_path / "run", tmp_path / "decisions.csv"
    shutil.copytree(finished, out)
    before = tables.read_closures(finished / "closures.parquet")
    accepted = np.flatnonzero(before.accepted).tolist()
    wrong, new = accepted[0], accepted[-1]
    known = set(zip(before.query.tolist(), before.match.tolist(), strict=True))
    beside = int(before.match[new]) + 1  # shows what its match shows, and was suppressed for that
    assert (int(before.query[new]), beside) not in known
    path.write_text(
        f"{HEADER}{before.query[wrong]},{before.match[wrong]},reject,,,\n{before.query[new]},{beside},add,,,\n"
    )
    record = verb("run", drive.log, "-o", out, "--decisions", path, "--json").json
    assert record["counts"]["verdicts"]["rejected_by_decision"] == 1
    assert record["counts"]["verdicts"]["accepted_by_decision"] == 1
    stages = read_run_json(out / "run.json")["stages"]
    assert {stages[name]["result"] for name in ("extract", "describe", "propose", "verify", "p_false")} == {"reused"}
    after = tables.read_closures(out / "closures.parquet")
    assert len(after) == len(before) + 1
    order = np.lexsort([after.rank, after.query])
    np.testing.assert_array_equal(order, np.arange(len(after)))
    row = int(np.flatnonzero((after.query == before.query[new]) & (after.match == beside))[0])
    assert after.verdict[row] is Verdict.ACCEPTED_BY_DECISION
    assert after.weight[row] == 1.0
    assert np.linalg.eigvalsh(after.information[row])[0] > 0
    assert "Accepted: A known inlier" in verb("explain", out, "--closure", row, "--no-picture").out


def test_decisions_are_for_one_drive(drive: Demo, verb: Callable[..., Said], tmp_path: Path) -> None:
    (tmp_path / "decisions.csv").write_text(HEADER)
    given = "-o", tmp_path / "out", "--decisions", tmp_path / "decisions.csv"
    assert "one drive at a time" in verb("run", drive.log, drive.log, *given).error
