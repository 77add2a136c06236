"""The whole job: a tree of settings, and the stages in order."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import model_validator

from vplog import logs, record
from vplog.back_end import about_gps, back_end
from vplog.data import Closures, EdgeKind, Keyframes, Reference
from vplog.errors import LibraryError, LogError, SettingsError
from vplog.extract import extract_frames, map_in_order, one_thread_each
from vplog.features.sift import SiftSettings
from vplog.features.store import FeatureStore
from vplog.graph import consistency
from vplog.graph.cross_check import CrossCheckSettings
from vplog.graph.joint import JoinSettings
from vplog.graph.noise import NoiseSettings
from vplog.graph.refine import RefineSettings
from vplog.graph.satellites import GpsSettings
from vplog.graph.solve import GncSettings, OptimiserSettings
from vplog.keyframes import KeyframeSettings, select_keyframes
from vplog.loops.propose import ProposeSettings, candidate_stops, propose
from vplog.loops.stereo import StereoSettings
from vplog.loops.verify import VerifySettings, verify
from vplog.places import PlaceSettings
from vplog.places.bobb import BobbSettings
from vplog.places.coverage import STRONGEST, choose_by_coverage, coverage_warning, frames_needed, measure_coverage
from vplog.places.library import WordSettings
from vplog.places.library import build_library as index_words
from vplog.places.sequence import SequenceSettings, rank_places
from vplog.places.shared import SharesReferences
from vplog.places.stored import load_references, read_library_record
from vplog.references import PAPER_SIZE, LibrarySettings, choose, evenly
from vplog.report import write_report
from vplog.results import g2o, mcap, run_record, tables, tum
from vplog.results.previews import PictureSettings, Previews
from vplog.settings import Settings, load_yaml, override
from vplog.show import Seen, earth_of, finished_picture, reference_use
from vplog.timing import Watch

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from vplog.data import Camera, Ints, Odometry, PoseGraph, Solution, Trajectory
    from vplog.loops.propose import Proposals
    from vplog.places.coverage import Coverage
    from vplog.results.shown import Shown
    from vplog.stages import Log, PlaceState

    Progress = Callable[[str, int, int], None]


_UNCALIBRATED = (
    "Camera {camera} is not calibrated, so no closure gets a metric pose: the trajectory is the odometry's. "
    "Record its camera_info, or name it with --camera-info-topic."
)


_NO_CLOSURE = "No closure passed verification: the trajectory is that of the odometry."


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
    """Other methods asked where the solve rejects much."""
    refine: RefineSettings = RefineSettings()
    """What the constraints kept say of the odometry."""
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
            known = ", ".join(sorted(file.stem for file in shipped.glob("*.yaml")))
            raise SettingsError(f"No pipeline {name!r}. Pipelines: {known}, or the path of a .yaml file.")
    tree, where = load_yaml(path), path.name
    for assignment in assignments:
        tree = override(tree, assignment)
        where = f"{path.name} and --set"
    return Pipeline.read(tree, where)


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
) -> Run:
    """Drive in, run folder out. Raises VplogError with one line where that cannot be.

    `path` is a log, or several that are the parts of one recording, in any order. The features of the keyframes go to
    the store given, for who needs them afterwards, or to one that goes with the run.
    """
    log = logs.open_drive(record.files_of(path), topics)
    watch, warnings = Watch(), []
    check_library(library, pipeline)
    record.begin_folder(out, pipeline, path, threads)
    with (
        ThreadPoolExecutor(1) as aside,
        FeatureStore(out / ".features") if features is None else nullcontext(features) as store,
        Previews(out / ".pictures", pipeline.pictures) as previews,
        record.heard(warnings),
    ):
        hashes = aside.submit(record.hash_inputs, path)
        with watch.stage("read"):
            odometry = _odometry(log)
            camera = log.camera()
            keyframes, missing = select_keyframes(log.name, log.stamps(), odometry, pipeline.keyframes)
            warnings += missing
        with watch.stage("extract", len(keyframes.stamp_ns)):
            later = library is not None or pipeline.library.choose == "coverage"
            chosen = set() if later else set(choose(keyframes.stamp_ns, pipeline.library).tolist())
            keyframes, references, lost = extract(log, keyframes, chosen, pipeline, store, previews, threads, progress)
            warnings += lost + ([_UNCALIBRATED.format(camera=camera.name)] if camera.matrix is None else [])
        if library is None and pipeline.library.choose == "coverage":
            with watch.stage("choose", len(store)):
                references = references_by_coverage(log, keyframes, store, pipeline.library, threads)
        with watch.stage("learn", None if library else len(references)):
            state = learn(pipeline, library, references, threads)
        with watch.stage("cover"):
            known = load_references(library) if library else references
            coverage, doubt = cover(log, keyframes, known, library is not None, store, threads)
            warnings += doubt
        with watch.stage("describe", len(store)):
            descriptors = describe(state, store, threads, progress)
        with watch.stage("propose", len(store)):
            proposals = find_candidates(state, descriptors, keyframes, pipeline, threads)
        with watch.stage("verify", len(proposals.query)):
            closures = verify(
                proposals, keyframes, camera, store.__getitem__, pipeline.verify, threads,
                lambda done, total: progress("verify", done, total), camera.baseline_m,
            )  # fmt: skip
            closures = name_shared(closures, state, descriptors)
        with watch.stage("solve"):
            solved = back_end(log, odometry, keyframes, closures, pipeline)
            closures, graph, solution = solved.closures, solved.refined.graph, solved.refined.solution
            warnings += solved.warnings
        with watch.stage("write"):
            done = Run(keyframes, closures, graph, solution)
            header = tables.TableMetadata(pipeline.model_dump(mode="json"), state.hash)
            places = [state.to_arrow(descriptors)]
            tables.write_descriptors(out / "descriptors.parquet", keyframes, places, state.arrow_type, header)
            head, on_earth = record.head(pipeline, path, threads), about_gps(solved.fixes, solved.refined)
            shown = finished_picture(
                Seen(previews.image, store.__getitem__, camera, state, descriptors), previews, closures, known,
                pipeline.verify, pipeline.pictures, threads,
                gps=log.gps(), earth=earth_of(solved.trajectory, log.gps(), on_earth),
                about={"versions": head["versions"], "inputs": hashes.result()},
            )  # fmt: skip
            write_results(out, done, odometry, solved.trajectory, camera, header, shown)
            if library is None:
                state.save(out / "library")
        account = {
            **head,
            "finished": True,
            "topics": (topics or logs.TopicChoice()).model_dump(mode="json"),
            "inputs": hashes.result(),
            "library": {
                "hash": state.hash,
                "from": str(library) if library else "the drive's own keyframes",
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
                "reason": solution.reason if EdgeKind.LOOP in graph.kind or solved.fixes else _NO_CLOSURE,
            },
            "odometry": {"sigma_factor": float(np.sqrt(solved.refined.noise)), "scale": solved.refined.scale},
            "gps": on_earth,
            "stages": watch.stages,
            "totals": watch.totals(),
            "warnings": log.warnings + warnings,
        }
    return replace(done, record=finish(out, account, watch))


def finish(out: Path, account: dict[str, Any], watch: Watch) -> dict[str, Any]:
    """Write the report and, last, run.json: what it holds."""
    with watch.stage("report"):
        write_report(out, account)
    account = {**account, "stages": watch.stages, "totals": watch.totals()}
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


def extract(
    log: Log,
    keyframes: Keyframes,
    chosen: set[int],
    pipeline: Pipeline,
    store: FeatureStore,
    previews: Previews,
    threads: int,
    progress: Progress,
) -> tuple[Keyframes, list[Reference], list[str]]:
    """Decode the keyframes, store their features, keep the chosen ones' images; undecodable frames are left out."""
    kept, references, lost = [], [], []
    total = len(keyframes.stamp_ns)
    if total < 2:
        raise LogError(
            f"{log.name}: by the odometry nothing moves far enough for a second keyframe, and a graph needs two. "
            "Set keyframes.distance_m lower, or choose another topic with --odometry-topic."
        )
    frames = extract_frames(log.frames(keyframes.stamp_ns), pipeline.features, threads, pipeline.stereo)
    for row, (stamp_ns, frame, features, why) in enumerate(frames):
        progress("extract", row + 1, total)
        if frame is None or features is None:
            lost.append(why)
            continue
        kept.append(int(np.searchsorted(keyframes.stamp_ns, stamp_ns)))
        store.append(features)
        previews.append(frame.image)
        if kept[-1] in chosen:
            references.append(Reference(frame.image, features, log.name, stamp_ns))
    if len(kept) < 2:
        why = f" The first: {lost[0]}" if lost else ""
        raise LogError(f"{log.name}: {len(kept)} of {total} keyframes could be decoded, and a graph needs two.{why}")
    warnings = (
        [f"{total - len(kept)} of {total} keyframes were lost to damaged images. First: {lost[0]}"] if lost else []
    )
    return Keyframes(keyframes.drive, keyframes.stamp_ns[kept], keyframes.odom_from_body[kept]), references, warnings


def references_by_coverage(
    log: Log, keyframes: Keyframes, store: FeatureStore, settings: LibrarySettings, threads: int
) -> list[Reference]:
    """The keyframes that explain the drive best, by their stored features; their images are read from the log again."""
    rows = choose_by_coverage(len(store), lambda row: store[row].descriptors, settings, threads)
    frames = log.frames(keyframes.stamp_ns[rows])
    return [
        Reference(encoded.decode().image, store[row], log.name, encoded.stamp_ns)
        for row, encoded in zip(rows.tolist(), frames, strict=True)
    ]


def learn(pipeline: Pipeline, library: Path | None, references: list[Reference], threads: int) -> PlaceState:
    """The recogniser with a library: the one given, or one of the drive's own images."""
    if library is not None:
        return pipeline.places.load(library, threads)
    return pipeline.places.learn(references, threads)


def cover(
    log: Log, keyframes: Keyframes, references: list[Reference], given: bool, store: FeatureStore, threads: int
) -> tuple[Coverage, list[str]]:
    """How far the references explain the drive, and what to do where that is little."""
    library = index_words(references, WordSettings(), threads)
    coverage = measure_coverage(len(store), store.__getitem__, keyframes.stamp_ns, log.name, library, threads)
    doubt = coverage_warning(coverage, len(store), given, len(library))
    return coverage, [doubt] if doubt else []


def describe(state: PlaceState, store: FeatureStore, threads: int, progress: Progress) -> Sequence[Any]:
    """A descriptor for every keyframe, in order."""
    result = []
    with ThreadPoolExecutor(threads, initializer=one_thread_each) as pool:
        work = map_in_order(pool, lambda row: state.describe(store[row]), range(len(store)), ahead=4 * threads)
        for descriptor in work:
            result.append(descriptor)
            progress("describe", len(result), len(store))
    return result


def find_candidates(
    state: PlaceState, descriptors: Sequence[Any], keyframes: Keyframes, pipeline: Pipeline, threads: int
) -> Proposals:
    """The earlier keyframes that each may be a return to, by sequences of views or view by view."""
    index, stops = state.index(descriptors), candidate_stops(keyframes, pipeline.propose)
    ranked = rank_places(index, descriptors, stops, pipeline.propose.asked, pipeline.sequence, threads)
    return propose(ranked, pipeline.propose)


def name_shared(closures: Closures, state: PlaceState, descriptors: Sequence[Any]) -> Closures:
    """The ledger with the references that explain both places of a candidate, where the recogniser has boxes."""
    if not isinstance(state, SharesReferences):
        return closures
    found = state.shared(descriptors, closures.query, closures.match)
    return replace(closures, shared_references=found.references, shared_overlap=found.overlap)


def check_library(folder: Path | None, pipeline: Pipeline) -> None:
    """Before any work: is what was given a library, and made as this run describes places? Raises LibraryError."""
    if folder is None:
        return
    made = pipeline.places.read(read_library_record(folder)["settings"], f"{folder}/library.json")
    for name, value in pipeline.places:
        if getattr(made, name) != value:
            raise LibraryError(
                f"{folder} was made with places.{name}={getattr(made, name)}, and this run asks for {value}. "
                f"Build another with `vplog library`, or run with --set places.{name}={getattr(made, name)}."
            )


def build_library(
    paths: Sequence[Path],
    out: Path,
    pipeline: Pipeline,
    topics: logs.TopicChoice | None = None,
    threads: int = 1,
    progress: Progress = lambda *_: None,
) -> PlaceState:
    """A library of frames of the logs: an equal share of each, or by coverage those that explain the frames of all.

    Raises VplogError where that cannot be.
    """
    references: list[Reference] = []
    opened = [logs.open(path, topics) for path in paths]
    by_coverage = pipeline.library.choose == "coverage"
    wanted = _stamps_by_coverage(opened, pipeline, threads, progress) if by_coverage else _shares(opened, pipeline)
    for log, stamps in zip(opened, wanted, strict=True):
        for done, (stamp_ns, frame, features, _) in enumerate(
            extract_frames(log.frames(stamps), pipeline.features, threads)
        ):
            progress(f"extract {log.name}", done + 1, len(stamps))
            if frame is not None and features is not None:
                references.append(Reference(frame.image, features, log.name, stamp_ns))
    state = pipeline.places.learn(references, threads)
    state.save(out)
    return state


def _shares(opened: Sequence[Log], pipeline: Pipeline) -> list[Ints]:
    """Stamps of an equal share of references for each log."""
    size, result = pipeline.library.size or PAPER_SIZE, []
    for number, log in enumerate(opened):
        share = size * (number + 1) // len(opened) - size * number // len(opened)
        seeded = pipeline.library.model_copy(update={"size": share, "seed": pipeline.library.seed + number})
        result.append(log.stamps()[choose(log.stamps(), seeded)])
    return result


def _stamps_by_coverage(opened: Sequence[Log], pipeline: Pipeline, threads: int, progress: Progress) -> list[Ints]:
    """Stamps of the references of each log that explain the frames of all best; equally many of each are seen."""
    each = -(-frames_needed(pipeline.library.size) // len(opened))
    descriptors, owners, seen_ns = [], [], []
    for number, log in enumerate(opened):
        stamps = log.stamps()[evenly(len(log.stamps()), each)]
        frames = extract_frames(log.frames(stamps), pipeline.features, threads)
        for done, (stamp_ns, _, features, _) in enumerate(frames):
            progress(f"look at {log.name}", done + 1, len(stamps))
            if features is not None:
                descriptors.append(features.descriptors[:STRONGEST].copy())
                owners.append(number)
                seen_ns.append(stamp_ns)
    rows = choose_by_coverage(len(descriptors), descriptors.__getitem__, pipeline.library, threads)
    owner, stamp = np.array(owners, np.int64)[rows], np.array(seen_ns, np.int64)[rows]
    return [stamp[owner == number] for number in range(len(opened))]


def _odometry(log: Log) -> Odometry:
    odometry = log.odometry()
    if odometry is None or len(odometry.stamp_ns) < 2:
        raise LogError(
            f"{log.name} has no odometry, and a trajectory is built on it. "
            "`vplog info` lists the topics; choose one with --odometry-topic."
        )
    return odometry
