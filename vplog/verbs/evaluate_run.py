"""A finished run against the truth: trajectory error before and after, and whether the closures were right."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from vplog import logs
from vplog.data import Closures, Floats, Gps, Keyframes, Trajectory
from vplog.errors import GraphError, ResultError, SettingsError, TruthError
from vplog.evaluate import closures, trajectory
from vplog.evaluate.body_truth import BodyTruth, TruthAt, body_truth
from vplog.evaluate.closure_pose import pose_bounds
from vplog.evaluate.truth import ate_to_gps, matched_fixes, read_truth, truth_warnings
from vplog.geometry import se3
from vplog.loops.propose import ProposeSettings, candidate_stops
from vplog.results import mcap_read, run_record, tables
from vplog.results.run_cameras import unit_camera
from vplog.results.run_record import has_metres
from vplog.run.provenance import reopened
from vplog.storage.folders import is_below
from vplog.storage.urls import shown
from vplog.verbs.limits import Limit

_FIGURES = {
    "ate_m": ("ate_after", "rmse_m"),
    "rpe_m": ("rpe_after", "translation_rmse_m"),
    "drift_m": ("drift_after", "translation_m"),
    "precision": ("closures", "precision"),
    "recall": ("closures", "recall"),
    "average_precision": ("closures", "average_precision"),
    "false_closures": ("closures", "accepted_false"),
}
FIGURES = tuple(_FIGURES)
"""Names of the figures of a run against the truth."""
_MAX_REFERENCES = 100
"""Maximum number of reference keyframes of the NEES. Each costs a solve, and a median of more changes little."""
_BESIDE = {"odometry_file", "calibration_file", "masks"}
_OWN_FIXES = "The satellite fixes are in this run's trajectory: that it is near them says little of its error."
_AGAIN = "Say where it is: --log LOG. Or give a truth file: --truth FILE.tum."


@dataclass(frozen=True)
class TruthOptions(closures.PlaceCriterion):
    """Options of the comparison of a run with the truth."""

    align: str = ""
    """Alignment of the ATE, a name of `trajectory.ALIGNMENTS`; empty takes `se3`, or `sim3` of a run without metres."""
    truth_offset_s: float = 0.0
    """s added to the stamps of the truth."""

    def of(self, record: dict[str, Any]) -> TruthOptions:
        """With the alignment for the run of this record."""
        return self if self.align else replace(self, align="se3" if has_metres(record) else "sim3")


@dataclass(frozen=True, eq=False)
class SharedTruth:
    """The truth of a drive, as the comparison of several drives in one frame needs it."""

    frame: str
    """Name of the frame of the truth, equal for drives whose truths share it; empty if no other drive shares it."""
    matched: trajectory.Matched
    """The result and the truth at the same times."""
    at_keyframes: TruthAt | None = None
    """None for satellite fixes, which judge no closure."""
    oriented: bool = False
    cameras: Sequence[Floats] = ()
    """body_from_camera (4, 4) of each camera."""


@dataclass(frozen=True, eq=False)
class RunEvaluation:
    """A run of one drive against a file of poses."""

    record: dict[str, Any]
    """The record that `evaluate` returns."""
    shared: SharedTruth
    keyframes: Keyframes
    truth: BodyTruth
    judged: closures.Judgement


def evaluate(
    folder: Path,
    truth: str,
    topics: logs.TopicChoice | None = None,
    options: TruthOptions | None = None,
    log: Path | None = None,
) -> dict[str, Any]:
    """ATE, RPE and drift of odometry and result, and which closures are right. `truth` is a TUM file, `gps`, or `auto`:
    the ground truth that comes with the log, else its GPS. `log` takes the place of the log that run.json names.

    Of a joint run each drive by itself, each map as one trajectory, and the closures between drives.

    Raises TruthError or ResultError with one line.
    """
    record = run_record.read_finished_run(folder)
    options = (options or TruthOptions()).of(record)
    if "maps" in record:
        return _joint(folder, record, truth, options)
    return evaluate_drive(folder, record, truth, topics, options, log)[0]


def evaluate_drive(
    folder: Path, record: dict[str, Any], truth: str, topics: logs.TopicChoice | None, options: TruthOptions,
    log: Path | None = None, joint: Path | None = None,
) -> tuple[dict[str, Any], SharedTruth]:  # fmt: skip
    """Compare the run of one drive with a truth, and return the record of `evaluate`. `log` as in `evaluate`. `joint`
    is the folder with the trajectory of the drive in the frame of a joint graph, which is then compared instead of the
    run's own. Raises as `evaluate`."""
    options = options.of(record)
    known = log_truth(folder, record, topics, options, log) if truth == "auto" else None
    if isinstance(known, Trajectory) or truth not in ("gps", "auto"):
        poses = known if isinstance(known, Trajectory) else None
        found = evaluate_poses(folder, record, truth, options, poses, joint)
        return found.record, found.shared
    account, matched = _against_gps(folder, record, topics, options, log, known, joint)
    return {"truth": truth, **account}, SharedTruth("earth", matched)


def figures_of(found: dict[str, Any]) -> dict[str, Any]:
    """The figures of what `evaluate` found of one drive, by name; None where there is none."""
    return {name: (found.get(part) or {}).get(field) for name, (part, field) in _FIGURES.items()}


def broken_limits(found: dict[str, Any], limits: Sequence[Limit]) -> list[str]:
    """A sentence for each limit that a drive fails of a run, a joint run or a map. Raises SettingsError for a limit of
    a figure that no drive has."""
    rows = found["drives"] if "drives" in found else [one for each in found.get("maps", ()) for one in each["drives"]]
    rows = [{**figures_of(one), **one} for one in rows or [found]]
    sentences = []
    for limit in limits:
        known = [(one.get("drive", "The run"), one[limit.name]) for one in rows if one[limit.name] is not None]
        if not known:
            raise SettingsError(
                f"--fail-on {limit.text!r}: {limit.name} is not known. It needs a TUM file with --truth, and rpe_m and "
                "drift_m one with orientations."
            )
        failed = [(who, value) for who, value in known if limit.fails(value)]
        sentences += [f"{who} has {limit.name} {value:.6g} ({limit.text})." for who, value in failed]
    return sentences


def recorded_topics(record: dict[str, Any], topics: logs.TopicChoice | None) -> logs.TopicChoice:
    """The topics of a run, those given in their place; without files beside the log, which may be gone."""
    known = logs.TopicChoice.read(record.get("topics") or {}, "run.json").model_dump(exclude=_BESIDE)
    given = {} if topics is None else topics.model_dump(exclude_defaults=True)
    return logs.TopicChoice.model_validate(known | given)


def log_truth(
    folder: Path,
    record: dict[str, Any],
    topics: logs.TopicChoice | None,
    options: TruthOptions,
    log: Path | None = None,
) -> Trajectory | Gps:
    """The ground truth that comes with the log of a run, or with `log` in its place, else its fixes. Raises TruthError
    where it has neither."""
    opened = reopened(folder, record, log, recorded_topics(record, topics), _AGAIN)
    found = opened.truth()
    found = opened.gps() if found is None else _shifted(found, options) if isinstance(found, Trajectory) else found
    if found is None:
        raise TruthError(f"{opened.name} comes with no ground truth and no GPS fixes. Give a file: --truth FILE.tum")
    return found


def evaluate_poses(
    folder: Path, record: dict[str, Any], truth: str, options: TruthOptions, known: Trajectory | None = None,
    joint: Path | None = None,
) -> RunEvaluation:  # fmt: skip
    """A run of one drive against a TUM file, or the poses `known` that were read from it; `joint` as in
    `evaluate_drive`. Raises as `evaluate`."""
    options, frame = options.of(record), "" if truth == "auto" else truth
    known = _shifted(read_truth(truth), options) if known is None else known
    after, odometry = tables.read_trajectory((joint or folder) / "trajectory.parquet")
    scale, mount = 1.0, unit_camera(record)
    if mount is not None:
        path = Trajectory(after.stamp_ns, after.world_from_body @ mount)
        scale = trajectory.ate(trajectory.at_truth(path, known)[0], known, alignment="sim3").scale
        if not (np.isfinite(scale) and scale > 0):
            raise TruthError(
                f"{shown(truth)} does not move while the run does, so the run's unit of length is not known."
            )
        after = Trajectory(after.stamp_ns, se3.stretched(after.world_from_body, scale, mount))
        odometry = replace(odometry, odom_from_body=se3.stretched(odometry.odom_from_body, scale, mount))
    before = odometry.trajectory
    keyframes, world_from_body = tables.read_keyframes(folder / "keyframes.parquet")
    ledger = tables.read_closures(folder / "closures.parquet")
    settings = run_record.recorded(record, folder / "run.json", dict, "settings", "propose")
    stops = candidate_stops(keyframes, ProposeSettings.read(settings, f"{folder}/run.json"))
    solved, units = world_from_body, np.eye(6)
    if mount is not None:
        units = se3.adjoint(mount) @ np.diag([1.0, 1.0, 1.0, *[scale] * 3]) @ se3.adjoint(se3.inverse(mount))
        keyframes, ledger = _stretched(keyframes, ledger, units, scale, mount)
        world_from_body = se3.stretched(solved, scale, mount)
    cameras = _cameras(folder)
    of_body = body_truth(known, before, next(iter(cameras), None))
    known = of_body.as_read or known
    score, judged = closures.score_closures(keyframes, ledger, of_body, stops, options, cameras)
    found = {
        "truth": shown(truth),
        "scale": None if mount is None else scale,
        "truth_is": {
            "frame": of_body.frame,
            "oriented": of_body.oriented,
            "offset_s": round(options.truth_offset_s + of_body.offset_s, 3) if of_body.offset_s else None,
            "odometry": (record.get("topics") or {}).get("odometry") == "truth",
            "disagreement": round(of_body.disagreement, 3),
            "other_motion": of_body.is_of_other_motion,
            "two_trajectories": of_body.holds_two_trajectories,
            "convention": of_body.convention,
            "unit": of_body.unit,
            "length_scale": round(of_body.scale, 4) if of_body.has_other_scale else None,
        },
        **_trajectories(before, after, known, of_body, options),
        "closures": asdict(score),
        "residuals": asdict(closures.score_residuals(keyframes, ledger, of_body)),
    }
    if record.get("gps") is None:  # with GPS they are relative to earth, where the truth need not be
        try:
            references, covariances = relative_to_references(folder, record, solved)
            in_metres = (units @ covariance @ units.T for covariance in covariances)
            poses = closures.score_poses(keyframes.stamp_ns, world_from_body, references, in_metres, of_body)
        except GraphError as error:
            poses = closures.PoseScore(0, None, None, str(error))
        found["poses"] = asdict(poses)
    found["warnings"] = [*truth_warnings(found), *run_record.piece_warnings(record)]
    matched = trajectory.matched_poses(trajectory.at_truth(after, known)[0], known)
    shared = SharedTruth(frame, matched, of_body.at(keyframes.stamp_ns), of_body.oriented, cameras)
    return RunEvaluation(found, shared, keyframes, of_body, judged)


def relative_to_references(
    folder: Path, record: dict[str, Any], world_from_body: Floats
) -> tuple[list[int], Iterator[Floats]]:
    """Return the rows of reference keyframes, and for each the covariances (N, 6, 6) of all keyframes relative to it.

    The references are spread evenly over the run. Raises GraphError if run.json has no record of shared errors, or if
    the edges do not determine the poses.
    """
    from vplog.graph.factors import Factors
    from vplog.graph.least_squares import Objective
    from vplog.graph.marginals import SharedScale, relative_covariances
    from vplog.graph.variance_components import Sigmas, claimed_times

    count = len(world_from_body)
    references = np.unique(np.linspace(0, count - 1, min(count, _MAX_REFERENCES)).astype(np.int64)).tolist()
    graph, weight, _ = tables.read_edges(folder / "edges.parquet", world_from_body)
    try:
        shared = record["covariance"]
        graph = claimed_times(graph, Sigmas(*shared["sigma_factors"]))
        scales = [SharedScale.of(scale, len(weight)) for scale in shared["shared_scales"]]
    except (KeyError, TypeError, ValueError) as error:  # such as a run of an older vplog
        raise GraphError("run.json lacks the errors that edges share. Run `vplog run` again.") from error
    return references, relative_covariances(Objective(Factors.of(graph), weight), world_from_body, references, scales)


def _stretched(
    keyframes: Keyframes, ledger: Closures, units: Floats, scale: float, mount: Floats
) -> tuple[Keyframes, Closures]:
    """A run in units of its own as one in which the lengths of the path of the camera at `mount` are multiplied.

    `units` (6, 6) multiplies twists of the body.
    """
    back = np.linalg.inv(units)
    ledger = replace(
        ledger,
        match_from_query=se3.stretched(ledger.match_from_query, scale, mount),
        information=back.T @ ledger.information @ back,
    )
    return replace(keyframes, odom_from_body=se3.stretched(keyframes.odom_from_body, scale, mount)), ledger


def _shifted(known: Trajectory, options: TruthOptions) -> Trajectory:
    return Trajectory(known.stamp_ns + round(options.truth_offset_s * 1e9), known.world_from_body)


def _trajectories(
    before: Trajectory, after: Trajectory, known: Trajectory, of_body: BodyTruth, options: TruthOptions
) -> dict[str, Any]:
    """ATE and RPE against the truth as it is given, as evo has them, and the drift against that of the body. RPE and
    drift are None where the truth has no orientations: steps are compared in the frame of the pose that they start at.
    """
    found: dict[str, Any] = {}
    for when, one in (("before", before), ("after", after)):
        compared, found["interpolated"] = trajectory.at_truth(one, known)
        found[f"ate_{when}"] = asdict(trajectory.ate(compared, known, alignment=options.align))
        found[f"rpe_{when}"] = found[f"drift_{when}"] = None
        if of_body.oriented:
            found[f"rpe_{when}"] = asdict(trajectory.rpe(compared, known))
            found[f"drift_{when}"] = asdict(trajectory.drift(compared, of_body.trajectory))
    return found


def _cameras(folder: Path) -> list[Floats]:
    """body_from_camera (4, 4) of each camera, none where the run was written without."""
    path = folder / "result.mcap"
    return mcap_read.read_camera_poses(path) if path.exists() else []


def _joint(folder: Path, record: dict[str, Any], truth: str, options: TruthOptions) -> dict[str, Any]:
    """A joint run: drives by themselves, each map of several as one trajectory, and the closures between drives.

    Drives that the truth does not cover are listed under `uncovered`. Raises TruthError where it covers none, or where
    drives of a map were recorded at the same time.
    """
    if truth in ("gps", "auto"):
        raise TruthError(f"{folder} holds several drives; each has its own truth: vplog evaluate {folder}/DRIVE")
    options = options.of(record)
    known = _shifted(read_truth(truth), options)
    drives: dict[str, RunEvaluation] = {}
    uncovered: dict[str, str] = {}
    maps = []
    for found in run_record.recorded(record, folder / "run.json", list, "maps"):
        names = run_record.recorded(found, folder / "run.json", list, "drives")
        if not all(map(is_below, names)):
            raise ResultError(f"{folder}/run.json names drives outside its folder. Run `vplog run` again.")
        for name in names:
            try:
                own = run_record.read_finished_run(folder / name)
                drives[name] = evaluate_poses(folder / name, own, truth, options, known)
            except TruthError as error:
                uncovered[name] = str(error)
        names = [name for name in names if name in drives]
        _check_apart_in_time(folder, {name: drives[name].keyframes for name in names})
        if names:
            file = "trajectory.parquet" if found.get("reason") is None else "joint_trajectory.parquet"
            parts = [tables.read_trajectory(folder / name / file)[0] for name in names]
            stamps, rows = np.unique(np.concatenate([part.stamp_ns for part in parts]), return_index=True)
            whole = Trajectory(stamps, np.concatenate([part.world_from_body for part in parts])[rows])
            ate = trajectory.ate(trajectory.at_truth(whole, known)[0], known, alignment=options.align)
            own = [{"drive": name, **drives[name].record} for name in names]
            maps.append({"drives": own, "ate_after": asdict(ate)})
    if not drives:
        raise TruthError(next(iter(uncovered.values()), f"{folder} holds no drive."))
    shared = {name: drive.shared for name, drive in drives.items()}
    joins = judge_joins(tables.read_joins(folder / "joins.parquet"), shared, options)
    return {"truth": shown(truth), "maps": maps, "joins": joins, "uncovered": uncovered}


def _check_apart_in_time(folder: Path, drives: dict[str, Keyframes]) -> None:
    """Raises TruthError where two drives of a map were recorded at the same time: a truth is of one body."""
    in_time = sorted(drives, key=lambda name: int(drives[name].stamp_ns[0]))
    for one, other in pairwise(in_time):
        if drives[other].stamp_ns[0] <= drives[one].stamp_ns[-1]:
            raise TruthError(
                f"{one} and {other} of {folder} were recorded at the same time, and a truth is of one of them. "
                f"Evaluate each by itself: vplog evaluate {folder}/{one} --truth FILE.tum"
            )


def judge_joins(
    ledgers: Mapping[tuple[str, str], Closures], drives: Mapping[str, SharedTruth], place: closures.PlaceCriterion
) -> list[dict[str, Any]]:
    """Judge the closures between drives whose truths share a frame, and return the counts of each pair of drives.

    `ledgers` are by query and match drive. Pairs with a drive that is not in `drives`, or without poses as its truth,
    are left out.
    """
    found = []
    for (later, earlier), ledger in ledgers.items():
        if later not in drives or earlier not in drives:
            continue
        ends = drives[later], drives[earlier]
        query, match = ends[0].at_keyframes, ends[1].at_keyframes
        if query is not None and match is not None:
            bounds = pose_bounds(*(at.world_from_body[at.known][:, :3, 3] for at in (query, match)))
            oriented = all(one.oriented for one in ends)
            cameras = ends[0].cameras, ends[1].cameras
            judged = closures.judge_closures(ledger, query, match, bounds, place, cameras, oriented)
            counts = closures.count_closures(ledger, judged, place)
            found.append({"query_drive": later, "match_drive": earlier, **counts})
    return found


def _against_gps(
    folder: Path,
    record: dict[str, Any],
    topics: logs.TopicChoice | None,
    options: TruthOptions,
    log: Path | None,
    fixes: Gps | None,
    joint: Path | None,
) -> tuple[dict[str, Any], trajectory.Matched]:
    """Return the record of `evaluate`, and the result and the fixes at the same times."""
    if options != TruthOptions(align=options.align):
        raise TruthError(
            "--truth gps takes no --distance-m, --heading-deg or --truth-offset-s: fixes judge no closure and are in "
            "the log's clock. Give a TUM file, or leave them out."
        )
    if options.align == "origin":
        raise TruthError("--truth gps takes no --align origin: fixes have no orientation. Choose se3 or sim3.")
    after, odometry = tables.read_trajectory((joint or folder) / "trajectory.parquet")
    if fixes is None:
        fixes = reopened(folder, record, log, recorded_topics(record, topics), _AGAIN).gps()
    if fixes is None or not len(fixes.stamp_ns):
        raise TruthError(f"{record.get('log')} has no GPS fixes. Give a truth file: --truth FILE.tum")
    if (mount := unit_camera(record)) is not None:  # the antenna is taken to be at the camera, whose path has one unit
        fixes = replace(fixes, antenna_m=mount[:3, 3])
    before = odometry.trajectory
    in_run = record.get("gps") is not None or (record.get("topics") or {}).get("odometry") == "gps"
    warnings = [_OWN_FIXES] * in_run + run_record.piece_warnings(record)
    matched = matched_fixes(after, fixes)
    ate_after = trajectory.ate_together([matched], options.align)[0]
    return {
        "warnings": warnings,
        "ate_before": asdict(ate_to_gps(before, fixes, options.align)),
        "ate_after": asdict(ate_after),
    }, matched
