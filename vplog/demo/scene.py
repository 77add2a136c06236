"""Everything there is to know about a drive before it is recorded; any frame of it can be rendered alone."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from vplog.data import Camera
from vplog.demo import route
from vplog.demo.render import Light, render
from vplog.demo.world import World, build_world, traffic
from vplog.geometry.se3 import pose

if TYPE_CHECKING:
    from vplog.data import Bytes, Float32s, Floats, Ints
    from vplog.demo.settings import DemoSettings

CAMERA_FRAME = "camera_optical"
BODY_FRAME = "base_link"
_MOUNT_M = (0.3, 0.0, 1.5)
"""Of the camera ahead of, left of and above the body's origin on the ground: behind the windscreen."""
_MOUNT_PITCH_RAD = 0.035
"""2 degrees down, so that nothing works that takes the camera for level."""

FIRST_LIGHT = Light(sun=(0.51, -0.31, 0.80), ambient=0.55, gain=1.1, gamma=1.0, gradient=0.0)
"""A bright morning."""
LATER_LIGHT = Light(sun=(-0.60, 0.50, 0.62), ambient=0.65, gain=0.85, gamma=1.25, gradient=-0.4)
"""The sun from the other side, a shorter exposure, a harder response and a soft shadow across the image."""


@dataclass(frozen=True, eq=False)
class Scene:
    """The street, the camera and where the car truly is at every frame."""

    settings: DemoSettings
    world: World
    camera: Camera
    stamp_ns: Ints
    """(F,) of the frames."""
    world_from_body: Floats
    """(F, 4, 4) truth at the frames."""


def make_camera(settings: DemoSettings) -> Camera:
    """The calibrated pinhole camera on the car."""
    focal_px = settings.width / 2 / np.tan(np.radians(settings.field_of_view_deg) / 2)
    centre = (settings.width - 1) / 2, (settings.height - 1) / 2
    matrix = np.array([[focal_px, 0, centre[0]], [0, focal_px, centre[1]], [0, 0, 1.0]])
    level = np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]])  # z ahead, x right, y down in the body's axes
    c, s = np.cos(_MOUNT_PITCH_RAD), np.sin(_MOUNT_PITCH_RAD)
    pitch = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    mount = pose(pitch @ level, np.array(_MOUNT_M))
    return Camera("camera", matrix, "plumb_bob", np.zeros(5), settings.width, settings.height, mount)


def make_scene(settings: DemoSettings) -> Scene:
    stamp_ns = route.frame_stamps(settings)
    return Scene(
        settings, build_world(settings), make_camera(settings), stamp_ns, route.world_from_body(settings, stamp_ns)
    )


def take_picture(scene: Scene, frame: int, right_m: float = 0.0) -> tuple[Bytes, Float32s]:
    """Grey image (H, W) with sensor noise and depth (H, W) in m, NaN for sky, of one frame of the drive.

    `right_m` moves the camera so far to its right.
    """
    settings = scene.settings
    time_s = float(scene.stamp_ns[frame] - route.START_NS) * 1e-9
    share = float(route.second_lap_share(settings, np.array(time_s * settings.speed_m_s)))
    image, depth = render(
        scene.world,
        scene.camera,
        scene.world_from_body[frame] @ scene.camera.body_from_camera @ pose(np.eye(3), np.array([right_m, 0.0, 0.0])),
        FIRST_LIGHT.towards(LATER_LIGHT, share),
        traffic(scene.world, settings, time_s),
    )
    rng = np.random.default_rng([settings.seed, 4, frame] if right_m == 0 else [settings.seed, 8, frame])
    noise = rng.standard_normal(image.shape, np.float32) * np.float32(settings.image_noise)
    return np.clip(np.round(image + noise), 0, 255).astype(np.uint8), depth
