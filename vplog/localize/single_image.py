"""Single images, from files or memory, in a run or a map that stays open."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from vplog import logs
from vplog.data import Bytes, Camera, Frame
from vplog.errors import LogError, SettingsError
from vplog.execution.execution import Execution
from vplog.localize.localize import LocalizedPicture, localize_frame
from vplog.storage.remote_path import located

if TYPE_CHECKING:
    from vplog.localize.places import Places


def localize_image(places: Places, image: Bytes | Path | str, camera: Camera | Path | str) -> LocalizedPicture:
    """The pose of an image: a file, or (H, W) or (H, W, 3) uint8 in red, green, blue; its camera, or a calibration
    file. Raises LogError where the file is no image or the camera's size is another."""
    return localize_frame(places, _frame(image, camera), Execution())


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
