"""One place recogniser on one query traversal and one map: scores and costs.

Times are CPU time of the thread that does the work, so they are those of one thread, however many are busy.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from shutil import disk_usage
from typing import Any

import numpy as np
import pyarrow as pa

from vplog.benchmark.published_answers import AnswersSettings, fill_scores
from vplog.benchmark.traversals import Traversal
from vplog.data import Features, Float32s, Floats, Ints, Reference
from vplog.errors import ResultError
from vplog.evaluate import retrieval
from vplog.evaluate.open_set import score_open_set
from vplog.evaluate.pairs import Pairs
from vplog.evaluate.retrieval import Ranks, Reliability, reliability
from vplog.execution.execution import Execution
from vplog.loops.match_probability import match_probabilities
from vplog.places import PlaceSettings
from vplog.places.self_recognition import NO_IMAGE
from vplog.places.sequence import SequenceSettings, sequence_rows
from vplog.places.views import views_of
from vplog.stages import EvidenceState, FrameState, PlaceIndex, PlaceState, ProbableIndex, StoredState
from vplog.storage.mapped_table import mapped_scores

ANSWERS = 10
"""Rows that a timed search returns: what `vplog run` requests by default, and the deepest recall reported."""
_NUMBERS = np.zeros(0, np.float32)
_NO_FEATURES = Features(_NUMBERS.reshape(0, 2), _NUMBERS, np.zeros((0, 0), np.uint8), _NUMBERS, 0, 0)
_NO_REFERENCE = Reference(NO_IMAGE, _NO_FEATURES, "", 0)
"""The library of methods that need no pixels."""


@dataclass(frozen=True, eq=False)
class MethodResult:
    """The result of one method on one query traversal and one map."""

    scores: Float32s
    """(Q, M), NaN for rows that are no candidates."""
    ranks: Ranks
    figures: dict[str, Any]
    """The entry of the method in compare.json."""
    sequence_ranks: Ranks | None = None
    """Ranks by sequences, where these were requested."""
    reliability: Reliability | None = None
    """Calibration of its probabilities, where it gives any."""


@dataclass(frozen=True, eq=False)
class MethodInputs:
    """Inputs of every method of a comparison."""

    references: Sequence[Reference]
    """Empty if no method needs pixels."""
    map_traversal: Traversal
    query_traversal: Traversal
    """The object of the map for a drive against itself, which is described once."""
    truth: Pairs
    stops: Ints
    """(Q,) each query's candidates are the map rows below."""
    sequence: SequenceSettings | None = None
    scratch: Path | None = None
    """Folder of the files of scores; None keeps them in memory."""


def evaluate_method(
    settings: PlaceSettings | AnswersSettings, inputs: MethodInputs, execution: Execution = Execution()
) -> MethodResult:
    """Learn the references, describe both traversals, search the map for every query.

    The map is rebuilt from what a table would store of it, so the bytes counted are all that is used.
    Without a true pair there are no scores among the figures. Raises whatever the method raises.
    """
    if isinstance(settings, AnswersSettings):
        return evaluate_answers(settings, inputs)
    map_traversal, query_traversal = inputs.map_traversal, inputs.query_traversal
    truth, stops = inputs.truth, inputs.stops
    began = time.process_time()
    state: Any = settings.learn(inputs.references or [_NO_REFERENCE], execution)
    learn_s = time.process_time() - began  # of all threads
    places, mining_ms = describe_traversal(state, map_traversal, "describe map", execution)
    column = state.to_arrow(places.values)
    places = replace(places, values=state.from_arrow(column))
    index, queries = state.index(places.values), places
    if query_traversal is not map_traversal:
        queries, more = describe_traversal(state, query_traversal, "describe queries", execution, query=True)
        mining_ms = np.concatenate([mining_ms, more])
    scores = score_table(len(query_traversal), len(map_traversal), inputs.scratch, "scores")
    query_ms = search(index, queries, places.rows, stops, scores, execution)
    ranks = ranked(scores, truth, stops)
    if isinstance(state, EvidenceState):
        found = enumerate(ranks.top_row.tolist())
        evidence = ["" if row < 0 else state.evidence(queries[query], places[row]) for query, row in found]
        ranks = replace(ranks, evidence=evidence)
    feature_ms = 0.0
    if not isinstance(state, FrameState | StoredState):
        traversals = [map_traversal] if query_traversal is map_traversal else [map_traversal, query_traversal]
        feature_ms = float(np.median(np.concatenate([traversal.feature_ms for traversal in traversals])))
    figures = {
        **scores_of(ranks),
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
    reliable = by_sequence = None
    if isinstance(index, ProbableIndex) and truth.positive.any():
        reliable = reliability_of(index, queries, places.rows, stops, ranks, truth, execution)
    if reliable is not None:
        figures["calibration"] = reliable.as_json()
    if inputs.sequence is not None:
        lines = score_table(len(query_traversal), len(map_traversal), inputs.scratch, "sequences")
        score_sequences(scores, inputs.sequence, stops, lines, execution)
        by_sequence = ranked(lines, truth, stops)
        figures["sequence"] = {**inputs.sequence.model_dump(), **scores_of(by_sequence)}
    return MethodResult(scores, ranks, figures, by_sequence, reliable)


def ranked(scores: Float32s, truth: Pairs, stops: Ints) -> Ranks:
    """Ranks of the true rows, with the probability of each answer where that can be learned on the scores."""
    ranks = retrieval.rank_queries(scores, truth, stops)
    return replace(ranks, p_match=match_probabilities(scores, stops))


def scores_of(ranks: Ranks) -> dict[str, Any]:
    """Figures of the ranks; none where no query has a true match."""
    if not ranks.positive.any():
        return {}
    return {**asdict(retrieval.score_retrieval(ranks)), "open_set": score_open_set(ranks)}


def evaluate_answers(settings: AnswersSettings, inputs: MethodInputs) -> MethodResult:
    """The answers of a file, judged as those of a method; they have no costs."""
    query, other = inputs.query_traversal, inputs.map_traversal
    scores = score_table(len(query), len(other), inputs.scratch, "scores")
    count = fill_scores(settings, query, other, scores)
    ranks = ranked(scores, inputs.truth, inputs.stops)
    figures = {"answers": count, "settings": settings.model_dump(mode="json")}
    return MethodResult(scores, ranks, {**scores_of(ranks), **figures})


@dataclass(frozen=True, eq=False)
class Descriptors:
    """Descriptors of some rows of a traversal."""

    rows: Ints
    """(K,) increasing."""
    values: Sequence[Any]
    """(K,)."""

    def __getitem__(self, row: int) -> Any:
        """The descriptor of a row that has one."""
        return self.values[int(np.searchsorted(self.rows, row))]


def describe_traversal(
    state: PlaceState, traversal: Traversal, stage: str, execution: Execution, query: bool | None = False
) -> tuple[Descriptors, Floats]:
    """Describe every row that the method can use, and measure the CPU ms (K,) of each. Descriptors that were computed
    elsewhere need no pixels, so that all rows have one."""
    rows = np.arange(len(traversal)) if isinstance(state, StoredState) else traversal.decoded
    views = views_of(state, traversal.log, traversal.stamp_ns[rows], traversal.store.__getitem__, query)

    def work(item: Any) -> tuple[Any, float]:
        loaded = views.load(item)
        began = time.thread_time()
        place = views.describe(loaded)
        return place, 1e3 * (time.thread_time() - began)

    places, spent_ms = _timed_map(work, views.items, len(rows), stage, execution)
    return Descriptors(rows, places), spent_ms


def search(
    index: PlaceIndex, queries: Descriptors, rows: Ints, stops: Ints, scores: Float32s, execution: Execution,
    timed: bool = True,
) -> Floats:  # fmt: skip
    """Fill `scores` (Q, M) and measure the CPU ms of each query's search for the best ANSWERS rows.

    `rows` are those of the map that the index holds, in order. NaN stays beyond each query's stop, in rows of queries
    without a descriptor, and in columns of the map that are not in the index.
    """
    scores[:] = np.nan

    def work(query: int) -> tuple[None, float]:
        stop = int(np.searchsorted(rows, stops[query]))
        began = time.thread_time()
        if timed:
            index.query(queries[query], ANSWERS, stop)
        spent = time.thread_time() - began
        scores[query, rows[:stop]] = index.scores(queries[query], stop)
        return None, 1e3 * spent

    return _timed_map(work, queries.rows.tolist(), len(queries.rows), "search", execution)[1]


def reliability_of(
    index: ProbableIndex, queries: Descriptors, rows: Ints, stops: Ints, ranks: Ranks, truth: Pairs,
    execution: Execution,
) -> Reliability | None:  # fmt: skip
    """The probabilities of the best answers against how often these are right; None without an answer.

    A drive's neighbouring frames show one place, among which its probability is divided. An answer is right where a
    true row is near, so what is near counts for it: as many rows around it as a true run has, by their median. `rows`
    are those of the map that the index holds, in order.
    """
    radius = int(np.median(truth.stop - truth.first)) // 2 if len(truth.first) else 0

    def work(query: int) -> float:
        best = int(ranks.top_row[query])
        near = slice(*np.searchsorted(rows, [best - radius, best + radius + 1]).tolist())
        probability = index.posterior(queries[query], int(np.searchsorted(rows, stops[query])))[0]
        return min(float(probability[near].sum()), 1.0)

    answered = np.flatnonzero(ranks.top_row >= 0)
    if not len(answered):
        return None
    probabilities = list(execution.map(work, answered.tolist()))
    return reliability(probabilities, ranks.top_true[answered] > 0.5)


def score_sequences(
    scores: Float32s, settings: SequenceSettings, stops: Ints, lines: Float32s, execution: Execution
) -> None:
    """Fill `lines` (Q, M) with the scores of sequences, NaN beyond each query's stop; a few rows at a time."""
    found = sequence_rows(lambda query: scores[query, : stops[query]], stops, settings, execution)
    for query, (row, _) in enumerate(execution.counted("sequences", found, len(stops))):
        lines[query, : len(row)] = row
        lines[query, len(row) :] = np.nan


def _timed_map(
    work: Callable[[Any], tuple[Any, float]], items: Iterable[Any], count: int, stage: str, execution: Execution
) -> tuple[list[Any], Floats]:
    found = list(execution.counted(stage, execution.map(work, items, ahead=2), count))
    return [result for result, _ in found], np.array([ms for _, ms in found])


def score_table(queries: int, rows: int, scratch: Path | None, name: str) -> Float32s:
    """(Q, M) float32 to be filled, in a file of the folder where one is given."""
    if scratch is None:
        return np.empty((queries, rows), np.float32)
    needed, free = 4 * queries * rows, disk_usage(scratch).free
    if needed > free:  # a full disk below a mapped file ends the process, so the room is checked first
        raise ResultError(
            f"The scores of {queries} queries against {rows} frames need {needed / 1e9:.1f} GB, and {scratch} has "
            f"{free / 1e9:.1f} GB free. Free space, or compare shorter drives."
        )
    path = scratch / f"{name}.npy"
    path.unlink(missing_ok=True)  # not written over: an earlier table may still be in use
    return mapped_scores(path, (queries, rows))


def stored_bytes(column: pa.Array) -> int:
    """Bytes of the values of an Arrow column and of an offset a row where their number varies.

    The bitmaps that mark empty cells are not counted: no descriptor is empty.
    """
    kind: Any = column.type
    if pa.types.is_struct(kind):
        return sum(stored_bytes(part) for part in column.flatten())
    nested = pa.types.is_fixed_size_list(kind) or pa.types.is_list(kind) or pa.types.is_large_list(kind)
    below = stored_bytes(column.flatten()) if nested else 0
    if pa.types.is_fixed_size_list(kind):
        return below
    if nested:
        return below + len(column) * (8 if pa.types.is_large_list(kind) else 4)
    bitmap = (len(column) + 7) // 8 if column.buffers()[0] is not None else 0
    return column.nbytes - bitmap
