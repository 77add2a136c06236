"""Result of a run, and the files of its folder."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vplog.cache.steps import Steps, step
from vplog.data import Camera, Closures, EdgeKind, Keyframes, Odometry, PoseGraph, Reference, Solution, Verdict
from vplog.geometry import tum
from vplog.graph import consistency
from vplog.graph.refine import about_odometry
from vplog.results import g2o, mcap, run_record, tables
from vplog.run import provenance
from vplog.run.back_end import BackEndResult, about_gps, keyframe_covariances
from vplog.run.figures.run_figures import (
    ClosureInputs,
    camera_thumbnails,
    choose_examples,
    choose_views,
    earth_of,
    mcap_extras,
    reference_use,
)
from vplog.run.report import write_report

if TYPE_CHECKING:
    from vplog.cache.feature_shards import Extracted
    from vplog.execution.execution import Execution
    from vplog.loops.verify import VerifySettings
    from vplog.places.coverage import Coverage
    from vplog.results.previews import PictureSettings
    from vplog.run.cameras import View
    from vplog.stages import Log, PlaceState


@dataclass(frozen=True, eq=False)
class Run:
    """Inputs, intermediate results and record of a finished run."""

    log: Log
    odometry: Odometry
    camera: Camera
    keyframes: Keyframes
    features: Extracted
    """Features of the keyframes, as long as the stage cache is there."""
    library: Path | None
    """The folder of the library given; None where the references are of the drive's own keyframes."""
    references: list[Reference]
    state: PlaceState
    coverage: Coverage
    places: Sequence[Any]
    """Descriptors of the keyframes."""
    solved: BackEndResult
    views: Sequence[View]
    """The pictures of every camera, the first one's first."""
    record: dict[str, Any] = field(default_factory=dict)
    """Content of run.json."""

    @property
    def closures(self) -> Closures:
        return self.solved.closures

    @property
    def graph(self) -> PoseGraph:
        return self.solved.refined.graph

    @property
    def solution(self) -> Solution:
        return self.solved.refined.solution


@step("write")
def write(
    folder: Path,
    run: Run,
    verify: VerifySettings,
    pictures: PictureSettings,
    header: tables.TableMetadata,
    *,
    steps: Steps,
    execution: Execution,
) -> None:
    """Write the tables, the trajectory, the graph and result.mcap of a run into its folder."""
    log, keyframes, trajectory, poses = run.log, run.keyframes, run.solved.trajectory, run.solution.world_from_body
    picture, gps = run.features.picture, log.gps()
    inputs = ClosureInputs(run.features.__getitem__, run.camera, run.state, run.places)
    previews = picture if run.features.has_pictures else None
    extras = replace(
        mcap_extras(inputs, previews, run.closures, run.references, verify, pictures, execution),
        thumbnails=camera_thumbnails(run.views, run.closures),
        gps=gps,
        earth=earth_of(trajectory, gps, about_gps(run.solved)),
        about={"versions": provenance.versions(), "inputs": steps.cache.hashes()},
    )
    places = [place for view in run.views for place in view.places]
    further = [(view.row, view.pictures.keyframes.stamp_ns) for view in run.views[1:]]
    described = run.state.to_arrow(places)
    tables.write_descriptors(folder / "descriptors.parquet", keyframes, described, header, further)
    tables.write_keyframes(folder / "keyframes.parquet", keyframes, poses, header, keyframe_covariances(run.solved))
    tables.write_closures(folder / "closures.parquet", run.closures, keyframes, header)
    residual = consistency.residual_sigma(run.graph, poses)
    tables.write_edges(folder / "edges.parquet", run.graph, run.solution, residual, header)
    tables.write_trajectory(folder / "trajectory.parquet", trajectory, run.odometry, header)
    tum.write_tum(folder / "trajectory.tum", trajectory)
    g2o.write_g2o(folder / "graph.g2o", run.graph, poses)
    mcap.write_mcap(folder / "result.mcap", keyframes, poses, run.graph, run.closures, header, extras)
    if run.library is None:
        run.state.save(folder / "library")
    steps.cache.finish([view.pictures.features.files for view in run.views])


@step("report")
def report(folder: Path, run: Run, head: dict[str, Any], *, steps: Steps) -> dict[str, Any]:
    """Write report.html of the run in `folder`; the record for its run.json, but for the time that this step takes."""
    warnings = run.log.warnings + steps.warnings
    record = {**head, **_results_record(run), "inputs": steps.cache.hashes(), "warnings": warnings}
    record["pictures"] = _pictures_record(run, head["settings"]["pictures"]["closures"])
    record["graph_sha256"] = hashlib.sha256((folder / "graph.g2o").read_bytes()).hexdigest()
    write_report(folder, {**record, **steps.record()})
    return record


def finish(folder: Path, run: Run, record: dict[str, Any], steps: Steps) -> Run:
    """Write run.json, the last file of a run, and give the run with its content."""
    record = {**record, **steps.record(), "finished": True}
    run_record.write_run_json(folder / "run.json", record)
    return replace(run, record=record)


def _pictures_record(run: Run, most: int) -> dict[str, int]:
    """Number of closures drawn in result.mcap, of those with a view in the report, and of accepted ones without."""
    if not run.features.has_pictures:
        return {"drawn": 0, "views": 0, "accepted_left_out": int(run.closures.accepted.sum())}
    drawn, views = choose_examples(run.closures, most), choose_views(run.closures)
    left_out = int(run.closures.accepted.sum() - run.closures.accepted[views].sum())
    return {"drawn": len(drawn), "views": len(views), "accepted_left_out": left_out}


def _results_record(run: Run) -> dict[str, Any]:
    """Fields of run.json about the results."""
    from vplog.graph.certificate import certify

    solution, refined, verdicts = run.solution, run.solved.refined, run.closures.verdict
    constrained = set(run.graph.kind) - {EdgeKind.ODOMETRY} or run.solved.refined.fixes
    return {
        "cameras": [view.camera.name for view in run.views],
        "library": {
            "hash": run.state.hash,
            "from": provenance.library_of(run.library),
            "references": len(run.references),
            "used": reference_use(run.state, run.places),
            "coverage": asdict(run.coverage),
        },
        "descriptor_bits": run.state.bits,
        "counts": {
            "frames": len(run.log.stamps()),
            "odometry": len(run.odometry.stamp_ns),
            "keyframes": len(run.keyframes.stamp_ns),
            "candidates": len(run.closures),
            "verdicts": {verdict.value: verdicts.count(verdict) for verdict in Verdict if verdict in verdicts},
        },
        "losses": [asdict(loss) for loss in getattr(run.log, "losses", [])],
        "noise": run.solved.noise_source,
        "scale": "metric" if run.odometry.metric else "unknown",
        "solution": {
            "error_before": solution.error_before,
            "error_after": solution.error_after,
            "iterations": solution.iterations,
            "converged": solution.converged,
            "reason": solution.reason if constrained else "No closure passed verification.",
        },
        "certificate": certify(run.graph, solution.weight, solution.world_from_body).record(),
        "odometry": about_odometry(refined),
        "gps": about_gps(run.solved),
    }
