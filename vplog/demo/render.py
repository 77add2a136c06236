"""A renderer of textured parallelograms: pinhole camera, z-buffer, anisotropic texture filter, sun light.

Every quad's image is a homography of its texture, so a pixel costs one 3x3 product; the nearest quad of every pixel
is found first (z-buffer), then each pixel is shaded once.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numba import njit

from vplog.geometry.se3 import inverse, transform

if TYPE_CHECKING:
    from vplog.data import Bytes, Camera, Float32s, Floats, Int32s
    from vplog.demo.world import Quads, World

NEAR_M = 0.2
"""What is nearer than this to the camera plane is not drawn."""
MAX_SAMPLES = 6
"""Texture samples along the longer axis of a pixel's footprint: sharp to 80 degrees of slant, blurred beyond."""


class Light(NamedTuple):
    """The light of a moment, and how the camera answers to it."""

    sun: tuple[float, float, float]
    """Direction to the sun in the world, of length 1."""
    ambient: float
    """0..1 of the light that reaches every surface; the rest falls from the sun."""
    gain: float
    """Grey level of a white surface in full light, in units of 255."""
    gamma: float
    """Exponent of the camera's response: above 1 darkens the middle tones."""
    gradient: float
    """Relative change of brightness from the left to the right edge of the image: a soft shadow across it."""

    def towards(self, other: Light, share: float) -> Light:
        """The light `share` (0..1) of the way to another."""
        x, y, z = (1 - share) * np.array(self.sun) + share * np.array(other.sun)
        norm = float(np.sqrt(x * x + y * y + z * z))
        rest = ((1 - share) * a + share * b for a, b in zip(self[1:], other[1:], strict=True))
        return Light((x / norm, y / norm, z / norm), *rest)


def render(
    world: World, camera: Camera, world_from_camera: Floats, light: Light, occluders: Quads | None = None
) -> tuple[Bytes, Float32s]:
    """The grey image (H, W) and the depth (H, W) in m along the camera's z, NaN where there is only sky.

    No noise; the camera has no distortion. Threads may render at the same time.
    """
    assert camera.matrix is not None  # noqa: S101 - the demo's camera is calibrated
    quads = world.quads if occluders is None else world.quads.with_others(occluders)
    camera_from_world = inverse(world_from_camera)
    corner = transform(camera_from_world, quads.corner)
    right, down = (v @ camera_from_world[:3, :3].T for v in (quads.right, quads.down))

    # K [right down corner] (u, v, 1) = z (x, y, 1), so its inverse gives (u, v, 1) / z of a pixel.
    image_from_quad = camera.matrix @ np.stack([right, down, corner], axis=-1)
    boxes = _boxes(camera, np.stack([corner, corner + right, corner + right + down, corner + down], axis=1))
    # The determinant vanishes where the camera is in the plane of the quad: there is nothing to see of it.
    visible = (boxes[:, :2] < boxes[:, 2:]).all(axis=1) & (np.abs(np.linalg.det(image_from_quad)) > 1e-6)
    normal = np.cross(quads.down, quads.right)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    lit = light.ambient + (1 - light.ambient) * np.clip(normal @ np.array(light.sun), 0, None)

    # Near quads first, so that most pixels behind them fail the depth test at once.
    order = np.flatnonzero(visible)
    order = order[np.argsort(image_from_quad[order, 2].sum(axis=-1), kind="stable")]
    quad_from_image = np.linalg.inv(image_from_quad[order])
    owner, nearness = _find_nearest(quad_from_image, boxes[order], camera.height, camera.width)
    up = world_from_camera[2, :3] @ np.linalg.inv(camera.matrix)  # z of a pixel's ray in the world
    pixels, levels = world.textures
    shade = _shade(quad_from_image, quads.texture[order], lit[order], pixels, levels, owner, nearness, up)

    across = light.gain / 255 * (1 + light.gradient * np.linspace(-0.5, 0.5, camera.width, dtype=np.float32))
    image = 255 * np.clip(across * shade, 0, 1) ** np.float32(light.gamma)
    depth = np.full(nearness.shape, np.nan, np.float32)
    np.divide(1, nearness, out=depth, where=nearness > 0, casting="same_kind")
    return np.round(image).astype(np.uint8), depth


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
def _find_nearest(quad_from_image, boxes, rows, columns):
    """The nearest quad of every pixel (H, W), -1 where there is none, and 1 / its depth (H, W)."""
    owner = np.full((rows, columns), -1, np.int32)
    nearness = np.zeros((rows, columns))
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
                    owner[y, x] = q
    return owner, nearness


@njit(cache=True, nogil=True, error_model="numpy")
def _shade(quad_from_image, texture, lit, pixels, levels, owner, nearness, up):
    """(H, W) grey 0..255: textures filtered over each pixel's footprint, times the light on them, before the sky."""
    rows, columns = owner.shape
    image = np.empty((rows, columns), np.float32)
    for y in range(rows):
        for x in range(columns):
            q = owner[y, x]
            if q < 0:  # sky: brighter towards the horizon, and without texture
                image[y, x] = 235 - 60 * min(1.0, max(0.0, up[0] * x + up[1] * y + up[2]))
                continue
            h, z, full = quad_from_image[q], 1 / nearness[y, x], levels[texture[q], 0]
            u, v = (h[0, 0] * x + h[0, 1] * y + h[0, 2]) * z, (h[1, 0] * x + h[1, 1] * y + h[1, 2]) * z
            # How far u and v move per pixel in x and in y: the pixel's footprint in the texture, a parallelogram.
            ux, vx = (h[0, 0] - u * h[2, 0]) * z, (h[1, 0] - v * h[2, 0]) * z
            uy, vy = (h[0, 1] - u * h[2, 1]) * z, (h[1, 1] - v * h[2, 1]) * z
            along_x, along_y = (ux * full[1]) ** 2 + (vx * full[2]) ** 2, (uy * full[1]) ** 2 + (vy * full[2]) ** 2
            # Several samples along its longer side, from the pyramid level that blurs as much as the shorter side.
            long2, short2 = max(along_x, along_y, 1.0), max(min(along_x, along_y), 1.0)
            du, dv = (ux, vx) if along_x > along_y else (uy, vy)
            samples = int(min(MAX_SAMPLES, np.ceil(np.sqrt(long2 / short2))))
            level = int(min(0.5 * np.log2(max(long2 / samples**2, 1.0)) + 0.5, levels.shape[1] - 1))
            total = 0.0
            for i in range(samples):
                at = (i + 0.5) / samples - 0.5
                total += _bilinear(pixels, levels[texture[q], level], u + at * du, v + at * dv)
            image[y, x] = total / samples * lit[q]
    return image


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
