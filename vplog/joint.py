"""Several drives in one map: each by itself, closures between them, one graph of those that closures join."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from vplog import logs, record
from vplog.between import closures_between, likely_drives, no_candidates, shared_of, with_drive, with_shared
from vplog.cores import limited
from vplog.errors import LogError, SettingsError
from vplog.features.store import FeatureStore
from vplog.graph import joint as graph_joint
from vplog.graph.correct import correct_trajectory
from vplog.joint_graph import between_of, judged_by, own_drive
from vplog.libraries import build_library, check_library
from vplog.loops.verify import calibration_share, drive_of
from vplog.parts import odometry_of
from vplog.pipeline import run as run_alone
from vplog.results import g2o, run_record, tables, tum
from vplog.results.run_record import CACHE
from vplog.run_folder import begun
from vplog.timing import Watch

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from vplog.data import Closures
    from vplog.loops.verify import Drive
    from vplog.pipeline import Pipeline, Run
    from vplog.stages import PlaceState

    Progress = Callable[[str, int, int], None]


@dataclass(frozen=True, eq=False)
class Alone:
    """One drive, run by itself."""

    name: str
    folder: Path
    done: Run
    drive: Drive
    """As its candidates are checked."""
    descriptors: Sequence[Any]


def run_joint(
    paths: Sequence[Path],
    out: Path,
    pipeline: Pipeline,
    library: Path | None = None,
    topics: logs.TopicChoice | None = None,
    threads: int = 1,
    progress: Progress = lambda *_: None,
    use_cache: bool = True,
    force: bool = False,
) -> dict[str, Any]:
    """Drives in, `out` with a run folder for each and what joins them out; the record in its run.json.

    What `out` holds stays until all is done; a run that has another log is replaced with `force` only. All drives
    share one library, the one given or one of an equal share of each. Raises VplogError with one line.
    """
    if pipeline.gps.use:
        raise SettingsError("GPS holds one drive at a time: run each by itself with --gps, or several without.")
    opened = [logs.open(path, topics) for path in paths]
    drives_at = dict(zip(_names([log.name for log in opened]), paths, strict=True))
    check_library(library, pipeline)
    for log in opened:  # before the first drive is computed
        odometry_of(log)
    watch = Watch()
    with ExitStack() as stack:
        made = stack.enter_context(
            begun(out, pipeline, paths[0], threads, library, topics, drives_at, resumable=use_cache, force=force)
        )
        if library is None:
            library = made / "library"
            with watch.stage("library"):
                build_library(paths, library, pipeline, topics, threads, progress)
        state = pipeline.places.load(library, threads)
        drives = []
        for name, path in drives_at.items():
            store = stack.enter_context(FeatureStore(made / f".features-{name}"))
            cache = out / CACHE / name if use_cache else None
            with watch.stage(name):
                alone = _alone(
                    name, path, made / name, pipeline, library, state, topics, threads, progress, store, cache
                )
                drives.append(alone)
        with watch.stage("between"):
            ledgers = _ledgers(drives, state, pipeline, threads, progress)
        with watch.stage("join"), limited(threads):
            between = [between_of(*pair, ledger) for pair, ledger in ledgers.items()]
            own = [_own(alone.done) for alone in drives]
            joined = graph_joint.join(own, between, pipeline.solve, pipeline.join, pipeline.refine)
        with watch.stage("write"):
            header = tables.TableMetadata(pipeline.model_dump(mode="json"), state.hash)
            judged = [judged_by(*found) for found in zip(ledgers.values(), joined.weight, joined.residual, strict=True)]
            pairs = list(ledgers)
            tables.write_joins(
                made / "joins.parquet",
                [
                    (drives[later].done.keyframes, drives[earlier].done.keyframes, ledger)
                    for (later, earlier), ledger in zip(pairs, judged, strict=True)
                ],
                header,
            )
            _write_maps(made, drives, joined, header)
        account = {
            **record.head(pipeline, paths[0], threads),
            **record.logs_of(paths),
            "finished": True,
            "library": {"hash": state.hash, "from": record.library_of(library)},
            **_told(drives, pairs, judged, joined),
            "stages": watch.stages,
            "totals": watch.totals(),
        }
        run_record.write_run_json(made / "run.json", account)
    return account


def _ledgers(
    drives: Sequence[Alone], state: PlaceState, pipeline: Pipeline, threads: int, progress: Progress
) -> dict[tuple[int, int], Closures]:
    """By (later, earlier) drive, the ledger of the later one's keyframes in the earlier one; empty where unlikely."""
    share = [0.0 if alone.drive.camera.matrix is None else calibration_share(alone.drive, threads) for alone in drives]
    ledgers = {}
    for later, own in enumerate(drives):
        found = no_candidates()
        for earlier in range(later):
            found = with_drive(
                found, earlier, own.descriptors, drives[earlier].descriptors, state, pipeline, threads
            )  # fmt: skip
        likely = likely_drives(found, pipeline.join)
        for earlier in range(later):
            other = drives[earlier]
            said = f"{own.name} in {other.name}"
            proposals = found.of(earlier) if earlier in likely else no_candidates().proposals
            ledger = closures_between(
                proposals, own.drive, other.drive, pipeline.join, threads,
                lambda done, total, said=said: progress(said, done, total), max(share[later], share[earlier]),
            )  # fmt: skip
            shared = shared_of(proposals, state, own.descriptors, other.descriptors)
            ledgers[later, earlier] = with_shared(ledger, proposals, shared)
    return ledgers


def _names(names: Sequence[str]) -> list[str]:
    """A folder name for each drive: its own, with a number where several have the same, or the library has it."""
    result: list[str] = []
    for name in names:
        number, free = 2, name
        while free in ("library", *result):
            free, number = f"{name}-{number}", number + 1
        result.append(free)
    return result


def _alone(
    name: str,
    path: Path,
    folder: Path,
    pipeline: Pipeline,
    library: Path,
    state: PlaceState,
    topics: logs.TopicChoice | None,
    threads: int,
    progress: Progress,
    store: FeatureStore,
    cache: Path | None,
) -> Alone:
    done = run_alone(
        path, folder, pipeline, library, topics, threads,
        lambda stage, count, total: progress(f"{name}: {stage}", count, total), store, cache,
        use_cache=cache is not None,
    )  # fmt: skip
    done = replace(done, keyframes=replace(done.keyframes, drive=name))
    camera = logs.open(path, topics).camera()
    if len(store) != len(done.keyframes.stamp_ns):
        raise LogError(f"{path} changed while it was read. Run again when it is complete.")
    column, _ = tables.read_descriptors(folder / "descriptors.parquet")
    drive = drive_of(done.keyframes, camera, store.__getitem__, pipeline.verify, camera.baseline_m)
    return Alone(name, folder, done, drive, state.from_arrow(column))


def _own(done: Run) -> graph_joint.Drive:
    graph = replace(done.graph, world_from_body=done.solution.world_from_body)
    return own_drive(graph, done.solution.weight, done.closures, done.record["odometry"]["sigma_factor"])


def _write_maps(
    out: Path,
    drives: Sequence[Alone],
    joined: graph_joint.Joined,
    header: tables.TableMetadata,
) -> None:
    """Of each drive in a map of several, its keyframes and trajectory in the map's frame; of each map its graph."""
    for number, members in enumerate(joined.maps):
        if members not in joined.solved:
            continue
        refined = joined.solved[members]
        g2o.write_g2o(out / f"map{number}.g2o", refined.graph, refined.solution.world_from_body)
        for member in members:
            alone, poses = drives[member], joined.world_from_body[member]
            _, odometry = tables.read_trajectory(alone.folder / "trajectory.parquet")
            trajectory = correct_trajectory(odometry, alone.done.keyframes, poses)
            tables.write_keyframes(alone.folder / "joint_keyframes.parquet", alone.done.keyframes, poses, header)
            tables.write_trajectory(alone.folder / "joint_trajectory.parquet", trajectory, odometry, header)
            tum.write_tum(alone.folder / "joint_trajectory.tum", trajectory)


def _told(
    drives: Sequence[Alone], pairs: Sequence[tuple[int, int]], ledgers: Sequence[Closures], joined: graph_joint.Joined
) -> dict[str, Any]:
    """Which drive constrains which, and what is kept apart."""
    joins, warnings = [], []
    for (later, earlier), ledger in zip(pairs, ledgers, strict=True):
        kept = int(np.nansum(ledger.weight))
        joins.append({
            "query_drive": drives[later].name,
            "match_drive": drives[earlier].name,
            "candidates": len(ledger),
            "verified": int(np.isfinite(ledger.weight).sum()),
            "kept": kept,
            "median_residual_sigma": float(np.nanmedian(ledger.residual_after)) if kept else None,
        })  # fmt: skip
    maps = [
        {
            "drives": [drives[member].name for member in members],
            "reason": joined.solved[members].solution.reason if members in joined.solved else None,
        }
        for members in joined.maps
    ]
    for at, reason in joined.apart.items():
        later, earlier = (drives[drive].name for drive in pairs[at])
        warnings.append(f"Closures of {later} to {earlier} were not enough to join them. {reason.strip()}")
    if len(joined.maps) > 1:
        single = [drives[members[0]].name for members in joined.maps if len(members) == 1]
        warnings += [
            f"{name} has too few closures with other drives (join.least_closures) and stays in its own frame."
            for name in single
        ]
    warnings += [f"{alone.name}: {text}" for alone in drives for text in alone.done.record["warnings"]]
    about = [
        {"name": alone.name, "folder": alone.name, "keyframes": len(alone.done.keyframes.stamp_ns), "map": number}
        for member, alone in enumerate(drives)
        for number, members in enumerate(joined.maps)
        if member in members
    ]
    return {"drives": about, "maps": maps, "joins": joins, "warnings": warnings}
