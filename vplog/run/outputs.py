"""Result of a run, and the files of its folder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vplog.data import (
    Camera,
    Closures,
    EdgeKind,
    Keyframes,
    Odometry,
    PoseGraph,
    Reference,
    Solution,
    Trajectory,
    Verdict,
)
from vplog.geometry import se3, tum
from vplog.graph import consistency
from vplog.joint.graph import spaced_apart
from vplog.places.library_files import name_extractor
from vplog.refinement.refine import about_odometry
from vplog.results import g2o, mcap, run_record, tables
from vplog.results.previews import thumbnail
from vplog.results.report.page import Pictures, ReportContent
from vplog.run import provenance
from vplog.run.back_end import BackEndResult, about_covariance, about_gps, keyframe_covariances
from vplog.run.cache.steps import Steps, step
from vplog.run.figures.run_figures import (
    ClosureInputs,
    camera_thumbnails,
    choose_examples,
    choose_views,
    earth_of,
    mcap_extras,
    reference_use,
)
from vplog.run.report import pictured_keyframes, questions_of, references_of, tracks_of, write_page
from vplog.storage.image_file import decode_image
from vplog.storage.json_records import plain

if TYPE_CHECKING:
    import pyarrow as pa

    from vplog.data import Floats
    from vplog.execution.execution import Execution
    from vplog.loops.verify import VerifySettings
    from vplog.places.coverage import Coverage
    from vplog.results.mcap import McapExtras
    from vplog.results.previews import PictureSettings
    from vplog.run.cache.feature_shards import Extracted
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
    extractor: dict[str, Any]
    """Identity of the local features, which a library names."""
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


@dataclass(frozen=True, eq=False)
class Written:
    """Content of the files of a run that is computed as they are written."""

    extras: McapExtras
    """Content of result.mcap."""
    covariance: Floats | None
    """(N, 6, 6) of the solved keyframes; None where edges and fixes do not determine them."""
    descriptors: pa.Array
    """The column of descriptors.parquet."""
    graph_sha256: str
    """sha256 of graph.g2o."""


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
) -> Written:
    """Write the tables, the trajectory, the graph and result.mcap of a run into its folder."""
    log, keyframes, trajectory, poses = run.log, run.keyframes, run.solved.trajectory, run.solution.world_from_body
    picture, gps = run.features.picture, log.gps()
    inputs = ClosureInputs(run.features.__getitem__, run.camera, run.state, run.places)
    previews = picture if run.features.has_pictures else None
    camera = None if run.odometry.metric else run.camera.body_from_camera
    extras = replace(
        mcap_extras(inputs, previews, run.closures, run.references, verify, pictures, execution),
        thumbnails=camera_thumbnails(run.views, run.closures),
        further_cameras=[view.camera.body_from_camera for view in run.views[1:]],
        gps=gps,
        earth=earth_of(trajectory, gps, about_gps(run.solved), camera),
        about={"versions": provenance.versions(), "inputs": steps.cache.hashes()},
    )
    places = [place for view in run.views for place in view.places]
    further = [(view.row, view.pictures.keyframes.stamp_ns) for view in run.views[1:]]
    descriptors, covariance = run.state.to_arrow(places), keyframe_covariances(run.solved)
    tables.write_descriptors(folder / "descriptors.parquet", keyframes, descriptors, header, further)
    tables.write_keyframes(folder / "keyframes.parquet", keyframes, poses, header, covariance)
    tables.write_closures(folder / "closures.parquet", run.closures, keyframes, header)
    residual = consistency.residual_sigma(run.graph, poses)
    tables.write_edges(folder / "edges.parquet", run.graph, run.solution, residual, header)
    tables.write_trajectory(folder / "trajectory.parquet", trajectory, run.odometry, header)
    tum.write_tum(folder / "trajectory.tum", trajectory)
    graph_sha256 = g2o.write_g2o(folder / "graph.g2o", run.graph, poses)
    mcap.write_mcap(folder / "result.mcap", keyframes, poses, run.graph, run.closures, header, extras)
    if run.library is None:
        run.state.save(folder / "library")
        name_extractor(folder / "library", run.extractor)
    steps.cache.finish([view.pictures.features.files for view in run.views])
    first = len(run.views[0].places)  # the report shows those of the first camera
    return Written(extras, covariance, descriptors[:first], graph_sha256)


@step("report")
def report(folder: Path, run: Run, written: Written, head: dict[str, Any], *, steps: Steps) -> dict[str, Any]:
    """Write report.html of the run in `folder`; the record for its run.json, but for the time that this step takes."""
    warnings = run.log.warnings + steps.warnings + steps.cache.problems
    record = {
        **head,
        **_results_record(run, head["settings"]["join"]["spacing"]),
        "inputs": steps.cache.hashes(),
        "warnings": warnings,
    }
    record["pictures"] = _pictures_record(run, head["settings"]["pictures"]["closures"])
    record["graph_sha256"] = written.graph_sha256
    write_page(_content(run, written, {**record, **steps.record()}), folder / "report.html")
    return record


def _content(run: Run, written: Written, record: dict[str, Any]) -> ReportContent:
    """The content of report.html."""
    extras, poses, closures = written.extras, run.solution.world_from_body, run.closures
    covariance = np.full((len(poses), 6, 6), np.nan) if written.covariance is None else written.covariance
    found = ReportContent(
        record,
        tracks_of(run.keyframes, poses, run.odometry, run.solved.trajectory, extras, extras.earth),
        covariance,
        closures,
        Pictures(extras.views, extras.references),
        questions=questions_of(replace(run.graph, world_from_body=poses), run.solution.weight, closures),
        references=references_of(written.descriptors, len(run.references), len(poses)),
    )
    if extras.image is None:
        return found
    thumbnails = {row: thumbnail(decode_image(extras.image(row))) for row in sorted(pictured_keyframes(found))}
    return replace(found, pictures=replace(found.pictures, thumbnails=thumbnails))


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


def _outcome(after: Trajectory, odometry: Odometry, closures: Closures, spacing: int) -> dict[str, float | int]:
    """The largest distance between a corrected and an odometry position, both from the same first pose, in m; the
    closures with more than half their weight, and the number of places they are at: how many of their queries, or of
    their matches, are `spacing` keyframes from the next, the fewer."""
    first_from_odom = after.world_from_body[0] @ se3.inverse(odometry.odom_from_body[0])
    moved = (after.world_from_body - first_from_odom @ odometry.odom_from_body)[:, :3, 3]
    used = closures.weight > 0.5  # NaN where the solver never had it
    places = min(spaced_apart(one[used].astype(np.int64), spacing) for one in (closures.query, closures.match))
    return {"moved_m": float(np.linalg.norm(moved, axis=1).max()), "closures": int(used.sum()), "places": places}


def _results_record(run: Run, spacing: int) -> dict[str, Any]:
    """Fields of run.json about the results."""
    from vplog.graph.certificate import certify

    solution, refined, verdicts = run.solution, run.solved.refined, run.closures.verdict
    losses = [loss for view in run.views for loss in getattr(view.log, "losses", [])]
    constrained = set(run.graph.kind) - {EdgeKind.ODOMETRY} or run.solved.refined.fixes
    return {
        "cameras": [view.camera.name for view in run.views],
        "calibrations": [plain(dict(vars(view.camera))) for view in run.views],
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
        "losses": [asdict(loss) for loss in dict.fromkeys(losses)],  # what all cameras share once
        "noise": run.solved.noise_source,
        "scale": "metric" if run.odometry.metric else "unknown",
        "solution": {
            "error_before": solution.error_before,
            "error_after": solution.error_after,
            "iterations": solution.iterations,
            "converged": solution.converged,
            "pieces": run.solved.pieces,
            "reason": solution.reason if constrained else "No closure passed verification.",
            **_outcome(run.solved.trajectory, run.odometry, run.closures, spacing),
        },
        "certificate": certify(run.graph, solution.weight, solution.world_from_body).record(),
        "odometry": about_odometry(refined),
        "gps": about_gps(run.solved),
        "covariance": about_covariance(run.solved),
    }
