"""The public API of `import vplog`, over which the verbs of the command line are thin."""

from __future__ import annotations

import os
import weakref
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vplog.errors import ResultError, SettingsError
from vplog.execution.cores import available, limited
from vplog.execution.execution import Execution, Progress, silent

if TYPE_CHECKING:
    import numpy as np
    import pyarrow as pa
    from numpy.typing import NDArray

    from vplog.batch.worker import DriveState
    from vplog.benchmark.compare import Comparison
    from vplog.data import Camera
    from vplog.logs import TopicChoice
    from vplog.maps.localization.localize import LocalizedPicture
    from vplog.pipeline import Pipeline
    from vplog.stages import Log

    Place = str | Path
    """A path, or a URL as text."""
    Topics = TopicChoice | Mapping[str, Any]
    """Topics and files to use instead of those that the rules choose, by part: `{"image": "/left"}`."""
    Settings = dict[str, Any] | Sequence[str]
    """Single settings by dotted name, `{"library.size": 50}`, or as --set has them, `["library.size=50"]`."""


def _let_numba_cache() -> None:
    """Where neither the installation nor the user's home can be written to, as in a container with another user, numba
    refuses to compile: kernels are then stored in this user's temporary folder."""
    home = os.path.expanduser("~")  # noqa: PTH111 (there may be none)
    writable = any(os.access(place, os.W_OK) for place in (Path(__file__).parent, f"{home}/.cache", home))
    if not writable and "NUMBA_CACHE_DIR" not in os.environ:
        from vplog.storage.scratch import own_folder

        os.environ["NUMBA_CACHE_DIR"] = str(own_folder() / "numba")


_let_numba_cache()


def run(
    log: Place | Sequence[Place],
    out: Place,
    pipeline: str | Path | Pipeline = "default",
    *,
    settings: Settings | None = None,
    topics: Topics | None = None,
    library: Place | None = None,
    one_drive: bool = False,
    cache: bool = True,
    force: bool = False,
    threads: int | None = None,
    progress: Progress = silent,
) -> RunFolder:
    """Turn a recorded drive into an optimised trajectory, in the run folder `out`.

    Several logs are drives of one graph where closures join them; with `one_drive`, the parts of one recording.

    pipeline: a shipped name (`default`, `paper`, ...), a YAML file or a Pipeline.
    settings: single settings by dotted name, `{"features.max_features": 600}`.
    topics: by part, `{"image": "/left", "odometry": "/odom"}`; the parts are the fields of vplog.logs.TopicChoice.
    library: reference images as `vplog library` writes them, None to choose them in the drive.
    cache: whether results of stages stay in `out` for later runs.
    force: whether the run of another log in `out` is replaced.
    threads: None for one a core; results do not depend on it.
    progress: called with a stage, items done and items in all, from any thread.
    """
    from vplog.maps.joining.joint_run import run_joint
    from vplog.pipeline import run as run_drive
    from vplog.run.run_folder import CacheOptions
    from vplog.storage.remote_path import RemotePath, local_copy, local_output, located

    place, execution = located(out), Execution(threads or available(), progress)
    paths, chosen, parts = _paths(log), _pipeline(pipeline, settings), _topics(topics)
    remote = isinstance(place, RemotePath)
    with ExitStack() as stack:
        stack.enter_context(limited(execution.threads))
        folder = stack.enter_context(local_output(place))
        references = None if library is None else stack.enter_context(local_copy(located(library)))
        # a cache that is sent over the net costs more than it saves
        options = CacheOptions(use=cache and not remote, force=force)
        if len(paths) > 1 and not one_drive:
            record = run_joint(paths, folder, chosen, references, parts, execution, options)
        else:
            record = run_drive(paths, folder, chosen, references, parts, execution, options).record
    return open_run(out) if remote else RunFolder(place, record)


def open_log(log: Place | Sequence[Place], topics: Topics | None = None) -> Log:
    """A drive as vplog reads it, its kind found by content; several files are the parts of one recording.

    `stamps()` (F,) i64 in ns, `frames(stamps)` to decode one by one, `camera()`, `odometry()`, `gps()`, `info()` and
    `warnings`, see vplog.stages.Log.
    """
    from vplog import logs

    paths = _paths(log)
    return logs.open(paths[0], _topics(topics)) if len(paths) == 1 else logs.open_drive(paths, _topics(topics))


def open_run(folder: Place) -> RunFolder:
    """A finished run, or a drive of a map (MAP/runs/drive=ID). One by URL is copied for as long as the result lives."""
    from vplog.results.run_record import read_finished_run
    from vplog.storage.remote_path import local_copy, located

    with ExitStack() as stack:
        here = stack.enter_context(local_copy(located(folder)))
        found = RunFolder(here, read_finished_run(here))
        weakref.finalize(found, stack.pop_all().close)
    return found


class RunFolder:
    """A finished run: its record, its tables as Arrow, and the images of its keyframes.

    Every table is a pyarrow.Table, whose `to_pandas()` gives a data frame where pandas is installed. Poses are columns
    `tx ty tz` (m) and `qx qy qz qw`; the page *Files and columns* of the documentation explains each column.
    """

    def __init__(self, folder: Path, record: dict[str, Any]) -> None:
        self.folder = folder
        """Local folder of the run."""
        self.record = record
        """Content of run.json: settings, counts, timings, warnings, losses."""

    def __repr__(self) -> str:
        return f"RunFolder({str(self.folder)!r})"

    @property
    def trajectory(self) -> pa.Table:
        """A row for each odometry sample: `stamp_ns`, world_from_body as optimised, and `odom_` as logged."""
        return self.table("trajectory")

    @property
    def keyframes(self) -> pa.Table:
        """A row for each keyframe: `stamp_ns`, `odom_` and `world_` poses."""
        return self.table("keyframes")

    @property
    def closures(self) -> pa.Table:
        """A row for each candidate closure, rejected ones too: `query`, `match`, `verdict`, `inliers`, `weight`, ..."""
        return self.table("closures")

    @property
    def drives(self) -> dict[str, RunFolder]:
        """The runs of a joint run by name of the drive, whose poses in the common frame are tables `joint_...`."""
        from vplog.storage.folders import is_below

        folders = {one["name"]: one["folder"] for one in self.record.get("drives", ())}
        if not all(map(is_below, folders.values())):
            raise ResultError(f"{self.folder}/run.json names drives outside its folder. Run `vplog run` again.")
        return {name: open_run(self.folder / folder) for name, folder in folders.items()}

    def table(self, name: str) -> pa.Table:
        """A table by the name of its file: `edges`, `descriptors`, `joins` of a joint run, ... Raises ResultError."""
        from vplog.results import tables
        from vplog.results.run_record import read_single_run

        if not (self.folder / f"{name}.parquet").is_file():
            read_single_run(self.folder)  # names the drives where there are several
        return tables.read_arrow(self.folder / f"{name}.parquet")

    def localize(self, image: Place | NDArray[np.uint8], camera: Camera | Place) -> LocalizedPicture:
        """The pose of one picture in the run, see `Map.localize`."""
        return self._localizer(image, camera)

    @cached_property
    def _localizer(self) -> Callable[..., LocalizedPicture]:
        return _localizer(self, self.folder)

    def images(
        self,
        keyframes: Iterable[int] | None = None,
        *,
        from_log: bool = False,
        log: Place | Sequence[Place] | None = None,
        topics: Topics | None = None,
    ) -> Iterator[tuple[int, NDArray[np.uint8]]]:
        """Row and grey image (H, W) of keyframes, of all where None, in order of time, one in memory at a time.

        They are those of result.mcap, reduced by the setting pictures.megapixels; with `from_log` those of the log, as
        recorded, which run.json names unless `log` says where it is. Raises ResultError where one is missing.
        """
        import numpy as np

        stamps = np.asarray(self.keyframes["stamp_ns"])
        rows = np.arange(len(stamps)) if keyframes is None else np.unique(np.asarray(list(keyframes), np.int64))
        if len(rows) and not 0 <= rows[0] <= rows[-1] < len(stamps):
            raise ResultError(f"{self.folder} has keyframes 0..{len(stamps) - 1}, not {rows[0]}..{rows[-1]}.")
        wanted = dict(zip(stamps[rows].tolist(), rows.tolist(), strict=True))
        found = self._recorded(stamps[rows], log, topics) if from_log or log is not None else self._shown()
        for stamp_ns, image in found:
            if stamp_ns in wanted:
                yield wanted.pop(stamp_ns), image()
        if wanted:
            where = "the log" if from_log or log is not None else f"{self.folder}/result.mcap"
            other = "" if where == "the log" else " Take those of the log: images(from_log=True)."
            raise ResultError(f"{where} has no image of keyframe {min(wanted.values())}.{other}")

    def _shown(self) -> Iterator[tuple[int, Callable[[], Any]]]:
        from vplog.results.mcap_read import read_images
        from vplog.storage.image_file import BadImageError, decode_image

        path = self.folder / "result.mcap"
        try:
            for one in read_images(path):
                yield one.stamp_ns, lambda jpeg=one.image: decode_image(jpeg)
        except BadImageError as error:
            raise ResultError(f"An image of {path} cannot be decoded: {error}. Run `vplog run` again.") from None

    def _recorded(
        self, stamps: Any, log: Place | Sequence[Place] | None, topics: Topics | None
    ) -> Iterator[tuple[int, Callable[[], Any]]]:
        from vplog import logs
        from vplog.run.provenance import reopened

        parts = _topics(self.record.get("topics") if topics is None else topics)
        if log is not None:
            opened = logs.open_drive(_paths(log), parts)
        else:
            opened = reopened(self.folder, self.record, None, parts, "Name it: log=LOG.")
        for frame in opened.frames(stamps):
            yield frame.stamp_ns, lambda frame=frame: frame.decode().image


def localize(
    map: Place,
    pictures: Place | Sequence[Place],
    *,
    topics: Topics | None = None,
    out: Place | None = None,
    top: int = 10,
    threads: int | None = None,
    progress: Progress = silent,
) -> dict[str, Any]:
    """The poses of pictures, or of the keyframes of a log, in a run or a map, each with covariance, verdict, sentence.

    `answers` of the result has a record for each: `localized`, `tx ty tz qx qy qz qw` (world_from_camera),
    `covariance` (6x6, rotation first, in the camera), `longitude latitude altitude_m` where known, ...

    map: a run folder, or a map as `batch` writes it.
    pictures: files of images, a folder of them, or a log, whose odometry then joins its frames.
    topics: as in `run`; `{"calibration_file": FILE}` for pictures.
    out: FILE.parquet for the records, or FILE.tum for the poses.
    top: places that a picture is verified against.
    """
    from vplog.maps.localization.verb import localize_paths
    from vplog.storage.remote_path import located

    threads = threads or available()
    with limited(threads):
        path = None if out is None else located(out)
        execution = Execution(threads, progress)
        return localize_paths(located(map), _paths(pictures), _topics(topics), path, execution, top)


def evaluate(
    run: RunFolder | Place,
    truth: Place = "auto",
    *,
    distance_m: float | None = None,
    heading_deg: float | None = None,
    align: str | None = None,
    truth_offset_s: float | None = None,
    topics: Topics | None = None,
    log: Place | None = None,
) -> dict[str, Any]:
    """ATE, RPE and drift of a run before and after, and which of its closures are right; or of a map `drives`, a record
    of figures for each, and `groups`, their means by tag and version.

    truth: a TUM file of poses, `gps`, the log's own fixes, or `auto`, the ground truth that comes with the log. Of a
        map also a manifest with a column `truth`; `auto` is first what the manifest of `batch` named.
    distance_m, heading_deg: bounds of one place; 6 m and 45 degrees unless given.
    align: alignment of the ATE, `se3`, `sim3` or `origin`; unless given `se3`, or `sim3` of a run without metres.
    truth_offset_s: added to the truth's stamps.
    log: the log of the run, if it is not where run.json says, or is on a server.
    """
    from vplog.storage.remote_path import local_copy, located
    from vplog.verbs.evaluate_run import TruthOptions
    from vplog.verbs.evaluate_run import evaluate as evaluate_run

    given = {"distance_m": distance_m, "heading_deg": heading_deg, "align": align, "truth_offset_s": truth_offset_s}
    options: Any = {name: value for name, value in given.items() if value is not None}
    place = run.folder if isinstance(run, RunFolder) else located(run)
    if (place / "map.json").exists():
        from vplog.batch.evaluate_map import evaluate_map

        if (chosen := _topics(topics)) is not None and chosen.model_dump(exclude_defaults=True):
            raise SettingsError("The drives of a map have topics of their own. Leave out the topics, or name a drive.")
        if log is not None:
            raise SettingsError("The drives of a map have logs of their own. Leave out the log, or name a drive.")
        return evaluate_map(place, os.fspath(truth), TruthOptions(**options))
    with local_copy(place) as folder:
        chosen = None if log is None else located(log)
        return evaluate_run(folder, os.fspath(truth), _topics(topics), TruthOptions(**options), chosen)


def compare(
    query: Place,
    map: Place | None = None,
    *,
    methods: str | Iterable[str],
    truth: Place | None = None,
    tolerance: int | None = None,
    distance_m: float | None = None,
    heading_deg: float | None = None,
    pipeline: str | Path | Pipeline = "default",
    settings: Settings | None = None,
    topics: Topics | None = None,
    library: Place | None = None,
    library_size: int | None = None,
    library_seed: int = 0,
    min_gap: int | None = None,
    sequence: int | None = None,
    out: Place | None = None,
    cache: Path | None = None,
    cache_gb: float | None = None,
    threads: int | None = None,
    progress: Progress = silent,
) -> Comparison:
    """Compare recognisers on the frames of one drive looked for in another, or in its own past with `min_gap` frames.

    `record` of the result holds the figures, `ranks` what they are of, `answers` a table with a row for each method and
    query.

    map: None to search the query's own frames, those `min_gap` frames older.
    methods: recognisers or pipelines, `["bobb", "gist"]` or `"bobb,gist"`, each with `:setting=value` as needed.
    truth: `index` (equal numbers in file names or of frames, within `tolerance`), FILE.csv (`query,match` or
    `image,label`), FILE.npy, `labels` (folders), `utm` (file names), FILE.tum, `poses` or `gps` (within `distance_m`
    and `heading_deg`); None for answers without scores.
    library: a log or a library of reference images, None for `library_size` images of the map drive: where it is None,
    too, all of them, 1600 at most, and of a drive in its own past as many as `run` takes.
    sequence: also match windows of so many frames.
    out: a local folder for compare.json, answers.csv, scores and figures.
    cache, cache_gb: folder and largest size in 10^9 bytes of the cache of features, None for the user's.
    """
    from vplog.benchmark.compare import CompareOptions
    from vplog.benchmark.compare import compare as compare_methods
    from vplog.benchmark.feature_cache import CacheChoice
    from vplog.benchmark.recogniser_specs import split_methods
    from vplog.evaluate.place_truth import TruthChoice
    from vplog.storage.remote_path import local_copy, located

    threads, bounds = threads or available(), (tolerance, distance_m, heading_deg)
    if truth is None and bounds != (None, None, None):
        raise SettingsError("--tolerance, --distance-m and --heading-deg are bounds of a truth: name one with --truth.")
    chosen = None if truth is None else TruthChoice(os.fspath(truth), *bounds)
    with limited(threads), ExitStack() as stack:
        references = None if library is None else stack.enter_context(local_copy(located(library)))
        place, parts, features = None if out is None else located(out), _topics(topics), CacheChoice(cache, cache_gb)
        options = CompareOptions(references, library_size, library_seed, min_gap, sequence, place, parts, features)
        names = split_methods(methods) if isinstance(methods, str) else methods
        drives = located(query), None if map is None else located(map)
        settled = _pipeline(pipeline, settings)
        return compare_methods(*drives, names, chosen, settled, options, Execution(threads, progress))


def batch(
    logs: Place | Iterable[Place],
    map: Place,
    pipeline: str | Path | Pipeline | None = None,
    *,
    settings: Settings | None = None,
    topics: Topics | None = None,
    library: Place | None = None,
    jobs: int | None = None,
    threads: int | None = None,
    engine: str = "local",
    address: str | None = None,
    retries: int = 2,
    drive_timeout_s: float | None = None,
    drive_memory_mb: float | None = None,
    join: bool = True,
    keep_cache: bool = False,
    dry_run: bool = False,
    cost_per_cpu_hour: float | None = None,
    progress: Progress = silent,
    on_drive: Callable[[DriveState], None] = lambda _: None,
) -> dict[str, Any]:
    """Compute many drives into one growing map, each log in a process of its own, here or on a Ray cluster.

    What the map has from the same log, settings and library stays. A drive that fails stops no other and raises
    nothing: `failed` of the result counts them, `drives` has the state and the error of each, and `join_error` says why
    drives that are in the map could not be joined.

    logs: logs, folders and prefixes of a store with logs below them, patterns with `*`, `@LIST.txt` with one of these a
        line, or manifests, `drives.csv` or `drives.parquet`, with a row for each drive.
    pipeline: None for the settings of the map, or the default for a new one.
    jobs: drives at once, each with so many `threads`.
    engine, address: `local` processes, or `ray` with the HOST:PORT of a cluster.
    retries: more attempts at a drive whose process was killed, or that could not be read, written or held.
    drive_timeout_s, drive_memory_mb: limits of an attempt at a drive, which then fails; of local processes alone.
    join: whether closures between drives are searched at the end.
    dry_run: say what would be computed, with bytes, images, CPU hours and, by `cost_per_cpu_hour`, the cost; nothing is
        written.
    on_drive: called with each drive as it starts, is to be tried again, and ends.
    """
    from vplog.batch.drive_inputs import drive_inputs
    from vplog.storage.remote_path import local_copy, located

    inputs, parts, threads = drive_inputs(_paths(logs)), _topics(topics), threads or available()
    if parts is not None and parts.odometry_file is not None and len(inputs) > 1:
        raise SettingsError(
            f"--odometry-file {parts.odometry_file} is of one drive, and {len(inputs)} logs are given. "
            "Give each drive its own in the column odometry_file of a manifest, drives.csv."
        )
    with limited(threads), ExitStack() as stack:
        from vplog.batch.batch import run_batch, settings_for
        from vplog.batch.engine import BatchOptions

        root = located(map)
        if pipeline is None or isinstance(pipeline, str):
            chosen = settings_for(root, pipeline, _assignments(settings))
        else:
            chosen = _pipeline(pipeline, settings)
        references = None if library is None else stack.enter_context(local_copy(located(library)))
        if dry_run:
            from vplog.batch.dry_run import dry_run as plan

            return plan(inputs, root, chosen, references, parts, Execution(threads, progress), cost_per_cpu_hour)
        options = BatchOptions(
            jobs, engine, address, retries, drive_timeout_s, drive_memory_mb, join, keep_cache, on_drive
        )
        return run_batch(inputs, root, chosen, references, parts, Execution(threads, progress), options)


def open_map(map: Place) -> Map:
    """A map of many drives, as `batch` writes it. Raises ResultError where there is none."""
    from vplog.maps.storage import map_store
    from vplog.storage.remote_path import located

    with map_store.reading(place := located(map)) as store:
        store.head()
    return Map(place)


@dataclass(frozen=True, eq=False)
class Map:
    """A map of many drives: what it holds, and where in it the views of a log are."""

    place: Path

    def info(self, check: bool = False) -> dict[str, Any]:
        """Drives, places, library, joins and failures; with `check` every file is compared with its checksum."""
        from vplog.maps.info import describe_map

        return describe_map(self.place, check=check)

    def query(
        self,
        log: Place,
        top: int = 10,
        *,
        topics: Topics | None = None,
        sequence: int | None = None,
        drives: Sequence[str] = (),
        box: tuple[float, float, float, float] | None = None,
        near_fixes_m: float | None = None,
        out: Place | None = None,
        engine: str = "local",
        address: str | None = None,
        cache: Path | None = None,
        cache_gb: float | None = None,
        as_of: str | None = None,
        threads: int | None = None,
        progress: Progress = silent,
    ) -> Answers:
        """The `top` places of the map most like each view of a log, or a picture.

        sequence: views in a window, odd; 1 ranks each by itself, None as the map's settings say.
        drives, box, near_fixes_m: search only drives of these names, that may have places in a box of degrees (south,
            west, north, east), or within metres of the log's own satellite fixes.
        out: a Parquet file for the answers.
        engine, address: who searches, as in `batch`.
        cache, cache_gb: folder and size of the cache of a map by URL.
        as_of: version or time (ISO 8601, UTC) of a map on an object store, None is the newest.
        """
        from vplog.batch.engine import BatchOptions, open_engine
        from vplog.maps.search.query import MapQuery, query_map
        from vplog.maps.storage.download_cache import cache_in
        from vplog.storage.remote_path import RemotePath, located

        threads = threads or available()
        downloads = cache_in(cache, cache_gb) if isinstance(self.place, RemotePath) else None
        with limited(threads), open_engine(BatchOptions(engine=engine, address=address), threads) as workers:
            place = None if out is None else located(out)
            query = MapQuery(top, sequence, place, workers.executor, downloads, drives, box, near_fixes_m, as_of)
            found = query_map(self.place, located(log), _topics(topics), query, Execution(threads, progress))
        return Answers(found)

    def localize(self, image: Place | NDArray[np.uint8], camera: Camera | Place) -> LocalizedPicture:
        """The pose of one picture in the map, with covariance, verdict and sentence.

        `localized` of the result says whether it has one, `found.world_from_camera` (4, 4) and `found.covariance`
        (6, 6) are it, and `record()` gives all as plain values. The map stays open for the next picture.

        image: a file, or grey (H, W) or red, green, blue (H, W, 3) uint8.
        camera: a vplog.data.Camera, or a calibration file as --calibration takes it.
        """
        return self._localizer(image, camera)

    @cached_property
    def _localizer(self) -> Callable[..., LocalizedPicture]:
        return _localizer(self, self.place)


def _localizer(owner: object, root: Path) -> Callable[..., LocalizedPicture]:
    """`localize_image` of a run or map that is open as long as `owner` lives."""
    from vplog.maps.localization.localize import localize_image
    from vplog.maps.localization.places import opened

    with ExitStack() as stack:
        places = stack.enter_context(opened(root, Execution()))
        weakref.finalize(owner, stack.pop_all().close)
    return partial(localize_image, places)


@dataclass(frozen=True)
class Answers:
    """Answers of a map to the views of a log."""

    record: dict[str, Any]
    """Counts, warnings, and the answers as plain values."""

    @cached_property
    def table(self) -> pa.Table:
        """A row for each answer: `query`, `rank`, `drive`, `keyframe`, `score`, ..., best first for each view."""
        import pyarrow as pa

        from vplog.results.tables import PLACED

        return pa.Table.from_pylist(self.record["answers"], schema=PLACED)


def _paths(log: Place | Iterable[Place]) -> list[Path]:
    from pathlib import Path

    from vplog.storage.remote_path import RemotePath, located

    one: Any = log
    paths = [located(path) for path in ([one] if isinstance(one, str | Path | RemotePath) else one)]
    if not paths:
        raise SettingsError("No log is given. Give a path or a URL, or several.")
    return paths


def _pipeline(pipeline: str | Path | Pipeline, settings: Settings | None) -> Pipeline:
    from vplog.pipeline import Pipeline, load_pipeline, pipeline_from

    if isinstance(pipeline, Pipeline):
        assignments = _assignments(settings)
        return pipeline_from(pipeline.model_dump(mode="json"), "pipeline", assignments) if assignments else pipeline
    return load_pipeline(os.fspath(pipeline), _assignments(settings))


def _assignments(settings: Settings | None) -> list[str]:
    """Settings as --set takes them; JSON is YAML."""
    import json

    if not isinstance(settings, dict):
        return list(settings or ())
    return [f"{name}={json.dumps(value, default=str)}" for name, value in settings.items()]


def _topics(topics: Topics | None) -> TopicChoice | None:
    """The choice of topics, with absolute paths of files, so that run.json is understood from any folder."""
    from vplog.logs import TopicChoice

    if topics is None:
        return None
    choice = topics if isinstance(topics, TopicChoice) else TopicChoice.read(dict(topics), "topics")
    files = {name: path.resolve() for name in ("odometry_file", "calibration_file") if (path := getattr(choice, name))}
    return choice.model_copy(update={**files, "masks": {one: path.resolve() for one, path in choice.masks.items()}})
