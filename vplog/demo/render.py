"""A small renderer: textured quads through a pinhole camera with exact occlusion, filtered textures and sun light.

Every quad's image is a homography of its texture, so a pixel costs one 3x3 product; the nearest quad of every pixel
is found first (z-buffer), then each pixel is shaded once.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass
from typing import TYPE_CHECKING

import numpy as np
from numba import njit

from vplog.geometry import inverse, transform

if TYPE_CHECKING:
    from vplog.data import Bytes, Camera, Float32s, Floats, Int32s
    from vplog.demo.world import Quads, World

NEAR_M = 0.2
"""What is nearer than this to the camera plane is not drawn."""
MAX_SAMPLES = 6
"""Texture samples along the longer axis of a pixel's footprint: sharp to 80 degrees of slant, blurred beyond."""


@dataclass(frozen=True)
class Light:
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

        def mix(a: float, b: float) -> float:
            return (1 - share) * a + share * b

        x, y, z = map(mix, self.sun, other.sun)
        norm = float(np.sqrt(x * x + y * y + z * z))
        _, *mine = astuple(self)
        _, *theirs = astuple(other)
        return Light((x / norm, y / norm, z / norm), *map(mix, mine, theirs))


def render(
    world: World, camera: Camera, world_from_camera: Floats, light: Light, occluders: Quads | None = None
) -> tuple[Bytes, Float32s]:
    """The grey image (H, W) and the depth (H, W) in m along the camera's z, NaN where there is only sky.

    No noise; the camera has no distortion. Threads may render at the same time.
    """
    assert camera.matrix is not None  # noqa: S101 - the demo's camera is calibrated
    quads = world.quads if occluders is None else world.quads + occluders
    camera_from_world = inverse(world_from_camera)
    corner = transform(camera_from_world, quads.corner)
    right, down = (v @ camera_from_world[:3, :3].T for v in (quads.right, quads.down))

    # K [right down corner] (u, v, 1) = z (x, y, 1), so its inverse gives (u, v, 1) / z of a pixel.
    image_from_quad = camera.matrix @ np.stack([right, down, corner], axis=-1)
    boxes = _boxes(camera, np.stack([corner, corner + right, corner + right + down, corner + down], axis=1))
    # The determinant vanishes where the camera is in the plane of the quad: there is nothing to see of it.
    seen = (boxes[:, 2] > boxes[:, 0]) & (boxes[:, 3] > boxes[:, 1]) & (np.abs(np.linalg.det(image_from_quad)) > 1e-6)
    image_from_quad, boxes = image_from_quad[seen], boxes[seen]
    texture, mask = quads.texture[seen], quads.mask[seen]

    normal = np.cross(quads.down[seen], quads.right[seen])
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    lit = light.ambient + (1 - light.ambient) * np.clip(normal @ np.array(light.sun), 0, None)

    # Near quads first, so that most pixels behind them fail the depth test at once.
    order = np.argsort(image_from_quad[:, 2].sum(axis=-1), kind="stable")
    quad_from_image = np.linalg.inv(image_from_quad)[order]
    pixels, levels = world.textures.pixels, world.textures.levels
    owner = np.full((camera.height, camera.width), -1, np.int32)
    nearness = np.zeros((camera.height, camera.width))
    _find_nearest(quad_from_image, boxes[order], mask[order], pixels, levels, owner, nearness)
    up = world_from_camera[2, :3] @ np.linalg.inv(camera.matrix)  # z of a pixel's ray in the world
    shade = _shade(quad_from_image, texture[order], lit[order], pixels, levels, owner, nearness, up)

    across = light.gain / 255 * (1 + light.gradient * np.linspace(-0.5, 0.5, camera.width, dtype=np.float32))
    image = 255 * np.clip(across * shade, 0, 1) ** np.float32(light.gamma)
    depth = np.full(nearness.shape, np.nan, np.float32)
    np.divide(1, nearness, out=depth, where=nearness > 0, casting="same_kind")
    return np.round(image).astype(np.uint8), depth


def _boxes(camera: Camera, corners: Floats) -> Int32s:
    """Pixels that quads with these corners (Q, 4, 3) in the camera can touch: x0, y0, x1, y1 (Q, 4), ends excluded."""
    following = np.roll(corners, -1, axis=1)
    # Where an edge passes the near plane, the crossing bounds the visible part.
    rise = following[..., 2] - corners[..., 2]
    share = (NEAR_M - corners[..., 2]) / np.where(rise == 0, 1, rise)
    crossing = corners + share[..., None] * (following - corners)
    points = np.concatenate([corners, crossing], axis=1)
    visible = np.concatenate([corners[..., 2] >= NEAR_M, (rise != 0) & (share > 0) & (share < 1)], axis=1)
    z = np.where(visible, np.maximum(points[..., 2], NEAR_M), 1.0)
    pixel = (points @ camera.matrix.T)[..., :2] / z[..., None]  # type: ignore[union-attr]
    low = np.where(visible[..., None], pixel, np.inf).min(axis=1)
    high = np.where(visible[..., None], pixel, -np.inf).max(axis=1)
    size = np.array([camera.width, camera.height])
    return np.concatenate([np.clip(np.ceil(low), 0, size), np.clip(np.floor(high) + 1, 0, size)], axis=1).astype(
        np.int32
    )


@njit(nogil=True, error_model="numpy")
def _find_nearest(quad_from_image, boxes, mask, pixels, levels, owner, nearness):
    """The nearest quad of every pixel in `owner` (H, W), and 1 / its depth in `nearness` (H, W)."""
    for q in range(len(boxes)):
        h = quad_from_image[q]
        for y in range(boxes[q, 1], boxes[q, 3]):
            u0, v0, w0 = h[0, 1] * y + h[0, 2], h[1, 1] * y + h[1, 2], h[2, 1] * y + h[2, 2]
            for x in range(boxes[q, 0], boxes[q, 2]):
                w = h[2, 0] * x + w0
                if w <= nearness[y, x] or w > 1 / NEAR_M:
                    continue
                u, v = h[0, 0] * x + u0, h[1, 0] * x + v0
                if u < 0 or v < 0 or u >= w or v >= w:
                    continue
                if mask[q] >= 0:
                    start, width, height = levels[mask[q], 1]  # half size: an outline needs no more
                    if pixels[start + int(v / w * height) * width + int(u / w * width)] < 128:
                        continue
                nearness[y, x] = w
                owner[y, x] = q


@njit(nogil=True, error_model="numpy")
def _shade(quad_from_image, texture, lit, pixels, levels, owner, nearness, up):
    """(H, W) grey 0..255: textures filtered over each pixel's footprint, times the light on them, before the sky."""
    rows, columns = owner.shape
    image = np.empty((rows, columns), np.float32)
    for y in range(rows):
        for x in range(columns):
            q = owner[y, x]
            if q < 0:  # sky: brighter towards the horizon, and nothing to hold on to
                image[y, x] = 235 - 60 * min(1.0, max(0.0, up[0] * x + up[1] * y + up[2]))
                continue
            a, b, c = quad_from_image[q, 0, 0], quad_from_image[q, 0, 1], quad_from_image[q, 0, 2]
            d, e, f = quad_from_image[q, 1, 0], quad_from_image[q, 1, 1], quad_from_image[q, 1, 2]
            g, h = quad_from_image[q, 2, 0], quad_from_image[q, 2, 1]
            z = 1 / nearness[y, x]
            u, v = (a * x + b * y + c) * z, (d * x + e * y + f) * z
            # How far u and v move per pixel in x and in y: the pixel's footprint in the texture, a parallelogram.
            ux, uy, vx, vy = (a - u * g) * z, (b - u * h) * z, (d - v * g) * z, (e - v * h) * z
            t = texture[q]
            width2, height2 = float(levels[t, 0, 1]) ** 2, float(levels[t, 0, 2]) ** 2
            along_x, along_y = ux * ux * width2 + vx * vx * height2, uy * uy * width2 + vy * vy * height2
            # Several samples along its longer side, from the pyramid level that blurs as much as the shorter side.
            if along_x > along_y:
                long2, short2, du, dv = along_x, along_y, ux, vx
            else:
                long2, short2, du, dv = along_y, along_x, uy, vy
            samples = int(min(MAX_SAMPLES, np.ceil(np.sqrt(max(long2, 1.0) / max(short2, 1.0)))))
            each = 1.0 / samples
            level = min(0.5 * np.log2(max(long2 * each * each, 1.0)), levels.shape[1] - 1.001)
            low = int(level)
            share = level - low
            total = 0.0
            for k in range(2):
                start, w, n = levels[t, low + k, 0], levels[t, low + k, 1], levels[t, low + k, 2]
                step_x, step_y = du * w * each, dv * n * each
                px, py = (u - 0.5 * du) * w - 0.5 - 0.5 * step_x, (v - 0.5 * dv) * n - 0.5 - 0.5 * step_y
                part = 0.0
                for _ in range(samples):
                    px, py = px + step_x, py + step_y
                    left, top = min(max(px, 0.0), w - 1.0), min(max(py, 0.0), n - 1.0)
                    x0, y0 = int(left), int(top)
                    right = 1 if x0 < w - 1 else 0
                    above = start + y0 * w + x0
                    below = above + w if y0 < n - 1 else above
                    fx = left - x0
                    upper = pixels[above] + fx * (float(pixels[above + right]) - pixels[above])
                    lower = pixels[below] + fx * (float(pixels[below + right]) - pixels[below])
                    part += upper + (top - y0) * (lower - upper)
                total += part * (share if k == 1 else 1 - share)
                if share == 0:
                    break
            image[y, x] = total * each * lit[q]
    return image
