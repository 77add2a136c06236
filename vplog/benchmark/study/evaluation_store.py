"""Trials of recognisers on pairs of drives: features extracted once, each library learned and described with once.

Results are stored under a hash of all their inputs, so an interrupted study resumes where it stopped.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vplog.benchmark.feature_cache import FeatureFolder
from vplog.benchmark.method_scores import Descriptors, describe_traversal, ranked, score_table, search, stored_bytes
from vplog.benchmark.traversals import Traversal, candidate_stops, extract_traversal, images_at, references_of
from vplog.data import Bytes, Ints, Reference
from vplog.errors import ResultError
from vplog.evaluate import retrieval
from vplog.evaluate.open_set import score_open_set
from vplog.evaluate.pairs import Pairs
from vplog.evaluate.place_truth import PlaceTruth
from vplog.evaluate.retrieval import Ranks
from vplog.execution.execution import Execution
from vplog.places.library_files import references_hash
from vplog.places.reference_choice import LibrarySettings, choose
from vplog.results.run_record import read_run_json, write_run_json
from vplog.stages import Log, PlaceState
from vplog.storage.json_records import key_of

if TYPE_CHECKING:
    from vplog.pipeline import Pipeline

SCORES = ("r_at_1", "r_at_5", "r_at_10", "anr", "ap", "recall_at_p100")
"""Scores of an evaluation, as `evaluate.retrieval` defines them."""
LESS_IS_BETTER = frozenset({"anr"})


@dataclass(frozen=True, order=True)
class RandomLibrary:
    """Random frames of a drive as reference images."""

    drive: int
    size: int
    seed: int


@dataclass(frozen=True)
class Evaluation:
    """The frames of one drive looked for in another, by one method with one library. Drives by number."""

    method: str
    library: RandomLibrary
    query: int
    map: int


@dataclass(eq=False)
class Bench:
    """The drives of a study and the evaluations done on them. Drives are decoded when first needed."""

    names: list[str]
    """Names of the drives, short and different."""
    logs: Sequence[Log]
    hashes: list[str]
    """Hashes of the drives' files."""
    methods: dict[str, Any]
    """Recognisers by name; grows with those of the ablations."""
    truth: dict[tuple[int, int], PlaceTruth]
    """By query and map; its keys are the pairs of the study."""
    frames: list[Ints]
    """Numbers of the frames of each drive that the truth covers."""
    pipeline: Pipeline
    min_gap: int | None
    common: dict[str, Any]
    """Further inputs of every evaluation, as plain values."""
    results: Path
    """File of the finished evaluations, by the hash of their inputs."""
    scratch: Path
    folders: list[FeatureFolder]
    """Features of each drive."""
    execution: Execution
    warnings: list[str] = field(default_factory=list)
    _traversals: dict[int, Traversal] = field(default_factory=dict)
    _done: dict[str, dict[str, Any]] | None = None
    _learned: tuple[Any, Any] = (None, None)

    @property
    def pairs(self) -> list[tuple[int, int]]:
        """(query, map) of every pair, in order."""
        return list(self.truth)

    def traversal(self, drive: int) -> Traversal:
        """The drive's frames as features."""
        if drive not in self._traversals:
            traversal = extract_traversal(
                self.logs[drive], self.pipeline.features, self.folders[drive], self.frames[drive], self.execution
            )  # fmt: skip
            self.warnings += traversal.warnings
            self._traversals[drive] = traversal
        return self._traversals[drive]

    def images(self, drive: int, rows: Sequence[int]) -> list[Bytes]:
        """The grey images of increasing rows of a traversal. Raises LogError where one is gone."""
        return images_at(self.logs[drive], self.traversal(drive).stamp_ns[rows])

    def references(self, library: RandomLibrary) -> list[Reference]:
        """Frames as `vplog compare` chooses them; those that cannot be decoded are left out after the choice."""
        covered = self.frames[library.drive]
        wanted = LibrarySettings(choose="random", size=library.size, seed=library.seed)
        return references_of(self.traversal(library.drive), covered[choose(covered, wanted)])

    def learn(self, method: str, library: RandomLibrary) -> PlaceState:
        """The trained state of a method on a library; the references of the last library are cached for the other
        methods."""
        if self._learned[0] != library:
            self._learned = library, self.references(library)
        return self.methods[method].learn(self._learned[1], self.execution)

    def rank(self, state: PlaceState, query: int, other: int, places: dict[int, Descriptors]) -> tuple[Ranks, Pairs]:
        """Ranks of every query of a pair, and its true pairs."""
        traversals = self.traversal(query), self.traversal(other)
        stops = candidate_stops(traversals[0].frames, traversals[1].frames, self.min_gap)
        truth = self.truth[query, other].pairs(traversals[0].frames, traversals[1].frames).below(stops)
        index = state.index(places[other].values)
        scores = score_table(len(traversals[0]), len(traversals[1]), self.scratch, "scores")
        execution = Execution(self.execution.threads)
        search(index, places[query], places[other].rows, stops, scores, execution, timed=False)
        return ranked(scores, truth, stops), truth

    def run(self, stage: str, evaluations: Iterable[Evaluation]) -> list[dict[str, Any]]:
        """Scores of every evaluation, in order; stored ones are not computed again."""
        wanted = list(dict.fromkeys(evaluations))
        keys = {evaluation: self._key(evaluation) for evaluation in wanted}
        done = self._stored()
        groups: dict[tuple[RandomLibrary, str], list[Evaluation]] = {}
        for evaluation in wanted:
            if keys[evaluation] not in done:
                groups.setdefault((evaluation.library, evaluation.method), []).append(evaluation)
        used = {group: sorted({drive for t in some for drive in (t.query, t.map)}) for group, some in groups.items()}
        total = sum(len(self.frames[drive]) for drives in used.values() for drive in drives)
        described = 0
        for (library, method), some in sorted(groups.items(), key=lambda one: one[0][0]):
            state = self.learn(method, library)
            places = {}
            for drive in used[library, method]:
                places[drive] = self.describe(state, drive, stage, described, total)
                described += len(self.frames[drive])
            for evaluation in some:
                ranks, _ = self.rank(state, evaluation.query, evaluation.map, places)
                column = state.to_arrow(places[evaluation.map].values)
                done[keys[evaluation]] = {
                    **asdict(retrieval.score_retrieval(ranks)),
                    "p_match_error": score_open_set(ranks).get("p_match", {}).get("expected_calibration_error"),
                    "bytes_per_image": round(stored_bytes(column) / len(column), 1),
                    "bits": state.bits,
                    "library_hash": references_hash(self._learned[1], self.methods[method]),
                }
            write_run_json(self.results, dict(sorted(done.items())))
        return [done[keys[evaluation]] for evaluation in wanted]

    def describe(self, state: PlaceState, drive: int, stage: str, before: int, total: int) -> Descriptors:
        """Places of a traversal as a table would give them back; `before` frames of the stage's `total` are done."""
        query = None if len(self.logs) > 1 else False
        execution = self.execution.part(before, total)
        places, _ = describe_traversal(state, self.traversal(drive), stage, execution, query)
        return replace(places, values=state.from_arrow(state.to_arrow(places.values)))

    def _key(self, evaluation: Evaluation) -> str:
        about = {
            **self.common,
            "method": self.methods[evaluation.method].model_dump(mode="json"),
            "library": [self.hashes[evaluation.library.drive], evaluation.library.size, evaluation.library.seed],
            "query": self.hashes[evaluation.query],
            "map": self.hashes[evaluation.map],
            "truth": self.truth[evaluation.query, evaluation.map].about,
        }
        return key_of(about)

    def _stored(self) -> dict[str, dict[str, Any]]:
        if self._done is None:
            try:
                found = read_run_json(self.results)
            except ResultError:  # none yet, or damaged: all are computed
                found = {}
            self._done = {key: value for key, value in found.items() if _is_whole(value)}
        return self._done


def _is_whole(entry: Any) -> bool:
    numbers = (*SCORES, "bytes_per_image", "bits")
    if not isinstance(entry, dict) or not isinstance(entry.get("p_match_error", ""), float | int | None):
        return False
    return all(isinstance(entry.get(name), (int, float)) for name in numbers)
