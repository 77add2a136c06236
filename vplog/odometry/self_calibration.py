"""The lens of a camera that nothing calibrates, by the motion of its own images.

An excerpt is tracked with a focal length that may be wrong, and one bundle adjustment of all its references leaves the
focal length and the first radial distortion free, as COLMAP's of cameras without a calibration; then it is tracked with
what was found, until it stays. Excerpts begin with focal lengths far apart, in turns: where two end at the same one,
the images tell it. They do not where the camera hardly turns, moves or finds anything to follow.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from vplog.data import Camera, Floats, Frame, Ints
from vplog.odometry.bundle_adjustment import Bundle, Observations, adjust
from vplog.odometry.sensor import Sensor
from vplog.odometry.visual import Tracker

EXCERPT = 80
"""Frames of an excerpt."""
_STARTS = (0.9, 0.0), (0.5, -0.2)
"""Focal lengths by the longer side, and radial distortions, that excerpts begin with in turns: longer than a phone's
some 0.75, and an action camera's."""
_PASSES = 7
"""Times that an excerpt is tracked at most: from a focal length twice too long three or four do without distortion."""
_UNSURE = 2
"""Times after which a focal length that is not sure will not become so."""
_STAYS = 0.01
"""Relative change of the focal length below which it stays."""
_SURE = 0.02
"""Largest relative sigma of a focal length that is taken: that of 75 frames of a phone in a hall is .03 to .05, and
they end anywhere. Errors of a track are not independent, so that true errors are some times larger."""
_AGREE = 0.05
"""Relative difference of two excerpts that agree: the scale of visual odometry with a focal length so far off drifts
by tenths, not by factors, in a turn."""
_RANGE = 0.3, 4.0
"""Focal lengths by the longer side that pinhole cameras have: fields of view of 118 to 14 degrees."""
_LEAST_VIEWS = 3
"""References that show a landmark: two determine its place, and tell nothing of the lens."""


class Lens(NamedTuple):
    """Focal length in px, and first radial distortion (`plumb_bob`)."""

    focal_px: float
    radial: float

    def of(self, camera: Camera) -> Camera:
        """The camera with this lens, its centre in the middle of its images."""
        x, y = (camera.width - 1) / 2.0, (camera.height - 1) / 2.0
        matrix = np.array([[self.focal_px, 0.0, x], [0.0, self.focal_px, y], [0.0, 0.0, 1.0]])
        model, distortion = ("plumb_bob", np.array([self.radial, 0, 0, 0, 0])) if self.radial else ("none", np.zeros(0))
        return replace(camera, matrix=matrix, distortion_model=model, distortion=distortion)


def lens_of(excerpts: Iterable[Callable[[], Iterable[Frame]]], camera: Camera) -> Lens | None:
    """The lens that two of the excerpts, each read several times, agree on; None where the images do not tell it."""
    found = list[Lens]()
    for number, excerpt in enumerate(excerpts):
        share, radial = _STARTS[number % len(_STARTS)]
        if (lens := _of_excerpt(excerpt, camera, Lens(share * max(camera.width, camera.height), radial))) is None:
            continue
        for other in found:
            if abs(np.log(other.focal_px / lens.focal_px)) < _AGREE:
                return Lens(*(float(value) for value in np.mean([other, lens], axis=0)))
        found.append(lens)
    return None


def _of_excerpt(excerpt: Callable[[], Iterable[Frame]], camera: Camera, lens: Lens) -> Lens | None:
    """The lens at which the adjustment of an excerpt ends; None where it does not settle, or is not sure."""
    low, high = (share * max(camera.width, camera.height) for share in _RANGE)
    for number in range(_PASSES):
        bundle = _adjusted(excerpt(), lens.of(camera), lens)
        if bundle is None:
            return None
        s, k = bundle.lens.tolist()
        before, lens = lens, Lens(lens.focal_px * s, k)
        is_sure = bool(np.sqrt(bundle.lens_covariance[0, 0]) < _SURE * s)
        if not low < lens.focal_px < high or not (is_sure or number < _UNSURE):
            return None
        if abs(np.log(lens.focal_px / before.focal_px)) < _STAYS:
            return lens if is_sure else None
    return None


def _adjusted(frames: Iterable[Frame], camera: Camera, lens: Lens) -> Bundle | None:
    """The references of the longest piece of an excerpt adjusted together with the lens; None where nothing is."""
    sensor = Sensor(camera, metric=False)
    structure = _structure(frames, sensor)
    if structure is None:
        return None
    poses, points, view, landmark, px = structure
    xyrho = np.column_stack([(px - camera.matrix[:2, 2]) / lens.focal_px, np.full(len(px), np.nan)])  # type: ignore[index]
    noise = np.tile(np.eye(2) * (sensor.pixel_sigma / lens.focal_px) ** 2, (len(px), 1, 1))
    observed = Observations(view, landmark, xyrho, noise, xyrho[:, 2])
    return adjust(poses, points, observed, metric=False, lens=np.array([1.0, lens.radial]))


def _structure(frames: Iterable[Frame], sensor: Sensor) -> tuple[Floats, Floats, Ints, Ints, Floats] | None:
    """Poses (V, 4, 4) of the references of the longest piece, landmarks (P, 3) that enough of them show, and its
    observations: view (O,), landmark (O,), px (O, 2)."""
    tracker = Tracker(sensor)
    shown, places = dict[tuple[int, int], tuple[Ints, Floats]](), dict[tuple[int, int], Floats]()
    for frame in frames:
        tracker.add(frame)
        piece = len(tracker.breaks)
        shown |= {(piece, view): (ids, points.px) for view, ids, points in tracker.window}
        places |= {(piece, number): at for number, at in tracker.world.items()}
    if not shown:
        return None
    pieces, views = np.array(list(shown)).T
    longest = int(np.bincount(pieces).argmax())
    own = np.sort(views[pieces == longest]).tolist()
    ids = np.concatenate([shown[longest, view][0] for view in own])
    px = np.concatenate([shown[longest, view][1] for view in own]).astype(np.float64)
    row = np.repeat(np.arange(len(own)), [len(shown[longest, view][0]) for view in own])
    numbers, count = np.unique(ids, return_counts=True)
    placed = np.array([(longest, number) in places for number in numbers.tolist()], bool)
    landmarks = numbers[placed & (count >= _LEAST_VIEWS)]
    used = np.isin(ids, landmarks)
    if len(own) < _LEAST_VIEWS or not used.any():
        return None
    poses = np.stack([tracker.views[view].world_from_camera for view in own])
    points = np.stack([places[longest, number] for number in landmarks.tolist()])
    return poses, points, row[used], np.searchsorted(landmarks, ids[used]), px[used]
