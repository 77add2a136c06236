"""Localisation of pictures: the likeliest places, and the pose by their landmarks."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from vplog import logs
from vplog.data import Bytes, Camera, Features, Frame, Ints, Verdict
from vplog.errors import LibraryError, LogError, SettingsError
from vplog.execution.execution import Execution
from vplog.features.extraction import describe
from vplog.geometry import se3
from vplog.geometry.masking import masked
from vplog.loops.localize import Localization, localize
from vplog.places.library_files import check_descriptors
from vplog.results.geo import on_earth
from vplog.results.tables import POSE_COLUMNS
from vplog.stages import EncodedFrame, Extractor, FrameState, Log, PlaceState, StoredState
from vplog.storage.remote_path import located

if TYPE_CHECKING:
    from vplog.maps.localization.places import Landmarked, Places

TOP = 10
"""Places that a picture is verified against."""
_AROUND = 2
"""Keyframes before and after the likeliest of each drive that are looked at too: they see the same landmarks."""
_BLOCK = 16
"""Pictures that are in memory at once, some 20 MB."""


@dataclass(frozen=True, eq=False)
class LocalizedPicture:
    """The answer for one picture: its pose, or why there is none."""

    name: str
    stamp_ns: int
    camera: Camera | None
    """None of a picture that does not decode."""
    found: Localization
    sentence: str
    drive: str | None = None
    """Drive of the place that explains it best."""
    keyframe: int | None = None
    frame: str | None = None
    """Frame of the pose: the first of the drives that the drive is joined with."""
    earth_deg_m: tuple[float, float, float] | None = None
    """Longitude and latitude in degrees and altitude in m, WGS84."""

    @property
    def localized(self) -> bool:
        return self.found.world_from_camera is not None

    def record(self) -> dict[str, Any]:
        """The answer as plain values for JSON."""
        pose, covariance = self.found.world_from_camera, self.found.covariance
        values: dict[str, Any] = {}
        if pose is not None and covariance is not None:
            values = dict(zip(POSE_COLUMNS, se3.vectors(pose).tolist(), strict=True))
            sigma_m, sigma_deg = sigmas(self.found)
            values |= {"covariance": covariance.tolist(), "sigma_m": sigma_m, "sigma_deg": sigma_deg}
            if self.earth_deg_m is not None:
                values |= dict(zip(("longitude", "latitude", "altitude_m"), self.earth_deg_m, strict=True))
        return {
            "picture": self.name, "stamp_ns": self.stamp_ns, "localized": self.localized,
            "verdict": self.found.verdict.value, "sentence": self.sentence, "drive": self.drive,
            "keyframe": self.keyframe, "frame": self.frame, "matches": self.found.matches,
            "inliers": self.found.inliers, "places": self.found.places, **values,
        }  # fmt: skip


def sigmas(found: Localization) -> tuple[float, float]:
    """Standard deviation of a pose's position in m and of its rotation in degrees, along the worst axis."""
    if found.covariance is None:
        return float("nan"), float("nan")
    turn, shift = (np.linalg.eigvalsh(found.covariance[part, part])[-1] for part in (slice(3), slice(3, 6)))
    return float(np.sqrt(shift)), float(np.degrees(np.sqrt(turn)))


def localize_log(
    places: Places, log: Log, stamp_ns: Ints, execution: Execution, top: int = TOP
) -> Iterator[LocalizedPicture]:
    """The frames of a log with these stamps (N,), in order; progress counts them."""
    names = dict(zip(log.stamps().tolist(), log.file_names() or [], strict=False))
    frames, done = _described(places, log.frames(stamp_ns), execution), 0
    while block := list(islice(frames, _BLOCK)):
        for found in _localized(places, block, execution, top, names):
            done += 1
            execution.progress("localize", done, len(stamp_ns))
            yield found


def localize_image(places: Places, image: Bytes | Path | str, camera: Camera | Path | str) -> LocalizedPicture:
    """The pose of an image: a file, or (H, W) or (H, W, 3) uint8 in red, green, blue; its camera, or a calibration
    file. Raises LogError where the file is no image or the camera's size is another."""
    return localize_frame(places, _frame(image, camera), Execution())


def localize_frame(places: Places, frame: Frame, execution: Execution) -> LocalizedPicture:
    picture = described(places.state, places.pipeline.features, frame, places.name)
    return next(_localized(places, [picture], execution, TOP, {}))


def _frame(image: Bytes | Path | str, camera: Camera | Path | str) -> Frame:
    if isinstance(image, np.ndarray):
        if not isinstance(camera, Camera):
            raise SettingsError("An image in memory needs its camera as vplog.data.Camera, not a file.")
        return _of_pixels(image, camera)
    file = None if isinstance(camera, Camera) else located(camera)
    log = logs.open_images([located(image)], logs.TopicChoice(calibration_file=file))
    frame = next(iter(log.frames(log.stamps()))).decode(colour=True)
    return _of_pixels(np.asarray(frame.colour), camera) if isinstance(camera, Camera) else frame


def _of_pixels(image: Any, camera: Camera) -> Frame:
    if image.dtype != np.uint8 or image.ndim not in (2, 3) or image.shape[2:] not in ((), (3,)):
        raise LogError(f"An image is (H, W) or (H, W, 3) uint8, not {image.shape} {image.dtype}.")
    if image.shape[:2] != (camera.height, camera.width):
        size = f"{image.shape[1]}x{image.shape[0]}"
        raise LogError(f"The image is {size}, and the camera {camera.width}x{camera.height}. Scale its matrix along.")
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    return Frame(0, camera, np.asarray(grey, np.uint8), colour=image if image.ndim == 3 else np.dstack([image] * 3))


@dataclass(frozen=True, eq=False)
class Picture:
    """A decoded picture."""

    stamp_ns: int
    camera: Camera | None
    features: Features | None
    descriptor: Any = None
    problem: str = ""


def _described(places: Places, frames: Iterator[EncodedFrame], execution: Execution) -> Iterator[Picture]:
    colour = isinstance(places.state, FrameState) and places.state.colour

    def work(encoded: EncodedFrame) -> Picture:
        try:
            return described(places.state, places.pipeline.features, encoded.decode(colour), places.name)
        except LogError as error:
            return Picture(encoded.stamp_ns, None, None, problem=str(error))

    return execution.map(work, frames, ahead=2)


def described(state: PlaceState, extractor: Extractor, frame: Frame, name: str) -> Picture:
    """A picture as the places of a run or map of this name are described. Raises LibraryError where it cannot be."""
    if isinstance(state, StoredState):
        raise LibraryError(
            f"The places of {name} have descriptors from a file, which new pictures lack. Make the map with a "
            "recogniser that describes pictures: --set places.kind=bobb."
        )
    features = describe(extractor, frame)  # depths of a pair would cost as much again, and add little
    check_descriptors(getattr(state, "references", ()), features)
    descriptor = state.describe_frame(masked(frame)) if isinstance(state, FrameState) else state.describe(features)
    return Picture(frame.stamp_ns, frame.camera, features, descriptor)


def _localized(
    places: Places, block: Sequence[Picture], execution: Execution, top: int, names: dict[int, str]
) -> Iterator[LocalizedPicture]:
    sound = [one for one in block if one.features is not None]
    found, loaded = places.search([one.descriptor for one in sound], top)
    likely = dict(zip(map(id, sound), found, strict=True))

    def work(one: Picture) -> LocalizedPicture:
        return _answer(places, one, likely.get(id(one), []), loaded, names.get(one.stamp_ns, str(one.stamp_ns)))

    return execution.map(work, block)


def _answer(
    places: Places, one: Picture, likely: list[tuple[int, int]], loaded: Mapping[int, Landmarked], name: str
) -> LocalizedPicture:
    if one.features is None or one.camera is None:
        return LocalizedPicture(name, one.stamp_ns, None, Localization(Verdict.TOO_FEW_MATCHES, -1, 0, 0), one.problem)
    verify = places.pipeline.verify
    likely = _with_neighbours(loaded, likely)
    # poses in frames of their own are not compared: the likeliest place's frame is
    frames = list(dict.fromkeys(places.drives[drive].frame for drive, _ in likely)) or [""]
    tried = []
    for frame in frames:
        own = [(drive, row) for drive, row in likely if places.drives[drive].frame == frame]
        views = [loaded[drive].landmarks(row, verify) for drive, row in own]
        tried.append((localize(one.features, one.camera, views, verify), own))
    found, own = max(tried, key=lambda pair: (pair[0].world_from_camera is not None, pair[0].inliers))
    if found.place < 0:
        return LocalizedPicture(name, one.stamp_ns, one.camera, found, _sentence(found, "", 0))
    drive, row = own[found.place]
    known, pose, where = places.drives[drive], found.world_from_camera, None
    if pose is not None and (earth := loaded[drive].earth) is not None:
        where = tuple(on_earth(replace(earth, point=np.zeros(3)), pose[None])[0].tolist())  # the camera is the pose's
    keyframe = int(loaded[drive].keyframe[row])
    sentence = _sentence(found, known.name, keyframe)
    return LocalizedPicture(name, one.stamp_ns, one.camera, found, sentence, known.name, keyframe, known.frame, where)


def _with_neighbours(loaded: Mapping[int, Landmarked], likely: list[tuple[int, int]]) -> list[tuple[int, int]]:
    first, found = dict(reversed(likely)), list(likely)
    for drive, row in first.items():
        found += [(drive, other) for other in loaded[drive].around(row, _AROUND)]
    return list(dict.fromkeys(found))


def _sentence(found: Localization, drive: str, keyframe: int) -> str:
    if found.world_from_camera is not None:
        sigma_m, sigma_deg = sigmas(found)
        places = "1 keyframe" if found.places == 1 else f"{found.places} keyframes"
        return (
            f"Localised by {found.inliers} landmarks of {places} around {keyframe} of {drive}, to {sigma_m:.2g} m and "
            f"{sigma_deg:.2g} degrees (1 sigma)."
        )
    if found.verdict is Verdict.NO_CALIBRATION:
        return "The picture has no calibration, so it has no pose in metres. Give one with --calibration FILE."
    if found.place < 0:
        return "No place of the map resembles the picture."
    if found.verdict is Verdict.INCONSISTENT:
        return "Two places that are far apart explain the picture equally well, so it is at neither."
    likeliest = f"Keyframe {keyframe} of {drive} comes closest, with {found.matches} matches."
    return f"{likeliest} {found.verdict.sentence}"
