"""Depth of a depth camera that is not that of the images, as RealSense and Kinect have it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.logs.drives import START_NS, Written, matrix
from tests.logs.test_camera_changes import image, info, written
from tests.logs.test_motion import tf
from vplog import logs
from vplog.data import Camera
from vplog.loops import undistort

if TYPE_CHECKING:
    from pathlib import Path

    from vplog.data import Frame

SIZE = (160, 120)
K = np.array([[150.0, 0, 79.5], [0, 150.0, 59.5], [0, 0, 1]])
COLOUR_FROM_DEPTH = matrix(np.array([0.06, -0.01, 0.005]), Rotation.from_rotvec([0.01, -0.02, 0.015]))
LENSES = {
    "none": [0.0] * 5, "plumb_bob": [0.1, -0.2, 0.002, -0.001, 0.05], "equidistant": [0.05, -0.01, 0.0, 0.0],
    "rational_polynomial": [0.4, -0.1, 0.001, 0.001, 0.02, 0.3, -0.05, 0.01],
}  # fmt: skip


def rays(size: tuple[int, int], k: np.ndarray, model: str, lens: list[float]) -> np.ndarray:
    """(H, W, 3) of the px of a camera."""
    camera = Camera("", k, model, np.array(lens), *size, np.eye(4))
    found = undistort.rays(camera, np.stack(np.meshgrid(np.arange(size[0]), np.arange(size[1])), -1).reshape(-1, 2))
    return np.concatenate([found, np.ones((len(found), 1))], 1).reshape(size[1], size[0], 3)


def plane_depth(of: np.ndarray, normal: np.ndarray, distance_m: float) -> np.ndarray:
    """Depth of the px with these rays where they meet a plane."""
    return distance_m / (of @ normal)


def seen(
    folder: Path, colour: tuple, depth: tuple, metres: np.ndarray, mount: np.ndarray | None = COLOUR_FROM_DEPTH,
    frames: tuple[str, str] = ("colour", "depth"),
) -> tuple[Frame, list[str]]:  # fmt: skip
    """The first frame of a log of both cameras, each of a size, a matrix or None for no calibration, a model and its
    coefficients, and what is said of it."""
    messages: list[Written] = []
    if mount is not None:
        messages.append(tf(2, "/tf_static", START_NS, (*frames, mount)))
    for i in range(3):
        grey = np.full(colour[0][::-1], 90, np.uint8)
        pixels = [image(grey, i, "/colour/image"), image(metres.astype(np.float32), i, "/depth/image", "32FC1")]
        for (size, k, model, lens), one, frame in zip((colour, depth), pixels, frames, strict=True):
            one.message.header.frame_id = frame
            messages.append(one)
            if k is not None:
                calibration: Any = info(k, size, i)
                calibration.topic, calibration.message.header.frame_id = (
                    one.topic.replace("image", "camera_info"),
                    frame,
                )
                calibration.message.distortion_model = "plumb_bob" if model == "none" else model
                calibration.message.d = np.array(lens)
                messages.append(calibration)
    log = logs.open(written(folder / "drive", messages))
    frame = next(iter(log.frames(log.stamps()))).decode()
    return frame, log.info().warnings


@pytest.mark.parametrize("seed", range(12))
def test_depth_is_brought_to_the_px_of_the_images(seed: int, tmp_path: Path) -> None:
    """Of a sloping plane, by cameras of any size, focal length, lens, and mount within a sensor's head."""
    rng = np.random.default_rng(seed)
    cameras = []
    for models in (sorted(LENSES), ("none", "plumb_bob", "rational_polynomial")):
        width = int(rng.integers(80, 320))
        height = int(width * rng.uniform(0.55, 0.8))
        focal, model = width * rng.uniform(0.7, 1.1), str(rng.choice(models))
        centre = np.array([width, height]) / 2 - 0.5 + rng.normal(0, 2, 2)
        k = np.array([[focal, 0, centre[0]], [0, focal * rng.uniform(0.98, 1.02), centre[1]], [0, 0, 1]])
        cameras.append(((width, height), k, model, LENSES[model]))
    mount = matrix(rng.normal(0, 0.03, 3), Rotation.from_rotvec(rng.normal(0, 0.03, 3)))
    normal, distance_m = Rotation.from_rotvec(rng.normal(0, 0.3, 3)).apply([0, 0, 1]), float(rng.uniform(1, 4))
    metres = plane_depth(rays(*cameras[1]), mount[:3, :3].T @ normal, distance_m - normal @ mount[:3, 3])
    frame, said = seen(tmp_path, cameras[0], cameras[1], metres, mount)
    assert frame.depth is not None
    assert "/depth/image is registered to the images by its calibration" in " ".join(said)
    at = rays(*cameras[0])
    expected = plane_depth(at, normal, distance_m)
    points = (expected[..., None] * at - mount[:3, 3]) @ mount[:3, :3]
    (width, height), k, model, lens = cameras[1]
    px = cv2.projectPoints(points.reshape(-1, 3), np.zeros(3), np.zeros(3), k, np.array(lens))[0].reshape(
        at.shape[0], -1, 2
    )
    inside = ((px > 1) & (px < np.array([width, height]) - 2)).all(-1) & (points[..., 2] > 0)
    assert inside.mean() > 0.3
    known = np.isfinite(frame.depth) & inside
    within = np.s_[3:-3, 3:-3]
    assert known[within].sum() > 0.9995 * inside[within].sum()
    steps = np.abs(np.gradient(expected)).max(0) * max(1.0, cameras[0][1][0, 0] / k[0, 0])  # a px of either image
    assert (np.abs(frame.depth - expected) < 1e-3 + 1.2 * steps)[known].mean() > 0.995


def test_what_is_near_hides_what_is_behind(tmp_path: Path) -> None:
    """A board 0.6 m ahead of a wall at 3 m, seen from 6 cm beside: as its outline in the images has it."""
    colour, depth = ((SIZE, K, "none", LENSES["none"]) for _ in range(2))
    mount = matrix(np.array([0.06, 0.0, 0.0]), Rotation.identity())
    metres = np.full(SIZE[::-1], 3.0)
    metres[30:90, 40:100] = 0.6
    frame, _ = seen(tmp_path, colour, depth, metres, mount)
    assert frame.depth is not None
    near = frame.depth < 1
    shift = round(150 * 0.06 / 0.6)
    expected = np.zeros(SIZE[::-1], bool)
    expected[30:90, 40 + shift : 100 + shift] = True
    np.testing.assert_array_equal(near, expected)
    hidden = round(150 * 0.06 * (1 / 0.6 - 1 / 3.0))
    assert np.isnan(frame.depth[60, 40 + 3 : 40 + shift - 1]).sum() == pytest.approx(hidden, abs=3)


def test_depth_in_the_frame_of_the_images_is_as_logged(tmp_path: Path) -> None:
    camera = SIZE, K, "none", LENSES["none"]
    metres = 1 + np.random.default_rng(1).random(SIZE[::-1])
    frame, said = seen(tmp_path, camera, camera, metres, None, ("colour", "colour"))
    np.testing.assert_allclose(frame.depth, metres, atol=1e-6)  # type: ignore[arg-type]
    assert said == []
    half = (80, 60), np.diag([0.5, 0.5, 1]) @ K, "none", LENSES["none"]
    frame, _ = seen(tmp_path / "half", camera, half, np.full((60, 80), 2.0), None, ("colour", "colour"))
    assert frame.depth is not None
    assert (frame.depth == 2.0).mean() > 0.98


def test_depth_that_cannot_be_registered_is_never_used_silently(tmp_path: Path) -> None:
    metres, lens = np.full(SIZE[::-1], 2.0), ("none", LENSES["none"])
    colour, other = (SIZE, K, *lens), (SIZE, np.diag([0.8, 0.8, 1]) @ K, *lens)
    for name, depth, mount, frames, why in (
        ("mount", other, None, ("colour", "depth"), "no static transform between them"),
        ("matrix", (SIZE, None, *lens), COLOUR_FROM_DEPTH, ("colour", "depth"), "no calibration of both"),
        ("frames", other, None, ("0", "0"), "its calibration is not theirs"),
    ):
        frame, said = seen(tmp_path / name, colour, depth, metres, mount, frames)
        assert frame.depth is not None
        assert "/depth/image is taken to be registered to the images" in " ".join(said)
        assert why in " ".join(said)
    back = matrix(np.zeros(3), Rotation.from_euler("y", 180, degrees=True))
    frame, said = seen(tmp_path / "back", colour, other, metres, back)
    assert frame.depth is None
    assert "Depth is not used: /depth/image looks another way than the images, by 180 degrees" in " ".join(said)
    small = (80, 60), other[1], *lens
    frame, said = seen(tmp_path / "small", colour, small, metres[:60, :80], None)
    assert frame.depth is None
    assert "Depth is not used: /depth/image has 80 x 60 px, the images 160 x 120." in said


def test_a_depth_calibration_of_its_own_is_not_that_of_the_images(tmp_path: Path) -> None:
    """With one calibration in the log, depth has none of its own."""
    camera = SIZE, K, "none", LENSES["none"]
    metres = np.full(SIZE[::-1], 2.0)
    frame, said = seen(tmp_path, camera, (SIZE, None, "none", []), metres, None, ("colour", "colour"))
    assert frame.depth is not None and said == []
