"""Differences of two runs of one drive: settings, closures, trajectories, scores, stages; and limits of them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vplog import logs
from vplog.data import USED, Floats
from vplog.errors import ResultError, SettingsError
from vplog.evaluate.pairs import poses_at
from vplog.evaluate.trajectory import motion_figures
from vplog.geometry import se3
from vplog.results import run_record, tables
from vplog.results.html import mapping
from vplog.results.report.page import Changes
from vplog.results.run_cameras import unit_camera
from vplog.run.report import write_report
from vplog.storage.json_records import differences
from vplog.verbs import evaluate_run
from vplog.verbs.evaluate_run import TruthOptions, evaluate, figures_of
from vplog.verbs.limits import Limit, read_limits
from vplog.verbs.report import judge

_OF_RECORD = {
    "candidates": ("counts", "candidates"),
    "seconds": ("totals", "seconds"),
    "memory_mb": ("totals", "peak_memory_mb"),
}
_SCORES = evaluate_run.FIGURES
FIGURES = (*_SCORES, "accepted", "gained", "lost", "moved_m", "moved_deg", *_OF_RECORD)
_LIMITED = (*FIGURES, "drives", "joins", "joint_frames")
"""Names of the figures that limits are of, those of maps among them."""


def diff(
    baseline: Path,
    run: Path,
    truth: str | None = None,
    topics: logs.TopicChoice | None = None,
    options: TruthOptions | None = None,
) -> dict[str, Any]:
    """The differences of the run in a folder from the one of the same drive in `baseline`.

    `settings` and `seconds` of stages hold pairs (baseline, run) by name. `closures` lists those gained and lost by the
    stamps of their keyframes. `trajectory` is how far the run's is from the baseline's, aligned by its positions, in m
    and degrees. `figures` are triples (baseline, run, change), with `truth`, as in `evaluate`, its scores among them.
    Raises ResultError or TruthError.
    """
    folders = (baseline, run)
    records = [run_record.read_single_run(folder) for folder in folders]
    trees = [{"settings": one.get("settings"), "versions": {**mapping(one.get("versions")), "vplog": one.get("vplog")}}
             for one in records]  # fmt: skip
    stages = [mapping(one.get("stages")) for one in records]
    ledgers = [_closures(folder) for folder in folders]
    gained, lost = ([pair for pair in one if pair not in other] for one, other in (ledgers[::-1], ledgers))
    moved = _moved(folders)
    figures: dict[str, Sequence[Any]] = {
        name: [mapping(one.get(part)).get(field) for one in records] for name, (part, field) in _OF_RECORD.items()
    }
    figures["accepted"] = [len(one) for one in ledgers]
    changes = {"gained": len(gained), "lost": len(lost), "moved_m": moved["rmse_m"], "moved_deg": moved["rmse_deg"]}
    figures |= {name: (0, change) for name, change in changes.items()}
    warnings = [] if _are_of_one_log(records) else ["The runs are of different logs: stamps alone pair their poses."]
    if truth is not None:
        scores = [evaluate(folder, truth, topics, options) for folder in folders]
        figures |= {name: [figures_of(one)[name] for one in scores] for name in _SCORES}
        warnings += dict.fromkeys(text for one in scores for text in one["warnings"])
    return {
        "baseline": str(baseline),
        "run": str(run),
        "warnings": warnings,
        "settings": differences(trees[0], trees[1]),
        "closures": {"common": len(ledgers[1]) - len(gained), "gained": gained, "lost": lost},
        "trajectory": moved,
        "figures": {name: [*figures[name], _change(*figures[name])] for name in FIGURES if name in figures},
        "seconds": {
            name: [mapping(one.get(name)).get("seconds") for one in stages]
            for name in dict.fromkeys([*stages[0], *stages[1]])
        },
    }


def write_page(
    path: Path,
    found: dict[str, Any],
    truth: str | None = None,
    topics: logs.TopicChoice | None = None,
    options: TruthOptions | None = None,
) -> None:
    """The report of the run that `diff` has compared, with the baseline's trajectory and what it says.

    Raises ResultError or TruthError.
    """
    baseline, run = Path(found["baseline"]), Path(found["run"])
    record = run_record.read_single_run(run)
    known, poses, everything = _same_stamps((baseline, run))
    run_from_baseline, scale = se3.align(known, poses, mount := _mount((baseline, run)))
    changes = {tuple(pair): kind for kind in ("gained", "lost") for pair in found["closures"][kind]}
    closures = tables.read_closures(run / "closures.parquet")
    stamps = tables.read_keyframes(run / "keyframes.parquet")[0].stamp_ns
    pairs = zip(stamps[closures.query].tolist(), stamps[closures.match].tolist(), strict=True)
    at = se3.transform(run_from_baseline, se3.stretched(everything, scale, mount)[:, :3, 3])
    judged = judge(run, record, truth, topics, options or TruthOptions()) if truth is not None else None
    write_report(run, record, path, judged, changes=Changes(found, at, [changes.get(pair) for pair in pairs]))


def check_limits(limits: Sequence[str]) -> list[Limit]:
    """The limits of changes. Raises SettingsError for the first that is none."""
    what = "limit of a change, a number or a percentage of the baseline: 'recall<-0.01', 'seconds>20%'"
    return read_limits(limits, _LIMITED, what, percent=True)


def exceeded(found: dict[str, Any], limits: Sequence[str]) -> list[str]:
    """A sentence for each limit that the changes of a diff fail. Raises SettingsError for one that cannot be judged."""
    sentences = []
    for limit in check_limits(limits):
        before, after, change = found["figures"].get(limit.name, (None, None, None))
        if change is None or (limit.percent and not before):
            why = " Give --truth." if limit.name in _SCORES and limit.name not in found["figures"] else ""
            text = f"the change of {limit.name} is not known ({before} to {after})"
            raise SettingsError(f"--fail-on {limit.text!r}: {text}.{why}")
        value = 100.0 * change / abs(before) if limit.percent else change
        if limit.fails(value):
            moved = f"{value:+.4g}{limit.percent}, from {before:.6g} to {after:.6g}"
            sentences.append(f"{limit.name} changed by {moved} ({limit.text}).")
    return sentences


def _are_of_one_log(records: Sequence[dict[str, Any]]) -> bool:
    """Whether the runs share a file, by its sha256, or a record does not tell, as of a log on an object store."""
    inputs = (map(str, mapping(each.get("inputs")).values()) for each in records)
    one, other = ({sha256 for sha256 in each if " " not in sha256} for each in inputs)
    return not one or not other or not one.isdisjoint(other)


def _closures(folder: Path) -> dict[tuple[int, int], None]:
    """Stamps in ns of query and match of the closures in the solution, in order. JSON has them as pairs."""
    closures = tables.read_closures(folder / "closures.parquet")
    stamps = tables.read_keyframes(folder / "keyframes.parquet")[0].stamp_ns
    used = closures.of(*USED)
    pairs = zip(stamps[closures.query[used]].tolist(), stamps[closures.match[used]].tolist(), strict=True)
    return dict.fromkeys(pairs)


def _moved(folders: Sequence[Path]) -> dict[str, Any]:
    """Distance and angle between the trajectories of two runs at the stamps of the first; in its unit, by a similarity
    where one of them has no metres."""
    known, poses, _ = _same_stamps(folders)
    aligned, scale = se3.align(poses, known, mount := _mount(folders))
    return motion_figures(se3.between(known, aligned @ se3.stretched(poses, scale, mount)))


def _mount(folders: Sequence[Path]) -> Floats | None:
    """The `unit_camera` of the first run without metres; None where all are in metres."""
    mounts = (unit_camera(run_record.read_run_json(folder / "run.json")) for folder in folders)
    return next((mount for mount in mounts if mount is not None), None)


def _same_stamps(folders: Sequence[Path]) -> tuple[Floats, Floats, Floats]:
    """Poses (S, 4, 4) of the trajectories of two runs at the stamps of the first that the second covers, which may be
    of other odometry, and all of the first. Raises ResultError where these are fewer than three."""
    baseline, run = (tables.read_trajectory(folder / "trajectory.parquet")[0] for folder in folders)
    poses, known = poses_at(run, baseline.stamp_ns)
    if known.sum() < 3:
        raise ResultError(f"{folders[0]} and {folders[1]} have {known.sum()} stamps in common. Give runs of one drive.")
    return baseline.world_from_body[known], poses[known], baseline.world_from_body


def _change(before: Any, after: Any) -> float | None:
    both = all(isinstance(one, int | float) and np.isfinite(one) for one in (before, after))
    return after - before if both else None
