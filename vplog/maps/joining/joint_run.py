"""A joint run of several drives: each by itself, inter-session closures, and one graph of the drives they connect."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vplog import logs
from vplog.data import Closures
from vplog.errors import SettingsError
from vplog.execution.cores import limited
from vplog.execution.execution import Execution
from vplog.execution.timing import StageTimer
from vplog.geometry import tum
from vplog.loops.verify import Drive, calibration_share, drive_of, no_closures
from vplog.maps.joining import inter_session
from vplog.maps.joining.inter_session import CameraDrive, PlacesByCamera
from vplog.maps.joining.joint_graph import SolvedDrive, own_drive, pair_record, solve_drives, write_drive
from vplog.pipeline import Pipeline, Run
from vplog.pipeline import run as run_alone
from vplog.places.vectors import check_drives
from vplog.results import g2o, run_record, tables
from vplog.results.run_record import CACHE
from vplog.run import provenance
from vplog.run.odometry import check_metric
from vplog.run.reference_library import check_library, library_of_logs
from vplog.run.run_folder import CacheOptions, staged_run
from vplog.run.verification import for_verification
from vplog.storage.folders import numbered

if TYPE_CHECKING:
    from vplog.joint.graph import Joined
    from vplog.maps.joining.joint_graph import Ledgers
    from vplog.stages import PlaceState


@dataclass(frozen=True, eq=False)
class DriveRun:
    """One drive, run by itself."""

    name: str
    run: Run
    drive: Drive
    solved: SolvedDrive


def run_joint(
    paths: Sequence[Path], out: Path, pipeline: Pipeline, library: Path | None = None,
    topics: logs.TopicChoice | None = None, execution: Execution = Execution(), cache: CacheOptions = CacheOptions(),
) -> dict[str, Any]:  # fmt: skip
    """Run each drive into a folder of its own in `out`, join them, and return the record in its run.json.

    What `out` holds stays until all is done; a run that has another log is replaced with `cache.force` only. All drives
    share one library, the one given or one of an equal share of each. Raises VplogError with one line.
    """
    if pipeline.gps.use:
        raise SettingsError("GPS is for one drive at a time: run each by itself with --gps, or several without.")
    pipeline.decisions.check_single_drive()
    check_drives(pipeline.places, len(paths))
    opened = [logs.open(path, topics) for path in paths]
    drives_at: dict[str, Path] = {}
    for log, path in zip(opened, paths, strict=True):
        drives_at[numbered(log.name, log.name, {"library", *drives_at})] = path
    check_library(library, pipeline)
    topics = topics or logs.TopicChoice()
    for log in opened:  # before the first drive is computed
        check_metric(log, topics)
    head = {**provenance.head(pipeline, paths[0], execution.threads), **provenance.logs_of(paths)}
    watch = StageTimer()
    with ExitStack() as stack:
        made = stack.enter_context(staged_run(out, head, paths, library, topics, drives_at, cache))
        caches = out / CACHE if cache.use else made / CACHE
        if not cache.use:
            stack.callback(shutil.rmtree, caches, ignore_errors=True)
        if library is None:
            library = made / "library"
            with watch.stage("library"):
                library_of_logs(opened, library, pipeline, execution)
        drives = []
        for name, path in drives_at.items():
            with watch.stage(name):
                done = run_alone(
                    path, made / name, pipeline, library, topics, execution.within(name), CacheOptions(caches / name)
                )
                check_metric(done.log, topics, done.odometry)
                drives.append(_drive_run(name, done, pipeline))
        with watch.stage("between"):
            state = drives[0].run.state
            ledgers = _ledgers(drives, state, pipeline, execution)
        with watch.stage("join"), limited(execution.threads):
            joined, ledgers = solve_drives([drive_run.solved for drive_run in drives], ledgers, pipeline)
        with watch.stage("write"):
            header = tables.TableMetadata(pipeline.model_dump(mode="json"), state.hash)
            keyframes = [one.solved.keyframes for one in drives]
            rows = [(keyframes[later], keyframes[earlier], one) for (later, earlier), one in ledgers.items()]
            tables.write_joins(made / "joins.parquet", rows, header)
            _write_maps(made, drives, joined, header)
        record = {
            **head,
            "finished": True,
            "library": {"hash": state.hash, "from": provenance.library_of(library)},
            **_joint_record(drives, ledgers, joined, pipeline),
            "stages": watch.stages,
            "totals": watch.totals(),
        }
        run_record.write_run_json(made / "run.json", record)
    return record


def _drive_run(name: str, run: Run, pipeline: Pipeline) -> DriveRun:
    keyframes = replace(run.keyframes, drive=name)
    graph = replace(run.graph, world_from_body=run.solution.world_from_body)
    own = own_drive(graph, run.solution.weight, run.closures)
    drive = drive_of(keyframes, run.camera, run.features.__getitem__, pipeline.verify)
    return DriveRun(name, run, drive, SolvedDrive(keyframes, own, lambda: run.odometry))


def _ledgers(drives: Sequence[DriveRun], state: PlaceState, pipeline: Pipeline, execution: Execution) -> Ledgers:
    """The ledger of every pair of drives; empty where too few candidates are proposed."""
    views = [drive_run.run.views for drive_run in drives]
    places = [PlacesByCamera([view.places for view in own]) for own in views]
    cameras = [
        [CameraDrive(view.row, drive if n == 0 else for_verification(view.pictures)) for n, view in enumerate(own)]
        for drive, own in zip([one.drive for one in drives], views, strict=True)
    ]
    shares = [
        [calibration_share(one.drive, execution) if one.drive.camera.matrix is not None else 0.0 for one in own]
        for own in cameras
    ]
    later = {number: places[number] for number in range(1, len(drives))}
    searched = {number: range(number) for number in later}
    found = inter_session.candidates_among(later, places.__getitem__, searched, state, pipeline, execution)
    pairs = inter_session.likely_pairs(found, places.__getitem__, state, pipeline.join)
    likely = {(one.later, one.earlier): one for one in pairs}

    def verified(later: int, earlier: int) -> Closures:
        pair = likely.get((later, earlier))
        if pair is None:
            return no_closures()
        return inter_session.closures_by_cameras(
            pair, cameras[later], cameras[earlier], pipeline,
            lambda query, match: max(shares[later][query], shares[earlier][match]),
            execution.within(f"{drives[later].name} in {drives[earlier].name}"),
        )  # fmt: skip

    return {(number, earlier): verified(number, earlier) for number in later for earlier in range(number)}


def _write_maps(out: Path, drives: Sequence[DriveRun], joined: Joined, header: tables.TableMetadata) -> None:
    for number, members in enumerate(joined.maps):
        if members not in joined.solved:
            continue
        refined = joined.solved[members]
        g2o.write_g2o(out / f"map{number}.g2o", refined.graph, refined.solution.world_from_body)
        for member in members:
            folder = out / drives[member].name
            trajectory = write_drive(folder, "joint_", drives[member].solved, joined.world_from_body[member], header)
            tum.write_tum(folder / "joint_trajectory.tum", trajectory)


def _joint_record(
    drives: Sequence[DriveRun], ledgers: Ledgers, joined: Joined, pipeline: Pipeline
) -> dict[str, Any]:  # fmt: skip
    names = [drive_run.name for drive_run in drives]
    maps = [
        {
            "drives": [names[member] for member in members],
            "reason": joined.solved[members].solution.reason if members in joined.solved else None,
        }
        for members in joined.maps
    ]
    pairs, warnings = list(ledgers), pipeline.rating.false_rate.warnings_between()
    for at, reason in joined.apart.items():
        later, earlier = (names[drive] for drive in pairs[at])
        warnings.append(f"Closures of {later} to {earlier} were not enough to join them. {reason.strip()}")
    if len(joined.maps) > 1:
        warnings += [
            f"{names[members[0]]} has too few closures with other drives (join.least_closures) and stays in its own "
            "frame."
            for members in joined.maps
            if len(members) == 1
        ]
    warnings += [f"{drive_run.name}: {text}" for drive_run in drives for text in drive_run.run.record["warnings"]]
    map_of = {member: number for number, members in enumerate(joined.maps) for member in members}
    return {
        "drives": [
            {"name": name, "folder": name, "keyframes": len(drives[at].run.keyframes.stamp_ns), "map": map_of[at]}
            for at, name in enumerate(names)
        ],
        "maps": maps,
        "joins": [pair_record(names[later], names[earlier], ledger) for (later, earlier), ledger in ledgers.items()],
        "warnings": warnings,
    }
