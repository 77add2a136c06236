"""The whole job: a tree of settings, and the stages in order."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import model_validator

from vplog import logs, record
from vplog.back_end import about_gps, back_end
from vplog.cores import limited
from vplog.data import Closures, EdgeKind, Keyframes, Reference
from vplog.errors import SettingsError, nearest
from vplog.features.sift import SiftSettings
from vplog.graph import consistency
from vplog.graph.cross_check import CrossCheckSettings
from vplog.graph.joint import JoinSettings
from vplog.graph.noise import NoiseSettings
from vplog.graph.refine import RefineSettings
from vplog.graph.satellites import GpsSettings
from vplog.graph.solve import GncSettings, OptimiserSettings
from vplog.inputs import files_of
from vplog.keyframes import KeyframeSettings, select_keyframes
from vplog.ledger import verify_in_parts
from vplog.libraries import about_references, check_library, cover, coverage_codec, own_images
from vplog.loops.propose import Proposals, ProposeSettings
from vplog.loops.stereo import StereoSettings
from vplog.loops.verify import VerifySettings
from vplog.parts import cut, extract, images_topics, kept, odometry_of
from vplog.places import PlaceSettings
from vplog.places.bobb import BobbSettings
from vplog.places.sequence import SequenceSettings
from vplog.places.stored import load_references
from vplog.recognise import describe, find_candidates, name_shared
from vplog.references import LibrarySettings
from vplog.report import write_report
from vplog.results import g2o, mcap, run_record, tables, tum
from vplog.results.previews import PictureSettings
from vplog.results.run_record import CACHE
from vplog.run_folder import begun
from vplog.settings import Settings, load_yaml, override
from vplog.show import Seen, earth_of, finished_picture, reference_use
from vplog.stage_cache import StageCache, inputs_of
from vplog.stage_codecs import arrays_codec, descriptors_codec, images_codec
from vplog.timing import Watch

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from vplog.data import Camera, Odometry, PoseGraph, Solution, Trajectory
    from vplog.features.store import FeaturesOf, FeatureStore
    from vplog.results.shown import Shown
    from vplog.stages import Log, PlaceState

    Progress = Callable[[str, int, int], None]


_UNCALIBRATED = (
    "Camera {camera} is not calibrated, so no closure gets a metric pose: the trajectory is the odometry's. "
    "Record its camera_info, or name it with --camera-info-topic."
)


class Pipeline(Settings):
    """Every setting of a run. A pipeline file holds only what differs."""

    keyframes: KeyframeSettings = KeyframeSettings()
    """Which frames become nodes."""
    features: SiftSettings = SiftSettings()
    """Local features of a frame."""
    stereo: StereoSettings = StereoSettings()
    """Depth of features from a stereo pair."""
    library: LibrarySettings = LibrarySettings()
    """The reference images that places are described by."""
    places: PlaceSettings = BobbSettings()
    """Place recognition."""
    sequence: SequenceSettings = SequenceSettings()
    """Views matched along with their neighbours."""
    propose: ProposeSettings = ProposeSettings()
    """Candidate closures."""
    verify: VerifySettings = VerifySettings()
    """Geometry of a candidate."""
    noise: NoiseSettings = NoiseSettings()
    """Odometry noise."""
    solve: OptimiserSettings = GncSettings()
    """Robust solve of the pose graph."""
    cross_check: CrossCheckSettings = CrossCheckSettings()
    """Other methods compared where the solve rejects much."""
    refine: RefineSettings = RefineSettings()
    """Noise and scale of the odometry by the constraints kept."""
    gps: GpsSettings = GpsSettings()
    """Satellite fixes as constraints."""
    join: JoinSettings = JoinSettings()
    """Several drives in one map."""
    pictures: PictureSettings = PictureSettings()
    """What result.mcap and report.html show of the camera's images."""

    @model_validator(mode="before")
    @classmethod
    def _default_kinds(cls, tree: Any) -> Any:
        """A setting of a method may be changed without naming the method: no `kind` means the default's."""
        if not isinstance(tree, dict):
            return tree
        kinds = {name: getattr(known.default, "kind", None) for name, known in cls.model_fields.items()}
        return {
            name: {"kind": kinds[name], **part} if kinds.get(name) and isinstance(part, dict) else part
            for name, part in tree.items()
        }


def load_pipeline(name: str, assignments: Iterable[str] = ()) -> Pipeline:
    """A pipeline by shipped name (`default`, `paper`) or file, with `a.b=c` overrides. Raises SettingsError."""
    path = Path(name)
    if path.suffix not in (".yaml", ".yml"):
        shipped = pipeline_folder()
        path = shipped / f"{name}.yaml"
        if not path.is_file():
            known = sorted(file.stem for file in shipped.glob("*.yaml"))
            choices = f"Pipelines: {', '.join(known)}, or the path of a .yaml file."
            raise SettingsError(f"No pipeline {name!r}.{nearest(name, known)} {choices}")
    return pipeline_from(load_yaml(path), path.name, assignments)


def pipeline_from(tree: dict[str, Any], where: str, assignments: Iterable[str] = ()) -> Pipeline:
    """A pipeline from a tree of settings, with `a.b=c` overrides. Raises SettingsError."""
    for assignment in assignments:
        tree = override(tree, assignment)
    return Pipeline.read(tree, where, assignments)


def pipeline_schema() -> dict[str, Any]:
    """JSON Schema of a pipeline file, for editors and outside checkers."""
    return Pipeline.model_json_schema()


def pipeline_folder() -> Path:
    """Where the named pipelines are: inside the installed package, or beside it in a checkout."""
    package = Path(__file__).parent
    inside = package / "pipelines"
    return inside if inside.is_dir() else package.parent / "pipelines"


@dataclass(frozen=True, eq=False)
class Run:
    """All that a finished run knows."""

    keyframes: Keyframes
    closures: Closures
    graph: PoseGraph
    solution: Solution
    record: dict[str, Any] = field(default_factory=dict)


def run(
    path: Path | Sequence[Path],
    out: Path,
    pipeline: Pipeline,
    library: Path | None = None,
    topics: logs.TopicChoice | None = None,
    threads: int = 1,
    progress: Progress = lambda *_: None,
    features: FeatureStore | None = None,
    cache: Path | None = None,
    use_cache: bool = True,
    force: bool = False,
) -> Run:
    """Drive in, run folder out. Raises VplogError with one line where that cannot be.

    `path` is a log, or several that are the parts of one recording, in any order. The features of the keyframes go to
    the store given too, for who needs them afterwards. What stages come to is kept in `cache`, a folder of this drive
    alone (by default in `out`), and found there by a later run as far as that would make the same; without
    `use_cache` nothing is found and nothing stays. What `out` holds stays until the new run is whole; the run of
    another log is replaced with `force` only.
    """
    topics = topics or logs.TopicChoice()
    log = logs.open_drive(files_of(path), topics)
    watch, warnings = Watch(), []
    check_library(library, pipeline)
    with (
        begun(out, pipeline, path, threads, library, topics, resumable=use_cache and not cache, force=force) as made,
        StageCache((cache or out / CACHE) if use_cache else made / CACHE, watch, warnings, use_cache) as stages,
        ThreadPoolExecutor(1) as aside,
        record.heard(warnings),
    ):
        inputs = inputs_of(path, stages.folder)
        hashes = aside.submit(stages.know_inputs, path, inputs)
        places = type(pipeline.places).__module__
        with watch.stage("read"):
            odometry, camera = odometry_of(log), log.camera()
            selected, missing = select_keyframes(log.name, log.stamps(), odometry, pipeline.keyframes)
            stages.saw(images=[inputs.token, images_topics(topics)], keyframes=selected, camera=camera)
            warnings += missing
        with watch.stage("extract", len(selected.stamp_ns)):
            parts = cut(files_of(path), topics, pipeline, selected, inputs)
            seen = extract(log, parts, stages, threads, progress)
            keyframes, lost = kept(selected, seen)
            warnings += lost + ([_UNCALIBRATED.format(camera=camera.name)] if camera.matrix is None else [])
            if features is not None:
                features.extend(seen)
        known = references_of(library, log, selected, keyframes, seen, pipeline.library, stages, threads)
        with watch.stage("learn", len(known)):
            state = learn(pipeline, library, known, threads)
            stages.saw(library=about_references(known), state=state.hash)
        coverage, doubt = stages.stage(
            "cover", ["keyframes", "extract", "library"], [], ["vplog.libraries"], coverage_codec(),
            lambda: cover(log.name, keyframes, known, library is not None, seen, threads),
        )  # fmt: skip
        warnings += doubt
        descriptors = stages.stage(
            "describe", ["extract", "state"], [pipeline.places], ["vplog.recognise", places],
            descriptors_codec(state, len(seen)), lambda: describe(state, seen, threads, progress), len(seen),
        )  # fmt: skip
        proposals = stages.stage(
            "propose", ["keyframes", "extract", "state", "describe"], [pipeline.propose, pipeline.sequence],
            ["vplog.recognise", places], arrays_codec(Proposals),
            lambda: find_candidates(state, descriptors, keyframes, pipeline.propose, pipeline.sequence, threads),
            len(seen),
        )  # fmt: skip
        with watch.stage("verify", len(proposals.query)):
            closures = verify_in_parts(
                proposals, keyframes, camera, seen, pipeline.verify, stages, threads,
                lambda done, total: progress("verify", done, total),
            )  # fmt: skip
            closures = name_shared(closures, state, descriptors)
        with watch.stage("solve"), limited(threads):
            solved = back_end(log, odometry, keyframes, closures, pipeline)
            closures, graph, solution = solved.closures, solved.refined.graph, solved.refined.solution
            warnings += solved.warnings
        with watch.stage("write"):
            done = Run(keyframes, closures, graph, solution)
            header = tables.TableMetadata(pipeline.model_dump(mode="json"), state.hash)
            column = [state.to_arrow(descriptors)]
            tables.write_descriptors(made / "descriptors.parquet", keyframes, column, state.arrow_type, header)
            previews = seen.pictures
            head, on_earth = record.head(pipeline, path, threads), about_gps(solved.fixes, solved.refined)
            shown = finished_picture(
                Seen(previews.image, seen.__getitem__, camera, state, descriptors), previews, closures, known,
                pipeline.verify, pipeline.pictures, threads,
                gps=log.gps(), earth=earth_of(solved.trajectory, log.gps(), on_earth),
                about={"versions": head["versions"], "inputs": hashes.result()},
            )  # fmt: skip
            write_results(made, done, odometry, solved.trajectory, camera, header, shown)
            if library is None:
                state.save(made / "library")
            stages.finish(path, inputs, seen.files)
        account = {
            **head,
            "finished": True,
            "topics": topics.model_dump(mode="json"),
            "inputs": hashes.result(),
            "library": {
                "hash": state.hash,
                "from": record.library_of(library),
                "references": len(known),
                "used": reference_use(state, descriptors),
                "coverage": asdict(coverage),
            },
            "descriptor_bits": state.bits,
            "counts": record.counts(log, odometry, keyframes, closures),
            "losses": record.losses(log),
            "noise": solved.noise_source,
            "solution": {
                "error_before": solution.error_before,
                "error_after": solution.error_after,
                "iterations": solution.iterations,
                "converged": solution.converged,
                "reason": solution.reason
                if EdgeKind.LOOP in graph.kind or solved.fixes
                else "No closure passed verification.",
            },
            "odometry": {"sigma_factor": float(np.sqrt(solved.refined.noise)), "scale": solved.refined.scale},
            "gps": on_earth,
            "stages": stages.account(),
            "totals": watch.totals(),
            "warnings": log.warnings + warnings,
        }
        return replace(done, record=finish(made, account, stages))


def finish(out: Path, account: dict[str, Any], stages: StageCache) -> dict[str, Any]:
    """Write the report and, last, run.json: what it holds."""
    with stages.watch.stage("report"):
        write_report(out, account)
    account = {**account, "stages": stages.account(), "totals": stages.watch.totals()}
    run_record.write_run_json(out / "run.json", account)
    return account


def write_results(
    out: Path,
    done: Run,
    odometry: Odometry,
    trajectory: Trajectory,
    camera: Camera,
    header: tables.TableMetadata,
    shown: Shown | None = None,
) -> None:
    """The files of a run folder that every method writes alike."""
    keyframes, closures, graph, solution = done.keyframes, done.closures, done.graph, done.solution
    poses = solution.world_from_body
    residual = consistency.residual_sigma(graph, poses)
    tables.write_keyframes(out / "keyframes.parquet", keyframes, poses, header)
    tables.write_closures(out / "closures.parquet", closures, keyframes, header)
    tables.write_edges(out / "edges.parquet", graph, solution, residual, header)
    tables.write_trajectory(out / "trajectory.parquet", trajectory, odometry, header)
    tum.write_tum(out / "trajectory.tum", trajectory)
    g2o.write_g2o(out / "graph.g2o", graph, poses)
    mcap.write_mcap(out / "result.mcap", keyframes, poses, graph, closures, header, camera, shown)


def references_of(
    library: Path | None,
    log: Log,
    selected: Keyframes,
    keyframes: Keyframes,
    features: FeaturesOf,
    settings: LibrarySettings,
    stages: StageCache,
    threads: int,
) -> list[Reference]:
    """The reference images: of the library given, or chosen among the drive's own `keyframes`."""
    if library is not None:
        with stages.watch.stage("choose"):
            return load_references(library, threads)
    images = stages.stage(
        "choose", ["images", "keyframes", "extract"], [settings], ["vplog.libraries"], images_codec(),
        lambda: own_images(log, selected, keyframes, features, settings, threads),
    )  # fmt: skip
    stamps = keyframes.stamp_ns.tolist()
    return [Reference(image, features[row], log.name, stamps[row]) for row, image in images]


def learn(pipeline: Pipeline, library: Path | None, references: list[Reference], threads: int) -> PlaceState:
    """The recogniser with a library: the one given, or one of the drive's own images."""
    if library is not None:
        return pipeline.places.load(library, threads)
    return pipeline.places.learn(references, threads)
