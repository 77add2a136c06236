"""The experiments of the paper that are numbers: which trials each takes, and its figures.

Numbers of figures are those of Tanaka et al., Mining Visual Phrases for Long-Term Visual SLAM, IROS 2014, section IV.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import chain
from typing import TYPE_CHECKING, Any

from vplog.benchmark.recogniser_specs import read_method
from vplog.benchmark.study.ablations import BASE, DEPARTURES
from vplog.benchmark.study.trial_store import LESS_IS_BETTER, SCORES, Library, Trial
from vplog.errors import SettingsError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from vplog.benchmark.study.trial_store import Bench
    from vplog.pipeline import Pipeline

    Row = dict[str, Any]

KINDS_OF_BOXES = ("bobb", "bobb_paper")
"""Recognisers that explain images by boxes on references: those that the size and the origin of a library matter to
most, and that pictures can be drawn of."""


@dataclass(frozen=True)
class Plan:
    """What a user asks of a study."""

    methods: tuple[str, ...]
    """Names, as the bench has them."""
    library_size: int
    sizes: tuple[int, ...]
    """Increasing."""
    seeds: int
    """Libraries drawn for every figure."""
    pipeline: Pipeline

    def libraries(self, drive: int, size: int | None = None) -> list[Library]:
        """One for each seed."""
        return [Library(drive, self.library_size if size is None else size, seed) for seed in range(self.seeds)]


def boxed(bench: Bench, plan: Plan) -> list[str]:
    """Those of the methods that make boxes. Raises SettingsError where none does."""
    found = [name for name in plan.methods if bench.methods[name].kind in KINDS_OF_BOXES]
    if not found:
        raise SettingsError(
            f"--methods {','.join(plan.methods)}: none of them makes boxes, which this experiment is about. "
            f"Add {' or '.join(KINDS_OF_BOXES)}, or leave the experiment out with --only."
        )
    return found


def pairs(bench: Bench, plan: Plan) -> dict[str, Any]:
    """Fig. 5: every method on every pair of drives, with a library from the map."""
    rows = _rows(bench, "pairs", _every(bench, plan.methods, plan.libraries))
    return {"rows": rows, "mean": _mean(rows, ("method",))}


def conditions(bench: Bench, plan: Plan) -> dict[str, Any]:
    """Fig. 10: the same trials, seen as a table of query against map condition."""
    rows = pairs(bench, plan)["rows"]
    names = bench.names
    table = {
        method: {
            score: [
                [next((r[score] for r in rows if (r["method"], r["query"], r["map"]) == (method, q, m)), None)
                 for m in names] for q in names
            ]
            for score in ("r_at_1", "anr")
        }
        for method in plan.methods
    }  # fmt: skip
    return {"drives": names, "query_by_map": table}


def bits(bench: Bench, plan: Plan) -> dict[str, Any]:
    """Section IV on spatial cost: the same trials, seen as what a place takes against how well it is found."""
    rows = _mean(pairs(bench, plan)["rows"], ("method",))
    for row in rows:
        row["stored_bits"] = round(8 * row["bytes_per_image"])
        row["packed_bits"] = min(row.pop("bits"), row["stored_bits"])
    return {"rows": rows}


def sizes(bench: Bench, plan: Plan) -> dict[str, Any]:
    """Fig. 6: libraries of several sizes from the map."""
    names = boxed(bench, plan)
    least = min(len(frames) for frames in bench.frames)
    fitting = [size for size in plan.sizes if size <= least]
    left_out = [size for size in plan.sizes if size > least]
    if not fitting:
        raise SettingsError(f"--sizes {','.join(map(str, plan.sizes))}: the shortest drive has only {least} frames.")
    trials = (_every(bench, names, lambda drive, size=size: plan.libraries(drive, size)) for size in fitting)
    rows = _rows(bench, "sizes", chain.from_iterable(trials))
    found: dict[str, Any] = {"rows": rows, "mean": _mean(rows, ("method", "size"))}
    if left_out:
        found["left_out"] = f"Sizes {left_out} are more than the {least} frames of the shortest drive."
    return found


def library(bench: Bench, plan: Plan) -> dict[str, Any]:
    """Fig. 8: libraries from every drive, for every pair."""
    drawn = [library for drive in range(len(bench.names)) for library in plan.libraries(drive)]
    rows = _rows(bench, "library", _every(bench, boxed(bench, plan), lambda _: drawn))
    for row in rows:
        row["from"] = {row["query"]: "query", row["map"]: "map"}.get(row["library"], "other")
    return {"rows": rows, "mean": _mean(rows, ("method", "from"))}


def ablations(bench: Bench, plan: Plan) -> dict[str, Any]:
    """Every departure from the paper taken back on its own. Raises SettingsError where a setting is no more."""
    names = [BASE, *(departure.method for departure in DEPARTURES)]
    for name in names:
        bench.methods[name] = read_method(name, plan.pipeline)
    rows = _rows(bench, "ablations", _every(bench, names, plan.libraries))
    found = {(row["method"], row["query"], row["map"]): row for row in rows}
    base = {row["method"]: row for row in _mean(rows, ("method",))}
    table = []
    for departure in DEPARTURES:
        changes = [
            {
                "query": bench.names[query],
                "map": bench.names[other],
                **{
                    score: _rounded(
                        found[departure.method, bench.names[query], bench.names[other]][score]
                        - found[BASE, bench.names[query], bench.names[other]][score]
                    )
                    for score in ("r_at_1", "anr", "ap")
                },
            }
            for query, other in bench.pairs
        ]
        table.append(
            {
                "name": departure.name,
                "setting": " ".join(departure.undone_by),
                "why": departure.why,
                **{score: base[departure.method][score] for score in ("r_at_1", "anr", "ap", "bytes_per_image")},
                **{
                    f"{score}_change": _rounded(base[departure.method][score] - base[BASE][score])
                    for score in ("r_at_1", "anr", "ap")
                },
                "changes": changes,
            }
        )
    return {"base": base[BASE], "rows": table}


NUMBERS: dict[str, Callable[[Bench, Plan], dict[str, Any]]] = {
    "pairs": pairs,
    "sizes": sizes,
    "library": library,
    "conditions": conditions,
    "bits": bits,
    "ablations": ablations,
}
"""Experiments by name."""


def _every(bench: Bench, methods: Iterable[str], libraries: Callable[[int], list[Library]]) -> list[Trial]:
    """Each method on each pair of drives, with each of the libraries for its map."""
    return [
        Trial(method, library, query, other)
        for query, other in bench.pairs
        for method in methods
        for library in libraries(other)
    ]


def _rows(bench: Bench, stage: str, trials: Iterable[Trial]) -> list[Row]:
    """A row for trials that differ by the seed of the library alone: mean of every score, and the worst."""
    trials = list(dict.fromkeys(trials))
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for trial, figures in zip(trials, bench.run(stage, trials), strict=True):
        key = (trial.method, trial.library.drive, trial.library.size, trial.query, trial.map)
        groups.setdefault(key, []).append(figures)
    rows = []
    for (method, drive, size, query, other), some in groups.items():
        row: Row = {
            "method": method,
            "query": bench.names[query],
            "map": bench.names[other],
            "library": bench.names[drive],
            "size": size,
        }
        for score in SCORES:
            values = [one[score] for one in some]
            row[score] = _rounded(sum(values) / len(values))
            row[f"{score}_worst"] = _rounded(max(values) if score in LESS_IS_BETTER else min(values))
        row["bytes_per_image"] = round(sum(one["bytes_per_image"] for one in some) / len(some), 1)
        row["bits"] = max(one["bits"] for one in some)
        row["library_hashes"] = [one["library_hash"][:12] for one in some]
        rows.append(row)
    return rows


def _mean(rows: list[Row], by: tuple[str, ...]) -> list[Row]:
    """Rows that agree in some columns as one: the mean over pairs of drives, and the worst of any."""
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        groups.setdefault(tuple(row[name] for name in by), []).append(row)
    result = []
    for key, some in groups.items():
        mean: Row = dict(zip(by, key, strict=True))
        for score in SCORES:
            mean[score] = _rounded(sum(row[score] for row in some) / len(some))
            worst = [row[f"{score}_worst"] for row in some]
            mean[f"{score}_worst"] = max(worst) if score in LESS_IS_BETTER else min(worst)
        mean["bytes_per_image"] = round(sum(row["bytes_per_image"] for row in some) / len(some), 1)
        mean["bits"] = max(row["bits"] for row in some)
        result.append(mean)
    return result


def _rounded(value: float) -> float:
    return round(value, 6)
