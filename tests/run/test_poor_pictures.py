"""Drives whose pictures are poor: what is recognised all the same, and what is said of them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vplog.execution.execution import Execution
from vplog.pipeline import load_pipeline, run
from vplog.verbs.demo import SMALL, make_drive
from vplog.verbs.evaluate_run import evaluate

if TYPE_CHECKING:
    from pathlib import Path

QUICK = (
    "features.max_features=600", "places.neighbours=8", "propose.per_query=2", "verify.calibration.pairs=0",
    "pictures.closures=0", "pictures.megapixels=0",
)  # fmt: skip


def test_a_small_camera_recognises_its_revisits(tmp_path: Path) -> None:
    drive = make_drive(tmp_path / "drive", SMALL.model_copy(update={"width": 160, "height": 120}))
    found = {}
    for least in (0, 300):
        settings = load_pipeline("default", (*QUICK, f"features.min_features={least}"))
        done = run(drive.log, tmp_path / "run", settings, execution=Execution(2))
        closures = evaluate(tmp_path / "run", str(drive.truth))["closures"]
        assert closures["accepted_false"] == 0
        poor = [line for line in done.record["warnings"] if line.startswith("Pictures are")]
        found[least] = closures["recall"], poor
    assert found[300][0] > found[0][0] + 0.3
    assert not found[0][1]
    assert "small (160 x 120 px)" in found[300][1][0]


def test_good_pictures_are_called_nothing(finished: Path) -> None:
    from vplog.results.run_record import read_run_json
    from vplog.run.feature_extraction import stored_features

    features = stored_features(finished / ".cache")
    assert features is not None
    assert min(features.counts) > 300
    assert [len(features[row]) for row in range(3)] == features.counts[:3]
    assert np.all(["Pictures are" not in line for line in read_run_json(finished / "run.json")["warnings"]])
