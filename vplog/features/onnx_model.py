"""A network in an ONNX file, with what it takes in a YAML file beside it, run by ONNX Runtime on the CPU.

# net.yaml beside net.onnx
size: [224, 224]
multiple: 14
mean: [0.485, 0.456, 0.406]
std: [0.229, 0.224, 0.225]
output: descriptor
"""

from __future__ import annotations

import hashlib
import os
import threading
from functools import lru_cache
from pathlib import Path
from typing import Any, ClassVar, Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from vplog.data import Bytes, Float32s, Frame
from vplog.errors import LibraryError, SettingsError
from vplog.settings import Settings, load_yaml

_MAX_BYTES = 2**31
"""A protobuf message, and so an ONNX file with its weights inside, is smaller (onnx.ai/onnx/repo-docs/IR.html)."""
_MAX_PIXELS = 2**24
"""px that a network gets, 4096 x 4096: some layers need a thousand times as many bytes."""
_INTERPOLATION = {"linear": cv2.INTER_LINEAR, "cubic": cv2.INTER_CUBIC}
_LOADING = threading.Lock()
_DTYPES = {"tensor(float)": np.float32, "tensor(float16)": np.float16}


class NetworkInput(Settings):
    """The pixels that a network takes, and the names of what it gives."""

    size: tuple[int, int] | None = None
    """Height and width in px that an image is resized to; null for its own."""
    multiple: int = Field(default=1, ge=1, le=1024)
    """Each side is reduced to a multiple of this, the patch of a transformer."""
    colour: Literal["rgb", "bgr", "grey"] = "rgb"
    """Order of the channels; `grey` is one."""
    mean: tuple[float, ...] = (0.485, 0.456, 0.406)
    """Subtracted from each channel of 0..1; the default is ImageNet's, as most networks are trained."""
    std: tuple[float, ...] = (0.229, 0.224, 0.225)
    """Divides each channel then."""
    interpolation: Literal["area", "linear", "cubic"] = "area"
    """Interpolation of a resized image; `area` averages where it shrinks and is linear where it grows."""
    layout: Literal["nchw", "nhwc"] = "nchw"
    """Order of the axes: batch, channels, height, width, or with the channels last."""
    input: str = ""
    """Name of the network's input; empty for its only one."""
    output: str = ""
    """Name of the output that is the place's vector; empty for the only one."""

    @model_validator(mode="after")
    def _fits(self) -> NetworkInput:
        channels = 1 if self.colour == "grey" else 3
        if {len(self.mean), len(self.std)} != {channels}:
            raise ValueError(f"mean and std must be of {channels} value(s) for colour {self.colour}")
        if not all(self.std):
            raise ValueError("a std is 0, by which pixels are divided")
        if self.size is not None and not (min(self.size) >= 1 and self.size[0] * self.size[1] <= _MAX_PIXELS):
            raise ValueError(f"size {list(self.size)} must be height and width of at most {_MAX_PIXELS} px together")
        return self

    def image_of(self, frame: Frame) -> Bytes:
        """(H, W, C) uint8 of a frame, in the order of the channels. Needs its `colour`, unless it is grey."""
        if self.colour == "grey":
            return frame.image[..., None]
        if frame.colour is None:
            raise LibraryError("The network takes colour, and the frame was decoded without it.")
        return frame.colour if self.colour == "rgb" else frame.colour[..., ::-1]

    def taken(self, height: int, width: int) -> tuple[int, int]:
        """Height and width in px of what the network gets of an image of this size."""
        height, width = self.size or (height, width)
        return max(height // self.multiple, 1) * self.multiple, max(width // self.multiple, 1) * self.multiple

    def tensor(self, image: Bytes) -> Float32s:
        """(1, C, h, w) or (1, h, w, C) float32 of (H, W, C) pixels: resized, then (value / 255 - mean) / std."""
        height, width = self.taken(*image.shape[:2])
        if height * width > _MAX_PIXELS:
            raise LibraryError(f"The network would get {width} x {height} px. Give it a smaller `size`.")
        pixels = self._resized(image, height, width).reshape(height, width, -1).astype(np.float32)
        pixels = (pixels / np.float32(255) - np.array(self.mean, np.float32)) / np.array(self.std, np.float32)
        return np.ascontiguousarray(pixels.transpose(2, 0, 1) if self.layout == "nchw" else pixels)[None]

    def _resized(self, image: Bytes, height: int, width: int) -> NDArray[Any]:
        if image.shape[:2] == (height, width):
            return image
        shrinks = height <= image.shape[0] and width <= image.shape[1]
        area = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
        return cv2.resize(image, (width, height), interpolation=_INTERPOLATION.get(self.interpolation, area))


class NetworkSettings(Settings):
    """A network by its file. Its YAML and its sha256 become part of the settings when these are read."""

    LOCATIONS: ClassVar = frozenset({"model"})

    model: str = ""
    """Path of the .onnx file; what it takes is in the .yaml of the same name beside it."""
    sha256: str = ""
    """Digest of the file; empty to take it as it is."""
    network: NetworkInput = NetworkInput()
    """Its input and outputs; those left out are read from the YAML."""

    @model_validator(mode="before")
    @classmethod
    def _read_files(cls, tree: Any) -> Any:
        if not isinstance(tree, dict) or not isinstance(tree.get("model"), str) or not tree["model"]:
            return tree
        path = Path(tree["model"]).absolute()
        found = {**tree, "model": str(path)}
        try:
            if not tree.get("sha256"):
                found["sha256"] = hashlib.sha256(_content(path)).hexdigest()
            yaml, given = path.with_suffix(".yaml"), tree.get("network")
            if "network" not in tree:
                found["network"] = cls._network(yaml)
            elif isinstance(given, dict) and not tree.get("sha256") and yaml.exists():  # a run's record has them all
                found["network"] = {**load_yaml(yaml), **given}
        except SettingsError as error:
            raise ValueError(str(error).rstrip(".")) from None
        return found

    @classmethod
    def _network(cls, path: Path) -> Any:
        again = "It says what the network takes: size, mean, std, colour, ..., one a line."
        return type(cls.model_fields["network"].default).read(load_yaml(path, again), str(path))

    def run(self, image: Bytes, outputs: list[str]) -> list[NDArray[Any]]:
        """Outputs of these names for (H, W, C) pixels, the only one for an empty name. Raises LibraryError where the
        network cannot be loaded or does not take them."""
        with _LOADING:  # the first frames of all threads wait for one
            session = _session(self.model, self.sha256)
        inputs = {one.name: one for one in session.get_inputs()}
        known = [one.name for one in session.get_outputs()]
        name = _chosen(self.network.input, list(inputs), f"{self.model}: input")
        dtype = _DTYPES.get(inputs[name].type)
        if dtype is None:
            raise LibraryError(f"{self.model}: input {name} takes {inputs[name].type}; export it for float.")
        names = [_chosen(output, known, f"{self.model}: output") for output in outputs]
        try:
            return session.run(names, {name: self.network.tensor(image).astype(dtype)})
        except Exception as error:  # those of ONNX Runtime have no common base of its own
            why = f"{_first_line(error)} Its .yaml says what it takes."
            raise LibraryError(f"{self.model} cannot be run on an image: {why}") from None


def _chosen(name: str, known: list[str], what: str) -> str:
    if name in known or (not name and len(known) == 1):
        return name or known[0]
    problem = f"{name} is not there" if name else "is not named"
    raise LibraryError(f"{what} {problem}. There are: {', '.join(known)[:500]}. Name one in its .yaml.")


def _content(path: Path) -> bytes:
    try:
        if path.stat().st_size >= _MAX_BYTES:
            raise SettingsError(f"{path} is larger than 2 GB, so it is not an ONNX file with its weights inside.")
        return path.read_bytes()
    except OSError as error:
        raise SettingsError(f"{path} is no network that can be read: {error.strerror}. Name an .onnx file.") from None


@lru_cache(maxsize=4)
def _session(model: str, sha256: str) -> Any:
    """The network, ready to run on one thread: frames are spread over threads already, and sums stay in one order."""
    if not model:
        raise SettingsError("No network is named. Name its file: onnx:MODEL.onnx, or model: MODEL.onnx in a pipeline.")
    try:
        import onnxruntime
    except ImportError:
        raise SettingsError(
            f"{model} needs ONNX Runtime, which is not installed. Install it: pip install onnxruntime"
        ) from None
    data = _content(Path(model))
    if sha256 and hashlib.sha256(data).hexdigest() != sha256:
        raise LibraryError(f"{model} is another network than the settings name, by sha256 {sha256}. Put that one back.")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4
    # all that is run is in the sha256: weights in files beside it, which would be looked for here, are not found
    options.add_session_config_entry("session.model_external_initializers_file_folder_path", os.devnull)
    try:
        return onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # as above
        why = _first_line(error)
        raise LibraryError(
            f"{model} cannot be loaded by ONNX Runtime: {why} Export it with its weights inside."
        ) from None


def _first_line(error: Exception) -> str:
    lines = str(error).strip().splitlines() or [type(error).__name__]
    return lines[0][:300].rstrip(".") + "."
