"""The places of a map as queries of itself: each is looked for among all others, of every drive."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
from scipy.spatial import KDTree

from vplog.data import Bools, Floats, Int32s, Ints, Ranking
from vplog.errors import ResultError
from vplog.execution.execution import Execution
from vplog.geometry import se3
from vplog.maps.condensation.redundancy import OwnQueries
from vplog.maps.joining.joint_record import joint_components, keyframe_poses
from vplog.maps.search.exact import RankedPlaces, best_places, merge, no_answers
from vplog.maps.search.index import SegmentView, pictures_of, read_column, update_index
from vplog.maps.search.segment import Segment
from vplog.maps.storage.layout import PICTURES
from vplog.maps.storage.map_store import Store
from vplog.stages import CodedState, PlaceState, index_of_part

Search = Callable[[Sequence[Any], int], RankedPlaces]
"""The best places of a map for some views (V,), as many as the number given for each."""

BEST = 16
"""Best places that are searched for each query at first: 192 bytes, as much as the codes of one."""
PASSES = 3
"""Later drives that pass a place and do not find it, after which it counts as faded: fewer may all be in bad
light."""
HEADING_DEG = 45.0
"""Largest angle of rotation between the poses of a place and of a later drive that passes it."""


@dataclass(frozen=True, eq=False)
class OwnPlaces:
    """The N places of a map, drive after drive."""

    drives: list[str]
    """In the map's order where closures join them."""
    columns: list[pa.Array]
    """Descriptors of each drive's places."""
    keyframe: Int32s
    """(N,) row of the drive's keyframes."""
    drive: Ints
    """(N,) number of the drive."""
    frame: Ints
    """(N,) number of the coordinate frame of the pose and the camera: drives that closures join share a frame; -1
    without a pose."""
    pose: Floats
    """(N, 4, 4) world_from_body."""
    spacing_m: float = 0.0
    """Median distance in m of consecutive keyframes with a pose."""

    @property
    def first(self) -> Ints:
        """(D + 1,) number of each drive's first place, and of all places."""
        return np.cumsum([0, *map(len, self.columns)])

    def same_place(self, distance_m: float) -> Callable[[int, Int32s | Ints], Bools]:
        """Whether others are within a distance of a place, in one frame."""
        position = self.pose[:, :3, 3]

        def same(place: int, others: Int32s | Ints) -> Bools:
            near = np.linalg.norm(position[others] - position[place], axis=1) <= distance_m
            return near & (self.frame[others] == self.frame[place]) & (self.frame[place] >= 0)

        return same

    def steps_m(self) -> Floats:
        """(N,) distance of each place from the one before; 0 of the first of a drive."""
        step = np.linalg.norm(np.diff(self.pose[:, :3, 3], axis=0, prepend=self.pose[:1, :3, 3]), axis=1)
        return np.where(np.diff(self.drive, prepend=-1) == 0, step, 0.0)


def read_own_places(store: Store, drives: Mapping[str, Mapping[str, Any]], state: PlaceState) -> OwnPlaces:
    """All places of a map, with their poses in the frame of the drives that closures join. Raises ResultError."""
    joint = joint_components(store)
    after = {drive: number for number, drive in enumerate(joint)}  # in the map's order, so that later ones are known
    names = sorted(drives, key=lambda drive: (after.get(drive, len(after)), drive))
    columns, keyframes, poses, frames, steps = [], [], [], [], [np.empty(0)]
    numbers: dict[Any, int] = {}
    for drive in names:
        columns.append(read_column(store, drive, state))
        keyframe, camera = pictures_of(store, drive)
        known = keyframe_poses(store, joint, drive)
        if len(keyframe) and keyframe.max() >= len(known):
            wrong = f"{store} has more keyframes of {drive} than the graph that joins it."
            raise ResultError(f"{wrong} Join the drives again: vplog map join {store}")
        where = joint[drive].drives[0] if drive in joint else drive
        # two cameras at one place show different things
        frame = [numbers.setdefault((where, one), len(numbers)) for one in camera.tolist()]
        keyframes.append(keyframe)
        poses.append(known[keyframe])
        posed = not drives[drive].get(PICTURES)
        frames.append(np.where(posed, np.array(frame, np.int64), -1))
        if posed:
            steps.append(np.linalg.norm(np.diff(known[:, :3, 3], axis=0), axis=1))
    number = np.repeat(np.arange(len(names)), list(map(len, columns)))
    keyframe, frame, pose = (np.concatenate(parts) for parts in (keyframes, frames, poses))
    step = np.concatenate(steps)
    return OwnPlaces(names, columns, keyframe, number, frame, pose, float(np.median(step)) if len(step) else 0.0)


def search_of(
    store: Store, about: Mapping[str, Mapping[str, Any]], places: OwnPlaces, state: PlaceState,
    execution: Execution = Execution(),
) -> tuple[Search, list[str]]:  # fmt: skip
    """The search for single views in a map, by its index where the recogniser has one, and warnings."""
    if isinstance(state, CodedState):
        parts, warnings = update_index(store, {drive: about[drive] for drive in places.drives}, state, execution)
        threads = Execution(execution.threads)
        return lambda views, top: best_places(parts, state, views, top, threads), warnings
    return search_in_memory(places, state), []


def search_in_memory(places: OwnPlaces, state: PlaceState, execution: Execution = Execution()) -> Search:
    """The search for single views by inverted lists where the recogniser has them, else by an index of each drive."""
    if isinstance(state, CodedState):
        segment = Segment("", (), places.first, state.lists(*places.columns))
        part = SegmentView(segment, None, np.arange(len(places.drives), dtype=np.int32))
        threads = Execution(execution.threads)
        return lambda views, top: best_places([part], state, views, top, threads)
    indexes = [index_of_part(state, state.from_arrow(column)) for column in places.columns]

    def by_drive(views: Sequence[Any], top: int) -> RankedPlaces:
        best = no_answers(len(views), top)
        for number, index in enumerate(indexes):
            found = no_answers(len(views), top)
            found.drive[:] = number
            for view, descriptor in enumerate(views):
                one = index.query(descriptor, top)
                found.keyframe[view, : len(one.rows)], found.score[view, : len(one.rows)] = one.rows, one.score
            best = merge([best, found], top)
        return best

    return by_drive


@dataclass(frozen=True, eq=False)
class OwnAnswers:
    """Answers of a map to its own places as queries."""

    place: Ints
    """(Q,) places that are answered rightly."""
    queries: OwnQueries
    faded: Bools
    """(N,) places that `PASSES` later drives came by, of which none has it among its best."""


def query_own_places(
    places: OwnPlaces, search: Search, state: PlaceState, distance_m: float, execution: Execution = Execution()
) -> OwnAnswers:
    """Look for every place among the others; an answer within the distance is right."""
    first, same = places.first, places.same_place(distance_m)
    matched, best = np.zeros(len(places.drive), np.bool_), dict[int, Ranking]()

    def ranked_others(rows: Ints, top: int) -> list[Ranking]:
        """The best of all other places for each of some rows of one drive."""
        number = int(places.drive[rows[0]])
        column = places.columns[number].take(pa.array(rows - first[number]))
        found, known = search(state.from_arrow(column), min(top + 1, len(places.drive))), []
        for at, row in enumerate(rows.tolist()):
            count = int(found.count[at])
            others = first[found.drive[at, :count]] + found.keyframe[at, :count]
            other = others != row
            known.append(Ranking(others[other].astype(np.int32), found.score[at, :count][other]))
        return known

    for number in execution.counted("query", range(len(places.drives)), len(places.drives)):
        rows = np.arange(first[number], first[number + 1])
        rows = rows[places.frame[rows] >= 0]
        for row, found in zip(rows.tolist(), ranked_others(rows, BEST) if len(rows) else [], strict=True):
            right = same(row, found.rows)
            matched[found.rows[right & (places.drive[found.rows] < number)]] = True
            if right[:1].any():
                best[row] = found
    place = np.array(sorted(best), np.int64)
    queries = OwnQueries(
        [best[row] for row in place.tolist()],
        lambda query, top: ranked_others(place[query : query + 1], top)[0],
        lambda query, others: same(int(place[query]), others),
    )
    return OwnAnswers(place, queries, (later_passes(places, distance_m) >= PASSES) & ~matched)


def near_another(places: OwnPlaces, distance_m: float) -> Bools:
    """(N,) places with another within the distance."""
    found = np.zeros(len(places.drive), np.bool_)
    for frame in np.unique(places.frame[places.frame >= 0]).tolist():
        rows = np.flatnonzero(places.frame == frame)
        position = places.pose[rows, :3, 3]
        found[rows] = KDTree(position).query(position, 2)[0][:, 1] <= distance_m
    return found


def later_passes(places: OwnPlaces, distance_m: float) -> Ints:
    """(N,) later drives that came by each place, within the distance and looking the same way."""
    passes = np.zeros(len(places.drive), np.int64)
    for frame in np.unique(places.frame[places.frame >= 0]).tolist():
        rows = np.flatnonzero(places.frame == frame)
        if len(np.unique(places.drive[rows])) <= PASSES:
            continue
        position, turn = places.pose[rows, :3, 3], places.pose[rows, :3, :3]
        for at, near in enumerate(KDTree(position).query_ball_point(position, distance_m)):
            later = np.array([one for one in near if places.drive[rows[one]] > places.drive[rows[at]]], np.int64)
            facing = se3.angle(turn[at].T @ turn[later]) <= np.radians(HEADING_DEG)
            passes[rows[at]] = len(np.unique(places.drive[rows[later[facing]]]))
    return passes
