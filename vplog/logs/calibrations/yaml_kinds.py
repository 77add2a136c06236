"""Calibrations in YAML: ROS camera_info, OpenCV, Kalibr's camchain, EuRoC's sensor.yaml, VSLAM-LAB and ORB-SLAM."""

from __future__ import annotations

import re
import reprlib
from typing import Any

import numpy as np
import yaml

from vplog.data import Floats
from vplog.geometry import se3
from vplog.logs.calibrations.camera import (
    BadCalibrationError,
    CalibratedCamera,
    matrix_of,
    numbers_of,
    pinhole,
    rigid_of,
    size_of,
    text_of,
)
from vplog.logs.cameras import lens_of
from vplog.logs.messages.records import CalibrationMessage

_VSLAM_LAB = {"camera_model": "cam_model", "resolution": "image_dimension", "distortion_model": "distortion_type"}
"""VSLAM-LAB's names of what Kalibr has, by Kalibr's."""
_SECTION = re.compile(r"(Camera\d?)\.fx")


class _Loader(yaml.SafeLoader):
    """Plain values alone, and OpenCV's matrices as the mappings that they are."""


_Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", yaml.SafeLoader.construct_yaml_map)


def load_tree(text: str) -> dict:
    """The top mapping of a YAML file, OpenCV's `%YAML:1.0` among them. Raises BadCalibrationError or YAMLError."""
    text = re.sub(r"\A%YAML:.*", "", text)  # no directive of YAML's: it has no colon
    tree = yaml.load(text, Loader=_Loader)  # noqa: S506 - a safe loader
    if not isinstance(tree, dict) or not tree:
        raise BadCalibrationError("its top level is not a mapping of names to values")
    return tree


def yaml_cameras(tree: dict) -> list[CalibratedCamera]:
    """The cameras of a tree, in its order. Raises BadCalibrationError where it is none of the known kinds."""
    if "camera_matrix" in tree:
        return [CalibratedCamera(text_of(tree.get("camera_name")) or "camera", "", _camera_info(tree))]
    if "intrinsics" in tree:
        placed = rigid_of(tree["T_BS"]) if "T_BS" in tree else None
        return [CalibratedCamera("camera", "", _intrinsics(tree), body_from_camera=placed)]
    if isinstance(listed := tree.get("cameras"), list):
        return [_listed(part) for part in listed if isinstance(part, dict)]
    if sections := [match[1] for name in tree if isinstance(name, str) and (match := _SECTION.fullmatch(name))]:
        return _settings(tree, sections)
    return _chain(tree)


def _chain(tree: dict) -> list[CalibratedCamera]:
    """Kalibr's camchain: each camera by the one before it (github.com/ethz-asl/kalibr/wiki/yaml-formats)."""
    chain = [(name, part) for name, part in tree.items() if isinstance(part, dict) and "intrinsics" in part]
    if not chain:
        raise BadCalibrationError("it has neither camera_matrix nor intrinsics")
    found, from_first = [], np.eye(4)
    for number, (name, part) in enumerate(chain):
        step = rigid_of(part["T_cn_cnm1"]) if "T_cn_cnm1" in part else None
        from_first = from_first if number == 0 else (None if step is None or from_first is None else step @ from_first)
        placed = se3.inverse(rigid_of(part["T_cam_imu"])) if "T_cam_imu" in part else None
        topic = text_of(part.get("rostopic"))
        found.append(CalibratedCamera(text_of(name), topic, _intrinsics(part), from_first, placed))
    return found


def _camera_info(tree: dict) -> CalibrationMessage:
    """docs.ros.org/en/api/camera_calibration_parsers, and OpenCV's calibration sample, which leaves the rest out."""
    lens = matrix_of(tree.get("distortion_coefficients", []), None)
    size = size_of(tree.get("image_width", 0)), size_of(tree.get("image_height", 0))
    k, p, r = (
        matrix_of(tree.get(f"{name}_matrix", unset.ravel().tolist()), unset.size).reshape(unset.shape)
        for name, unset in (("camera", np.eye(3)), ("projection", np.zeros((3, 4))), ("rectification", np.eye(3)))
    )
    model = text_of(tree.get("distortion_model")) or ("equidistant" if tree.get("fisheye_model") else "")
    return CalibrationMessage(0, "", *size, model, lens, k, p, r)


def _intrinsics(tree: dict) -> CalibrationMessage:
    """github.com/ethz-asl/kalibr/wiki/yaml-formats."""
    kind = tree.get("camera_model", "pinhole")
    if kind != "pinhole":
        raise BadCalibrationError(f"camera_model {reprlib.repr(kind)[:40]} is not supported; pinhole is")
    numbers = numbers_of(tree["intrinsics"], 4)
    lens = tree.get("distortion_coeffs", tree.get("distortion_coefficients", []))
    width, height = numbers_of(tree.get("resolution", [0, 0]), 2)
    model = _model(tree.get("distortion_model", "none"))
    return pinhole(numbers[:2], numbers[2:], (size_of(width), size_of(height)), model, numbers_of(lens, None))


def _model(name: Any) -> str:
    lens = lens_of(name) if isinstance(name, str) else None
    if lens is None and name != "none":
        raise BadCalibrationError(
            f"distortion_model {reprlib.repr(name)[:40]} is none of radtan, radtan8, equidistant, fisheye, none"
        )
    return lens or ""


def _listed(part: dict) -> CalibratedCamera:
    """A camera of VSLAM-LAB's calibration.yaml."""
    focal, centre = (numbers_of(part.get(name), 2).tolist() for name in ("focal_length", "principal_point"))
    named = {kalibrs: part[own] for kalibrs, own in _VSLAM_LAB.items() if own in part}
    calibration = _intrinsics(part | named | {"intrinsics": [*focal, *centre]})
    placed = rigid_of(part["T_BS"]) if "T_BS" in part else None
    return CalibratedCamera(text_of(part.get("cam_name")), "", calibration, None, placed, _per_m(part, "depth_factor"))


def _settings(tree: dict, sections: list[str]) -> list[CalibratedCamera]:
    """The settings of ORB-SLAM 2 and 3, and of VSLAM-LAB before its list of cameras."""
    per_m = _per_m(tree, "RGBD.DepthMapFactor", "DepthMapFactor", "Depth0.factor")
    return [CalibratedCamera(name, "", _section(tree, name), depth_per_m=per_m) for name in sections]


def _per_m(tree: dict, *names: str) -> float | None:
    """Counts of a metre by the first name that is there; None without one, or where it is not positive."""
    factor = next((float(numbers_of([tree[name]], 1)[0]) for name in names if name in tree), 0.0)
    return factor if factor > 0 else None


def _section(tree: dict, name: str) -> CalibrationMessage:
    def numbers(names: str) -> Floats:
        return numbers_of([tree.get(f"{name}.{one}", tree.get(f"Camera.{one}", 0.0)) for one in names.split()], None)

    kind = text_of(tree.get("Camera.type", tree.get(f"{name}.model")))
    model, lens = ("equidistant", "k1 k2 k3 k4") if lens_of(kind) == "equidistant" else ("plumb_bob", "k1 k2 p1 p2 k3")
    width, height = np.maximum(numbers("width height"), numbers("w h"))
    size = size_of(float(width)), size_of(float(height))
    return pinhole(numbers("fx fy"), numbers("cx cy"), size, model, numbers(lens))
