"""Several drives in one map: each by itself, closures between them, one graph of those that closures join."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass, replace
from itertools import combinations
from typing import TYPE_CHECKING, Any

import numpy as np

from vplog import logs, record
from vplog.back_end import by_odometry
from vplog.data import EdgeKind, Verdict
from vplog.errors import LogError, SettingsError
from vplog.features.store import FeatureStore
from vplog.graph import joint as graph_joint
from vplog.graph.correct import correct_trajectory
from vplog.graph.refine import rescaled
from vplog.loops.propose import propose
from vplog.loops.verify import drive_of, verify_between
from vplog.pipeline import build_library, check_library, name_shared
from vplog.pipeline import run as run_alone
from vplog.places.sequence import rank_places
from vplog.results import g2o, run_record, tables, tum
from vplog.timing import Watch

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from vplog.data import Closures, Floats
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
) -> dict[str, Any]:
    """Drives in, `out` with a run folder for each and what joins them out; the record in its run.json.

    All drives share one library, the one given or one of an equal share of each. Raises VplogError with one line.
    """
    if pipeline.gps.use:
        raise SettingsError("GPS holds one drive at a time: run each by itself with --gps, or several without.")
    names = _names([logs.open(path, topics).name for path in paths])
    check_library(library, pipeline)
    watch = Watch()
    record.begin_folder(out, pipeline, paths[0], threads)
    with ExitStack() as stack:
        if library is None:
            library = out / "library"
            with watch.stage("library"):
                build_library(paths, library, pipeline, topics, threads, progress)
        state = pipeline.places.load(library, threads)
        drives = []
        for name, path in zip(names, paths, strict=True):
            store = stack.enter_context(FeatureStore(out / f".features-{name}"))
            with watch.stage(name):
                drives.append(
                    _alone(name, path, out / name, pipeline, library, state, topics, threads, progress, store)
                )
        ledgers: dict[tuple[int, int], Closures] = {}
        with watch.stage("between"):
            for earlier, later in combinations(range(len(drives)), 2):
                said = f"{names[later]} in {names[earlier]}"
                ledgers[later, earlier] = closures_between(
                    drives[later], drives[earlier], state, pipeline, threads,
                    lambda done, total, said=said: progress(said, done, total),
                )  # fmt: skip
        with watch.stage("join"):
            between = [_between(pair, ledger) for pair, ledger in ledgers.items()]
            own = [_own(alone.done) for alone in drives]
            joined = graph_joint.join(own, between, pipeline.solve, pipeline.join, pipeline.refine)
        with watch.stage("write"):
            header = tables.TableMetadata(pipeline.model_dump(mode="json"), state.hash)
            judged = [_judged(*found) for found in zip(ledgers.values(), joined.weight, joined.residual, strict=True)]
            pairs = list(ledgers)
            tables.write_joins(
                out / "joins.parquet",
                [
                    (drives[later].done.keyframes, drives[earlier].done.keyframes, ledger)
                    for (later, earlier), ledger in zip(pairs, judged, strict=True)
                ],
                header,
            )
            _write_maps(out, drives, joined, header)
        account = {
            **record.head(pipeline, paths[0], threads),
            "logs": [str(path.resolve()) for path in paths],
            "finished": True,
            "library": {"hash": state.hash, "from": str(library)},
            **_told(drives, pairs, judged, joined),
            "stages": watch.stages,
            "totals": watch.totals(),
        }
        run_record.write_run_json(out / "run.json", account)
    return account


def closures_between(
    later: Alone,
    earlier: Alone,
    state: PlaceState,
    pipeline: Pipeline,
    threads: int,
    progress: Callable[[int, int], None],
) -> Closures:
    """The ledger of the later drive's keyframes (queries) against the earlier one's (matches), any of them."""
    index = state.index(earlier.descriptors)
    stops = np.full(len(later.descriptors), len(earlier.descriptors), np.int64)
    ranked = rank_places(index, later.descriptors, stops, pipeline.propose.asked, pipeline.sequence, threads)
    ledger = verify_between(propose(ranked, pipeline.propose), later.drive, earlier.drive, threads, progress)
    both = [*earlier.descriptors, *later.descriptors]  # the two drives' places one after the other
    numbered = replace(ledger, query=ledger.query + np.int32(len(earlier.descriptors)))
    named = name_shared(numbered, state, both)
    return replace(ledger, shared_references=named.shared_references, shared_overlap=named.shared_overlap)


def _names(names: Sequence[str]) -> list[str]:
    """A folder name for each drive: its own, with a number where several have the same."""
    result: list[str] = []
    for name in names:
        number, free = 2, name
        while free in result:
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
) -> Alone:
    done = run_alone(
        path, folder, pipeline, library, topics, threads,
        lambda stage, count, total: progress(f"{name}: {stage}", count, total), store,
    )  # fmt: skip
    done = replace(done, keyframes=replace(done.keyframes, drive=name))
    camera = logs.open(path, topics).camera()
    if len(store) != len(done.keyframes.stamp_ns):
        raise LogError(f"{path} changed while it was read. Run again.")
    column, _ = tables.read_descriptors(folder / "descriptors.parquet")
    drive = drive_of(done.keyframes, camera, store.__getitem__, pipeline.verify, camera.baseline_m)
    return Alone(name, folder, done, drive, state.from_arrow(column))


def _own(done: Run) -> graph_joint.Drive:
    """The drive's graph without the closures that its own solve rejected, with the odometry's noise as it was said.

    The metres stay as they were found: with the same noise for all, the joint solve judges it anew.
    """
    learned = done.record["odometry"]["sigma_factor"] ** 2
    odometry = np.array([kind == EdgeKind.ODOMETRY for kind in done.graph.kind], bool)
    accepted = [verdict in (Verdict.ACCEPTED, Verdict.REJECTED_BY_SOLVER) for verdict in done.closures.verdict]
    graph = rescaled(done.graph, odometry, odometry, 1.0 / learned, 1.0)
    of_odometry = by_odometry(graph, done.closures, np.flatnonzero(accepted))
    kept = np.flatnonzero(odometry | (done.solution.weight > 0.5))
    graph = replace(
        graph,
        world_from_body=done.solution.world_from_body,
        a=graph.a[kept],
        b=graph.b[kept],
        a_from_b=graph.a_from_b[kept],
        information=graph.information[kept],
        kind=[graph.kind[edge] for edge in kept.tolist()],
    )
    return graph_joint.Drive(graph, of_odometry[kept])


def _between(pair: tuple[int, int], ledger: Closures) -> graph_joint.Between:
    rows = np.flatnonzero([verdict is Verdict.ACCEPTED for verdict in ledger.verdict])
    return graph_joint.Between(
        *pair,
        query=ledger.query[rows].astype(np.int64),
        match=ledger.match[rows].astype(np.int64),
        match_from_query=ledger.match_from_query[rows],
        information=ledger.information[rows],
        of_odometry=np.array([ledger.scale[row] == "odometry" for row in rows.tolist()], bool),
    )


def _judged(ledger: Closures, weight: Floats, residual: Floats) -> Closures:
    """The ledger with what the joint solve made of its verified rows."""
    rows = np.flatnonzero([verdict is Verdict.ACCEPTED for verdict in ledger.verdict])
    weights, residuals, verdict = np.full(len(ledger), np.nan), np.full(len(ledger), np.nan), list(ledger.verdict)
    weights[rows], residuals[rows] = weight, residual
    for row in rows[weight < 0.5].tolist():
        verdict[row] = Verdict.REJECTED_BY_SOLVER
    return replace(ledger, weight=weights, residual_after=residuals, verdict=verdict)


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
        warnings += [f"{name} joins no other drive and is kept apart, in its own frame." for name in single]
    warnings += [f"{alone.name}: {text}" for alone in drives for text in alone.done.record["warnings"]]
    about = [
        {"name": alone.name, "folder": alone.name, "keyframes": len(alone.done.keyframes.stamp_ns), "map": number}
        for member, alone in enumerate(drives)
        for number, members in enumerate(joined.maps)
        if member in members
    ]
    return {"drives": about, "maps": maps, "joins": joins, "warnings": warnings}
