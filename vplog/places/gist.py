"""GIST: Oliva & Torralba, Modeling the shape of the scene, IJCV 42(3), 2001, with the filters of their published code.

The energy of a bank of Gabor filters over the prefiltered image, averaged over a coarse grid.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Literal

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from pydantic import Field

from vplog.data import THUMBNAIL_SIDE, Bytes, Features, Float32s, Reference
from vplog.execution.execution import Execution
from vplog.places.dense import VectorState, nearness, thumbnail_of
from vplog.places.library_files import RelearnedSettings, keep_references

_PREFILTER_PAD, _PREFILTER_CYCLES, _LEAST_CONTRAST = 5, 4, 0.2
"""px mirrored around the image, cycles an image where the low-pass falls to half, and what is added to the contrast."""
_PAD = 32
"""px mirrored around the prefiltered image, so that the filters do not see it wrap around."""
_HIGHEST, _OCTAVE = 0.3, 1.85
"""Centre of the finest scale in cycles a px, and how many times lower each next one is."""
_RADIAL, _ANGULAR = 3.5, 16.0
"""Falloff of a filter along frequency, and along angle for 32 orientations; fewer orientations are wider."""


class GistSettings(RelearnedSettings):
    """The spatial envelope of the whole image. It learns nothing: the references only go into the library."""

    kind: Literal["gist"] = "gist"
    """Name of the recogniser."""
    scales: int = Field(default=4, ge=1, le=8)
    """Scales of the Gabor filters."""
    orientations: int = Field(default=8, ge=1, le=32)
    """Orientations of the Gabor filters at each scale."""
    blocks: Literal[1, 2, 4, 8] = 4
    """Blocks along each side of the image in which a filter's energy is averaged."""

    def learn(self, references: Iterable[Reference], execution: Execution) -> GistState:
        """Nothing to learn. Raises LibraryError where there is no reference."""
        return GistState(self, keep_references(references))


class GistState(VectorState):
    """The filters. Shared freely between threads."""

    similarity = staticmethod(nearness)

    def __init__(self, settings: GistSettings, references: list[Reference]) -> None:
        super().__init__(settings, references)
        s = settings
        self.arrow_type = pa.list_(pa.float16(), s.scales * s.orientations * s.blocks**2)
        self._low_pass = _low_pass(THUMBNAIL_SIDE + 2 * _PREFILTER_PAD)
        self._filters = gabor_filters(THUMBNAIL_SIDE + 2 * _PAD, s.scales, s.orientations)

    def describe(self, features: Features) -> NDArray[np.float16]:
        """(D,) mean energy by scale, orientation, then block, row by row. Needs the thumbnail."""
        flat = np.pad(self._prefilter(thumbnail_of(features)), _PAD, "symmetric")
        spectrum = np.fft.fft2(flat)
        inside = slice(_PAD, _PAD + THUMBNAIL_SIDE)
        n = self.settings.blocks
        side = THUMBNAIL_SIDE // n
        energy = [
            np.abs(np.fft.ifft2(spectrum * each)[inside, inside]).reshape(n, side, n, side).mean(axis=(1, 3))
            for each in self._filters
        ]
        return np.array(energy, np.float16).reshape(-1)

    def _prefilter(self, image: Bytes) -> Float32s:
        """Log intensities without their low frequencies, over the local contrast: shadows and exposure matter less."""
        padded = np.pad(np.log1p(image.astype(np.float32)), _PREFILTER_PAD, "symmetric")
        high = padded - self._blur(padded)
        contrast = np.sqrt(np.abs(self._blur(high * high)))
        inside = slice(_PREFILTER_PAD, _PREFILTER_PAD + THUMBNAIL_SIDE)
        return (high / (np.float32(_LEAST_CONTRAST) + contrast))[inside, inside]

    def _blur(self, image: Float32s) -> Float32s:
        return np.fft.ifft2(np.fft.fft2(image) * self._low_pass).real.astype(np.float32)


def _low_pass(side: int) -> Float32s:
    """(side, side) Gaussian in the Fourier domain, one half at 4 cycles an image."""
    cycles = np.fft.fftfreq(side) * side
    squared = cycles[:, None] ** 2 + cycles[None] ** 2
    return np.exp(-np.log(2) * squared / _PREFILTER_CYCLES**2).astype(np.float32)


def gabor_filters(side: int, scales: int, orientations: int) -> Float32s:
    """(scales * orientations, side, side) in the Fourier domain, finest scale first: a bump around one frequency."""
    y, x = np.meshgrid(np.fft.fftfreq(side), np.fft.fftfreq(side), indexing="ij")
    frequency, angle = np.hypot(x, y), np.arctan2(y, x)
    falloff = _ANGULAR * (orientations / 32) ** 2
    filters = []
    for centre in _HIGHEST / _OCTAVE ** np.arange(scales):
        radial = _RADIAL * (frequency / centre - 1) ** 2
        for orientation in range(orientations):
            turn = (angle + np.pi * orientation / orientations + np.pi) % (2 * np.pi) - np.pi
            filters.append(np.exp(-radial - 2 * np.pi * falloff * turn**2))
    return np.array(filters, np.float32)
