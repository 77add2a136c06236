"""R@1 of a drive that a map has not seen against the bytes of the map's places, as `vplog map condense` removes them,
beside random thinning and places at even steps: the Gardens Point walks, day, day and night.

Two walks are the map, the third asks. Frame i of one walk is frame i of the others, and stands for its position: 1 m a
frame.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from tests.benchmarks.measure import Figure
from vplog import logs
from vplog.execution.execution import Execution
from vplog.maps.condensation.own_queries import OwnPlaces, query_own_places, search_in_memory
from vplog.maps.condensation.redundancy import remove_redundant
from vplog.maps.search.query import describe_log
from vplog.pipeline import load_pipeline
from vplog.run.figures.canvas import saved_figure
from vplog.run.reference_library import build_library

if TYPE_CHECKING:
    from collections.abc import Iterator

    from vplog.data import Bools, Float32s, Ints
    from vplog.stages import PlaceState

WALKS = ("gardens_day_left", "gardens_day_right", "gardens_night_right")
SHARES = (1.0, 0.75, 0.5, 0.35, 0.25, 0.15, 0.1, 0.06)
"""Of the places that stay."""
TOLERANCE = 2.0
"""Frames; the walks are aligned to that."""
SEEDS = 5
"""Of random thinning."""
BAR = 0.97
"""Least R@1 at the loss stated by default, as a share of that of the whole map."""
LOSS = 0.01


def condense(folder: Path) -> Iterator[Figure]:
    """A figure for each walk that asks, and the curves in `condense.png`; descriptors are kept in `folder`."""
    state, columns, frames = _described(folder)
    curves = {}
    for asking in range(len(WALKS)):
        curves[WALKS[asking]] = curve = _curves(state, columns, frames, asking)
        whole, there = curve["whole"], curve["default"]
        facts = {
            "places": there["places"], "of": whole["places"],
            "R@1": there["r_at_1"], "R@1 of the whole map": whole["r_at_1"],
            **{f"R@1 {how} at as many places": round(there[how], 3) for how in ("random", "even")},
            "kB": round(there["kB"], 1), "kB of the whole map": round(whole["kB"], 1),
        }  # fmt: skip
        name = f"R@1 of {WALKS[asking]} in the condensed map of the others, share of the whole map's"
        yield Figure(name, there["r_at_1"] / whole["r_at_1"], BAR, False, facts)
    _draw(folder, curves)


def _described(folder: Path) -> tuple[PlaceState, list[pa.Array], list[Ints]]:
    """The recogniser, and descriptors and frame numbers of each walk."""
    data = Path(os.environ.get("VPLOG_DATA", Path(__file__).parents[3] / "shared" / "data")) / "drives"
    paths, pipeline, execution = [data / f"{walk}.mcap" for walk in WALKS], load_pipeline("default"), Execution()
    if not paths[0].exists():
        raise SystemExit(f"there is no {paths[0]}: set VPLOG_DATA to the folder with the real drives")
    if not (folder / "library" / "library.json").exists():
        build_library(paths, folder / "library", pipeline)
    state = pipeline.places.load(folder / "library", execution)
    columns, frames = [], []
    for path in paths:
        stored = folder / f"{path.stem}.parquet"
        if not stored.exists():
            log = logs.open(path)
            stamps, descriptors, _ = describe_log(log, pipeline, state, execution)
            frame = np.searchsorted(log.stamps(), stamps)
            pq.write_table(pa.table({"descriptor": state.to_arrow(descriptors), "frame": frame}), stored)
        table = pq.read_table(stored)
        columns.append(table["descriptor"].combine_chunks().cast(state.arrow_type))
        frames.append(table["frame"].to_numpy())
    return state, columns, frames


def _curves(state: PlaceState, columns: list[pa.Array], frames: list[Ints], asking: int) -> dict[str, Any]:
    """R@1 of one walk in a map of the others, by how the map was thinned and the share that stays."""
    own = [number for number in range(len(columns)) if number != asking]
    places = _places([WALKS[number] for number in own], [columns[number] for number in own], [frames[n] for n in own])
    asked = query_own_places(places, search_in_memory(places, state), state, TOLERANCE)
    count = len(places.drive)
    removable = np.isin(np.arange(count), asked.place)
    removal = remove_redundant(asked.queries, places.drive, np.cumsum(places.steps_m()), removable, asked.faded, count)
    index = state.index(state.from_arrow(pa.concat_arrays(places.columns)))
    scores = np.stack([index.scores(one) for one in state.from_arrow(columns[asking])])
    near = np.abs(places.keyframe - frames[asking][:, None]) <= TOLERANCE
    size = sum(column.nbytes for column in places.columns) / count / 1e3
    found: dict[str, Any] = {"condense": [], "random": [], "even": []}
    for share in SHARES:
        left = max(round(share * count), 1)
        removed = min(count - left, len(removal.places))
        found["condense"].append(
            (size * (count - removed), _recall(scores, near, _without(count, removal.places[:removed])))
        )
        found["random"].append((size * left, _random(scores, near, left)))
        found["even"].append((size * left, _recall(scores, near, _even(places, left))))
    gone = int(np.searchsorted(removal.lost, int(LOSS * count), "right"))
    left = count - gone
    found["whole"] = {"places": count, "r_at_1": _recall(scores, near, np.ones(count, np.bool_)), "kB": size * count}
    found["default"] = {
        "places": left, "r_at_1": _recall(scores, near, _without(count, removal.places[:gone])), "kB": size * left,
        "random": _random(scores, near, left), "even": _recall(scores, near, _even(places, left)),
    }  # fmt: skip
    return found


def _places(names: list[str], columns: list[pa.Array], frames: list[Ints]) -> OwnPlaces:
    keyframe = np.concatenate(frames)
    pose = np.tile(np.eye(4), (len(keyframe), 1, 1))
    pose[:, 0, 3] = keyframe
    drive = np.repeat(np.arange(len(names)), list(map(len, columns)))
    return OwnPlaces(names, columns, keyframe.astype(np.int32), drive, np.zeros(len(keyframe), np.int64), pose)


def _recall(scores: Float32s, near: Bools, kept: Bools) -> float:
    """Share of the queries that have a match, and whose best place of those that stay is one."""
    best = np.where(kept, scores, -np.inf).argmax(axis=1)
    possible = near.any(axis=1)
    return float(near[np.arange(len(best)), best][possible].mean())


def _random(scores: Float32s, near: Bools, left: int) -> float:
    count = scores.shape[1]
    drawn = [np.random.default_rng(seed).permutation(count)[left:] for seed in range(SEEDS)]
    return float(np.mean([_recall(scores, near, _without(count, removed)) for removed in drawn]))


def _even(places: OwnPlaces, left: int) -> Bools:
    """So many places, at even steps along the drives."""
    kept = np.zeros(len(places.drive), np.bool_)
    kept[np.linspace(0, len(kept) - 1, left).round().astype(int)] = True
    return kept


def _without(count: int, removed: Ints) -> Bools:
    kept = np.ones(count, np.bool_)
    kept[removed] = False
    return kept


def _draw(folder: Path, curves: dict[str, Any]) -> None:
    colours = {"condense": "#d62728", "even": "#1f77b4", "random": "#7f7f7f"}
    with saved_figure(folder, "condense", 11.0, 4.0, ("png",)) as figure:
        for axes, (walk, curve) in zip(figure.subplots(1, len(curves), sharey=True), curves.items(), strict=True):
            for how, colour in colours.items():
                axes.plot(*zip(*curve[how], strict=True), "o-", color=colour, label=how, markersize=3)
            default = curve["default"]
            axes.plot(
                default["kB"], default["r_at_1"], "*", color=colours["condense"], markersize=11, label="loss 0.01"
            )
            axes.set(title=f"{walk} in the others", xlabel="descriptors of the map, kB", ylim=(0, 1.02))
            axes.grid(alpha=0.3)
        figure.axes[0].set_ylabel("R@1")
        figure.axes[0].legend(loc="lower right")
