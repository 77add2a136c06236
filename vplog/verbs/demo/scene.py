"""The scene of a drive before it is recorded, and the renderer of its frames.

Textured parallelograms before a pinhole camera: z-buffer, anisotropic texture filter, sun light. Every quad's image is
a homography of its texture, so a pixel costs one 3x3 product.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numba import njit

from vplog.data import Bytes, Camera, Float32s, Floats, Int32s, Ints
from vplog.geometry.se3 import inverse, pose, so3_exp, transform
from vplog.verbs.demo import route
from vplog.verbs.demo.settings import DemoSettings
from vplog.verbs.demo.world import Quads, World, build_world, traffic

CAMERA_FRAME = "camera_optical"
REAR_FRAME = "rear_optical"
BODY_FRAME = "base_link"
_FIELD_OF_VIEW_DEG, _IMAGE_NOISE = 80.0, 1.5
"""Horizontal field of view; standard deviation of the sensor noise in grey levels."""
_MOUNT_M = (0.3, 0.0, 1.5)
"""The camera's position ahead of, left of and above the body's origin on the ground: behind the windscreen."""
_MOUNT_PITCH_RAD = 0.035
"""2 degrees down, so that nothing works that takes the camera for level."""
NEAR_M = 0.2
"""m; the near plane of the renderer."""
MAX_SAMPLES = 6
"""Texture samples along the longer axis of a pixel's footprint: sharp to 80 degrees of slant, blurred beyond."""


class Light(NamedTuple):
    """The light of a moment, and how the camera answers to it."""

    sun: Floats
    """(3,) towards the sun in the world, of length 1."""
    ambient: float
    """0..1 of the light that reaches every surface; the rest falls from the sun."""
    gain: float
    """Grey level of a white surface in full light, in units of 255."""
    gamma: float
    """Exponent of the camera's response: above 1 darkens the middle tones."""
    gradient: float
    """Relative change of brightness from the left to the right edge of the image: a soft shadow across it."""


FIRST_LIGHT = Light(sun=np.array([0.51, -0.31, 0.80]), ambient=0.55, gain=1.1, gamma=1.0, gradient=0.0)
"""A bright morning."""
LATER_LIGHT = Light(sun=np.array([-0.60, 0.50, 0.62]), ambient=0.65, gain=0.85, gamma=1.25, gradient=-0.4)
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


def make_scene(settings: DemoSettings) -> Scene:
    """The scene with a calibrated pinhole camera on the car."""
    focal_px = settings.width / 2 / np.tan(np.radians(_FIELD_OF_VIEW_DEG) / 2)
    matrix = np.array([
        [focal_px, 0, (settings.width - 1) / 2], [0, focal_px, (settings.height - 1) / 2], [0, 0, 1.0],
    ])  # fmt: skip
    level = np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]])  # z ahead, x right, y down in the body's axes
    mount = pose(so3_exp(np.array([0, _MOUNT_PITCH_RAD, 0])) @ level, np.array(_MOUNT_M))
    camera = Camera("camera", matrix, "plumb_bob", np.zeros(5), settings.width, settings.height, mount)
    stamp_ns = route.frame_stamps(settings)
    return Scene(settings, build_world(settings.street()), camera, stamp_ns, route.world_from_body(settings, stamp_ns))


def rear_mount(camera: Camera) -> Floats:
    """body_from_camera of the rear camera: the first one's, turned about the body's vertical."""
    return pose(np.diag([-1.0, -1.0, 1.0]), np.zeros(3)) @ camera.body_from_camera


def take_picture(scene: Scene, frame: int, right_m: float = 0.0, rear: bool = False) -> tuple[Bytes, Float32s]:
    """Grey image (H, W) with sensor noise and depth (H, W) in m, NaN for sky, of one frame of the drive.

    `right_m` moves the camera so far to its right; `rear` takes the one that looks back.
    """
    settings = scene.settings
    time_s = float(scene.stamp_ns[frame] - route.START_NS) * 1e-9
    later = float(route.second_lap_share(settings, np.array(time_s * settings.speed_m_s)))
    light: Any = [(1 - later) * a + later * b for a, b in zip(FIRST_LIGHT, LATER_LIGHT, strict=True)]
    mount = rear_mount(scene.camera) if rear else scene.camera.body_from_camera
    mount = mount @ pose(np.eye(3), np.array([right_m, 0.0, 0.0]))
    occluders = traffic(settings, time_s)
    image, depth = render(scene.world, scene.camera, scene.world_from_body[frame] @ mount, Light(*light), occluders)
    rng = np.random.default_rng([settings.seed, 8 if right_m else 9 if rear else 4, frame])
    noise = rng.standard_normal(image.shape, np.float32) * np.float32(_IMAGE_NOISE)
    return np.clip(np.round(image + noise), 0, 255).astype(np.uint8), depth


def render(
    world: World, camera: Camera, world_from_camera: Floats, light: Light, occluders: Quads | None = None
) -> tuple[Bytes, Float32s]:
    """The grey image (H, W) and the depth (H, W) in m along the camera's z, NaN where there is only sky.

    No noise; the camera has no distortion. Threads may render at the same time.
    """
    quads = world.quads if occluders is None else world.quads.with_others(occluders)
    camera_from_world = inverse(world_from_camera)
    corner = transform(camera_from_world, quads.corner)
    right, down = (v @ camera_from_world[:3, :3].T for v in (quads.right, quads.down))

    # K [right down corner] (u, v, 1) = z (x, y, 1), so its inverse gives (u, v, 1) / z of a pixel.
    matrix: Floats = camera.matrix  # type: ignore[assignment]
    image_from_quad = matrix @ np.stack([right, down, corner], axis=-1)
    boxes = _boxes(camera, np.stack([corner, corner + right, corner + right + down, corner + down], axis=1))
    # The determinant vanishes where the camera is in the plane of the quad: there is nothing to see of it.
    visible = (boxes[:, :2] < boxes[:, 2:]).all(axis=1) & (np.abs(np.linalg.det(image_from_quad)) > 1e-6)
    order = np.flatnonzero(visible)  # near quads first, so that most pixels behind them fail the depth test at once
    order = order[np.argsort(image_from_quad[order, 2].sum(axis=-1), kind="stable")]
    normal = np.cross(quads.down, quads.right)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    lit = light.ambient + (1 - light.ambient) * np.clip(normal @ light.sun, 0, None)

    # The sky is brighter towards the horizon, by z of a pixel's ray in the world.
    up = world_from_camera[2, :3] @ np.linalg.inv(matrix)
    x, y = np.arange(camera.width), np.arange(camera.height)[:, None]
    image = (235 - 60 * np.clip(up[0] * x + up[1] * y + up[2], 0, 1)).astype(np.float32)
    nearness = np.zeros(image.shape)
    _draw(
        np.linalg.inv(image_from_quad[order]),
        boxes[order],
        quads.texture[order],
        lit[order],
        world.textures,
        image,
        nearness,
    )

    across = light.gain / 255 * (1 + light.gradient * np.linspace(-0.5, 0.5, camera.width, dtype=np.float32))
    grey = 255 * np.clip(across * image, 0, 1) ** np.float32(light.gamma)
    with np.errstate(divide="ignore"):
        depth = np.where(nearness > 0, 1 / nearness, np.nan)
    return np.round(grey).astype(np.uint8), depth.astype(np.float32)


def _boxes(camera: Camera, corners: Floats) -> Int32s:
    """Pixels that quads with these corners (Q, 4, 3) in the camera can touch: x0, y0, x1, y1 (Q, 4), ends excluded.

    The whole image where a quad passes the near plane.
    """
    size, z = np.array([camera.width, camera.height]), corners[..., 2]
    pixel = (corners @ camera.matrix.T)[..., :2] / np.maximum(z, NEAR_M)[..., None]  # type: ignore[union-attr]
    ahead, whole = z.max(axis=1, keepdims=True) > NEAR_M, z.min(axis=1, keepdims=True) > NEAR_M
    low = np.where(whole, np.ceil(pixel.min(axis=1)), 0)
    high = np.where(whole, np.floor(pixel.max(axis=1)) + 1, size) * ahead
    return np.concatenate([np.clip(low, 0, size), np.clip(high, 0, size)], axis=1).astype(np.int32)


@njit(cache=True, nogil=True, error_model="numpy")
def _draw(quad_from_image, boxes, texture, lit, textures, image, nearness):
    """Lay quads, near ones first, over an image (H, W) of grey 0..255 in full light and its 1 / depth (H, W)."""
    pixels, levels = textures
    for q in range(len(boxes)):
        h = quad_from_image[q]
        for y in range(boxes[q, 1], boxes[q, 3]):
            u0, v0, w0 = h[0, 1] * y + h[0, 2], h[1, 1] * y + h[1, 2], h[2, 1] * y + h[2, 2]
            for x in range(boxes[q, 0], boxes[q, 2]):
                w = h[2, 0] * x + w0
                if w <= nearness[y, x] or w > 1 / NEAR_M:
                    continue
                u, v = h[0, 0] * x + u0, h[1, 0] * x + v0
                if u >= 0 and v >= 0 and u < w and v < w:
                    nearness[y, x] = w
                    image[y, x] = lit[q] * _filtered(pixels, levels[texture[q]], h, u / w, v / w, 1 / w)


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _filtered(pixels, levels, h, u, v, z):
    """The mean of a picture over the footprint of a pixel at u, v (0..1), a parallelogram."""
    # How far u and v move per pixel in x and in y.
    ux, vx = (h[0, 0] - u * h[2, 0]) * z, (h[1, 0] - v * h[2, 0]) * z
    uy, vy = (h[0, 1] - u * h[2, 1]) * z, (h[1, 1] - v * h[2, 1]) * z
    _, width, height = levels[0]
    along_x, along_y = (ux * width) ** 2 + (vx * height) ** 2, (uy * width) ** 2 + (vy * height) ** 2
    # Several samples along its longer side, from the pyramid level that blurs as much as the shorter side.
    long2, short2 = max(along_x, along_y, 1.0), max(min(along_x, along_y), 1.0)
    du, dv = (ux, vx) if along_x > along_y else (uy, vy)
    samples = int(min(MAX_SAMPLES, np.ceil(np.sqrt(long2 / short2))))
    level = int(min(0.5 * np.log2(max(long2 / samples**2, 1.0)) + 0.5, len(levels) - 1))
    total = 0.0
    for i in range(samples):
        at = (i + 0.5) / samples - 0.5
        total += _bilinear(pixels, levels[level], u + at * du, v + at * dv)
    return total / samples


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _bilinear(pixels, level, u, v):
    """The value of one level of a picture at u, v (0..1)."""
    start, w, h = level
    x, y = min(max(u * w - 0.5, 0.0), w - 1.0), min(max(v * h - 0.5, 0.0), h - 1.0)
    x0, y0 = int(x), int(y)
    right, below = 1 if x0 < w - 1 else 0, w if y0 < h - 1 else 0
    at, fx = start + y0 * w + x0, x - x0
    upper = pixels[at] + fx * (float(pixels[at + right]) - pixels[at])
    lower = pixels[at + below] + fx * (float(pixels[at + below + right]) - pixels[at + below])
    return upper + (y - y0) * (lower - upper)
