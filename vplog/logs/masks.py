"""Masks of cameras from files: one picture for all images of a camera, or a folder of one for each image.

A px of zero is masked, as in COLMAP and hloc; of a JPEG or a lossy WebP, which blur edges, what is darker than half. In
a folder the mask of `left/7.jpg` is `left/7.jpg.png`, as COLMAP has it, `left/7.png`, or either name without its
folder; that of a recorded image is called by its stamp in ns.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import Any

import cv2
import numpy as np

from vplog.data import Bools
from vplog.errors import LogError, nearest_path, plural
from vplog.logs.formats.container import Channel, Notes
from vplog.logs.image_folder import is_image
from vplog.logs.messages.pixels import spread
from vplog.storage.image_file import BadImageError, decode_image, image_size, is_lossy

_HALF = 128
_INVERTED = 0.5
"""Share of an image from which it is noted that a mask leaves out so much: many tools write masks the other way
round."""


class Mask:
    """One mask file, decoded when it is needed."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def used(self, size: tuple[int, int]) -> Bools:
        """(H, W) px that count, of images of this width and height. Raises LogError where the mask does not fit."""
        return resized_mask(self.own, size, str(self.path))

    @cached_property
    def own(self) -> Bools:
        """(H, W) px that count, as the file has them. Raises LogError."""
        try:
            data = self.path.read_bytes()
            if image_size(data) is None:
                raise LogError(f"{self.path} is no whole image, so it is no mask. Write it as PNG.")
            image = decode_image(data)
        except OSError as error:
            raise LogError(f"Cannot read the mask {self.path}: {error.strerror or error}.") from None
        except BadImageError as error:
            raise LogError(f"The mask {self.path} cannot be decoded: {error}. Write it as PNG.") from None
        return is_used(image, is_lossy(data))


def is_used(image: Any, lossy: bool) -> Bools:
    """(H, W) px that count, of a mask as it was decoded."""
    return image >= _HALF if lossy else image > 0


class Masks:
    """The masks of one image topic, or none."""

    def __init__(self, path: Path | None, topic: str, files: Mapping[int, str]) -> None:
        """`files` names the images of the topic by stamp, where they are files. Raises LogError where `path` is neither
        an image nor a folder of such."""
        self._path, self._topic, self._files = path, topic, files
        self._one = None if path is None or path.is_dir() else Mask(path)
        self._many: dict[str, Path] = {}
        if path is not None and self._one is None:
            found = sorted(file for file in path.rglob("*") if file.is_file() and is_image(file))
            self._many = {file.relative_to(path).with_suffix("").as_posix(): file for file in found}
            if not found:
                raise LogError(f"{path} has no images, so it is no folder of masks. Give one with --mask.")

    def of(self, stamp_ns: int) -> Mask | None:
        """The mask of an image; None where there is none."""
        if not self._many:
            return self._one
        name = PurePosixPath(self._files.get(stamp_ns, str(stamp_ns)))
        ends = (PurePosixPath(*name.parts[at:]) for at in range(len(name.parts)))
        keys = (str(key) for end in ends for key in (end, end.with_suffix("")))
        return next((Mask(self._many[key]) for key in keys if key in self._many), None)

    def check(self, stamp_ns: Iterable[int], size: tuple[int, int], notes: Notes) -> None:
        """Note what is unlikely to be meant. Raises LogError where no mask is of one of the images, or the first is of
        another shape, or all mask all."""
        if self._path is None:
            return
        found = [self.of(one) for one in stamp_ns]
        masks = [one for one in found if one is not None]
        if not masks:
            raise LogError(
                f"No mask in {self._path} is of an image of {self._topic}: the mask of an image is called like it, "
                "that of a recorded image by its stamp in ns."
            )
        first, *others = masks[:1] if self._one else masks[:: spread(len(masks))]
        used, own = [first.used(size)], first.own.shape[::-1]
        for one in others:
            with suppress(LogError):  # its image is left out
                used.append(one.used(size))
        if own != size:
            notes.add(
                f"{first.path.name} has {own[0]} x {own[1]} px and is resized to the images' {size[0]} x {size[1]}."
            )
        if missing := found.count(None):
            notes.add(
                f"{self._path} has no mask for {plural(missing, 'image')} of {self._topic}; these are used whole."
            )
        if self._one and used[0].all():
            notes.add(
                f"{first.path.name} masks nothing of {self._topic}: a px of zero is masked, and an alpha channel does "
                "not count. Write the mask as grey levels."
            )
        check_share(str(self._path), used, self._topic, notes)


def check_share(name: str, used: Sequence[Bools], topic: str, notes: Notes) -> None:
    """Note masks that leave out most of their images. Raises LogError where they leave out all."""
    if not any(one.any() for one in used):
        raise LogError(f"{name} is black, which masks all of {topic}: zero is masked. Invert it.")
    if (share := 1 - float(np.mean([one.mean() for one in used]))) > _INVERTED:
        notes.add(f"{name} masks {share:.0%} of the images of {topic}; zero is masked: is it inverted?")


def masks_of(
    given: Mapping[str, Path], topics: Mapping[str, Mapping[int, str]], *images: Channel | None
) -> list[Masks]:
    """The masks of each of the topics in use, among those `given` by topic; one without a topic is of the first.

    `topics` names the files of each topic by stamp. Raises LogError where a mask is of none of them, or not there.
    """
    for name, path in given.items():
        if name and name not in topics:
            raise LogError(f"--mask {name}={path}: the log has no topic {name}. Topics: {', '.join(sorted(topics))}.")
        if not path.exists():
            raise LogError(
                f"There is no mask at {path}: --mask takes an image or a folder of them.{nearest_path(path)}"
            )
    named = [image.topic if image else "" for image in images]
    paths = [given.get(topic) if topic else None for topic in named]
    paths[0] = paths[0] or given.get("")
    return [Masks(path, topic, topics.get(topic, {})) for path, topic in zip(paths, named, strict=True)]


def resized_mask(used: Bools, size: tuple[int, int], name: str) -> Bools:
    """(H, W) px that count of images of this width and height, each by the nearest px of the mask. Raises LogError
    where its sides relate otherwise than those of the images, by more than a px of the smaller."""
    height, width = used.shape
    if (width, height) == size:
        return used
    if abs(size[0] * height - size[1] * width) > max(*size, height, width):
        raise LogError(
            f"The mask {name} has {width} x {height} px, another shape than the images' {size[0]} x {size[1]}. "
            "Draw it on an image of this camera."
        )
    return np.asarray(cv2.resize(used.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST_EXACT)) > 0
