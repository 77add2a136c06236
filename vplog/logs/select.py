"""Which topic of a log plays which part.

An image topic is depth where its encoding is 16UC1 or 32FC1, or compressedDepth, or mono16 under a name with `depth`.
Static transforms are those of all topics whose name ends in `static`. Of several topics that could play one of the
other parts the first by these rules does, unless TopicChoice names another:
- image: calibrated first, then most messages, then name;
- depth: with the image's frame_id first, then the longest namespace in common with it, then most messages, then name;
- camera_info: of those whose namespace holds the image (`/cam0/camera_info` and `/cam0/image_raw/compressed`), else of
  those with the image's frame_id: longest namespace in common, then the same frame_id, calibrated, most messages, name;
- odometry: nav_msgs/Odometry first, then types with a covariance, then most messages, then name;
- gps: most messages, then name.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from vplog.errors import LogError
from vplog.settings import Settings

if TYPE_CHECKING:
    from collections.abc import Callable

    from vplog.logs.containers import Channel


class TopicChoice(Settings):
    """Topics to use instead of those the rules pick."""

    image: str | None = None
    """Topic of the camera's images."""
    depth: str | None = None
    """Topic of the depth images; an empty string uses none."""
    camera_info: str | None = None
    """Topic of the camera's calibration; an empty string uses none."""
    odometry: str | None = None
    """Topic of the odometry; an empty string uses none."""
    gps: str | None = None
    """Topic of the satellite fixes; an empty string uses none."""


@dataclass(frozen=True)
class Candidate:
    """A topic that could play a part, with what its first message says."""

    channel: Channel
    count: int
    role: str
    frame: str = ""
    calibrated: bool = False
    """A camera_info whose matrix is set."""


@dataclass(frozen=True)
class Selection:
    """The topics in use, None where no topic plays the part."""

    image: Channel | None = None
    depth: Channel | None = None
    camera_info: Channel | None = None
    odometry: Channel | None = None
    gps: Channel | None = None
    tf_static: tuple[Channel, ...] = ()

    @property
    def channels(self) -> list[Channel]:
        parts = (self.image, self.depth, self.camera_info, self.odometry, self.gps)
        return [part for part in parts if part is not None] + list(self.tf_static)


_NAMES = {
    "image": "Image",
    "depth": "Depth",
    "camera_info": "Calibration",
    "odometry": "Odometry",
    "gps": "GPS",
}
_POSE_TYPES = ("nav_msgs/Odometry", "geometry_msgs/PoseWithCovarianceStamped")
"""Odometry types in order of preference; every other comes after."""


def select(candidates: list[Candidate], choice: TopicChoice, log: str) -> Selection:
    """The topics to use by the rules above. Raises LogError where a topic named in `choice` cannot play its part."""

    def pick(role: str, key: Callable[[Candidate], tuple], also: str = "") -> Candidate | None:
        wanted = getattr(choice, role)
        found = sorted((c for c in candidates if c.role == role and c.count), key=key)
        if wanted is None:
            return found[0] if found else None
        if wanted == "":
            return None
        named = [c for c in candidates if c.channel.topic == wanted]
        fitting = sorted((c for c in named if c.role in (role, also)), key=key)
        if not fitting:
            raise LogError(_refusal(named, wanted, role, [c.channel.topic for c in found], log))
        return fitting[0]

    def by_size(c: Candidate) -> tuple:
        return -c.count, c.channel

    def calibrations(image: Candidate) -> list[Candidate]:
        return _calibrations(image, [c for c in candidates if c.role == "camera_info" and c.count])

    image = pick("image", lambda c: (not any(info.calibrated for info in calibrations(c)[:1]), *by_size(c)), "depth")
    depth = calibration = None
    if image is not None:
        depth = pick("depth", lambda c: (c.frame != image.frame, -_shared(c, image), *by_size(c)), "image")
        calibration = next(iter(calibrations(image)), None)
        if choice.camera_info is not None:
            calibration = pick("camera_info", by_size)
    odometry = pick("odometry", lambda c: (_pose_rank(c), *by_size(c)))
    gps = pick("gps", by_size)
    static = tuple(sorted(c.channel for c in candidates if c.role == "tf_static"))
    parts = (image, depth, calibration, odometry, gps)
    return Selection(*(part.channel if part else None for part in parts), tf_static=static)


def _calibrations(image: Candidate, infos: list[Candidate]) -> list[Candidate]:
    """The calibrations that belong to an image, the most likely first."""
    same_frame = [c for c in infos if c.frame and c.frame == image.frame]
    unplaced = [
        c for c in infos if not c.frame and "/" not in c.channel.topic.strip("/")
    ]  # `/camera_info`, no frame_id
    best = [c for c in infos if _above(c, image)] or same_frame or unplaced
    return sorted(
        best, key=lambda c: (-_shared(c, image), c.frame != image.frame, not c.calibrated, -c.count, c.channel)
    )


def _above(info: Candidate, image: Candidate) -> bool:
    """The image lies in the calibration's namespace: `/cam0/camera_info` and `/cam0/image_raw/compressed`."""
    space = info.channel.topic.strip("/").split("/")[:-1]
    space = space[:-1] if space[-1:] == ["info"] else space  # RealSense: /Color_0/info/camera_info, /Color_0/image/data
    return bool(space) and _shared(info, image) >= len(space)


def _shared(a: Candidate, b: Candidate) -> int:
    """Levels of the namespace that two topics have in common, their own names left out."""
    x, y = (c.channel.topic.strip("/").split("/")[:-1] for c in (a, b))
    return next((i for i, (p, q) in enumerate(zip(x, y, strict=False)) if p != q), min(len(x), len(y)))


def _pose_rank(candidate: Candidate) -> int:
    kind = candidate.channel.type.replace("/msg/", "/")
    return _POSE_TYPES.index(kind) if kind in _POSE_TYPES else len(_POSE_TYPES)


def _refusal(named: list[Candidate], wanted: str, role: str, found: list[str], log: str) -> str:
    what = f"No topic {wanted!r} in {log}." if not named else f"Topic {wanted!r} in {log} is {named[0].channel.type}."
    if not found:
        return f"{what} {_NAMES[role]} topics: none."
    option = role.replace("_", "-")
    return f"{what} {_NAMES[role]} topics: {', '.join(sorted(set(found)))}. Choose one with --{option}-topic."
