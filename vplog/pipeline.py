"""The pipeline of one drive: its tree of settings, and run(), the stages in order."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from pydantic import model_validator

from vplog import logs
from vplog.errors import ResultError, SettingsError, nearest
from vplog.execution.execution import Execution
from vplog.features.extractors import FeatureSettings
from vplog.features.sift import SiftSettings
from vplog.features.stereo_depth import StereoSettings
from vplog.graph.noise import NoiseSettings
from vplog.graph.solve import GncSettings, OptimiserSettings
from vplog.joint.graph import JoinSettings
from vplog.loops.false_rate import FalseRateSettings
from vplog.loops.propose import ProposeSettings
from vplog.loops.verify import VerifySettings
from vplog.places import KINDS, PlaceSettings
from vplog.places.bobb import BobbSettings
from vplog.places.plugin import as_plugin
from vplog.places.reference_choice import LibrarySettings
from vplog.places.sequence import SequenceSettings
from vplog.refinement.gps_factors import GpsSettings
from vplog.refinement.refine import RefineSettings
from vplog.results import tables
from vplog.results.previews import PictureSettings
from vplog.results.run_record import CACHE
from vplog.run import provenance
from vplog.run.back_end import solve
from vplog.run.cache.steps import Steps
from vplog.run.cameras import View, describe_cameras, name_shared, read_cameras, verify_cameras
from vplog.run.decisions import DecisionSettings, decide, read_decisions
from vplog.run.false_rate import RatingSettings, rate_closures
from vplog.run.feature_extraction import decoded, extract
from vplog.run.keyframes import KeyframeSettings
from vplog.run.odometry import read
from vplog.run.outputs import Run, finish, report, write
from vplog.run.place_recognition import describe, find_candidates
from vplog.run.reference_library import check_library, cover, given_references, learn, own_images, own_references
from vplog.run.run_folder import CacheOptions, staged_run
from vplog.run.scale_drift import in_one_scale, scale_ratios
from vplog.run.verification import DriveFeatures, verify
from vplog.settings import Settings, load_yaml, override
from vplog.storage.input_hashes import files_of


class Pipeline(Settings):
    """Every setting of a run. A pipeline file holds only what differs."""

    keyframes: KeyframeSettings = KeyframeSettings()
    """Selection of keyframes."""
    features: FeatureSettings = SiftSettings()
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
    false_rate: FalseRateSettings = FalseRateSettings()
    """The share of false closures that is admitted."""
    decisions: DecisionSettings = DecisionSettings()
    """Closures decided by a person."""
    noise: NoiseSettings = NoiseSettings()
    """Odometry noise."""
    solve: OptimiserSettings = GncSettings()
    """Robust solve of the pose graph."""
    refine: RefineSettings = RefineSettings()
    """Noise and scale of the odometry by the constraints kept."""
    gps: GpsSettings = GpsSettings()
    """Satellite fixes as constraints."""
    join: JoinSettings = JoinSettings()
    """Several drives in one map."""
    pictures: PictureSettings = PictureSettings()
    """Images of the camera in result.mcap and report.html."""

    @property
    def rating(self) -> RatingSettings:
        """How closures are rated: without mirrored candidates where features are not SIFT, as only its descriptors are
        mirrored without the image."""
        mirrored = {} if self.features.kind == "sift" else {"null_pairs": 0}
        return RatingSettings(self.false_rate.model_copy(update=mirrored), self.propose, self.noise)

    @model_validator(mode="before")
    @classmethod
    def _default_kinds(cls, tree: Any) -> Any:
        """A setting of a method may be changed without naming the method: no `kind` means the default's. Plug-ins are
        named by their own kind."""
        if not isinstance(tree, dict):
            return tree
        kinds = {name: getattr(known.default, "kind", None) for name, known in cls.model_fields.items()}
        tree = {name: as_plugin(part, KINDS) if name == "places" else part for name, part in tree.items()}
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


def recorded_pipeline(folder: Path, record: dict[str, Any]) -> Pipeline:
    """The settings of a run. Raises ResultError."""
    try:
        return Pipeline.read(record.get("settings") or {}, f"{folder}/run.json")
    except SettingsError as error:
        raise ResultError(f"{error} The run is of another version of vplog: run it again.") from None


def pipeline_schema() -> dict[str, Any]:
    """JSON Schema of a pipeline file, for editors and outside checkers."""
    return Pipeline.model_json_schema()


def pipeline_folder() -> Path:
    """Folder of the named pipelines: inside the installed package, or beside it in a checkout."""
    package = Path(__file__).parent
    inside = package / "pipelines"
    return inside if inside.is_dir() else package.parent / "pipelines"


STAGES = (
    "read", "extract", "cameras", "choose", "learn", "cover", "describe", "propose", "scale", "verify",
    "describe_cameras", "verify_cameras", "p_false", "decide", "solve", "write", "report",
)  # fmt: skip
"""Names of the steps of `run` in order, as run.json and progress have them; those of cameras are for several, `scale`
for drives without metres and `decide` for decisions alone."""


def run(
    path: Path | Sequence[Path],
    out: Path,
    pipeline: Pipeline,
    library: Path | None = None,
    topics: logs.TopicChoice | None = None,
    execution: Execution = Execution(),
    cache: CacheOptions = CacheOptions(),
) -> Run:
    """Drive in, run folder out. Raises VplogError with one line where that cannot be.

    `path` is a log, or several that are the parts of one recording, in any order. `library` holds the reference images;
    without one they are keyframes of the drive. What `out` holds stays until the new run is whole.
    """
    topics = topics or logs.TopicChoice()
    log = logs.open_drive(files_of(path), topics)
    check_library(library, pipeline)
    head = provenance.head(pipeline, path, execution.threads, topics)
    head["arguments"] = provenance.arguments(files_of(path), topics, pipeline, library)
    with (
        staged_run(out, head, files_of(path), library, topics, cache=cache) as folder,
        Steps(path, cache.folder or (out if cache.use else folder) / CACHE, execution, use_cache=cache.use) as do,
    ):
        odometry, camera, selected = do(read, log, topics, pipeline.keyframes, pipeline.gps.use)
        features = do(extract, log, topics, selected, pipeline)
        keyframes, features = decoded(selected, features, pipeline.features, odometry, camera.name)
        decisions = read_decisions(Path(pipeline.decisions.file), keyframes) if pipeline.decisions.file else None
        others = {topic: topics.of_camera(topic) for topic in log.further_cameras() if odometry.metric}
        views = do(read_cameras, log, others, odometry, keyframes, pipeline, library is None) if others else []
        if library is None:
            images = do(own_images, log, keyframes, features, pipeline.library)
            references = own_references(keyframes, features, images)
            references += [one for view in views for one in view.references]
        else:
            references = do(given_references, library)
        state = do(learn, pipeline.places, references, library)
        coverage = do(cover, keyframes, references, library is not None, features)
        descriptors = do(describe, state, log, features)
        proposals = do(find_candidates, state, descriptors, keyframes, pipeline.propose, pipeline.sequence)
        drive = DriveFeatures(keyframes, camera, features, pipeline.verify, odometry.trajectory)
        if not odometry.metric:
            odometry, keyframes = in_one_scale(odometry, keyframes, camera, do(scale_ratios, proposals, drive))
            drive = replace(drive, keyframes=keyframes, odometry=odometry.trajectory)
        closures = do(verify, proposals, drive)
        views = [View.of(log, drive, descriptors), *(do(describe_cameras, views, state) if views else [])]
        if len(views) > 1:
            closures = do(verify_cameras, closures, views, state, pipeline)
        pictures, rows = [view.pictures for view in views], [view.row for view in views]
        closures = do(rate_closures, closures, odometry, pictures, rows, pipeline.rating)
        if decisions is not None:
            closures = do(decide, closures, decisions, drive)
        closures = name_shared(closures, state, views)
        solved = do(solve, odometry, keyframes, closures, log.gps(), pipeline)
        result = Run(
            log, odometry, camera, keyframes, features, library, references, state, coverage, descriptors, solved,
            views, pipeline.features.identity(),
        )  # fmt: skip
        header = tables.TableMetadata(pipeline.model_dump(mode="json"), state.hash)
        written = do(write, folder, result, pipeline.verify, pipeline.pictures, header)
        return finish(folder, result, do(report, folder, result, written, head), do)
