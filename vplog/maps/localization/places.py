"""The places of a run or a map that pictures are looked for among, with their poses and landmarks."""

from __future__ import annotations

import os
import time
import weakref
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass, replace
from functools import cache, lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from vplog.data import Floats, Int32s, Ints
from vplog.errors import LibraryError, LogError, ResultError
from vplog.execution.execution import Execution
from vplog.geometry import se3
from vplog.loops.candidate import Drive
from vplog.loops.localize import KeyframeLandmarks
from vplog.loops.verify import VerifySettings
from vplog.maps.geo_bounds import earth_of_run
from vplog.maps.joining.drive_pairs import known_camera
from vplog.maps.joining.joint_record import Component, joint_components, keyframe_poses
from vplog.maps.joining.members import member_of, opened_drive, untried_camera
from vplog.maps.search.exact import NO_SCORE, best_places
from vplog.maps.search.index import SegmentView, pictures_of, update_index
from vplog.maps.search.query import open_map
from vplog.maps.search.sequences import LineSearch, best_lines
from vplog.maps.storage import map_store
from vplog.maps.storage.contents import damage_warnings, skip_damaged
from vplog.maps.storage.damage import reading_drive
from vplog.maps.storage.layout import PICTURES, PLACES_ONLY
from vplog.maps.storage.map_store import Store
from vplog.pipeline import Pipeline, recorded_pipeline
from vplog.results import run_record, tables
from vplog.results.geo import Earth
from vplog.results.landmark_table import LandmarkTable
from vplog.results.run_cameras import camera_pictures
from vplog.run.landmarks import landmark_key, landmarks_file, run_drive, write_drive_landmarks
from vplog.run.provenance import library_at
from vplog.stages import CodedState, PlaceState
from vplog.storage.json_records import key_of
from vplog.storage.remote_path import RemotePath, original
from vplog.storage.scratch import scratch

Likely = list[list[tuple[int, int]]]
"""Drive and row in `Landmarked` of the likeliest places of each of some pictures, best first."""

_AWAY_S = 300.0
"""s after which a drive is looked for again whose log was not there."""
_LOADED = 32
"""Drives of a map whose landmarks stay open between pictures, each with up to 20 MB and a file for each camera."""


@dataclass(frozen=True, eq=False)
class Landmarked:
    """The pictures of one drive, with their landmarks: of the first camera at each of N keyframes, then of each further
    one those with a descriptor."""

    keyframe: Ints
    """(P,) rows of the keyframes."""
    camera: Ints
    """(P,) numbers."""
    world_from_body: Floats
    """(P, 4, 4) at the stamps of the pictures."""
    earth: Earth | None
    """Pose on earth of the frame of these poses; None without satellite fixes."""
    tables: Mapping[int, LandmarkTable]
    """Landmarks of each camera, by its number."""

    def landmarks(self, row: int, settings: VerifySettings) -> KeyframeLandmarks:
        """The landmarks of a picture. Raises ResultError where their file is damaged."""
        table = self.tables[int(self.camera[row])]
        (features, sigma), camera = table[row - self._of_its_camera(row).start], table.camera
        measured, pixel_sigma = table.scale != "odometry", settings.landmarks.pixel_sigma
        world_from_camera = self.world_from_body[row] @ camera.body_from_camera
        return KeyframeLandmarks(world_from_camera, features, sigma, camera, pixel_sigma, measured)

    def around(self, row: int, count: int) -> range:
        """Up to so many pictures of the same camera before and after one, and itself."""
        own = self._of_its_camera(row)
        return range(max(row - count, own.start), min(row + count + 1, own.stop))

    def _of_its_camera(self, row: int) -> range:
        ends = (np.searchsorted(self.camera, self.camera[row], side) for side in ("left", "right"))
        return range(*map(int, ends))


Search = Callable[[Sequence[Any], int], tuple[Likely, dict[int, Landmarked]]]
"""The likeliest places for each of some descriptors, so many at most, and the drives that these are in, by number.
Raises VplogError."""


@dataclass(frozen=True, eq=False)
class PlacesOfDrive:
    """One drive, which is read when a picture may be in it: a map has thousands."""

    name: str
    frame: str
    """Frame of its poses: the first of the drives that closures join with it."""
    load: Callable[[], Landmarked]
    """Its keyframes, with landmarks that are made where they are not stored. Raises VplogError."""


@dataclass(frozen=True, eq=False)
class Places:
    """The run or map in which pictures are localised."""

    name: str
    state: PlaceState
    pipeline: Pipeline
    drives: Sequence[PlacesOfDrive]
    search: Search
    warnings: list[str]


def opened(root: Path, execution: Execution) -> AbstractContextManager[Places]:
    """A run folder or a map. Raises VplogError where it is neither, or a map by URL."""
    if isinstance(root, RemotePath):
        raise ResultError(f"{root} is read from a local folder to localise in it. Copy it to this machine.")
    return _of_map(root, execution) if (root / "map.json").exists() else _of_run(root, execution)


@contextmanager
def _of_run(folder: Path, execution: Execution) -> Iterator[Places]:
    record = run_record.read_single_run(folder)
    pipeline = recorded_pipeline(folder, record)
    with library_at(folder, record) as library:
        state = pipeline.places.load(library, Execution(execution.threads))
    column, made_by = tables.read_descriptors(folder / "descriptors.parquet")
    if made_by != state.hash:
        raise LibraryError(f"{original(library)} is not the library of the run in {folder}, so nothing is found in it.")
    pictures = tables.read_pictures(folder / "descriptors.parquet")
    index = state.index(state.from_arrow(column))
    keyframes, world_from_body = tables.read_keyframes(folder / "keyframes.parquet")
    row_of = _landmark_rows(pictures, len(world_from_body))

    with ExitStack() as stack:
        spare = _spare(stack)

        def table(camera: int) -> LandmarkTable:
            key = landmark_key(folder, record, pipeline, camera)
            drive = partial(run_drive, folder, record, pipeline, camera, execution)
            return _stored_or_made(folder / landmarks_file(camera), key, drive, spare, execution)

        @cache
        def load() -> Landmarked:
            return _landmarked(folder, world_from_body, earth_of_run(folder), pictures, table)

        def search(descriptors: Sequence[Any], top: int) -> tuple[Likely, dict[int, Landmarked]]:
            found = execution.map(lambda one: index.query(one, top).rows, descriptors)
            likely = [[(0, row) for row in row_of[rows].tolist()] for rows in found]
            return likely, {0: load()} if any(likely) else {}

        stack.callback(load.cache_clear)
        own = PlacesOfDrive(keyframes.drive, keyframes.drive, load)
        yield Places(str(folder), state, pipeline, [own], search, run_record.unit_warnings(record))


@contextmanager
def _of_map(root: Path, execution: Execution) -> Iterator[Places]:
    with map_store.reading(root) as store, ExitStack() as stack:
        known, pipeline, state = open_map(store, execution)
        joint, spare = joint_components(store), _spare(stack)

        @lru_cache(_LOADED)
        def load(name: str, first: str) -> Landmarked:
            earth, pictures = _map_earth(store, joint, first), pictures_of(store, name)
            table = partial(_map_landmarks, store, known[name], pipeline, spare, execution)
            with reading_drive(name):
                return _landmarked(store.run(name), keyframe_poses(store, joint, name), earth, pictures, table)

        stack.callback(load.cache_clear)
        first = {name: joint[name].drives[0] if name in joint else name for name in known}
        drives = [PlacesOfDrive(name, first[name], partial(load, name, first[name])) for name in known]
        warnings: list[str] = []
        search = _map_search(store, known, drives, state, warnings, execution)
        yield Places(str(store), state, pipeline, drives, search, warnings)


def _map_earth(store: Store, joint: Mapping[str, Component], first: str) -> Earth | None:
    """The georeference of the frame of a drive and those joined with it, by its own run's."""
    earth = store.earth(first)
    if earth is None or first not in joint:
        return earth
    own = keyframe_poses(store, {}, first)[0] @ se3.inverse(keyframe_poses(store, joint, first)[0])
    return replace(earth, enu_from_world=earth.enu_from_world @ own)


def _map_search(
    store: Store, known: Mapping[str, Mapping[str, Any]], drives: Sequence[PlacesOfDrive], state: PlaceState,
    warnings: list[str], execution: Execution,
) -> Search:  # fmt: skip
    """The search for single views in all drives that have landmarks or the log to make them, and are not damaged;
    `warnings` names those that have lost their log or are damaged, as they are found."""
    parts, problems, lost, lost_at = list[SegmentView](), list[str](), dict[str, str](), dict[str, float]()
    poseless = [name for name, about in known.items() if about.get(PICTURES) or PLACES_ONLY in about]
    number = {name: at for at, name in enumerate(known)}

    def indexed(state: CodedState) -> tuple[list[SegmentView], list[str]]:
        there = {name: about for name, about in known.items() if name not in store.damaged}
        found, problems = update_index(store, there, state, execution)
        number_of = np.array([*map(number.__getitem__, there), -1], np.int32)  # -1 stays
        return [replace(part, numbers=number_of[part.numbers]) for part in found], problems

    if isinstance(state, CodedState):
        parts, problems = skip_damaged(store, lambda: indexed(state))
    warnings += [*problems, *damage_warnings(store)]

    def search(descriptors: Sequence[Any], top: int) -> tuple[Likely, dict[int, Landmarked]]:
        def attempt() -> tuple[Likely, dict[int, Landmarked]] | None:
            """None where a drive has lost its log."""
            without = {*poseless, *store.damaged, *lost}
            there = {at: name for name, at in number.items() if name not in without}
            if isinstance(state, CodedState):
                found = best_places([one.of(there) for one in parts], state, descriptors, top, execution)
            else:
                found = best_lines(store, there, state, descriptors, top, LineSearch(), execution)
            for at in np.unique(found.drive[found.score > NO_SCORE]).tolist():
                own = (found.drive == at) & (found.score > NO_SCORE)
                name = drives[at].name
                row_of = _landmark_rows(pictures_of(store, name), store.rows("keyframes", name))
                found.keyframe[own] = row_of[found.keyframe[own]]
            rows = zip(found.drive.tolist(), found.keyframe.tolist(), found.count.tolist(), strict=True)
            likely = [list(zip(drive[:count], row[:count], strict=True)) for drive, row, count in rows]
            loaded = dict[int, Landmarked]()
            for at in sorted({drive for one in likely for drive, _ in one}):
                try:
                    loaded[at] = drives[at].load()
                except LogError as error:  # its log is gone, and it has no landmarks
                    lost[drives[at].name] = f"{drives[at].name} is left out. {error}"
                    lost_at[drives[at].name] = time.monotonic()
            return (likely, loaded) if lost.keys() <= without else None

        for name in [name for name in lost if time.monotonic() - lost_at[name] > _AWAY_S]:
            del lost[name]  # a disk or a server may be there again
        while (found := skip_damaged(store, attempt)) is None:
            pass
        warnings[:] = [*problems, *damage_warnings(store), *lost.values()]
        return found

    return search


def _landmark_rows(pictures: tuple[Int32s, Int32s], keyframes: int) -> Ints:
    """(D,) rows in `Landmarked` of the pictures with a descriptor, of a drive with so many keyframes."""
    keyframe, camera = pictures
    further = np.cumsum(camera > 0) - 1
    return np.where(camera == 0, keyframe, keyframes + further)


def _landmarked(
    folder: Path, world_from_body: Floats, earth: Earth | None, pictures: tuple[Int32s, Int32s],
    table: Callable[[int], LandmarkTable],
) -> Landmarked:  # fmt: skip
    """The pictures of a drive whose tables are in a folder, with the landmarks of each camera by `table`; the poses
    (N, 4, 4) are those of its keyframes."""
    cameras = [0, *np.unique(pictures[1][pictures[1] > 0]).tolist()]
    known = [camera_pictures(folder, camera) for camera in cameras]
    odometry = known[0].keyframes.odom_from_body
    poses = [world_from_body[row] @ se3.between(odometry[row], own.odom_from_body) for row, own in known]
    row = np.concatenate([own.row for own in known])
    camera = np.repeat(cameras, [len(own.row) for own in known])
    with ExitStack() as stack:
        landmarks = {camera: stack.enter_context(closing(table(camera))) for camera in cameras}
        found = Landmarked(row, camera, np.concatenate(poses), earth, landmarks)
        weakref.finalize(found, stack.pop_all().close)  # when the last picture that is looked for in it is answered
    return found


def _map_landmarks(
    store: Store, about: dict[str, Any], pipeline: Pipeline, spare: Callable[[], Path], execution: Execution,
    camera: int,
) -> LandmarkTable:  # fmt: skip
    """The landmarks of a camera of a drive of a map, beside its features for joins."""
    of_drive = member_of(store, about)
    member = of_drive.of_camera(camera)
    folder = store.run(about["drive"])
    record = run_record.read_run_json(folder / "run.json")
    key = key_of([landmark_key(folder, record, member.pipeline, camera), member.key])

    @contextmanager
    def drive() -> Iterator[Drive]:
        trust = known_camera(store, of_drive, pipeline)
        known = untried_camera(member) if trust is None else trust.each[camera]
        with opened_drive(member, known, member.pipeline.verify, execution) as (found, fetch):
            fetch(np.arange(len(found.keyframes.stamp_ns)))
            yield found

    return _stored_or_made(member.features.with_name(landmarks_file(camera)), key, drive, spare, execution)


def _spare(stack: ExitStack) -> Callable[[], Path]:
    """The scratch folder for landmarks that cannot be stored, made when the first are, until the stack closes."""
    return cache(lambda: stack.enter_context(scratch("landmarks")))


def _stored_or_made(
    path: Path, key: str, drive: Callable[[], AbstractContextManager[Drive]], spare: Callable[[], Path],
    execution: Execution,
) -> LandmarkTable:  # fmt: skip
    """The landmarks in a file; made there first unless it is of this key, or in the spare folder where it cannot be."""
    with suppress(ResultError):
        return LandmarkTable(path, key)
    above = next(folder for folder in path.parents if folder.is_dir())
    if not os.access(above, os.W_OK):
        path = spare() / path.parent.name / path.name
        with suppress(ResultError):
            return LandmarkTable(path, key)
    with drive() as found:
        write_drive_landmarks(path, found, key, execution)
    return LandmarkTable(path, key)
