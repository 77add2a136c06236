"""The experiments of the paper that are numbers: the evaluations of each, and its figures.

Numbers of figures are those of Tanaka et al., Mining Visual Phrases for Long-Term Visual SLAM, IROS 2014, section IV.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any

from vplog.benchmark.feature_cache import CacheChoice
from vplog.benchmark.recogniser_specs import read_method
from vplog.benchmark.study.evaluation_store import LESS_IS_BETTER, SCORES, Bench, Evaluation, RandomLibrary
from vplog.errors import SettingsError
from vplog.logs import TopicChoice
from vplog.places.reference_choice import PAPER_SIZE

Row = dict[str, Any]

METHODS = ("bobb", "bobb_paper", "bovf", "fabmap", "vlad", "gist", "thumbnail")
"""Compared where the user names none."""
KINDS_OF_BOXES = ("bobb", "bobb_paper", "hybrid")
"""Recognisers that explain images by boxes on references: those that the size and the origin of a library matter to
most, and that pictures can be drawn of."""
BASE = "bobb"
"""The recogniser that is ablated."""


@dataclass(frozen=True)
class Ablation:
    """One departure from the paper, undone by itself."""

    name: str
    """Variant without it, in a few words."""
    assignments: tuple[str, ...]
    """Assignments of settings, as `--methods bobb:setting=value` takes them."""
    why: str
    """Purpose of the idea, in one sentence."""

    @property
    def method(self) -> str:
        """The recogniser without it, as `--methods` takes it."""
        return ":".join((BASE, *self.assignments))


ABLATIONS = (
    Ablation(
        "plain SIFT", ("root_sift=false",), "Roots of descriptors keep a few large values from ruling the distance."
    ),
    Ablation("grain too", ("least_size=0",), "The smallest features are grain that another camera or light lacks."),
    Ablation("keypoints alone", ("patch_weight=0",), "Patches need no detector, which fails in the dark."),
    Ablation("patches alone", ("features=0",), "Keypoints are found again where the view turns or comes nearer."),
    Ablation("800 keypoints", ("features=800",), "More describe blurred views, and cost twice the time."),
    Ablation("own image left out", ("own=false",), "A later visit is explained by the image of the first one."),
    Ablation("weights not rooted", ("share_power=1",), "The root lets more than the first reference decide."),
    Ablation(
        "boxes of a tenth",
        ("box_columns=6", "box_rows=3"),
        "Boxes of half the sides measure how far apart they are; smaller ones miss each other at once.",
    ),
    Ablation("10 neighbours", ("neighbours=10",), "The scale of distances is read off a far neighbour, not a match."),
    Ablation("all matches weigh alike", ("reach=100",), "Distances change with light, so a match counts relatively."),
    Ablation(
        "no agreement", ("agreement_floor=1",), "Matches of one place move alike from view to view; chance ones do not."
    ),
    Ablation("popular ones count fully", ("popularity=0",), "What explains every view distinguishes none."),
    Ablation("J = 4", ("references=4",), "More references explain more of a view, at twelve bytes each."),
    Ablation("2 x 2 windows", ("windows_along=2",), "Nine windows say where in the view a box comes from."),
    Ablation("windows of a quarter", ("window_share=0.25",), "A window must hold enough features to be found again."),
    Ablation("best window only", ("pairing=best",), "Eq. (1); the same window says that the view is the same."),
    Ablation("same window only", ("pairing=same",), "The best window also finds a view from nearer or aside."),
)
"""One row of the study each."""


_CHANGED = ("r_at_1", "anr", "ap")
"""Scores whose change is reported for each ablation."""


@dataclass(frozen=True)
class StudyOptions:
    """Choice of experiments and their data."""

    methods: Sequence[str] = METHODS
    sizes: Sequence[int] = (10, 20, 50, 100)
    """Library sizes of the experiment about them, those of Fig. 6."""
    seeds: int = 3
    """Libraries drawn for every figure: enough to see where one draw was lucky."""
    library_size: int = PAPER_SIZE
    """References of all other experiments."""
    min_gap: int | None = None
    """Frames that a match is older, at least, where a single drive is searched for in its own past."""
    only: Sequence[str] | None = None
    """Names of the experiments; None for all."""
    topics: TopicChoice | None = None
    cache: CacheChoice = CacheChoice()
    """Cache of features for further calls."""

    def libraries(self, drive: int, size: int | None = None) -> list[RandomLibrary]:
        """One for each seed."""
        return [RandomLibrary(drive, self.library_size if size is None else size, seed) for seed in range(self.seeds)]


def box_methods(bench: Bench, options: StudyOptions) -> list[str]:
    """The methods that make boxes."""
    return [name for name in options.methods if bench.methods[name].kind in KINDS_OF_BOXES]


def fitting_sizes(bench: Bench, options: StudyOptions) -> tuple[list[int], int]:
    """Library sizes that no drive is too short for, increasing, and the frames of the shortest. Raises SettingsError
    where there is none."""
    least = min(len(frames) for frames in bench.frames)
    fitting = sorted({size for size in options.sizes if size <= least})
    if not fitting:
        raise SettingsError(
            f"--sizes {min(options.sizes)}: the shortest drive has only {least} frames. Give smaller ones."
        )
    return fitting, least


def pairs(bench: Bench, options: StudyOptions) -> dict[str, Any]:
    """Fig. 5: every method on every pair of drives, with a library from the map."""
    rows = _rows(bench, "pairs", _every(bench, options.methods, options.libraries))
    return {"rows": rows, "mean": _mean(rows, ("method",))}


def conditions(bench: Bench, options: StudyOptions) -> dict[str, Any]:
    """Fig. 10: the same evaluations as a table of query against map condition."""
    rows = pairs(bench, options)["rows"]
    names = bench.names
    table = {
        method: {
            score: [
                [next((r[score] for r in rows if (r["method"], r["query"], r["map"]) == (method, q, m)), None)
                 for m in names] for q in names
            ]
            for score in ("r_at_1", "anr")
        }
        for method in options.methods
    }  # fmt: skip
    return {"drives": names, "query_by_map": table}


def bits(bench: Bench, options: StudyOptions) -> dict[str, Any]:
    """Section IV on spatial cost: the same evaluations as the size of a stored place against its scores."""
    rows = _mean(pairs(bench, options)["rows"], ("method",))
    for row in rows:
        row["stored_bits"] = round(8 * row["bytes_per_image"])
        row["packed_bits"] = min(row.pop("bits"), row["stored_bits"])
    return {"rows": rows}


def sizes(bench: Bench, options: StudyOptions) -> dict[str, Any]:
    """Fig. 6: libraries of several sizes from the map."""
    names = box_methods(bench, options)
    fitting, least = fitting_sizes(bench, options)
    evaluations = (_every(bench, names, lambda drive, size=size: options.libraries(drive, size)) for size in fitting)
    rows = _rows(bench, "sizes", chain.from_iterable(evaluations))
    found: dict[str, Any] = {"rows": rows, "mean": _mean(rows, ("method", "size"))}
    if left_out := sorted({*options.sizes} - {*fitting}):
        found["left_out"] = f"Sizes {left_out} are more than the {least} frames of the shortest drive."
    return found


def library(bench: Bench, options: StudyOptions) -> dict[str, Any]:
    """Fig. 8: libraries from every drive, for every pair."""
    drawn = [library for drive in range(len(bench.names)) for library in options.libraries(drive)]
    rows = _rows(bench, "library", _every(bench, box_methods(bench, options), lambda _: drawn))
    for row in rows:
        row["from"] = {row["query"]: "query", row["map"]: "map"}.get(row["library"], "other")
    return {"rows": rows, "mean": _mean(rows, ("method", "from"))}


def ablations(bench: Bench, options: StudyOptions) -> dict[str, Any]:
    """Every departure from the paper undone on its own. Raises SettingsError where a setting no longer exists."""
    names = [BASE, *(ablation.method for ablation in ABLATIONS)]
    for name in names:
        bench.methods[name] = read_method(name, bench.pipeline)
    rows = _rows(bench, "ablations", _every(bench, names, options.libraries))
    found = {(row["method"], row["query"], row["map"]): row for row in rows}
    mean = {row["method"]: row for row in _mean(rows, ("method",))}
    named = [(bench.names[query], bench.names[other]) for query, other in bench.pairs]
    table: list[Row] = []
    for ablation in ABLATIONS:
        without = mean[ablation.method]
        row: Row = {"name": ablation.name, "setting": " ".join(ablation.assignments), "why": ablation.why}
        row |= {score: without[score] for score in (*_CHANGED, "bytes_per_image")}
        row |= {f"{score}_change": change for score, change in _changes(without, mean[BASE]).items()}
        row["changes"] = [
            {"query": pair[0], "map": pair[1], **_changes(found[ablation.method, *pair], found[BASE, *pair])}
            for pair in named
        ]
        table.append(row)
    return {"base": mean[BASE], "rows": table}


def _changes(row: Row, base: Row) -> dict[str, float]:
    return {score: _rounded(row[score] - base[score]) for score in _CHANGED}


NUMBERS: dict[str, Callable[[Bench, StudyOptions], dict[str, Any]]] = {
    "pairs": pairs,
    "sizes": sizes,
    "library": library,
    "conditions": conditions,
    "bits": bits,
    "ablations": ablations,
}
"""Experiments by name."""


def _every(bench: Bench, methods: Iterable[str], libraries: Callable[[int], list[RandomLibrary]]) -> list[Evaluation]:
    """Each method on each pair of drives, with each of the libraries for its map."""
    return [
        Evaluation(method, library, query, other)
        for query, other in bench.pairs
        for method in methods
        for library in libraries(other)
    ]


def _rows(bench: Bench, stage: str, evaluations: Iterable[Evaluation]) -> list[Row]:
    """One row for evaluations that differ in the seed of the library alone: mean of every score, and the worst."""
    evaluations = list(dict.fromkeys(evaluations))
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for evaluation, figures in zip(evaluations, bench.run(stage, evaluations), strict=True):
        names = (bench.names[drive] for drive in (evaluation.query, evaluation.map, evaluation.library.drive))
        groups.setdefault((evaluation.method, *names, evaluation.library.size), []).append(figures)
    by = ("method", "query", "map", "library", "size")
    return [
        {**_aggregated(by, key, some), "library_hashes": [one["library_hash"][:12] for one in some]}
        for key, some in groups.items()
    ]


def _mean(rows: list[Row], by: tuple[str, ...]) -> list[Row]:
    """Rows that agree in some columns as one: the mean over pairs of drives, and the worst of any."""
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        groups.setdefault(tuple(row[name] for name in by), []).append(row)
    return [_aggregated(by, key, some) for key, some in groups.items()]


def _aggregated(by: tuple[str, ...], key: tuple[Any, ...], some: list[Row]) -> Row:
    """One row of several: mean and worst of every score; aggregated rows bring their own worst."""
    row: Row = dict(zip(by, key, strict=True))
    for score in SCORES:
        row[score] = _rounded(sum(one[score] for one in some) / len(some))
        worst = max if score in LESS_IS_BETTER else min
        row[f"{score}_worst"] = _rounded(worst(one.get(f"{score}_worst", one[score]) for one in some))
    errors = [one["p_match_error"] for one in some if one["p_match_error"] is not None]
    row["p_match_error"] = _rounded(sum(errors) / len(errors)) if errors else None
    row["bytes_per_image"] = round(sum(one["bytes_per_image"] for one in some) / len(some), 1)
    row["bits"] = max(one["bits"] for one in some)
    return row


def _rounded(value: float) -> float:
    return round(value, 6)
