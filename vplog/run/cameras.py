"""Several cameras on one body: their pictures at the keyframes, and the closures between pictures of any two of them.

A keyframe has one pose, and a picture of each camera near its stamp. Every picture is described and verified as its own
camera has it; its closure is carried to the keyframes by the odometry of the moment between the stamps.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from vplog import logs
from vplog.data import Bytes, Camera, Closures, Ints, Keyframes, Odometry, Reference, Verdict
from vplog.errors import LogError
from vplog.execution.execution import Execution
from vplog.execution.run_warnings import warn
from vplog.geometry import se3
from vplog.loops.propose import Proposals, ProposeSettings, candidate_stops, propose
from vplog.loops.verify import VerifySettings, verify_between
from vplog.loops.verify_rig import Rig, verify_together
from vplog.places.reference_choice import LibrarySettings
from vplog.places.sequence import SequenceSettings, rank_places
from vplog.places.vectors import VectorsSettings
from vplog.results.run_cameras import CameraPictures
from vplog.run.cache.codecs import closures_codec
from vplog.run.cache.steps import Steps, step
from vplog.run.feature_extraction import Extraction, decoded, extract
from vplog.run.keyframes import KeyframeSettings, is_covered
from vplog.run.place_recognition import describe, shared_of
from vplog.run.reference_library import own_images, own_references
from vplog.run.verification import DriveFeatures, calibrated, for_verification, merged
from vplog.stages import Log, PlaceState
from vplog.storage.input_hashes import files_of

if TYPE_CHECKING:
    from vplog.places import PlaceSettings

VIEW_BY_VIEW = SequenceSettings(length=1)
"""Between two cameras the places of a way may come in either order."""


class RigSettings(Extraction, Protocol):
    """The settings that these steps take, as the pipeline has them."""

    @property
    def library(self) -> LibrarySettings: ...
    @property
    def places(self) -> PlaceSettings: ...
    @property
    def propose(self) -> ProposeSettings: ...
    @property
    def sequence(self) -> SequenceSettings: ...
    @property
    def verify(self) -> VerifySettings: ...


@dataclass(frozen=True, eq=False)
class View:
    """The pictures of one camera of the body."""

    log: Log
    """The log with this camera's images as its own."""
    pictures: DriveFeatures
    """V pictures: their stamps, the odometry's poses there, and their features."""
    row: Ints
    """(V,) keyframe of each picture, increasing."""
    images: Sequence[tuple[int, Bytes]] = ()
    """Row (of the V) and image of those that become references."""
    places: Sequence[Any] = ()
    """(V,) descriptors, once they are described."""

    @classmethod
    def of(cls, log: Log, drive: DriveFeatures, places: Sequence[Any]) -> View:
        """The view of the first camera, by whose stamps the keyframes are selected."""
        return cls(log, drive, np.arange(len(drive.keyframes.stamp_ns)), places=places)

    @property
    def camera(self) -> Camera:
        return self.pictures.camera

    @property
    def references(self) -> list[Reference]:
        return own_references(self.pictures.keyframes, self.pictures.features, self.images)

    def at(self, keyframe: int) -> int:
        """The picture of a keyframe that has one."""
        return int(np.searchsorted(self.row, keyframe))


@step("cameras")
def read_cameras(
    log: Log, others: Mapping[str, logs.TopicChoice], odometry: Odometry, keyframes: Keyframes, settings: RigSettings,
    own_library: bool, *, steps: Steps, execution: Execution,
) -> list[View]:  # fmt: skip
    """The pictures of the other cameras, extracted; a camera that cannot be used is left out with a warning."""
    found = list[View]()
    if isinstance(settings.places, VectorsSettings):
        warn(f"{', '.join(others)} not used: vectors from a file do not say of which camera they are.")
        return found
    for topic, choice in others.items():
        try:
            other = logs.open_drive(files_of(steps.cache.drive), choice)
            row, selected = pictures_at(keyframes, other.stamps(), odometry, settings.keyframes)
            features = extract(other, choice, selected, settings, steps=steps, execution=execution)
            pictures, features = decoded(selected, features, settings.features, odometry, topic)
            camera = other.camera()
            chosen = (other, pictures, features, settings.library)
            images = steps.part(own_images, *chosen) if own_library else ()
        except LogError as error:
            warn(f"Camera {topic} is not used: {error}")
            continue
        row = row[np.searchsorted(selected.stamp_ns, pictures.stamp_ns)]
        found.append(
            View(other, DriveFeatures(pictures, camera, features, settings.verify, odometry.trajectory), row, images)
        )
        for warning in other.warnings:
            if warning not in log.warnings:
                warn(warning)
    return found


def pictures_at(
    keyframes: Keyframes, stamp_ns: Ints, odometry: Odometry, settings: KeyframeSettings
) -> tuple[Ints, Keyframes]:
    """Rows of the keyframes that have a picture among those with these (F,) stamps no further than their period away,
    and these pictures, each of the nearest keyframe alone. Raises LogError where there are fewer than two."""
    stamp_ns = stamp_ns[is_covered(stamp_ns, odometry, settings)]
    if len(stamp_ns) < 2:
        raise LogError(f"{len(stamp_ns)} of its images have odometry at their stamps.")
    after = np.clip(np.searchsorted(stamp_ns, keyframes.stamp_ns), 1, len(stamp_ns) - 1)
    before_is_nearer = keyframes.stamp_ns - stamp_ns[after - 1] <= stamp_ns[after] - keyframes.stamp_ns
    nearest = after - before_is_nearer
    apart_ns = np.abs(stamp_ns[nearest] - keyframes.stamp_ns)
    row = np.flatnonzero(apart_ns <= np.median(np.diff(stamp_ns)))
    row = row[np.lexsort([apart_ns[row], nearest[row]])]
    taken, first = np.unique(nearest[row], return_index=True)
    if len(taken) < 2:
        raise LogError(f"{len(taken)} of its images are near the stamp of a keyframe.")
    poses = se3.interpolate_at(odometry.stamp_ns, odometry.odom_from_body, stamp_ns[taken])
    return row[first], Keyframes(keyframes.drive, stamp_ns[taken], poses)


@step("describe_cameras")
def describe_cameras(views: Sequence[View], state: PlaceState, *, steps: Steps) -> list[View]:
    """The views with a descriptor for each picture."""
    return [replace(view, places=steps.part(describe, state, view.log, view.pictures.features)) for view in views]


@step("verify_cameras")
def verify_cameras(
    closures: Closures, views: Sequence[View], state: PlaceState, settings: RigSettings,
    *, steps: Steps, execution: Execution,
) -> Closures:  # fmt: skip
    """The ledger of the first camera with the candidates of all other pairs of cameras, each pair of keyframes once: as
    the two cameras have it with which it is accepted with most inliers."""
    ledgers, indexes = [closures], [state.index(view.places) for view in views]
    shares = [calibrated(view.pictures, steps) for view in views]
    for q, later in enumerate(views):
        found = dict[int, Proposals]()
        for m, earlier in enumerate(views):
            if q == m == 0:  # of the first camera they are verified already
                continue
            sequence = settings.sequence if q == m else VIEW_BY_VIEW
            stops = _stops(later, earlier, settings.propose)
            ranked = rank_places(indexes[m], later.places, stops, settings.propose.ranked, sequence, execution)
            found[m] = propose(ranked, settings.propose)
        own = {q: found.pop(q)} if q else {}
        for m, proposals in (own | best_together(found, settings.propose.per_query)).items():
            if len(proposals.query):
                share = max(shares[q], shares[m])
                ledger = steps.part(verify_pair, proposals, share, later.pictures, views[m].pictures)
                ends = [CameraPictures(one.row, one.pictures.keyframes) for one in (later, views[m])]
                ledgers.append(of_keyframes(ledger, ends, (q, m), [views[0].pictures.keyframes] * 2))
    closures, drives = once(ledgers), [view.pictures for view in views]
    return steps.part(verify_by_all, closures, drives, [view.row for view in views], max(shares))


def best_together(found: dict[int, Proposals], count: int) -> dict[int, Proposals]:
    """The best of the candidates in all other cameras together, so many of each query: with six cameras there are not
    six times as many to verify."""
    query, score = (np.concatenate([getattr(one, name) for one in found.values()]) for name in ("query", "score"))
    order = np.lexsort([-score, query])
    place = np.empty(len(order), np.int64)
    place[order] = np.arange(len(order)) - np.searchsorted(query[order], query[order])
    ends = np.cumsum([len(one.query) for one in found.values()])[:-1]
    best = np.split(place < count, ends)
    return {m: one.rows(rows) for (m, one), rows in zip(found.items(), best, strict=True)}


@step("verify", lambda *_: closures_codec())
def verify_pair(
    proposals: Proposals, share: float, later: DriveFeatures, earlier: DriveFeatures, *, execution: Execution
) -> Closures:
    """The ledger of candidates between the pictures of two cameras."""
    return verify_between(proposals, for_verification(later), for_verification(earlier), execution, share)


@step("verify", lambda *_: closures_codec())
def verify_by_all(
    closures: Closures, cameras: Sequence[DriveFeatures], rows: Sequence[Ints], share: float, *, execution: Execution
) -> Closures:
    """The ledger of `loops.verify_rig.verify_together`; `rows` are the keyframes of the pictures of each camera."""
    rig = Rig([for_verification(one) for one in cameras], rows, share)
    found = verify_together(closures, rig, execution)
    return merged(found, _numbered(found)) if found else closures


def _stops(later: View, earlier: View, settings: ProposeSettings) -> Ints:
    """(V,) int64: picture i of the later view may match pictures of the earlier one below stops[i] only, as early as
    those of its own camera that it may match."""
    stops, stamp_ns = candidate_stops(later.pictures.keyframes, settings), later.pictures.keyframes.stamp_ns
    latest = stamp_ns[np.maximum(stops - 1, 0)]
    found = np.searchsorted(earlier.pictures.keyframes.stamp_ns, latest, side="right")
    return np.where(stops > 0, found, 0).astype(np.int64)


def of_keyframes(
    found: Closures, pictures: Sequence[CameraPictures], cameras: tuple[int, int], keyframes: Sequence[Keyframes]
) -> Closures:
    """The ledger of two cameras with rows, poses and information of keyframes instead of pictures: of those of the
    queries, then of those of the matches."""
    (query, to_query), (match, to_match) = (
        (own.row[rows], se3.between(drive.odom_from_body[own.row[rows]], own.keyframes.odom_from_body[rows]))
        for own, drive, rows in zip(pictures, keyframes, (found.query, found.match), strict=True)
    )
    Ad = se3.adjoint(se3.inverse(to_query))  # T exp(d) inv(Q) = T inv(Q) exp(Ad_Q d)
    return replace(
        found,
        query=query.astype(np.int32),
        match=match.astype(np.int32),
        match_from_query=to_match @ found.match_from_query @ se3.inverse(to_query),
        information=np.swapaxes(Ad, -1, -2) @ found.information @ Ad,
        query_camera=np.full(len(found), cameras[0], np.int32),
        match_camera=np.full(len(found), cameras[1], np.int32),
    )


def _numbered(ledgers: Sequence[Closures]) -> list[Ints]:
    """Numbers of the candidates of several ledgers one after the other."""
    ends = np.cumsum([0, *map(len, ledgers)])
    return [np.arange(begin, end) for begin, end in pairwise(ends)]


def once(ledgers: Sequence[Closures]) -> Closures:
    """Every pair of keyframes of several ledgers once, ordered by query, then rank: accepted rather than not, then
    calibrated rather than not, then with most inliers, then of the first ledgers."""
    closures = merged(ledgers, _numbered(ledgers))
    uncalibrated = closures.of(Verdict.NO_CALIBRATION)
    order = np.lexsort([-closures.inliers, uncalibrated, ~closures.accepted, closures.match, closures.query])
    pair = np.stack([closures.query, closures.match])[:, order]
    best = order[np.insert((np.diff(pair) != 0).any(axis=0), 0, True)] if len(order) else order
    return closures.rows(best[np.lexsort([closures.match[best], closures.rank[best], closures.query[best]])])


def name_shared(closures: Closures, state: PlaceState, views: Sequence[View]) -> Closures:
    """The ledger with the references that explain both places of a candidate, where the recogniser has boxes."""
    places = [place for view in views for place in view.places]
    begin = np.cumsum([0, *(len(view.row) for view in views)])
    query, match = (
        np.array([begin[n] + views[n].at(row) for row, n in zip(rows.tolist(), of.tolist(), strict=True)], np.int32)
        for rows, of in ((closures.query, closures.query_camera), (closures.match, closures.match_camera))
    )
    found = shared_of(state, places, query, match)
    return replace(closures, shared_references=found.references, shared_overlap=found.overlap)
