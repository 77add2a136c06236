"""Calibrations in YAML: ROS camera_info, OpenCV, Kalibr's camchain, EuRoC's sensor.yaml, VSLAM-LAB and ORB-SLAM."""

from __future__ import annotations

import re
import reprlib
from dataclasses import replace
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
_LONGEST_S = 3600.0
"""s between the clocks of camera and IMU, at most."""


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
    if "LEFT.K" in tree:  # Camera.fx is of the images that ORB-SLAM 2 makes of these (its Examples/Stereo/EuRoC.yaml)
        return [_raw(tree, side) for side in ("LEFT", "RIGHT") if f"{side}.K" in tree]
    if sections := [match[1] for name in tree if isinstance(name, str) and (match := _SECTION.fullmatch(name))]:
        return _settings(tree, sections)
    return _chain(tree)


def _chain(tree: dict) -> list[CalibratedCamera]:
    """Kalibr's camchain: each camera by the one before it (github.com/ethz-asl/kalibr/wiki/yaml-formats); and that of
    OpenVINS, with `T_imu_cam`."""
    chain = [(name, part) for name, part in tree.items() if isinstance(part, dict) and "intrinsics" in part]
    if not chain:
        raise BadCalibrationError("it has neither camera_matrix nor intrinsics")
    found, from_first = list[CalibratedCamera](), np.eye(4)
    for name, part in chain:
        placed = se3.inverse(rigid_of(part["T_cam_imu"])) if "T_cam_imu" in part else None
        placed = rigid_of(part["T_imu_cam"]) if "T_imu_cam" in part else placed
        step = rigid_of(part["T_cn_cnm1"]) if "T_cn_cnm1" in part else None
        if step is None and found and placed is not None and (last := found[-1].body_from_camera) is not None:
            step = se3.inverse(placed) @ last
        if found:
            from_first = None if step is None or from_first is None else step @ from_first
        topic, shift_s = text_of(part.get("rostopic")), float(numbers_of([part.get("timeshift_cam_imu", 0.0)], 1)[0])
        if abs(shift_s) > _LONGEST_S:
            raise BadCalibrationError(f"its timeshift_cam_imu of {shift_s:g} s is longer than an hour")
        known = _intrinsics(part)
        found.append(CalibratedCamera(text_of(name), topic, known, from_first, placed, True, shift_s))
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
    per_m = _per_m(part, "depth_factor")
    return CalibratedCamera(text_of(part.get("cam_name")), "", calibration, body_from_camera=placed, depth_per_m=per_m)


def _settings(tree: dict, sections: list[str]) -> list[CalibratedCamera]:
    """The settings of ORB-SLAM 2 and 3, and of VSLAM-LAB before its list of cameras."""
    per_m = _per_m(tree, "RGBD.DepthMapFactor", "DepthMapFactor", "Depth0.factor")
    from_first, mounts = {sections[0]: np.eye(4)}, {sections[0]: _mount(tree)}
    if "Stereo.T_c1_c2" in tree:
        from_first["Camera2"] = se3.inverse(rigid_of(tree["Stereo.T_c1_c2"]))
    cameras = [
        CalibratedCamera(
            name, "", _section(tree, name), from_first.get(name), mounts.get(name), True, depth_per_m=per_m
        )
        for name in sections
    ]
    if len(cameras) == 1 and per_m is None and (baseline_m := _baseline_m(tree, cameras[0].calibration)):
        first = replace(cameras[0], name="Camera1")
        right_from_left = se3.pose(np.eye(3), np.array([-baseline_m, 0.0, 0.0]))
        cameras = [first, CalibratedCamera("Camera2", "", first.calibration, right_from_left, None, True)]
    return cameras


def _baseline_m(tree: dict, calibration: CalibrationMessage) -> float:
    """Baseline of a rectified pair in m, as ORB-SLAM 3 names it since 1.0, and before; 0 without one.

    The settings of a depth camera have one, too, for a right image that ORB-SLAM computes from the depth.
    """
    baseline_m, in_px = (float(numbers_of([tree.get(name, 0.0)], 1)[0]) for name in ("Stereo.b", "Camera.bf"))
    return max(baseline_m or in_px / max(calibration.matrix[0, 0], 1.0), 0.0)


def _raw(tree: dict, side: str) -> CalibratedCamera:
    """A camera of a pair before it is rectified, with the R and P by which it is."""
    info = {"camera": "K", "rectification": "R", "projection": "P"}
    named = {f"{name}_matrix": tree[f"{side}.{own}"] for name, own in info.items() if f"{side}.{own}" in tree}
    size = {f"image_{name}": tree.get(f"{side}.{name}", tree.get(f"Camera.{name}", 0)) for name in ("width", "height")}
    lens = {"distortion_coefficients": tree.get(f"{side}.D", []), "distortion_model": _lens(tree, side)}
    mount = _mount(tree) if side == "LEFT" else None
    return CalibratedCamera(side, "", _camera_info(named | size | lens), None, mount, True)


def _mount(tree: dict) -> Floats | None:
    """(4, 4) IMU from the first camera, as ORB-SLAM 3 has it since 1.0, and before; None without."""
    return next((rigid_of(tree[name]) for name in ("IMU.T_b_c1", "Tbc") if name in tree), None)


def _lens(tree: dict, name: str) -> str:
    kind = text_of(tree.get("Camera.type", tree.get(f"{name}.model")))
    return "equidistant" if lens_of(kind) == "equidistant" else "plumb_bob"


def _per_m(tree: dict, *names: str) -> float | None:
    """Counts of a metre by the first name that is there; None without one, or where it is not positive."""
    factor = next((float(numbers_of([tree[name]], 1)[0]) for name in names if name in tree), 0.0)
    return factor if factor > 0 else None


def _section(tree: dict, name: str) -> CalibrationMessage:
    def numbers(names: str) -> Floats:
        return numbers_of([tree.get(f"{name}.{one}", tree.get(f"Camera.{one}", 0.0)) for one in names.split()], None)

    model = _lens(tree, name)
    lens = "k1 k2 k3 k4" if model == "equidistant" else "k1 k2 p1 p2 k3"
    width, height = np.maximum(numbers("width height"), numbers("w h"))
    size = size_of(float(width)), size_of(float(height))
    return pinhole(numbers("fx fy"), numbers("cx cy"), size, model, numbers(lens))
