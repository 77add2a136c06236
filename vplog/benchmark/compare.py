"""Place recognisers side by side: the frames of one drive are looked for among those of another, or among older ones.

Every method gets the same features, the same reference images and the same truth.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from vplog import logs
from vplog.benchmark.answers import answers_table, file_stem, write_answers
from vplog.benchmark.compare_figures import FIGURES, Figures
from vplog.benchmark.feature_cache import CacheChoice, FeatureFolder
from vplog.benchmark.method_scores import MethodInputs, evaluate_method
from vplog.benchmark.published_answers import AnswersSettings
from vplog.benchmark.recogniser_specs import read_methods
from vplog.benchmark.sequence_fit import sequence_warning
from vplog.benchmark.traversals import Traversal, candidate_stops, extract_traversal, references_of, without_features
from vplog.data import Float32s, Ints, Reference
from vplog.errors import SettingsError, TruthError
from vplog.evaluate.pairs import Pairs
from vplog.evaluate.place_truth import PlaceTruth, TruthChoice, no_truth, open_truth
from vplog.evaluate.retrieval import Ranks
from vplog.execution.execution import Execution
from vplog.execution.run_warnings import collect_warnings
from vplog.logs import EVERY_IMAGE
from vplog.pipeline import Pipeline
from vplog.places import KINDS
from vplog.places.library_files import check_descriptors, load_references, read_library_record, references_hash
from vplog.places.network_vector import OnnxSettings
from vplog.places.reference_choice import FRAMES_A_REFERENCE, PAPER_SIZE, LibrarySettings, choose
from vplog.places.self_recognition import MOST, NO_IMAGE, add_until_enough
from vplog.places.sequence import SequenceSettings
from vplog.places.vectors import VectorsSettings
from vplog.results import run_record
from vplog.results.staging import check_contents, staged
from vplog.run.reference_library import check_extractor
from vplog.stages import Log
from vplog.storage.remote_path import located
from vplog.storage.scratch import replacing
from vplog.version import __version__


@dataclass(frozen=True, eq=False)
class Comparison:
    """Every method's figures, and the ranks and answers they are of."""

    record: dict[str, Any]
    """The content of compare.json."""
    ranks: dict[str, Ranks]
    """By name; a method by sequences has `, L=..` added."""
    answers: pa.Table
    """A row for each method and query, as answers.csv has them."""


@dataclass(frozen=True)
class CompareOptions:
    """Options of a comparison of recognisers."""

    library: Path | None = None
    """A drive, or a saved library; None for the map."""
    library_size: int | None = None
    """None for all frames of the map, 1600 at most. Of a drive in its own past as many as `vplog run` takes of as
    many keyframes, see `places.reference_choice`; of a library's log 100."""
    library_seed: int = 0
    min_gap: int | None = None
    """Frames that a match is older, at least, in a drive compared with itself."""
    sequence: int | None = None
    """Frames of a sequence, other settings of which are the pipeline's; None for single views only."""
    out: Path | None = None
    """Folder of compare.json, answers, scores and figures; None writes nothing."""
    topics: logs.TopicChoice | None = None
    cache: CacheChoice = CacheChoice()
    """Cache of features for further calls."""


def compare(
    query: Path,
    other: Path | None,
    methods: Iterable[str],
    truth: TruthChoice | None,
    pipeline: Pipeline,
    options: CompareOptions = CompareOptions(),
    execution: Execution = Execution(),
) -> Comparison:
    """Every method on a query and a map drive; without a map, or with the same one, frames among their own past.

    Without a truth there are answers and costs, and no scores. Raises VplogError with one line where that cannot be.
    """
    other = query if other is None else other
    recognisers, sequences = read_methods(methods, pipeline, answers=True), None
    if options.sequence is not None:
        tree = {**pipeline.sequence.model_dump(), "length": options.sequence}
        sequences = SequenceSettings.read(tree, "--sequence")
    _check_gap(query, same_drive(query, other), options.min_gap)
    with ExitStack() as stack:
        out = options.out
        made = None if out is None else stack.enter_context(staged(out, lambda: _comparison_in(out, query, other)))
        warnings = stack.enter_context(collect_warnings())
        scratch = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix=".vplog-", dir=made)))
        cached = stack.enter_context(options.cache.opened(scratch))
        drives = _open(query, other, truth, pipeline, options, cached, execution)
        warnings += check_truth(drives.known, drives.query_log, drives.map_log, options.min_gap)  # before the long part
        without = {*KINDS.values(), AnswersSettings} - {OnnxSettings}  # those of vplog that learn from features alone
        images = any(type(one) not in without for one in recognisers.values())
        pixels = any(not isinstance(one, AnswersSettings | VectorsSettings) for one in recognisers.values())
        map_traversal, query_traversal, references, notes = drives.extract_all(pixels, images)
        warnings += notes + _fewer_features(options.library, references, recognisers)
        if pixels:
            check_descriptors(references, map_traversal.store[0])
        stops = candidate_stops(query_traversal.frames, map_traversal.frames, options.min_gap)
        pairs = drives.known.pairs(query_traversal.frames, map_traversal.frames).below(stops)
        if sequences is not None:
            warnings += sequence_warning(pairs, sequences, truth is not None)
        inputs = MethodInputs(references, map_traversal, query_traversal, pairs, stops, sequences, scratch)
        figures, account = Figures(query_traversal, map_traversal, pairs), drives.account(inputs)
        ranks: dict[str, Ranks] = {}
        tables: list[pa.Table] = []
        for number, (name, settings) in enumerate(recognisers.items(), start=1):
            result = evaluate_method(settings, inputs, execution.within(name))
            account["methods"][name] = result.figures
            by_name = {name: result.ranks}
            if result.sequence_ranks is not None:
                by_name[f"{name}, L={options.sequence}"] = result.sequence_ranks
            ranks |= by_name
            tables += [answers_table(one, found, query_traversal, map_traversal) for one, found in by_name.items()]
            if made is not None:
                figures.add(made, number, name, result)
                result.figures["scores"] = _write_scores(
                    made, number, name, result.scores, query_traversal, map_traversal
                )
        answers = write_answers(tables, made)
        account["answers"] = answers.to_pylist() if made is None else "answers.csv"
        logged = [*drives.query_log.warnings, *drives.map_log.warnings]
        account["warnings"] = list(dict.fromkeys([*logged, *warnings]))
        if made is not None:
            figures.draw(ranks, made)
            run_record.write_run_json(made / "compare.json", account)
    return Comparison(account, ranks, answers)


@dataclass(frozen=True, eq=False)
class _Drives:
    """The drives of a comparison, opened, and how their features are made."""

    query: Path
    other: Path
    query_log: Log
    map_log: Log
    """The object of the query for a drive against itself."""
    known: PlaceTruth
    library: Path | None
    """None for the map."""
    source: Log | list[Reference] | None
    """The log or the images of the library folder; None of the map or a saved library."""
    options: CompareOptions
    pipeline: Pipeline
    cached: tuple[Path, Path]
    """The folders of `CacheChoice.opened`."""
    execution: Execution

    def traversal_of(self, path: Path, log: Log, frames: Ints, pixels: bool = True) -> Traversal:
        if not pixels:
            return without_features(log, frames)
        made = FeatureFolder.of(*self.cached, path, self.options.topics, log, self.pipeline.features)
        return extract_traversal(log, self.pipeline.features, made, frames, self.execution)

    def extract_all(self, pixels: bool, images: bool) -> tuple[Traversal, Traversal, list[Reference], list[str]]:
        """Traversals of the map and the query (one object for a drive against itself), the references, with their
        images where these count, and warnings. Without `pixels` no image is decoded, and only a saved library has
        references."""
        source, known, options = self.source, self.known, self.options
        map_traversal = query_traversal = self.traversal_of(self.other, self.map_log, known.map_frames, pixels)
        if self.query_log is not self.map_log:
            query_traversal = self.traversal_of(self.query, self.query_log, known.query_frames, pixels)
        warnings = list(dict.fromkeys(map_traversal.warnings + query_traversal.warnings))
        if isinstance(source, list):
            if options.library_size is not None or options.library_seed:
                raise SettingsError(f"{self.library} is a saved library: leave out --library-size and --library-seed.")
            return map_traversal, query_traversal, source, warnings
        if not pixels:
            return map_traversal, query_traversal, [], warnings
        itself = self.query_log is self.map_log
        size = options.library_size or (PAPER_SIZE if source is not None else None if itself else MOST)
        wanted = LibrarySettings(choose="random", size=size, seed=options.library_seed)
        if source is None or self.library is None:
            rows = self._reference_rows(map_traversal, wanted)
            references = references_of(map_traversal, map_traversal.frames[map_traversal.decoded[rows]], images)
        else:
            chosen = choose(source.stamps(), wanted)
            traversal = self.traversal_of(self.library, source, chosen)
            references = references_of(traversal, chosen, images)
            warnings += traversal.warnings
        if options.library_size is not None and options.library_size > len(references):
            warnings.append(
                f"The library has {len(references)} images instead of {size}: its drive has no more frames."
            )
        return map_traversal, query_traversal, references, warnings

    def _reference_rows(self, traversal: Traversal, wanted: LibrarySettings) -> Ints:
        """Choose the references among the map's decoded frames, by their number in `traversal.store`; of a drive in its
        own past as many as `vplog run` takes, unless their number is given."""
        stamp_ns, most = traversal.stamp_ns[traversal.decoded], len(traversal) // FRAMES_A_REFERENCE

        def reference(row: int) -> Reference:
            return Reference(NO_IMAGE, traversal.store[row], traversal.name, int(stamp_ns[row]))

        rows = choose(stamp_ns, wanted)
        if self.options.library_size is None:
            rows = add_until_enough(rows, stamp_ns, wanted, most, reference, self.execution)
        return rows

    def account(self, inputs: MethodInputs) -> dict[str, Any]:
        """compare.json, but for methods and warnings."""
        options, pairs = self.options, inputs.truth
        return {
            "vplog": __version__,
            "query": str(self.query.resolve()),
            "map": str(self.other.resolve()),
            "min_gap": options.min_gap,
            "library": {
                "from": str(self.library or self.other),
                "size": len(inputs.references),
                "seed": None if _is_saved(self.library) else options.library_seed,
                "hash": references_hash(inputs.references, self.pipeline.features),
            },
            "truth": {**self.known.about, "pairs": pairs.count},
            "protocol": protocol(self.known, pairs, options.min_gap),
            "queries": len(inputs.query_traversal),
            "map_frames": len(inputs.map_traversal),
            "undecodable": {
                "queries": len(inputs.query_traversal.store.lost),
                "map_frames": len(inputs.map_traversal.store.lost),
            },
            "positives": int(pairs.positive.sum()),
            "features": self.pipeline.features.model_dump(mode="json"),
            "methods": {},
        }


def _open(
    query: Path, other: Path, truth: TruthChoice | None, pipeline: Pipeline, options: CompareOptions,
    cached: tuple[Path, Path], execution: Execution,
) -> _Drives:  # fmt: skip
    """The logs, the truth and the library of a comparison."""
    topics = every_image(options.topics) if truth is not None and truth.is_labels else options.topics
    options = replace(options, topics=topics)
    query_log = logs.open(query, topics)
    map_log = query_log if same_drive(query, other) else logs.open(other, topics)
    known = no_truth(query_log, map_log) if truth is None else open_truth(truth, query_log, map_log)
    library, source = options.library, None
    if library is not None and same_drive(library, other):
        library = None
    if library is not None and _is_saved(library):
        check_extractor(library, pipeline.features)
        source = load_references(library, execution)
    elif library is not None:
        source = logs.open(library, topics)
    return _Drives(query, other, query_log, map_log, known, library, source, options, pipeline, cached, execution)


def every_image(topics: logs.TopicChoice | None) -> logs.TopicChoice:
    """Labels tell places from cameras: all images are read unless some are chosen."""
    topics = topics or logs.TopicChoice()
    return topics if topics.image is not None else topics.model_copy(update={"image": EVERY_IMAGE})


def protocol(known: PlaceTruth, pairs: Pairs, min_gap: int | None) -> dict[str, Any]:
    """The rule by which a match is true, with its bounds, and how many queries have one; `text` in a sentence."""
    bounds = ("source", "same_place", "tolerance", "distance_m", "heading_deg")
    found = {name: known.about.get(name) for name in bounds} | {"min_gap": min_gap}
    found |= {"queries": len(pairs), "with_match": int(pairs.positive.sum()), "pairs": pairs.count}
    gap = "" if min_gap is None else f", at least {min_gap} frames older"
    text = "no truth was given, so nothing is scored"
    if known.about["source"] is not None:
        rule = f"true is {known.about['same_place']} (--truth {known.about['source']}){gap}"
        text = f"{rule}; {found['with_match']} of {len(pairs)} queries have a match, {pairs.count} pairs"
    return {**found, "text": text}


def _is_saved(library: Path | None) -> bool:
    return library is not None and os.path.lexists(library / "library.json")


def _fewer_features(library: Path | None, references: list[Reference], recognisers: Mapping[str, Any]) -> list[str]:
    """A warning where a saved library has the strongest features of its images alone, and some methods use more."""
    if library is None or not _is_saved(library):
        return []
    kept = read_library_record(library)["settings"].get("features")
    if not isinstance(kept, int) or max(len(one.features) for one in references) != kept:
        return []
    used = {name: getattr(one, "features", None) for name, one in recognisers.items()}
    more = [name for name, count in used.items() if isinstance(count, int) and count > kept]
    uses = f"has the {kept} strongest features of an image, and these methods use more: {', '.join(more)}."
    return [f"{library} {uses} Give the log of its images as --library."] if more else []


def _check_gap(query: Path, itself: bool, min_gap: int | None) -> None:
    if itself and min_gap is None:
        raise SettingsError(
            f"{query} is compared with itself, where every frame finds itself. "
            "Say how many frames older a match must be: --min-gap 50."
        )
    if not itself and min_gap is not None:
        raise SettingsError("--min-gap is for a drive compared with itself; leave it out, or leave out MAP.")


def check_truth(known: PlaceTruth, query: Log, other: Log, min_gap: int | None) -> list[str]:
    """The gaps of the truth, one sentence each. Raises TruthError where no query can find anything."""
    if known.about["source"] is None:
        return []
    stops = candidate_stops(known.query_frames, known.map_frames, min_gap)
    if not known.pairs(known.query_frames, known.map_frames).below(stops).positive.any():
        gap = "" if min_gap is None else f" at least {min_gap} frames older"
        raise TruthError(
            f"By --truth {known.about['source']} ({known.about['same_place']}) none of the {len(known.query_frames)} "
            f"frames of {query.name} shows a "
            f"place of a frame of {other.name}{gap}, so nothing can be found. Give the truth of these drives, or allow "
            "more with --tolerance, --distance-m or --heading-deg."
        )
    warnings = []
    if known.about.get("by") == "rows" and (query.file_names() or other.file_names()):
        warnings.append(
            "--truth index pairs frames in order: the file names of one drive, or both, do not number them."
        )
    for log, frames in {query.name: (query, known.query_frames), other.name: (other, known.map_frames)}.values():
        if len(frames) < len(log.stamps()):
            outside = len(log.stamps()) - len(frames)
            warnings.append(f"{log.name}: {outside} of {len(log.stamps())} frames have no truth and are left out.")
    if known.about["source"] == "poses" and query is not other:
        warnings.append(
            "--truth poses assumes that the odometry of both drives is in one frame; else give a TUM file for each."
        )
    return warnings


def same_drive(a: Path, b: Path) -> bool:
    return a.resolve() == b.resolve()


def _comparison_in(out: Path, query: Path, other: Path) -> list[str]:
    """The files of a comparison in a folder that a new one of the same drives replaces. Raises SettingsError where
    there are others, or it is of other drives."""
    path = out / "compare.json"
    check_contents(out, "a comparison", run_record.is_ours(path))
    if path.exists():
        earlier = run_record.read_run_json(path)
        drives = [str(earlier.get(name)) for name in ("query", "map")]
        if not all(map(same_drive, map(located, drives), (query, other))):
            raise SettingsError(f"{out} holds a comparison of {' in '.join(drives)}. Choose another folder with -o.")
    return ["compare.json", "answers.csv", "scores-[0-9][0-9]-*.npz", *FIGURES]


def _write_scores(out: Path, number: int, name: str, scores: Float32s, query: Traversal, other: Traversal) -> str:
    """Name of the file; the number makes it unique where the allowed letters do not."""
    file = f"scores-{file_stem(number, name)}.npz"
    named: Any = {key: np.array(one.names) for key, one in (("query_name", query), ("map_name", other)) if one.names}
    with replacing(out / file) as stream:
        np.savez(
            stream, scores=scores, query_frame=query.frames, query_ns=query.stamp_ns, map_frame=other.frames,
            map_ns=other.stamp_ns, **named,
        )  # fmt: skip
    return file
