"""Figures of a run: the keyframes' pictures with their boxes, closures drawn, the trajectory on earth."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import chain, groupby
from typing import TYPE_CHECKING, Any

import numpy as np

from vplog.data import ACCEPTED, USED, Bytes, Camera, Closures, Features, Floats, Gps, Reference, Trajectory, Verdict
from vplog.errors import ResultError
from vplog.geometry import geodesy, se3
from vplog.loops.verify import VerifySettings
from vplog.results import closure_views
from vplog.results.collage import FramePanel, ReferencePanel, collage
from vplog.results.geo import Earth
from vplog.results.mcap import McapExtras, ReferenceBoxes
from vplog.results.previews import PictureSettings, jpeg, scaled_size, shrink, thumbnail
from vplog.run.figures.closure_view import find_agreement, find_boxes
from vplog.stages import BoxState, PlaceState
from vplog.storage.image_file import decode_image

if TYPE_CHECKING:
    from vplog.execution.execution import Execution
    from vplog.run.cameras import View

_REFERENCE_MEGAPIXELS = 0.05
"""Size of a reference's picture: 260 x 195, 8 kB; it is written for every keyframe that it explains best."""
_MOST_REFERENCES = 1000
"""References whose pictures are written: 8 MB. Libraries of a drive have some hundred."""
_VOTED = 1
"""Shared references of a closure that are drawn with voting maps."""
_PANELS = 2
"""Shared references of a closure that are drawn."""
_VOTING = 150
"""Strongest features whose votes are drawn: the search of the library takes its time for each."""
_LEAST_VIEWS, _MOST_VIEWS = 100, 5000
"""Closures with a view, half of them nearest misses where there are so many: some 10 ms and 2 kB each."""
_LEAST_FIXES = 3
"""Fixes that determine position and heading of a trajectory."""


@dataclass(frozen=True, eq=False)
class ClosureInputs:
    """Images, features and places of a drive, for pictures of its closures."""

    features: Callable[[int], Features]
    """Features of a keyframe's whole image by its row."""
    camera: Camera
    state: PlaceState
    places: Sequence[Any]
    """Descriptors of the keyframes."""


def mcap_extras(
    inputs: ClosureInputs,
    previews: Callable[[int], bytes] | None,
    closures: Closures,
    references: list[Reference],
    verify: VerifySettings,
    pictures: PictureSettings,
    execution: Execution,
) -> McapExtras:
    """Images, references and drawn closures for result.mcap; `previews` gives a keyframe's JPEG by its row."""
    state, camera = inputs.state, inputs.camera
    small = reference_pictures(references, pictures.quality) if pictures.megapixels else {}
    drawn, views = {}, {}
    if previews is not None:
        rows = choose_examples(closures, pictures.closures)
        drawn = draw_closures(
            rows, lambda row: decode_image(previews(row)), inputs, closures, verify, pictures.quality, execution
        )
        views = view_closures(choose_views(closures), inputs, closures, verify, execution)
    return McapExtras(
        camera=camera,
        image=previews,
        image_size=scaled_size(camera.width, camera.height, pictures.megapixels),
        explained=(lambda row: explain(state, inputs.places[row])) if isinstance(state, BoxState) else None,
        references=small,
        pictures=drawn,
        views=views,
    )


def reference_pictures(references: Sequence[Reference], quality: int) -> dict[int, bytes]:
    """Small JPEGs of the first references by their number."""
    return {
        number: jpeg(shrink(reference.image, _REFERENCE_MEGAPIXELS), quality)
        for number, reference in enumerate(references[:_MOST_REFERENCES])
    }


def explain(state: BoxState, place: Any) -> ReferenceBoxes | None:
    """Where the parts of a keyframe were found on the reference that explains it best; None where none does."""
    found = state.boxes(place)
    if not len(found.references):
        return None
    return ReferenceBoxes(found.references.tolist(), state.windows(0), found.corners[0])


def reference_use(state: PlaceState, places: Sequence[Any]) -> list[int] | None:
    """Number of keyframes that each reference explains; None for a recogniser without boxes."""
    if not isinstance(state, BoxState):
        return None
    count = np.zeros(len(state.references), np.int64)
    for place in places:
        count[state.boxes(place).references] += 1
    return count.tolist()


def choose_examples(closures: Closures, count: int) -> list[int]:
    """Rows of the first camera worth a picture: accepted ones evenly along the drive, and of every reason of rejection
    the best scored."""
    verdicts = np.array([verdict.value for verdict in closures.verdict])
    accepted, first = np.flatnonzero(closures.accepted & closures.of_first_camera), closures.of_first_camera
    others = [
        rows[np.argsort(-closures.score[rows], kind="stable")].tolist()
        for verdict in reversed(Verdict)  # the reasons that come last in the checks are the most telling
        if verdict not in ACCEPTED and len(rows := np.flatnonzero((verdicts == verdict.value) & first))
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
    rows: Sequence[int],
    image: Callable[[int], Bytes],
    inputs: ClosureInputs,
    closures: Closures,
    verify: VerifySettings,
    quality: int,
    execution: Execution,
) -> dict[int, bytes]:
    """JPEGs of ledger rows; `image` gives a keyframe's picture (h, w) by its row."""
    images = {node: image(node) for row in rows for node in (int(closures.query[row]), int(closures.match[row]))}
    drawn = execution.map(lambda row: jpeg(_draw(row, inputs, images, closures, verify), quality), rows)
    return dict(zip(rows, drawn, strict=True))


def _draw(
    row: int, inputs: ClosureInputs, images: dict[int, Bytes], closures: Closures, verify: VerifySettings
) -> Bytes:
    nodes = int(closures.query[row]), int(closures.match[row])
    features = inputs.features(nodes[0]), inputs.features(nodes[1])
    pose, inliers = closures.match_from_query[row], int(closures.inliers[row])
    agreement = find_agreement(*features, pose, inliers, (inputs.camera, inputs.camera), verify)
    sides = [np.array([one.width, one.height]) for one in features]
    frames = [
        FramePanel(images[node], f"closure {row}, {name}: keyframe {node}", (points + 0.5) / side)
        for name, node, points, side in zip(
            ("query", "match"), nodes, (agreement.query, agreement.match), sides, strict=True
        )
    ]
    return collage(frames[0], frames[1], agreement.agrees, _panels(row, nodes, features, inputs, closures))


def _panels(
    row: int, nodes: Sequence[int], features: Sequence[Features], inputs: ClosureInputs, closures: Closures
) -> list[ReferencePanel]:
    """Boxes of both on the references they share most on, and how both vote on the first of these."""
    shared, state = closures.shared_references[row].tolist(), inputs.state
    if not isinstance(state, BoxState):
        return []
    panels, none = [], np.zeros((0, 4))
    for found in find_boxes(state, inputs.places[nodes[0]], inputs.places[nodes[1]], shared)[:_PANELS]:
        name = f"reference {found.reference}"
        panels.append(ReferencePanel(found.image, f"{name}: boxes of both", found.query_boxes, found.match_boxes, None))
        if len(panels) <= _VOTED:
            for side, one in zip(("query", "match"), features, strict=True):
                [votes] = state.voting_maps(_strongest(one), [found.reference])
                panels.append(ReferencePanel(found.image, f"votes of the {side}", none, none, votes))
    return panels


def _strongest(features: Features) -> Features:
    return replace(features.rows(slice(_VOTING)), thumbnail=None)


def camera_thumbnails(views: Sequence[View], closures: Closures) -> dict[tuple[int, int], bytes]:
    """Small JPEGs of the pictures of cameras beside the first, by camera and keyframe: of closures in the solution,
    then of the nearest misses; empty where pictures are switched off."""
    order = np.lexsort((-closures.inliers, ~closures.of(*USED)))
    cameras, rows = (
        np.stack(ends, 1)[order].ravel().tolist()
        for ends in ((closures.query_camera, closures.match_camera), (closures.query, closures.match))
    )
    wanted = dict.fromkeys((n, row) for n, row in zip(cameras, rows, strict=True) if n)
    return {
        (n, row): thumbnail(decode_image(views[n].pictures.features.picture(views[n].at(row))))
        for n, row in list(wanted)[:_MOST_VIEWS]
        if views[n].pictures.features.has_pictures
    }


def choose_views(closures: Closures) -> list[int]:
    """Rows, of the first camera alone, of the closures in the solution and of as many nearest misses: those that
    geometry accepted, then those of most inliers and matches."""
    used, first = closures.of(*USED), closures.of_first_camera
    order = np.lexsort((-closures.matches, -closures.inliers, np.isnan(closures.residual_after), ~used))
    return sorted(order[first[order]][: min(max(2 * int(used.sum()), _LEAST_VIEWS), _MOST_VIEWS)].tolist())


def view_closures(
    rows: Sequence[int], inputs: ClosureInputs, closures: Closures, verify: VerifySettings, execution: Execution
) -> dict[int, dict[str, Any]]:
    """Matches of the strongest features, boxes and votes of ledger rows, see `closure_views.view`.

    A keyframe's features search the library once.
    """
    state, matching = inputs.state, verify.matching
    strongest = matching.model_copy(update={"features": min(matching.first_look, matching.features)})
    verify = verify.model_copy(update={"matching": strongest})
    ends = {row: (int(closures.query[row]), int(closures.match[row])) for row in rows}
    shared: dict[int, list[tuple[int, Floats, Floats]]] = {row: [] for row in rows}
    votes: dict[tuple[int, int], Floats] = {}
    if isinstance(state, BoxState):
        for row, pair in ends.items():
            mine, theirs = (inputs.places[node] for node in pair)
            found = find_boxes(state, mine, theirs, closures.shared_references[row].tolist())[:_PANELS]
            shared[row] = [(one.reference, one.query_boxes, one.match_boxes) for one in found]
        wanted = sorted({(node, boxes[0][0]) for row, boxes in shared.items() if boxes for node in ends[row]})
        groups = [(node, [reference for _, reference in some]) for node, some in groupby(wanted, lambda one: one[0])]
        maps = execution.map(lambda one: state.voting_maps(_strongest(inputs.features(one[0])), one[1]), groups)
        votes = dict(zip(wanted, chain.from_iterable(maps), strict=True))

    def one(row: int) -> dict[str, Any]:
        query, match = map(inputs.features, ends[row])
        pose, inliers, boxes = closures.match_from_query[row], int(closures.inliers[row]), shared[row]
        found = find_agreement(query, match, pose, inliers, (inputs.camera, inputs.camera), verify)
        here, there = (
            (points + 0.5) / (features.width, features.height)
            for points, features in ((found.query, query), (found.match, match))
        )
        voted = [votes[node, boxes[0][0]] for node in ends[row]] if boxes else []
        return closure_views.view(here, there, found.agrees, boxes, voted)

    return dict(zip(rows, execution.map(one, rows), strict=True))


def earth_of(
    trajectory: Trajectory, gps: Gps | None, solved: dict[str, Any] | None, camera: Floats | None = None
) -> Earth | None:
    """The pose of a trajectory on earth: that of the solve (`solved`, the `gps` of run.json), else by alignment to the
    fixes (Umeyama 1991), with scale and of the camera where its body_from_camera (4, 4) is given, as in
    `unit_camera`. None without at least three fixes within the drive, or where they do not move and there is no
    scale."""
    if solved is not None:
        try:
            origin = [float(solved["origin"][name]) for name in ("latitude_deg", "longitude_deg", "altitude_m")]
            world_from_enu = np.array(solved["world_from_enu"], np.float64)
        except (KeyError, TypeError, ValueError, OverflowError):
            origin, world_from_enu = [], np.empty(0)
        if world_from_enu.shape != (4, 4) or not np.isfinite([*origin, *world_from_enu.ravel()]).all():
            raise ResultError("run.json's `gps` lacks the run's place on earth. Run again: vplog run LOG --gps")
        return Earth((origin[0], origin[1], origin[2]), se3.inverse(world_from_enu))
    if gps is None or len(trajectory.stamp_ns) < 2:
        return None
    fixes = geodesy.local_enu(gps)
    inside = (fixes.stamp_ns >= trajectory.stamp_ns[0]) & (fixes.stamp_ns <= trajectory.stamp_ns[-1])
    if inside.sum() < _LEAST_FIXES:
        return None
    poses = se3.interpolate_at(trajectory.stamp_ns, trajectory.world_from_body, fixes.stamp_ns[inside])
    point = np.zeros(3) if camera is None else camera[:3, 3]
    antenna_m = point if gps.antenna_m is None or camera is not None else gps.antenna_m
    enu_from_world, scale = se3.umeyama(
        se3.transform(poses, antenna_m[None])[:, 0], fixes.enu_m[inside], with_scale=camera is not None
    )
    enu_from_world[:3, :3] *= scale
    return Earth(fixes.origin, enu_from_world, point) if scale > 0.0 else None
