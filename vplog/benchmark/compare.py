"""Place recognisers side by side: the frames of one drive are looked for among those of another, or among older ones.

Every method gets the same features, the same reference images and the same truth.
"""

from __future__ import annotations

import os
import re
import tempfile
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import vplog
from vplog import logs
from vplog.benchmark.method_scores import MethodInputs, evaluate_method
from vplog.benchmark.recogniser_specs import read_methods
from vplog.benchmark.traversals import Traversal, candidate_stops, extract_traversal
from vplog.errors import SettingsError, TruthError
from vplog.evaluate.place_truth import PlaceTruth, TruthChoice, open_truth
from vplog.evaluate.retrieval import average_precision, precision_recall, recall_at
from vplog.execution.execution import Execution, logged_warnings
from vplog.features.store import FeatureStore
from vplog.figures.canvas import as_text, drawn
from vplog.places.library_files import load_references, references_hash
from vplog.places.reference_choice import PAPER_SIZE, LibrarySettings, choose
from vplog.places.sequence import SequenceSettings
from vplog.results import run_record
from vplog.results.staging import staged
from vplog.storage.scratch import replacing

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from vplog.data import Float32s, Ints, Reference
    from vplog.evaluate.retrieval import Ranks, Reliability
    from vplog.pipeline import Pipeline
    from vplog.stages import Log


_DEEPEST_RANK = 25
"""Last rank of the curves, as usual for recall@N in place recognition (Arandjelovic et al., NetVLAD, CVPR 2016)."""
_LINES = ("-", "--", "-.", ":")
"""One kind each time the ten colours have gone round, so that forty methods are told apart."""


@dataclass(frozen=True, eq=False)
class Comparison:
    """Every method's figures, and the ranks they are of."""

    record: dict[str, Any]
    """What compare.json says."""
    ranks: dict[str, Ranks]
    """By name; a method by sequences has `, L=..` added."""


@dataclass(frozen=True)
class CompareOptions:
    """How recognisers are compared."""

    library: Path | None = None
    """A drive, or a saved library; None for the map."""
    library_size: int = PAPER_SIZE
    library_seed: int = 0
    min_gap: int | None = None
    """Frames that a match is older, at least, in a drive compared with itself."""
    sequence: int | None = None
    """Frames of a sequence, other settings of which are the pipeline's; None for single views only."""
    out: Path | None = None
    """Folder of compare.json, scores and curves; None writes nothing."""
    topics: logs.TopicChoice | None = None


def compare(
    query: Path,
    other: Path | None,
    methods: Iterable[str],
    truth: TruthChoice,
    pipeline: Pipeline,
    options: CompareOptions = CompareOptions(),
    execution: Execution = Execution(),
) -> Comparison:
    """Every method on a query and a map drive; without a map, or with the same one, frames among their own past.

    Raises VplogError with one line where that cannot be.
    """
    other = query if other is None else other
    library, min_gap, out, topics = options.library, options.min_gap, options.out, options.topics
    recognisers, sequences = read_methods(methods, pipeline), None
    if options.sequence is not None:
        tree = {**pipeline.sequence.model_dump(), "length": options.sequence}
        sequences = SequenceSettings.read(tree, "--sequence")
    itself = same_drive(query, other)
    _check_gap(query, itself, min_gap)
    warnings: list[str] = []
    with ExitStack() as stack:
        made = None if out is None else stack.enter_context(staged(out, lambda: _comparison_in(out)))
        stack.enter_context(logged_warnings(warnings))
        scratch = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix=".vplog-", dir=made)))
        query_log = logs.open(query, topics)
        map_log = query_log if itself else logs.open(other, topics)
        known = open_truth(truth, query_log, map_log)
        warnings += check_truth(known, query_log, map_log, min_gap)  # before the long part
        if library is not None and same_drive(library, other):
            library = None
        wanted = LibrarySettings(choose="random", size=options.library_size, seed=options.library_seed)

        def traversal_of(log: Log, role: str, frames: Ints, references: Ints | None = None) -> Traversal:
            store = stack.enter_context(FeatureStore(scratch / f"{role}.features"))
            return extract_traversal(log, pipeline.features, store, frames, references, execution)

        source = None
        if library is not None:
            source = load_references(library, execution) if _is_saved(library) else logs.open(library, topics)
        map_traversal, query_traversal, references, notes = _extract_all(
            query_log, map_log, known, source, wanted, traversal_of
        )
        warnings += notes
        stops = candidate_stops(query_traversal.frames, map_traversal.frames, min_gap)
        pairs = known.pairs(query_traversal.frames, map_traversal.frames).below(stops)
        account: dict[str, Any] = {
            "vplog": vplog.__version__,
            "query": str(query),
            "map": str(other),
            "min_gap": min_gap,
            "library": {
                "from": str(library or other),
                "size": len(references),
                "seed": None if _is_saved(library) else options.library_seed,
                "hash": references_hash(references, pipeline.features),
            },
            "truth": {**known.about, "pairs": pairs.count},
            "queries": len(query_traversal),
            "map_frames": len(map_traversal),
            "positives": int(pairs.positive.sum()),
            "features": pipeline.features.model_dump(mode="json"),
            "methods": {},
        }
        inputs = MethodInputs(references, map_traversal, query_traversal, pairs, stops, sequences, scratch)
        ranks: dict[str, Ranks] = {}
        reliable: dict[str, Reliability] = {}
        for number, (name, settings) in enumerate(recognisers.items(), start=1):
            result = evaluate_method(settings, inputs, execution.within(name))
            account["methods"][name] = result.figures
            ranks[name] = result.ranks
            if result.reliability is not None:
                reliable[name] = result.reliability
            if result.sequence_ranks is not None:
                ranks[f"{name}, L={options.sequence}"] = result.sequence_ranks
            if made is not None:
                result.figures["scores"] = _write_scores(
                    made, number, name, result.scores, query_traversal, map_traversal
                )
        account["warnings"] = list(dict.fromkeys([*query_log.warnings, *map_log.warnings, *warnings]))
        if made is not None:
            draw_curves(ranks, made)
            if reliable:
                draw_reliability(reliable, made)
            run_record.write_run_json(made / "compare.json", account)
    return Comparison(account, ranks)


def _extract_all(
    query: Log,
    other: Log,
    known: PlaceTruth,
    library: Log | list[Reference] | None,
    wanted: LibrarySettings,
    traversal_of: Callable[..., Traversal],
) -> tuple[Traversal, Traversal, list[Reference], list[str]]:
    """Walks of the map and the query, one and the same for a drive against itself, the references, and warnings."""
    chosen = known.map_frames[choose(other.stamps()[known.map_frames], wanted)] if library is None else None
    map_traversal = traversal_of(other, "map", known.map_frames, chosen)
    query_traversal = map_traversal if query is other else traversal_of(query, "query", known.query_frames)
    warnings = list(dict.fromkeys(map_traversal.warnings + query_traversal.warnings))
    if isinstance(library, list):
        return map_traversal, query_traversal, library, warnings
    references = map_traversal.references
    if library is not None:
        rows = choose(library.stamps(), wanted)
        traversal = traversal_of(library, "library", rows, rows)
        references = traversal.references
        warnings += traversal.warnings
    if len(references) < (wanted.size or 0):
        warnings.append(
            f"The library has {len(references)} images instead of {wanted.size}: its drive has no more frames."
        )
    return map_traversal, query_traversal, references, warnings


def _is_saved(library: Path | None) -> bool:
    return library is not None and os.path.lexists(library / "library.json")


def _check_gap(query: Path, itself: bool, min_gap: int | None) -> None:
    if itself and min_gap is None:
        raise SettingsError(
            f"{query} is compared with itself, where every frame finds itself. "
            "Say how many frames older a match must be: --min-gap 50."
        )
    if not itself and min_gap is not None:
        raise SettingsError("--min-gap is for a drive compared with itself; leave it out, or leave out MAP.")


def check_truth(known: PlaceTruth, query: Log, other: Log, min_gap: int | None) -> list[str]:
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
        warnings.append(
            "--truth poses assumes that the odometry of both drives is in one frame; else give a TUM file for each."
        )
    return warnings


def same_drive(a: Path, b: Path) -> bool:
    return a.resolve() == b.resolve()


def _comparison_in(out: Path) -> list[str]:
    """The files of a comparison in a folder that a new one replaces. Raises SettingsError where there are others."""
    if any(not file.name.startswith(".") for file in out.iterdir()) and not (out / "compare.json").is_file():
        raise SettingsError(f"{out} is a folder with other things in it, not a comparison. Choose another with -o.")
    return ["compare.json", "scores-[0-9][0-9]-*.npz", *(f"{name}.[ps][nv]g" for name in ("curves", "reliability"))]


def _write_scores(out: Path, number: int, name: str, scores: Float32s, query: Traversal, other: Traversal) -> str:
    """Name of the file; the number tells apart what the letters that files may have do not."""
    file = f"scores-{number:02d}-{re.sub(r'[^A-Za-z0-9.=+-]+', '_', Path(name).name)[:80]}.npz"
    with replacing(out / file) as stream:
        np.savez(
            stream, scores=scores, query_frame=query.frames, query_ns=query.stamp_ns, map_frame=other.frames,
            map_ns=other.stamp_ns,
        )  # fmt: skip
    return file


def draw_curves(ranks: dict[str, Ranks], folder: Path) -> None:
    """Write curves.png and curves.svg. The same ranks give the same bytes."""
    with drawn(folder, "curves", 10, 4.5) as figure:
        left, right = figure.subplots(1, 2)
        for number, (plain_name, found) in enumerate(ranks.items()):
            name = as_text(plain_name)
            style = {"color": f"C{number % 10}", "linestyle": _LINES[number // 10 % len(_LINES)]}
            curve = precision_recall(found)
            left.step(
                [0.0, *curve.recall], [*curve.precision[:1], *curve.precision], where="pre",
                label=f"{name}  AP {average_precision(curve):.3f}", **style,
            )  # fmt: skip
            depth = range(1, _DEEPEST_RANK + 1)
            right.plot(
                depth, [recall_at(found, k) for k in depth], label=f"{name}  R@1 {recall_at(found, 1):.3f}", **style
            )
        left.set(xlabel="recall of the best answers", ylabel="precision", title="Precision over recall")
        right.set(xlabel="rank N", ylabel="recall@N", title="A true match among the N best", xlim=(1, _DEEPEST_RANK))
        right.set_xticks([1, *range(5, _DEEPEST_RANK + 1, 5)])
        left.set_xlim(0, 1.02)
        for axes in (left, right):
            axes.set_ylim(0, 1.02)
            axes.grid(alpha=0.3)
            axes.legend(loc="lower left" if axes is left else "lower right", fontsize=8)


def draw_reliability(found: dict[str, Reliability], folder: Path) -> None:
    """Write reliability.png and reliability.svg: of answers given with a probability, how many are right.

    Guo et al., On calibration of modern neural networks, ICML 2017, Fig. 1. Below the diagonal is over-confident. The
    bars beneath say how many answers a point is of.
    """
    with drawn(folder, "reliability", 5.5, 5.5) as figure:
        top, below = figure.subplots(2, 1, height_ratios=(4, 1), sharex=True)
        top.plot([0, 1], [0, 1], color="0.6", linestyle=":", label="calibrated")
        for number, (plain_name, one) in enumerate(found.items()):
            filled, colour = one.count > 0, f"C{number % 10}"
            top.plot(
                one.confidence[filled], one.accuracy[filled], marker="o", color=colour,
                label=f"{as_text(plain_name)}  ECE {one.expected_calibration_error:.3f}, "
                f"over-confident by {one.overconfidence:+.3f}",
            )  # fmt: skip
            width = (one.edges[1] - one.edges[0]) / len(found)
            below.bar(one.edges[:-1] + number * width, one.count, width, align="edge", color=colour)
        top.set(ylabel="share of answers that are right", title="Reliability of the probabilities of answers")
        below.set(xlabel="probability of the best answer", ylabel="answers", xlim=(0, 1.02))
        below.set_yscale("log")  # of loop detection, most answers are improbable and few are certain
        below.set_ylim(bottom=0.5)
        top.set_ylim(0, 1.02)
        for axes in (top, below):
            axes.grid(alpha=0.3)
        top.legend(loc="best", fontsize=8)
