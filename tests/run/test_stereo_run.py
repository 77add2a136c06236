"""A drive with a stereo pair: metres are the pair's, and what the odometry's metres are off is found."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from vplog.data import Verdict
from vplog.execution.execution import Execution
from vplog.pipeline import load_pipeline, run
from vplog.results.run_record import read_run_json
from vplog.verbs.demo import SMALL, make_drive
from vplog.verbs.evaluate_run import evaluate

if TYPE_CHECKING:
    from pathlib import Path

BASELINE_M = 0.3
QUICK = (
    "features.max_features=300", "features.max_megapixels=0.05", "places.neighbours=8", "propose.per_query=2",
    "verify.calibration.pairs=0", "pictures.closures=0", "pictures.megapixels=0",
)  # fmt: skip


def test_metres_come_from_the_pair(tmp_path: Path) -> None:
    drive = make_drive(tmp_path / "drive", SMALL.model_copy(update={"stereo_baseline_m": BASELINE_M}))
    done = run(drive.log, tmp_path / "run", load_pipeline("default", QUICK), execution=Execution(2))
    accepted = [row for row, verdict in enumerate(done.closures.verdict) if verdict is Verdict.ACCEPTED]
    assert len(accepted) >= 10
    assert {done.closures.scale[row] for row in accepted} == {"stereo"}
    found = evaluate(tmp_path / "run", str(drive.truth))
    assert found["ate_after"]["rmse_m"] < 0.1 * found["ate_before"]["rmse_m"]
    record = read_run_json(tmp_path / "run" / "run.json")
    # the demo's odometry is 1 % too long
    assert record["odometry"]["scale"] == pytest.approx(1 / (1 + SMALL.odometry_scale_error), abs=0.01)
