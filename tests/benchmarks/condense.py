"""R@1 of a drive that a map has not seen against the bytes of the map's library and places, as `vplog map condense`
removes references and places, beside as many at random and at even steps: the Gardens Point walks, day, day and night.

Two walks are the map, with a library of their frames, and the third asks, described with what is left of the library.
Frame i of one walk is frame i of the others, and stands for its position: 1 m a frame.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa

from tests.benchmarks.measure import Figure
from vplog import logs
from vplog.execution.execution import Execution
from vplog.features.extraction import extract_frames
from vplog.maps.condensation.condense import condense_places
from vplog.maps.condensation.own_queries import OwnPlaces, query_own_places, search_in_memory
from vplog.maps.search.query import select_views
from vplog.pipeline import load_pipeline
from vplog.run.figures.canvas import saved_figure
from vplog.run.reference_library import build_library

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from vplog.data import Bools, Features, Ints

WALKS = ("gardens_day_left", "gardens_day_right", "gardens_night_right")
LOSS = 0.01
LOSSES = (LOSS, 0.02, 0.05, 0.1, 0.2)
TOLERANCE = 2.0
"""Frames; the walks are aligned to that."""
SEEDS = 3
"""Of random removal."""
BAR = 0.97
"""Least R@1 at the loss stated by default, as a share of that of the whole map; of 200 views, with an error of .03."""


@dataclass(frozen=True, eq=False)
class Walk:
    """The N views of a walk."""

    path: Path
    features: list[Features]
    frame: Ints
    """(N,)."""


@dataclass(frozen=True, eq=False)
class Point:
    """A map of some references and places, and how the walk that asks does in it."""

    references: int
    places: int
    mb: float
    r_at_1: float


def condense(folder: Path) -> Iterator[Figure]:
    """A figure for each walk that asks, and the curves in `condense.png`; libraries are kept in `folder`."""
    walks, curves = [_read(name) for name in WALKS], {}
    for asking in walks:
        curves[asking.path.stem] = curve = _curves(folder, [walk for walk in walks if walk is not asking], asking)
        [whole], at = curve["whole"], LOSSES.index(LOSS)
        facts = {how: [vars(one) for one in points] for how, points in curve.items()}
        name = f"R@1 of {asking.path.stem} in the condensed map of the others, share of the whole map's"
        yield Figure(name, curve["condense"][at].r_at_1 / whole.r_at_1, BAR, False, facts)
    _draw(folder, curves)


def _read(name: str) -> Walk:
    data = Path(os.environ.get("VPLOG_DATA", Path(__file__).parents[3] / "shared" / "data")) / "drives"
    path, pipeline = data / f"{name}.mcap", load_pipeline("default")
    if not path.exists():
        raise SystemExit(f"there is no {path}: set VPLOG_DATA to the folder with the real drives")
    log = logs.open(path)
    stamps, _, _ = select_views(log, pipeline.keyframes)
    found = extract_frames(log.frames(stamps), pipeline.features, Execution())
    features = [one for _, _, one, _ in found if one is not None]
    return Walk(path, features, np.searchsorted(log.stamps(), stamps))


def _curves(folder: Path, walks: Sequence[Walk], asking: Walk) -> dict[str, list[Point]]:
    """The whole map, and what is left of it at each loss, by how it was chosen."""
    library, made, pipeline = folder / f"{asking.path.stem}-others", folder / "small", load_pipeline("default")
    if not (library / "library.json").exists():
        build_library([walk.path for walk in walks], library, pipeline)
    state: Any = pipeline.places.load(library, Execution())
    places = _places(state, walks)
    column, near = pa.concat_arrays(places.columns), np.abs(places.keyframe - asking.frame[:, None]) <= TOLERANCE
    answers = query_own_places(places, search_in_memory(places, state), state, TOLERANCE)

    def point(references: Ints, kept: Ints) -> Point:
        less = state.subset(references, Execution())
        less.save_small(made)
        index = less.index(less.from_arrow(state.on_subset(column.take(pa.array(kept)), references)))
        asked = Execution().map(less.describe, asking.features)
        best = np.array([kept[index.scores(one).argmax()] for one in asked])
        return Point(len(references), len(kept), _mb(made, column, len(kept)), _recall(near, best))

    every, count = np.arange(state.shape[0]), len(places.drive)
    whole = point(every, np.arange(count))
    curve = {"whole": [Point(len(every), count, _mb(library, column, count), whole.r_at_1)]}
    curve |= {"condense": [], "random": [], "even": []}
    for loss in LOSSES:
        found = condense_places(places, answers, state, TOLERANCE, loss)
        kept = np.flatnonzero(found.retained)
        small: Any = found.state
        stamps = {(one.drive, one.stamp_ns) for one in small.references}
        own = np.flatnonzero([(one.drive, one.stamp_ns) in stamps for one in state.references])
        curve["condense"].append(point(own, kept))
        drawn = [point(*_drawn(seed, (len(every), len(own)), (count, len(kept)))) for seed in range(SEEDS)]
        mean = [float(np.mean([getattr(one, name) for one in drawn])) for name in ("mb", "r_at_1")]
        curve["random"].append(Point(len(own), len(kept), *mean))
        curve["even"].append(point(_even(len(every), len(own)), _even(count, len(kept))))
    return curve


def _places(state: Any, walks: Sequence[Walk]) -> OwnPlaces:
    columns = [state.to_arrow(list(Execution().map(state.describe, walk.features))) for walk in walks]
    keyframe = np.concatenate([walk.frame for walk in walks])
    pose = np.tile(np.eye(4), (len(keyframe), 1, 1))
    pose[:, 0, 3] = keyframe
    drive = np.repeat(np.arange(len(walks)), list(map(len, columns)))
    names = [walk.path.stem for walk in walks]
    return OwnPlaces(names, columns, keyframe.astype(np.int32), drive, np.zeros(len(keyframe), np.int64), pose)


def _mb(library: Path, column: pa.Array, places: int) -> float:
    """Of the library's files, and so many places as they are without compression."""
    return (sum(file.stat().st_size for file in library.iterdir()) + column.nbytes / len(column) * places) / 1e6


def _recall(near: Bools, best: Ints) -> float:
    """Share of the queries that have a match in the whole map whose best place is one."""
    return float(near[np.arange(len(best)), best][near.any(axis=1)].mean())


def _drawn(seed: int, *sizes: tuple[int, int]) -> list[Ints]:
    rng = np.random.default_rng(seed)
    return [np.sort(rng.choice(count, left, replace=False)) for count, left in sizes]


def _even(count: int, left: int) -> Ints:
    """So many, at even steps along the drives."""
    return np.linspace(0, count - 1, left).round().astype(int)


def _draw(folder: Path, curves: dict[str, dict[str, list[Point]]]) -> None:
    colours = {"condense": "#d62728", "even": "#1f77b4", "random": "#7f7f7f", "whole": "#000000"}
    with saved_figure(folder, "condense", 11.0, 4.0, ("png",)) as figure:
        for axes, (walk, curve) in zip(figure.subplots(1, len(curves), sharey=True), curves.items(), strict=True):
            for how, colour in colours.items():
                axes.plot(
                    *zip(*((one.mb, one.r_at_1) for one in curve[how]), strict=True),
                    "o-", color=colour, label=how, markersize=3,
                )  # fmt: skip
            at = curve["condense"][LOSSES.index(LOSS)]
            axes.plot(at.mb, at.r_at_1, "*", color=colours["condense"], markersize=11, label=f"loss {LOSS}")
            axes.set(
                title=f"{walk} in the others",
                xlabel="library and places of the map, MB",
                xlim=(0, None),
                ylim=(0, 1.02),
            )
            axes.grid(alpha=0.3)
        figure.axes[0].set_ylabel("R@1")
        figure.axes[0].legend(loc="lower right")
