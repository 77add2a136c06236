"""Files beside a log: its odometry, and its calibration in any of the kinds of `calibrations/`."""

from __future__ import annotations

from pathlib import Path

import yaml

from vplog.data import Floats, Odometry
from vplog.errors import LogError, nearest_path
from vplog.geometry import se3
from vplog.geometry.tum import read_tum
from vplog.logs.calibrations.camera import BadCalibrationError, CalibratedCamera
from vplog.logs.calibrations.text_kinds import colmap_binary, colmap_text, kitti_cameras
from vplog.logs.calibrations.yaml_kinds import load_tree, yaml_cameras
from vplog.logs.continuity import without_jumps
from vplog.logs.formats.container import Notes
from vplog.logs.topic_selection import PAIRS, TopicChoice

_LARGEST = 1_000_000
"""Bytes; a calibration has some kB, and the parser is not to be blown up."""
_SIDES = {"LEFT": 0, "RIGHT": 1, "Camera1": 0, "Camera2": 1}
"""Names of the cameras of a pair in the settings of ORB-SLAM 2 and 3, by their place in PAIRS."""
_KINDS = (
    "A calibration is YAML (ROS camera_info, OpenCV, Kalibr, EuRoC, VSLAM-LAB, ORB-SLAM), KITTI's calib.txt or "
    "COLMAP's cameras.txt or cameras.bin"
)


def read_calibrations(path: Path) -> list[CalibratedCamera]:
    """The cameras of a file, in its order. Raises LogError where it is none of the known kinds."""
    try:
        if path.stat().st_size > _LARGEST:
            raise LogError(f"{path} is larger than 1 MB, so it is not a calibration. {_KINDS}.")
        return _cameras(path.name, path.read_bytes())
    except (OSError, UnicodeDecodeError) as error:
        why = (error.strerror or error) if isinstance(error, OSError) else "it is not text"
        near = nearest_path(path)
        raise LogError(f"Cannot read {path}: {why}. Give a calibration with --calibration.{near}") from None
    except BadCalibrationError as error:
        raise LogError(f"{path}: {error}. {_KINDS}.") from None
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise LogError(f"{path} is not YAML: {str(error).splitlines()[0]}. {_KINDS}.") from None


def calibrations_beside(path: Path, remarks: list[str]) -> list[CalibratedCamera]:
    """The cameras of the calibration that a data set has; none without one, or, with a remark, where it is of a kind
    that is not read: --calibration may give another."""
    try:
        return read_calibrations(path) if path.is_file() else []
    except LogError as error:
        remarks.append(f"The calibration of the data set is not used; --calibration takes another. {error}")
        return []


def _cameras(name: str, data: bytes) -> list[CalibratedCamera]:
    """By the first line that is no comment, except COLMAP's binary file, which nothing marks but its name."""
    if name == "cameras.bin":
        return colmap_binary(data)
    text = data.decode("utf-8-sig")
    first = next((line.split() for line in text.splitlines() if line.strip() and line[0] not in "#%"), [])
    if first[:1] == ["P0:"]:
        return kitti_cameras(text)
    if len(first) > 4 and first[0].isdecimal() and first[1].isupper():
        return colmap_text(text)
    return yaml_cameras(load_tree(text))


class SidecarFiles:
    """The files of a TopicChoice, read at once: what is wrong with them shows before any work on the log."""

    def __init__(self, choice: TopicChoice, notes: Notes) -> None:
        """Raises LogError where a file cannot be read."""
        self.odometry: Odometry | None = None
        """None without a file."""
        if choice.odometry_file is not None:
            logged = Odometry(*read_tum(choice.odometry_file, LogError, "--odometry-file"), None)
            self.odometry = without_jumps(logged, choice.odometry_file.name, notes)
            notes.add(f"{choice.odometry_file.name} carries no covariance; its noise is that of the drift model.")
        self._cameras = [] if choice.calibration_file is None else read_calibrations(choice.calibration_file)
        if self._cameras and choice.of_further_camera and not named_for(self._cameras, choice.image or ""):
            notes.add(
                f"{choice.calibration_file} names no camera {choice.image}; that of the log is used, if it has one."
            )
            choice = choice.model_copy(update={"calibration_file": None})
        self.choice, self._path = choice, choice.calibration_file
        """Choice of topics, without a calibration file that is of another camera."""

    @property
    def has_pair(self) -> bool:
        """Whether there is a file, of more cameras than the left one of a pair."""
        return self._path is not None and len(self._cameras) > 1

    def camera(self, topic: str) -> CalibratedCamera | None:
        """The camera of an image topic; None without a file. Raises LogError where the file does not say which."""
        return None if self._path is None else camera_for(self._cameras, topic, self._path)

    def right_from_left(self, left: str, right: str) -> Floats | None:
        """(4, 4) between the cameras of two image topics; None where the file has no chain that leads there."""
        a, b = self.camera(left), self.camera(right)
        if a is None or b is None or a is b or a.from_first is None or b.from_first is None:
            return None
        return b.from_first @ se3.inverse(a.from_first)


def camera_for(cameras: list[CalibratedCamera], topic: str, path: Path) -> CalibratedCamera:
    """Return the camera of an image topic: by its topic, by its name in the topic, or the only calibration. Raises
    LogError."""
    if len(cameras) == 1:
        return cameras[0]
    if len(named := named_for(cameras, topic)) == 1:
        return named[0]
    if all(camera.calibration is cameras[0].calibration for camera in cameras):  # a rectified pair
        return cameras[0]
    known = ", ".join(f"{c.name} ({c.topic})" if c.topic else c.name for c in cameras[:8])
    raise LogError(f"{path} does not say which of its cameras is {topic}: {known}. Choose a topic with --image-topic.")


def named_for(cameras: list[CalibratedCamera], topic: str) -> list[CalibratedCamera]:
    """Cameras with the topic of the images, or else a name in it; of ORB-SLAM's two by words for left and right."""
    named = [c for c in cameras if c.topic and (topic == c.topic or topic.startswith(f"{c.topic.rstrip('/')}/"))]
    named = named or [c for c in cameras if c.name in topic.strip("/").split("/")]
    sides = {number for pair in PAIRS for number, word in enumerate(pair) if word in topic}
    return named or [c for c in cameras if _SIDES.get(c.name) in sides]
