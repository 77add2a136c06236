"""A finished run against the truth: trajectory error before and after, and whether the closures were right."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

from vplog.data import Trajectory
from vplog.errors import ResultError, TruthError
from vplog.evaluate import closures, gps, residuals, trajectory
from vplog.evaluate.truth import read_truth
from vplog.loops.propose import ProposeSettings, candidate_stops
from vplog.record import reopened
from vplog.results import run_record, tables
from vplog.urls import without_secrets

if TYPE_CHECKING:
    from pathlib import Path

    from vplog import logs


def evaluate(folder: Path, truth: str, topics: logs.TopicChoice | None = None) -> dict[str, Any]:
    """ATE and RPE of odometry and result, and the closures' precision and recall. `truth` is a TUM file or `gps`.

    Of several drives in one folder the ATE of each by itself, and of each map as one trajectory.

    Raises TruthError or ResultError with one line.
    """
    record = run_record.read_finished_run(folder)
    if "maps" in record:
        return _joint(folder, record, truth)
    after, odometry = tables.read_trajectory(folder / "trajectory.parquet")
    before = Trajectory(odometry.stamp_ns, odometry.odom_from_body)
    if truth == "gps":
        return {"truth": "gps", **_against_gps(record, before, after, topics)}
    known = read_truth(truth)
    keyframes, _ = tables.read_keyframes(folder / "keyframes.parquet")
    ledger = tables.read_closures(folder / "closures.parquet")
    settings = _recorded(record, folder, dict, "settings", "propose")
    stops = candidate_stops(keyframes, ProposeSettings.read(settings, f"{folder}/run.json"))
    return {
        "truth": without_secrets(truth),
        "ate_before": asdict(trajectory.ate(before, known)),
        "ate_after": asdict(trajectory.ate(after, known)),
        "rpe_before": asdict(trajectory.rpe(before, known)),
        "rpe_after": asdict(trajectory.rpe(after, known)),
        "closures": asdict(closures.score_closures(keyframes, ledger, known, stops)),
        "residuals": asdict(residuals.score_residuals(keyframes, ledger, known)),
    }


def _joint(folder: Path, record: dict[str, Any], truth: str) -> dict[str, Any]:
    """Each drive by itself, and each map of several as one trajectory, all against a truth in the drives' clock."""
    if truth == "gps":
        raise TruthError(f"{folder} holds several drives; hold each against its own GPS: vplog evaluate {folder}/DRIVE")
    known = read_truth(truth)
    maps = []
    for found in _recorded(record, folder, list, "maps"):
        names = _recorded(found, folder, list, "drives")
        joined = found.get("reason") is not None
        file = "joint_trajectory.parquet" if joined else "trajectory.parquet"
        parts = [tables.read_trajectory(folder / name / file) for name in names]
        stamps, rows = np.unique(np.concatenate([after.stamp_ns for after, _ in parts]), return_index=True)
        whole = Trajectory(stamps, np.concatenate([after.world_from_body for after, _ in parts])[rows])
        own = [
            {
                "drive": name,
                "ate_before": asdict(trajectory.ate(Trajectory(odometry.stamp_ns, odometry.odom_from_body), known)),
                "ate_after": asdict(trajectory.ate(after, known)),
            }
            for name, (after, odometry) in zip(names, parts, strict=True)
        ]
        maps.append({"drives": own, "ate_after": asdict(trajectory.ate(whole, known))})
    return {"truth": without_secrets(truth), "maps": maps}


def _recorded(record: Any, folder: Path, kind: type, *names: str) -> Any:
    """What run.json holds under these names. Raises ResultError where that is not of the kind, or not there."""
    for name in names:
        record = record.get(name) if isinstance(record, dict) else None
    if not isinstance(record, kind):
        raise ResultError(f"{folder}/run.json lacks {'.'.join(names)}. Run `vplog run` again to write it anew.")
    return record


def _against_gps(
    record: dict[str, Any], before: Trajectory, after: Trajectory, topics: logs.TopicChoice | None
) -> dict[str, Any]:
    fixes = reopened(record, None, topics, "Put it back there, or give a truth file: --truth FILE.tum.").gps()
    if fixes is None or not len(fixes.stamp_ns):
        raise TruthError(f"{record.get('log')} has no GPS fixes. Give a truth file: --truth FILE.tum")
    return {
        "ate_before": asdict(gps.ate_to_gps(before, fixes)),
        "ate_after": asdict(gps.ate_to_gps(after, fixes)),
    }
