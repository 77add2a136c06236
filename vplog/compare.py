"""Place recognisers side by side: the frames of one drive are looked for among those of another, or among older ones.

Every method gets the same features, the same reference images and the same truth. Times are CPU time of the thread
that does the work, so they are those of one thread, however many are busy.
"""

from __future__ import annotations

import re
import tempfile
import time
import typing
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from shutil import disk_usage
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa

import vplog
from vplog import compare_figures, logs, record
from vplog.data import Reference
from vplog.errors import LogError, ResultError, SettingsError, TruthError
from vplog.evaluate import retrieval
from vplog.evaluate.place_truth import PlaceTruth, TruthChoice, open_truth
from vplog.extract import extract_frames, map_in_order, one_thread_each
from vplog.features.store import FeatureStore
from vplog.pipeline import load_pipeline
from vplog.places import PlaceSettings
from vplog.places.sequence import SequenceSettings, sequence_rows
from vplog.places.stored import load_references, references_hash
from vplog.references import PAPER_SIZE, LibrarySettings, choose
from vplog.results import run_record
from vplog.results.atomic import replacing
from vplog.settings import override

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from vplog.data import Bytes, Features, Float32s, Floats, Ints
    from vplog.evaluate.pairs import Pairs
    from vplog.evaluate.retrieval import Ranks
    from vplog.pipeline import Pipeline
    from vplog.stages import Extractor, Log, PlaceIndex, PlaceState, Recogniser

    Progress = Callable[[str, int, int], None]

ANSWERS = 10
"""Rows that a timed search returns: what `vplog run` asks for by default, and the deepest recall reported."""


@dataclass(frozen=True, eq=False)
class Walk:
    """The frames of a drive as features, on disk."""

    name: str
    store: FeatureStore
    """Features of row i at i."""
    frames: Ints
    """(N,) numbers of the frames in the drive, increasing."""
    stamp_ns: Ints
    """(N,)."""
    references: list[Reference]
    """The frames asked for as reference images."""
    feature_ms: Floats
    """(N,) CPU ms that the features of each frame took, decoding not included; as they were done, in no other order."""
    warnings: list[str]

    def __len__(self) -> int:
        return len(self.frames)


@dataclass(frozen=True, eq=False)
class MethodResult:
    """What one method made of one query walk and one map."""

    state: PlaceState
    scores: Float32s
    """(Q, M), NaN for rows that are no candidates."""
    ranks: Ranks
    figures: dict[str, Any]
    """What compare.json says of the method."""
    sequence_ranks: Ranks | None = None
    """The same by sequences, where these were asked for."""


@dataclass(frozen=True, eq=False)
class Comparison:
    """Every method's figures, and the ranks they are of."""

    record: dict[str, Any]
    """What compare.json says."""
    ranks: dict[str, Ranks]
    """By name; a method by sequences has `, L=..` added."""


def extract_walk(
    log: Log,
    extractor: Extractor,
    store: FeatureStore,
    frames: Ints | None = None,
    chosen: Ints | None = None,
    threads: int = 1,
    progress: Progress = lambda *_: None,
) -> Walk:
    """Features of the frames with these numbers (all where None), streamed into an empty store.

    The images of `chosen`, numbers among them, are kept as references. Frames that cannot be decoded are left out,
    with a warning. Raises LogError where none is left.
    """
    stamps = log.stamps()
    frames = np.arange(len(stamps)) if frames is None else frames
    wanted = set() if chosen is None else set(chosen.tolist())
    kept, spent, references, lost = [], [], [], []

    def timed(image: Bytes, depth_m: Float32s | None = None) -> Features:
        began = time.thread_time()
        features = extractor(image, depth_m)
        spent.append(1e3 * (time.thread_time() - began))
        return features

    found = extract_frames(log.frames(stamps[frames]), timed, threads)
    for done, (stamp_ns, frame, features, why) in enumerate(found, start=1):
        progress(f"extract {log.name}", done, len(frames))
        if frame is None or features is None:
            lost.append(why)
            continue
        number = int(np.searchsorted(stamps, stamp_ns))
        store.append(features)
        kept.append(number)
        if number in wanted:
            references.append(Reference(frame.image, features, log.name, stamp_ns))
    if not kept:
        why = f" The first: {lost[0]}" if lost else " `vplog info` shows what is in it."
        raise LogError(f"{log.name}: none of {len(frames)} frames could be decoded.{why}")
    warnings = []
    if lost:
        warnings.append(f"{log.name}: {len(lost)} of {len(frames)} frames could not be decoded. First: {lost[0]}")
    rows = np.array(kept, np.int64)
    return Walk(log.name, store, rows, stamps[rows], references, np.array(spent), warnings)


def evaluate_method(
    settings: PlaceSettings,
    references: Sequence[Reference],
    map_walk: Walk,
    query_walk: Walk,
    truth: Pairs,
    stops: Ints,
    threads: int = 1,
    progress: Progress = lambda *_: None,
    sequence: SequenceSettings | None = None,
    scratch: Path | None = None,
) -> MethodResult:
    """Learn the references, describe both walks, look for every query among the map rows below `stops[q]`, (Q,).

    A drive against itself is the same walk twice, described once. The map is rebuilt from what a table would store of
    it, so the bytes counted are all that is used. Scores are kept in a file of the folder `scratch`, or in memory.
    Raises TruthError without a true pair, and whatever the method raises.
    """
    state, learn_s = _learn(settings, references, threads)
    places, mining_ms = describe_walk(state, map_walk, threads, lambda *at: progress("describe map", *at))
    column = state.to_arrow(places)
    places = state.from_arrow(column)
    index, queries = state.index(places), places
    if query_walk is not map_walk:
        queries, more = describe_walk(state, query_walk, threads, lambda *at: progress("describe queries", *at))
        mining_ms = np.concatenate([mining_ms, more])
    scores = _score_table(len(queries), len(index), scratch, "scores")
    query_ms = search(index, queries, stops, scores, threads, lambda *at: progress("search", *at))
    ranks = retrieval.rank_queries(scores, truth, stops)
    walks = [map_walk] if query_walk is map_walk else [map_walk, query_walk]
    feature_ms = float(np.median(np.concatenate([walk.feature_ms for walk in walks])))
    figures = {
        **asdict(retrieval.score_retrieval(ranks)),
        "bytes_per_image": round(stored_bytes(column) / len(column), 1),
        "encode_ms": round(feature_ms + float(np.median(mining_ms)), 3),
        "feature_ms": round(feature_ms, 3),
        "mining_ms": round(float(np.median(mining_ms)), 3),
        "query_ms": round(float(np.median(query_ms)), 4),
        "learn_s": round(learn_s, 3),
        "bits": state.bits,
        "hash": state.hash,
        "settings": settings.model_dump(mode="json"),
    }
    if sequence is None:
        return MethodResult(state, scores, ranks, figures)
    lines = _score_table(len(queries), len(index), scratch, "sequences")
    match_lines(scores, sequence, stops, lines, threads, lambda *at: progress("sequences", *at))
    by_sequence = retrieval.rank_queries(lines, truth, stops)
    figures["sequence"] = {**sequence.model_dump(), **asdict(retrieval.score_retrieval(by_sequence))}
    return MethodResult(state, scores, ranks, figures, by_sequence)


def _learn(recogniser: Recogniser, references: Sequence[Reference], threads: int) -> tuple[PlaceState, float]:
    """What it learned, and the CPU s that all threads took."""
    began = time.process_time()
    state = recogniser.learn(references, threads)
    return state, time.process_time() - began


def describe_walk(
    state: PlaceState, walk: Walk, threads: int, progress: Callable[[int, int], None]
) -> tuple[list[Any], Floats]:
    """A descriptor for every row, and the CPU ms (N,) each took."""

    def work(row: int) -> tuple[Any, float]:
        features = walk.store[row]
        began = time.thread_time()
        place = state.describe(features)
        return place, 1e3 * (time.thread_time() - began)

    return _timed_map(work, len(walk), threads, progress)


def search(
    index: PlaceIndex,
    queries: Sequence[Any],
    stops: Ints,
    scores: Float32s,
    threads: int,
    progress: Callable[[int, int], None],
) -> Floats:
    """Fill `scores` (Q, M), NaN beyond each query's stop; CPU ms (Q,) of a search for the best ANSWERS rows."""

    def work(row: int) -> tuple[None, float]:
        stop = int(stops[row])
        began = time.thread_time()
        index.query(queries[row], ANSWERS, stop)
        spent = time.thread_time() - began
        scores[row, :stop] = index.scores(queries[row], stop)
        scores[row, stop:] = np.nan
        return None, 1e3 * spent

    return _timed_map(work, len(queries), threads, progress)[1]


def match_lines(
    scores: Float32s,
    settings: SequenceSettings,
    stops: Ints,
    lines: Float32s,
    threads: int,
    progress: Callable[[int, int], None],
) -> None:
    """Fill `lines` (Q, M) with the scores of sequences, NaN beyond each query's stop; a few rows at a time."""
    found = sequence_rows(lambda query: scores[query, : stops[query]], stops, settings, threads)
    for query, (row, _) in enumerate(found):
        lines[query, : len(row)] = row
        lines[query, len(row) :] = np.nan
        progress(query + 1, len(stops))


def _timed_map(
    work: Callable[[int], tuple[Any, float]], count: int, threads: int, progress: Callable[[int, int], None]
) -> tuple[list[Any], Floats]:
    results, spent = [], []
    with ThreadPoolExecutor(threads, initializer=one_thread_each) as pool:
        for result, ms in map_in_order(pool, work, range(count), ahead=4 * threads):
            results.append(result)
            spent.append(ms)
            progress(len(results), count)
    return results, np.array(spent)


def _score_table(queries: int, rows: int, scratch: Path | None, name: str) -> Float32s:
    """(Q, M) float32 to be filled, in a file of the folder where one is given."""
    if scratch is None:
        return np.empty((queries, rows), np.float32)
    needed, free = 4 * queries * rows, disk_usage(scratch).free
    if needed > free:  # a full disk below a mapped file ends the process, so it is asked for first
        raise ResultError(
            f"The scores of {queries} queries against {rows} frames need {needed / 1e9:.1f} GB, and {scratch} has "
            f"{free / 1e9:.1f} GB free. Free space, or compare shorter drives."
        )
    path = scratch / f"{name}.npy"
    path.unlink(missing_ok=True)  # not written over: an earlier table may still be in use
    return np.lib.format.open_memmap(path, "w+", np.dtype("<f4"), (queries, rows))


def candidate_stops(query_frames: Ints, map_frames: Ints, min_gap: int | None) -> Ints:
    """(Q,) each query's candidates are the map rows below this: all, or those at least `min_gap` frames older."""
    if min_gap is None:
        return np.full(len(query_frames), len(map_frames), np.int64)
    return np.searchsorted(map_frames, query_frames - min_gap, side="right").astype(np.int64)


def stored_bytes(column: pa.Array) -> int:
    """Bytes of the values of an Arrow column and of an offset a row where their number varies.

    The bitmaps that mark empty cells are not counted: no descriptor is empty.
    """
    kind: Any = column.type
    if pa.types.is_struct(kind):
        return sum(stored_bytes(part) for part in column.flatten())  # pyright: ignore[reportAttributeAccessIssue]
    nested = pa.types.is_fixed_size_list(kind) or pa.types.is_list(kind) or pa.types.is_large_list(kind)
    below = stored_bytes(column.flatten()) if nested else 0  # pyright: ignore[reportAttributeAccessIssue]
    if pa.types.is_fixed_size_list(kind):
        return below
    if nested:
        return below + len(column) * (8 if pa.types.is_large_list(kind) else 4)
    bitmap = (len(column) + 7) // 8 if column.buffers()[0] is not None else 0
    return column.nbytes - bitmap


def known_methods() -> dict[str, Any]:
    """The recognisers by kind: the members of the union in vplog/places."""
    union = typing.get_args(PlaceSettings)[0]
    members = typing.get_args(union) or (union,)
    return {member.model_fields["kind"].default: member for member in members}


def split_methods(text: str) -> list[str]:
    """`a,b:c=[1,2]` as `a` and `b:c=[1,2]`: commas inside brackets belong to a value."""
    return [name.strip() for name in re.split(r",(?![^\[{]*[\]}])", text)]


def read_method(text: str, pipeline: Pipeline) -> Any:
    """The recogniser of `kind`, `pipeline` or `file.yaml`, each with `:setting=value` as often as wanted.

    A kind has its default settings, or the pipeline's where it is the pipeline's own. Raises SettingsError.
    """
    name, *assignments = text.split(":")
    known = known_methods()
    if name in known:
        chosen = pipeline.places if pipeline.places.kind == name else known[name]()
    else:
        try:
            chosen = load_pipeline(name).places
        except SettingsError as error:
            if Path(name).suffix in (".yaml", ".yml"):
                raise
            raise SettingsError(f"No method {name!r}. Methods: {', '.join(sorted(known))}. {error}") from None
    tree = chosen.model_dump(mode="json")
    for assignment in assignments:
        try:
            tree = override(tree, assignment)
        except SettingsError:
            raise SettingsError(
                f"Method {text}: {assignment!r} is not a setting with a value. Write it as {name}:setting=value."
            ) from None
    return type(chosen).read(tree, f"method {text}")


def compare(
    query: Path,
    other: Path | None,
    methods: Iterable[str],
    truth: TruthChoice,
    pipeline: Pipeline,
    library: Path | None = None,
    library_size: int = PAPER_SIZE,
    library_seed: int = 0,
    min_gap: int | None = None,
    sequence: int | None = None,
    out: Path | None = None,
    topics: logs.TopicChoice | None = None,
    threads: int = 1,
    progress: Progress = lambda *_: None,
) -> Comparison:
    """Every method on a query and a map drive; without a map, or with the same one, frames among their own past.

    `library` is a drive or a saved library, None the map. `sequence` is a length in frames, the rest of it the
    pipeline's; None for single views only. With `out`, compare.json, the scores and the curves are written there.
    Raises VplogError with one line where that cannot be.
    """
    other = query if other is None else other
    recognisers = _read_methods(methods, pipeline)
    sequences = None
    if sequence is not None:
        sequences = SequenceSettings.read({**pipeline.sequence.model_dump(), "length": sequence}, "--sequence")
    itself = _same(query, other)
    _check_gap(query, itself, min_gap)
    if out is not None:
        _begin(out)
    warnings: list[str] = []
    with ExitStack() as stack:
        stack.enter_context(record.heard(warnings))
        scratch = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix=".vplog-", dir=out)))
        query_log = logs.open(query, topics)
        map_log = query_log if itself else logs.open(other, topics)
        known = open_truth(truth, query_log, map_log)
        warnings += _check_truth(known, query_log, map_log, min_gap)  # before the long part
        if library is None or _same(library, other):
            library = None
        wanted = LibrarySettings(choose="random", size=library_size, seed=library_seed)
        map_walk, query_walk, references, notes = _extract_all(
            query_log, map_log, known, library, wanted, pipeline, topics, threads, progress, stack, scratch
        )
        warnings += notes
        stops = candidate_stops(query_walk.frames, map_walk.frames, min_gap)
        pairs = known.pairs(query_walk.frames, map_walk.frames).below(stops)
        account: dict[str, Any] = {
            "vplog": vplog.__version__,
            "query": str(query),
            "map": str(other),
            "min_gap": min_gap,
            "library": {
                "from": str(library or other),
                "size": len(references),
                "seed": None if _is_saved(library) else library_seed,
                "hash": references_hash(references, pipeline.features),
            },
            "truth": {**known.about, "pairs": pairs.count},
            "queries": len(query_walk),
            "map_frames": len(map_walk),
            "positives": int(pairs.positive.sum()),
            "features": pipeline.features.model_dump(mode="json"),
            "methods": {},
        }
        ranks: dict[str, Ranks] = {}
        for number, (name, settings) in enumerate(recognisers.items(), start=1):
            result = evaluate_method(
                settings, references, map_walk, query_walk, pairs, stops, threads,
                lambda stage, done, total, name=name: progress(f"{name}: {stage}", done, total), sequences, scratch,
            )  # fmt: skip
            account["methods"][name] = result.figures
            ranks[name] = result.ranks
            if result.sequence_ranks is not None:
                ranks[f"{name}, L={sequence}"] = result.sequence_ranks
            if out is not None:
                result.figures["scores"] = _write_scores(out, number, name, result.scores, query_walk, map_walk)
        account["warnings"] = list(dict.fromkeys([*query_log.warnings, *map_log.warnings, *warnings]))
    if out is not None:
        compare_figures.draw_curves(ranks, out)
        run_record.write_run_json(out / "compare.json", account)
    return Comparison(account, ranks)


def _extract_all(
    query: Log,
    other: Log,
    known: PlaceTruth,
    library: Path | None,
    wanted: LibrarySettings,
    pipeline: Pipeline,
    topics: logs.TopicChoice | None,
    threads: int,
    progress: Progress,
    stack: ExitStack,
    scratch: Path,
) -> tuple[Walk, Walk, list[Reference], list[str]]:
    """Walks of the map and the query, one and the same for a drive against itself, the references, and warnings."""

    def walk_of(log: Log, role: str, frames: Ints, chosen: Ints | None = None) -> Walk:
        store = stack.enter_context(FeatureStore(scratch / f"{role}.features"))
        return extract_walk(log, pipeline.features, store, frames, chosen, threads, progress)

    chosen = known.map_frames[choose(other.stamps()[known.map_frames], wanted)] if library is None else None
    map_walk = walk_of(other, "map", known.map_frames, chosen)
    query_walk = map_walk if query is other else walk_of(query, "query", known.query_frames)
    warnings = list(dict.fromkeys(map_walk.warnings + query_walk.warnings))
    if library is not None and _is_saved(library):
        return map_walk, query_walk, load_references(library), warnings
    references = map_walk.references
    if library is not None:
        log = logs.open(library, topics)
        rows = choose(log.stamps(), wanted)
        walk = walk_of(log, "library", rows, rows)
        references = walk.references
        warnings += walk.warnings
    if len(references) < (wanted.size or 0):
        warnings.append(f"The library has {len(references)} images instead of {wanted.size}: its drive has no more.")
    return map_walk, query_walk, references, warnings


def _is_saved(library: Path | None) -> bool:
    return library is not None and (library / "library.json").is_file()


def _read_methods(methods: Iterable[str], pipeline: Pipeline) -> dict[str, Any]:
    names = list(methods)
    recognisers = {name: read_method(name, pipeline) for name in names}
    if not names or len(recognisers) < len(names):
        raise SettingsError(f"--methods {','.join(names)}: name each method once, and one at least.")
    return recognisers


def _check_gap(query: Path, itself: bool, min_gap: int | None) -> None:
    if itself and min_gap is None:
        raise SettingsError(
            f"{query} is compared with itself, where every frame finds itself. "
            "Say how many frames older a match must be: --min-gap 50."
        )
    if not itself and min_gap is not None:
        raise SettingsError("--min-gap is for a drive compared with itself; leave it out, or leave out MAP.")


def _check_truth(known: PlaceTruth, query: Log, other: Log, min_gap: int | None) -> list[str]:
    """What the truth does not cover, one sentence each. Raises TruthError where no query can find anything."""
    stops = candidate_stops(known.query_frames, known.map_frames, min_gap)
    if not known.pairs(known.query_frames, known.map_frames).below(stops).positive.any():
        gap = "" if min_gap is None else f" at least {min_gap} frames older"
        raise TruthError(
            f"By --truth {known.about['source']} none of the {len(known.query_frames)} frames of {query.name} shows a "
            f"place of a frame of {other.name}{gap}, so nothing can be found. Give the truth of these drives, or allow "
            "more with --tolerance, --distance-m or --heading-deg."
        )
    warnings = []
    for log, frames in {query.name: (query, known.query_frames), other.name: (other, known.map_frames)}.values():
        if len(frames) < len(log.stamps()):
            outside = len(log.stamps()) - len(frames)
            warnings.append(f"{log.name}: {outside} of {len(log.stamps())} frames have no truth and are left out.")
    if known.about["source"] == "poses" and query is not other:
        warnings.append("--truth poses takes the odometry of both drives to be in one frame.")
    return warnings


def _same(a: Path, b: Path) -> bool:
    return a.resolve() == b.resolve()


def _begin(out: Path) -> None:
    if out.is_dir() and any(out.iterdir()) and not (out / "compare.json").is_file():
        raise SettingsError(f"{out} is a folder with other things in it, not a comparison. Choose another with -o.")
    try:
        out.mkdir(parents=True, exist_ok=True)
        (out / "compare.json").unlink(missing_ok=True)  # written last: where it is, the rest is whole
    except OSError as error:
        raise SettingsError(f"Cannot make the folder {out}: {error.strerror}. Choose another with -o.") from None


def _write_scores(out: Path, number: int, name: str, scores: Float32s, query: Walk, other: Walk) -> str:
    """Name of the file; the number tells apart what the letters that files may have do not."""
    file = f"scores-{number:02d}-{re.sub(r'[^A-Za-z0-9.=+-]+', '_', Path(name).name)[:80]}.npz"
    with replacing(out / file) as stream:
        np.savez(
            stream,
            scores=scores,
            query_frame=query.frames,
            query_ns=query.stamp_ns,
            map_frame=other.frames,
            map_ns=other.stamp_ns,
        )
    return file
