"""Files beside a log: its odometry, and calibrations as ROS camera_info, Kalibr's camchain, EuRoC's sensor.yaml."""

from __future__ import annotations

import reprlib
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml

from vplog.data import Odometry
from vplog.errors import LogError
from vplog.geometry import se3
from vplog.geometry.tum import read_tum
from vplog.logs.continuity import without_jumps
from vplog.logs.messages.records import CalibrationMessage

if TYPE_CHECKING:
    from pathlib import Path

    from vplog.data import Floats
    from vplog.logs.formats.container import Notes
    from vplog.logs.topic_selection import TopicChoice

_LARGEST = 1_000_000
"""Bytes; a calibration has some kB, and the parser is not to be blown up."""
_MODELS = {"radtan": "plumb_bob", "radial-tangential": "plumb_bob", "equidistant": "equidistant", "none": ""}
"""Kalibr's and EuRoC's names of distortion models, and ROS's."""
_KINDS = "A calibration is ROS camera_info YAML, a Kalibr camchain or a EuRoC sensor.yaml"
_ROUNDED = 1e-3
"""Most that the rows of a rotation may be off from unit length and right angles: files have six digits."""


class _BadCalibrationError(Exception):
    """What is wrong, to follow the file's name."""


@dataclass(frozen=True, eq=False)
class CalibratedCamera:
    """One camera of a calibration file."""

    name: str
    topic: str
    """Image topic, empty where the file does not say."""
    calibration: CalibrationMessage
    from_first: Floats | None = None
    """(4, 4) this camera from the first one of the chain; None where the file has no chain."""
    body_from_camera: Floats | None = None
    """(4, 4) where the IMU is the body, as EuRoC and Kalibr have it; None where the file does not say."""


def read_calibrations(path: Path) -> list[CalibratedCamera]:
    """The cameras of a file, in its order. Raises LogError where it is none of the known kinds."""
    try:
        if path.stat().st_size > _LARGEST:
            raise LogError(f"{path} is larger than 1 MB, so it is no calibration. {_KINDS}.")
        tree = yaml.safe_load(path.read_text(encoding="utf-8-sig"))
    except (OSError, UnicodeDecodeError) as error:
        raise LogError(f"Cannot read {path}: {error}. Give a calibration with --calibration.") from None
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise LogError(f"{path} is not YAML: {str(error).splitlines()[0]}. {_KINDS}.") from None
    try:
        return _cameras(tree)
    except _BadCalibrationError as error:
        raise LogError(f"{path}: {error}. {_KINDS}.") from None


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
        self._path = choice.calibration_file
        self._cameras = [] if self._path is None else read_calibrations(self._path)

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
    """The camera of an image topic: by its topic, by its name in the topic, or the only one. Raises LogError."""
    if len(cameras) == 1:
        return cameras[0]
    named = [c for c in cameras if c.topic and (topic == c.topic or topic.startswith(f"{c.topic.rstrip('/')}/"))]
    named = named or [c for c in cameras if c.name in topic.strip("/").split("/")]
    if len(named) == 1:
        return named[0]
    known = ", ".join(f"{c.name} ({c.topic})" if c.topic else c.name for c in cameras[:8])
    raise LogError(f"{path} does not say which of its cameras is {topic}: {known}. Choose a topic with --image-topic.")


def _cameras(tree: Any) -> list[CalibratedCamera]:
    if not isinstance(tree, dict) or not tree:
        raise _BadCalibrationError("its top level is not a mapping of names to values")
    if "camera_matrix" in tree:
        return [CalibratedCamera(_text(tree.get("camera_name")) or "camera", "", _camera_info(tree))]
    if "intrinsics" in tree:
        placed = _pose(tree["T_BS"]) if "T_BS" in tree else None
        return [CalibratedCamera("camera", "", _intrinsics(tree), body_from_camera=placed)]
    chain = [(name, part) for name, part in tree.items() if isinstance(part, dict) and "intrinsics" in part]
    if not chain:
        raise _BadCalibrationError("it has neither camera_matrix nor intrinsics")
    found, from_first = [], np.eye(4)
    for number, (name, part) in enumerate(chain):
        step = _pose(part["T_cn_cnm1"]) if "T_cn_cnm1" in part else None
        from_first = from_first if number == 0 else (None if step is None or from_first is None else step @ from_first)
        placed = se3.inverse(_pose(part["T_cam_imu"])) if "T_cam_imu" in part else None
        topic = _text(part.get("rostopic"))
        found.append(CalibratedCamera(_text(name), topic, _intrinsics(part), from_first, placed))
    return found


def _camera_info(tree: dict) -> CalibrationMessage:
    """docs.ros.org/en/api/camera_calibration_parsers."""
    lens = _matrix(tree.get("distortion_coefficients", []), None)
    size = _size(tree.get("image_width", 0)), _size(tree.get("image_height", 0))
    k, p, r = (
        _matrix(tree.get(f"{name}_matrix", unset.ravel().tolist()), unset.size).reshape(unset.shape)
        for name, unset in (("camera", np.eye(3)), ("projection", np.zeros((3, 4))), ("rectification", np.eye(3)))
    )
    return CalibrationMessage(0, "", *size, _text(tree.get("distortion_model")), lens, k, p, r)


def _intrinsics(tree: dict) -> CalibrationMessage:
    """github.com/ethz-asl/kalibr/wiki/yaml-formats."""
    kind = tree.get("camera_model", "pinhole")
    if kind != "pinhole":
        raise _BadCalibrationError(f"camera_model {reprlib.repr(kind)[:40]} is not supported; pinhole is")
    model = tree.get("distortion_model", "none")
    if not isinstance(model, str) or model not in _MODELS:
        raise _BadCalibrationError(f"distortion_model {reprlib.repr(model)[:40]} is none of {', '.join(_MODELS)}")
    fx, fy, cx, cy = _numbers(tree["intrinsics"], 4)
    lens = tree.get("distortion_coeffs", tree.get("distortion_coefficients", []))
    width, height = _numbers(tree.get("resolution", [0, 0]), 2)
    matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    return CalibrationMessage(
        0, "", _size(width), _size(height), _MODELS[model], _numbers(lens, None), matrix, np.zeros((3, 4))
    )


def _pose(value: Any) -> Floats:
    values = _matrix(value, 16).reshape(4, 4)
    turn = values[:3, :3]
    if np.abs(turn @ turn.T - np.eye(3)).max() > _ROUNDED or np.linalg.det(turn) < 0:
        raise _BadCalibrationError("a transform in it is not rigid (a rotation and a translation)")
    u, _, v = np.linalg.svd(turn)  # the nearest rotation: digits were cut
    return se3.pose(u @ v, values[:3, 3])


def _matrix(value: Any, count: int | None) -> Floats:
    """Row by row, from `data`, from a list of rows or from a flat list."""
    if isinstance(value, dict):
        value = value.get("data")
    if isinstance(value, list) and value and all(isinstance(row, list) and len(row) <= 16 for row in value[:16]):
        value = [item for row in value[:16] for item in row]
    return _numbers(value, count)


def _numbers(value: Any, count: int | None) -> Floats:
    """`count` finite numbers; up to 16 where None."""
    fits = isinstance(value, list) and (len(value) <= 16 if count is None else len(value) == count)
    if not fits or not all(isinstance(x, int | float) and not isinstance(x, bool) and abs(x) < 1e15 for x in value):
        raise _BadCalibrationError(f"it has {reprlib.repr(value)[:40]} where {count or 'a few'} numbers are expected")
    return np.array(value, np.float64)


def _text(value: Any) -> str:
    return value[:1000] if isinstance(value, str) else ""


def _size(value: Any) -> int:
    if not isinstance(value, int | float) or not 0 <= value < 1e6:
        raise _BadCalibrationError(f"{reprlib.repr(value)[:40]} is not an image size in px")
    return int(value)
