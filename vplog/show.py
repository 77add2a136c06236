"""What a run shows beside its tables: the keyframes' pictures with their boxes, closures drawn, the way on earth."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from vplog import geodesy, geometry
from vplog.boxes import boxes_of, references_of, voting_map, windows_of
from vplog.data import Verdict
from vplog.errors import ResultError
from vplog.extract import one_thread_each
from vplog.places.bobb import BobbState
from vplog.places.bobb_paper import PaperBobbState
from vplog.places.hybrid import HybridState
from vplog.results.collage import Half, Panel, collage
from vplog.results.previews import jpeg, scaled_size, shrink
from vplog.results.shown import Earth, Explained, Shown
from vplog.shared_view import find_agreement, find_boxes

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from vplog.boxes import BoxState
    from vplog.data import Bytes, Camera, Closures, Features, Gps, Reference, Trajectory
    from vplog.loops.verify import VerifySettings
    from vplog.results.previews import PictureSettings, Previews
    from vplog.stages import PlaceState

_REFERENCE_MEGAPIXELS = 0.05
"""Of a reference's picture: 260 x 195, 8 kB; it is written for every keyframe that it explains best."""
_MOST_REFERENCES = 1000
"""References whose pictures are kept: 8 MB. Libraries of a drive have some hundred."""
_VOTED = 1
"""Of the references that a closure shares, those drawn with voting maps: each costs a search of the library."""
_LEAST_FIXES = 3
"""Fixes that say where a trajectory is and how it is turned."""


@dataclass(frozen=True, eq=False)
class Seen:
    """What was seen of a drive: all that pictures of its closures are made of."""

    image: Callable[[int], Bytes]
    """A keyframe's picture (h, w) by its row."""
    features: Callable[[int], Features]
    """Of the keyframe's whole image."""
    camera: Camera
    state: PlaceState
    places: Sequence[Any]
    """Descriptors of the keyframes."""


def finished_picture(
    seen: Seen, previews: Previews, closures: Closures, references: list[Reference], verify: VerifySettings,
    pictures: PictureSettings, threads: int, gps: Gps | None, earth: Earth | None, about: dict[str, Any],
) -> Shown:  # fmt: skip
    """All that result.mcap shows of a run, made while its features are at hand."""
    boxed = box_state(seen.state)
    camera = seen.camera
    small = {
        number: jpeg(shrink(reference.image, _REFERENCE_MEGAPIXELS), pictures.quality)
        for number, reference in enumerate(references[:_MOST_REFERENCES] if pictures.megapixels else [])
    }
    drawn = {}
    if len(previews):
        rows = choose_examples(closures, pictures.closures)
        drawn = draw_closures(rows, seen, closures, verify, pictures.quality, threads)
    return Shown(
        image=previews.__getitem__ if len(previews) else None,
        image_size=scaled_size(camera.width, camera.height, pictures.megapixels),
        explained=None if boxed is None else lambda row: explain(boxed, _boxes(seen.state, seen.places[row])),
        references=small,
        pictures=drawn,
        gps=gps,
        earth=earth,
        about=about,
    )


def box_state(state: Any) -> BoxState | None:
    """The recogniser's state where it is one with boxes."""
    if isinstance(state, HybridState):
        return state.bobb
    return state if isinstance(state, BobbState | PaperBobbState) else None


def explain(state: BoxState, place: Any) -> Explained | None:
    """Where the parts of a keyframe were found on the reference that explains it best; None where none does."""
    found = boxes_of(state, place)
    if not len(found.references):
        return None
    return Explained(found.references.tolist(), windows_of(state, 0), found.corners[0])


def reference_use(state: Any, places: Sequence[Any]) -> list[int] | None:
    """How many keyframes each reference explains, or None for a recogniser without boxes."""
    boxed = box_state(state)
    if boxed is None:
        return None
    count = np.zeros(len(references_of(boxed)), np.int64)
    for place in places:
        count[boxes_of(boxed, _boxes(state, place)).references] += 1
    return count.tolist()


def _boxes(state: Any, place: Any) -> Any:
    """The part of a place that is boxes."""
    return place.boxes if isinstance(state, HybridState) else place


def choose_examples(closures: Closures, count: int) -> list[int]:
    """Rows worth a picture: accepted ones evenly along the drive, and of every reason of rejection the best scored."""
    verdicts = np.array([verdict.value for verdict in closures.verdict])
    accepted = np.flatnonzero(verdicts == Verdict.ACCEPTED.value)
    others = [
        rows[np.argsort(-closures.score[rows], kind="stable")].tolist()
        for verdict in reversed(Verdict)  # the reasons that come last in the checks are the most telling
        if verdict is not Verdict.ACCEPTED and len(rows := np.flatnonzero(verdicts == verdict.value))
    ]
    room = count - min(count // 2, sum(map(len, others)))
    chosen = accepted[np.linspace(0, len(accepted) - 1, min(room, len(accepted))).astype(np.int64)].tolist()
    turn = 0
    while len(chosen) < count and any(others):
        if others[turn % len(others)]:
            chosen.append(others[turn % len(others)].pop(0))
        turn += 1
    return sorted(chosen)


def draw_closures(
    rows: Sequence[int], seen: Seen, closures: Closures, verify: VerifySettings, quality: int, threads: int
) -> dict[int, bytes]:
    """JPEGs of ledger rows."""
    images = {node: seen.image(node) for row in rows for node in (int(closures.query[row]), int(closures.match[row]))}
    with ThreadPoolExecutor(threads, initializer=one_thread_each) as pool:
        drawn = pool.map(lambda row: jpeg(_draw(row, seen, images, closures, verify), quality), rows)
        return dict(zip(rows, drawn, strict=True))


def _draw(row: int, seen: Seen, images: dict[int, Bytes], closures: Closures, verify: VerifySettings) -> Bytes:
    nodes = int(closures.query[row]), int(closures.match[row])
    features = seen.features(nodes[0]), seen.features(nodes[1])
    agreement = find_agreement(*features, _pose_columns(closures, row), seen.camera, verify)
    sides = [np.array([one.width, one.height]) for one in features]
    halves = [
        Half(images[node], f"{name}: keyframe {node}", (points + 0.5) / side)
        for name, node, points, side in zip(
            ("query", "match"), nodes, (agreement.query, agreement.match), sides, strict=True
        )
    ]
    return collage(halves[0], halves[1], agreement.agrees, _panels(row, nodes, features, seen, closures))


def _panels(
    row: int, nodes: Sequence[int], features: Sequence[Features], seen: Seen, closures: Closures
) -> list[Panel]:
    """Boxes of both on the references they share most on, and how both vote on the first of these."""
    shared, boxed = closures.shared_references[row].tolist(), box_state(seen.state)
    if boxed is None or not shared:
        return []
    panels, none = [], np.zeros((0, 4))
    for found in find_boxes(seen.state, seen.places[nodes[0]], seen.places[nodes[1]], shared)[:2]:
        name = f"reference {found.reference}"
        panels.append(Panel(found.image, f"{name}: boxes of both", found.query_boxes, found.match_boxes, None))
        if len(panels) <= _VOTED:
            for who, one in zip(("query", "match"), features, strict=True):
                votes = voting_map(boxed, one, found.reference)
                panels.append(Panel(found.image, f"votes of the {who}", none, none, votes))
    return panels


def _pose_columns(closures: Closures, row: int) -> dict[str, Any]:
    """The row as `find_agreement` takes it."""
    pose = closures.match_from_query[row]
    columns: dict[str, Any] = dict.fromkeys(("tx", "ty", "tz", "qx", "qy", "qz", "qw"))
    if np.isfinite(pose).all():
        columns = dict(zip(columns, [*pose[:3, 3], *geometry.quaternion(pose[None, :3, :3])[0]], strict=True))
    return {**columns, "inliers": int(closures.inliers[row])}


def earth_of(trajectory: Trajectory, gps: Gps | None, known: dict[str, Any] | None) -> Earth | None:
    """Where on earth a trajectory is: as the solve found it (`known`, the `gps` of run.json), else by laying it on
    the fixes as a whole (Umeyama 1991). None without at least three fixes within the drive."""
    if known is not None:
        try:
            origin = [float(known["origin"][name]) for name in ("latitude_deg", "longitude_deg", "altitude_m")]
            world_from_enu = np.array(known["world_from_enu"], np.float64)
        except (KeyError, TypeError, ValueError, OverflowError):
            origin, world_from_enu = [], np.empty(0)
        if world_from_enu.shape != (4, 4) or not np.isfinite([*origin, *world_from_enu.ravel()]).all():
            raise ResultError("run.json's `gps` lacks the run's place on earth. Run again: vplog run LOG --gps")
        return Earth((origin[0], origin[1], origin[2]), geometry.inverse(world_from_enu))
    if gps is None or len(trajectory.stamp_ns) < 2:
        return None
    fixes = geodesy.local_enu(gps)
    inside = (fixes.stamp_ns >= trajectory.stamp_ns[0]) & (fixes.stamp_ns <= trajectory.stamp_ns[-1])
    if inside.sum() < _LEAST_FIXES:
        return None
    poses = geometry.interpolate_at(trajectory.stamp_ns, trajectory.world_from_body, fixes.stamp_ns[inside])
    return Earth(fixes.origin, geometry.umeyama(poses[:, :3, 3], fixes.enu_m[inside])[0])
