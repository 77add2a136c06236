"""Selection of the topic of each part of a log.

An image topic is depth where its encoding is 16UC1, 16SC1, 32FC1 or 64FC1, or compressedDepth, or mono16 under a name
with `depth`; 16UC1 without px that lack a measurement is a thermal camera's, where its name says so or no camera shares
its frame.
Static transforms are those of all topics whose name ends in `static`. Of several topics that could play one of the
other parts the first by these rules does, unless TopicChoice names another:
- image: encodings that can be decoded first, thermal cameras last, then calibrated ones, then those that are not the
  right one of a pair, then most messages, then name;
- right: the topic named like the image's with `right` for `left` (or another of _PAIRS), where no depth is used;
- depth: with the image's frame_id first, then the longest namespace in common with it, then most messages, then name;
- camera_info: of those whose namespace holds the image (`/cam0/camera_info` and `/cam0/image_raw/compressed`), else of
  those with the image's frame_id: longest namespace in common, then the same frame_id, calibrated, most messages, name;
- odometry: the source with the highest score once the log is read (`odometry_sources.py`): pose topics, and tf, whose
  chain from its root to the body is taken;
- gps: sentences of NMEA last, then most messages, then name.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import Field

from vplog.errors import LogError, nearest
from vplog.logs.messages.records import GEOMETRY, NMEA, TWISTS, WHEELS, short_type
from vplog.settings import Settings

if TYPE_CHECKING:
    from collections.abc import Callable

    from vplog.logs.formats.container import Channel


EVERY_IMAGE = "*"
"""Choice of all images of a folder and of the folders in it, whatever their names and sizes."""
SOURCES = ("twist", "gps", "truth", "visual")
"""Odometry that no topic is chosen for: velocities added up, positions of fixes, the ground truth of a data set, and
visual odometry, which a run computes."""


class TopicChoice(Settings):
    """Topics to use instead of those the rules pick."""

    image: str | None = None
    """Topic of the camera's images; of a folder with those of several cameras the group of one, or `*` for all."""
    depth: str | None = None
    """Topic of the depth images; an empty string uses none."""
    right: str | None = None
    """Topic of the right images of a stereo pair, whose left ones are `image`; an empty string uses none."""
    camera_info: str | None = None
    """Topic of the camera's calibration; an empty string uses none."""
    odometry: str | None = None
    """Topic of the odometry, or a source of SOURCES; an empty string uses none."""
    odometry_file: Path | None = None
    """TUM file of poses beside the log that is the odometry: of the body, or of the camera where the log's static
    transforms have no base_link; its clock is that of the images' stamps."""
    calibration_file: Path | None = None
    """YAML file beside the log that calibrates the camera, or both of a pair: ROS camera_info, a Kalibr camchain or
    EuRoC's sensor.yaml."""
    gps: str | None = None
    """Topic of the satellite fixes; an empty string uses none."""
    mask: str | None = None
    """Topic of masks of the camera's images, in which a px of zero is masked."""
    masks: dict[str, Path] = Field(default_factory=dict)
    """By image topic, empty for that in use, the file of its mask, or a folder with one for each image."""
    imu: str | None = None
    """Topic of the IMU whose gyroscope turns velocities that are the odometry; an empty string uses none."""
    wheelbase_m: float | None = Field(default=None, gt=0, le=100)
    """m between the axles, for ackermann_msgs/AckermannDriveStamped."""
    track_m: float | None = Field(default=None, gt=0, le=100)
    """m between left and right wheels, for wheel speeds in sensor_msgs/JointState."""
    wheel_radius_m: float | None = Field(default=None, gt=0, le=100)
    """m; for wheel speeds in sensor_msgs/JointState."""
    start_s: float | None = Field(default=None, ge=0, le=1e9)
    """s after the first image, before which images are left out."""
    stop_s: float | None = Field(default=None, ge=0, le=1e9)
    """s after the first image, from which on images are left out."""

    @property
    def files(self) -> dict[str, Path]:
        """The files and folders beside the log, by what they are."""
        named = {"odometry_file": self.odometry_file, "calibration_file": self.calibration_file}
        return {name: path for name, path in named.items() if path} | {f"mask {k}": v for k, v in self.masks.items()}


@dataclass(frozen=True)
class Candidate:
    """A topic that could be used, described by its first message."""

    channel: Channel
    count: int
    role: str
    frame: str = ""
    calibrated: bool = False
    """A camera_info whose matrix is set."""
    codec: str = ""
    """FFmpeg's decoder where the images are a video."""
    encoding: str = ""
    """Pixel layout of the images, or their format where compressed, as the first message names it."""
    size: tuple[int, int] = (0, 0)
    """Width and height in px of the first image, 0 where only decoding tells it."""
    supported: bool = True
    """Whether images of its encoding can be decoded to grey."""


@dataclass(frozen=True)
class Selection:
    """The topics in use, None where no topic plays the part."""

    image: Channel | None = None
    depth: Channel | None = None
    camera_info: Channel | None = None
    odometry: Channel | None = None
    """As requested, or as chosen among `sources` once these are read."""
    sources: tuple[Channel, ...] = ()
    """Topics that may be the odometry; the transforms over time are one source, named by the largest topic."""
    kind: str = ""
    """The one of SOURCES that is requested, `topic` of a topic or none at all, or empty."""
    geometry: dict[Channel, tuple[float, float]] = field(default_factory=dict)
    """Factors of the linear and angular velocities of sources that are wheel speeds."""
    imu: Channel | None = None
    """The IMU whose gyroscope turns velocities, where these are the odometry."""
    gps: Channel | None = None
    tf_static: tuple[Channel, ...] = ()
    tf: tuple[Channel, ...] = ()
    """Transforms over time: read where odometry may come from them, or where no topic is of static ones alone."""
    right: Channel | None = None
    right_info: Channel | None = None
    mask: Channel | None = None

    @property
    def parts(self) -> dict[Channel, str]:
        """Part of each topic in use, as in `vplog.data.Topic.part`."""
        named = ("image", "depth", "camera_info", "odometry", "gps", "right", "right_info", "imu", "mask")
        many = [(channel, name) for name in ("tf_static", "tf") for channel in getattr(self, name)]
        one = [(channel, name) for name in named if (channel := getattr(self, name)) is not None]
        return dict(many) | dict(one)

    @property
    def has_depth(self) -> bool:
        """Whether depth or right images are among them."""
        return self.depth is not None or self.right is not None

    @property
    def channels(self) -> list[Channel]:
        return list(dict.fromkeys((*self.parts, *self.sources, *([self.imu] if self.imu else ()))))

    def with_odometry(self, odometry: Channel | None) -> Selection:
        """The selection once the source of odometry is known."""
        tf = self.tf if odometry in self.tf or not self.tf_static else ()
        return replace(self, odometry=odometry, sources=(), tf=tf)


_NAMES = {
    "image": "Image", "depth": "Depth", "right": "Image", "camera_info": "Calibration", "odometry": "Odometry",
    "gps": "GPS", "imu": "IMU", "mask": "Image",
}  # fmt: skip
_ROLES = {"right": "image", "mask": "image"}
"""Parts whose topics are candidates of another part until topics are assigned."""
_PAIRS = (("left", "right"), ("Left", "Right"), ("LEFT", "RIGHT"), ("infra1", "infra2"), ("cam0", "cam1"),
          ("image_0", "image_1"), ("image_2", "image_3"), ("rgb_0", "rgb_1"))  # fmt: skip
"""Words that tell the topics of a stereo pair apart: most drivers', RealSense's, EuRoC's, KITTI's and VSLAM-LAB's."""


def select(candidates: list[Candidate], choice: TopicChoice, log: str) -> Selection:
    """The topics to use by the rules above. Raises LogError where a topic named in `choice` cannot play its part."""

    def pick(
        role: str, key: Callable[[Candidate], tuple], also: str = "", taken: Candidate | None = None
    ) -> Candidate | None:
        wanted = getattr(choice, role)
        found = sorted((c for c in candidates if c.role == _ROLES.get(role, role) and c.count), key=key)
        found = [c for c in found if c is not taken and (role == "mask" or c.channel.topic != choice.mask)]
        if wanted is None:
            return found[0] if found else None
        if wanted == "":
            return None
        named = [c for c in candidates if c.channel.topic == wanted]
        fitting = sorted((c for c in named if c.role in (_ROLES.get(role, role), also)), key=key)
        if not fitting:
            raise LogError(_no_topic(named, wanted, role, [c.channel.topic for c in found], log))
        return fitting[0]

    def calibrations(image: Candidate) -> list[Candidate]:
        return _calibrations(image, [c for c in candidates if c.role == "camera_info" and c.count])

    def as_image(c: Candidate) -> tuple:
        uncalibrated = not any(info.calibrated for info in calibrations(c)[:1])
        sixteen_bits = c.encoding.startswith("16UC1")  # a thermal camera comes behind one that sees
        return not c.supported, sixteen_bits, uncalibrated, _partner(c, candidates, back=True) is not None, *_by_size(c)

    image = _image_alone(pick("image", as_image, "depth"), choice, log)
    depth = calibration = right = right_info = None
    if image is not None:
        if choice.depth is not None or not choice.right:
            depth = pick("depth", lambda c: (c.frame != image.frame, -_shared(c, image), *_by_size(c)), "image", image)
        right = pick("right", _by_size) if choice.right is not None else _partner(image, candidates)
        if right is not None and depth is not None:
            if choice.right and choice.depth:
                raise LogError(
                    f"{log}: depth comes from {choice.depth} or from the pair {image.channel.topic} and "
                    f"{choice.right}, not both. Leave out --depth-topic or --right-topic."
                )
            right = None
        right_info = next(iter(calibrations(right)), None) if right is not None else None
        calibration = next(iter(calibrations(image)), None)
        if choice.calibration_file is not None:
            if choice.camera_info:
                raise LogError(
                    _conflict("calibration", choice.camera_info, choice.calibration_file, "camera-info-topic")
                )
            calibration = right_info = None
        elif choice.camera_info is not None:
            calibration = pick("camera_info", _by_size)
    if choice.odometry_file is not None:
        if choice.odometry:
            raise LogError(_conflict("odometry", choice.odometry, choice.odometry_file, "odometry-topic"))
        choice = choice.model_copy(update={"odometry": ""})
    named = choice.odometry in SOURCES and all(c.channel.topic != choice.odometry for c in candidates)
    kind = "" if choice.odometry is None else choice.odometry if named else "topic"
    requested = pick("odometry", _by_size, "tf") if kind == "topic" else None
    geometry = {c.channel: factors for c in candidates if (factors := _geometry(c, choice))}
    sources = _sources(candidates, kind, requested, geometry)
    turned = kind == "twist" or all(short_type(c.channel.type) in (*TWISTS, *GEOMETRY) for c in sources)
    imu = pick("imu", _by_size) if sources and turned else None
    gps = pick("gps", lambda c: (short_type(c.channel.type) == NMEA, *_by_size(c)))
    static = tuple(sorted(c.channel for c in candidates if c.role == "tf_static"))
    parts = {
        "image": image, "depth": depth, "camera_info": calibration, "odometry": requested, "gps": gps,
        "right": right, "right_info": right_info, "imu": imu,
        "mask": pick("mask", _by_size, "depth") if choice.mask else None,
    }  # fmt: skip
    found = {name: part.channel for name, part in parts.items() if part is not None}
    moving = tuple(c.channel for c in sorted((c for c in candidates if c.role == "tf" and c.count), key=_by_size))
    tf = moving if not static or any(c.role == "tf" for c in sources) else ()
    return Selection(
        **found, sources=tuple(c.channel for c in sources), tf_static=static, tf=tf, kind=kind, geometry=geometry
    )


def _image_alone(image: Candidate | None, choice: TopicChoice, log: str) -> Candidate | None:
    """The image. Raises LogError where the image topic is asked to be another part, too."""
    for role in ("depth", "right", "mask"):
        if image is not None and getattr(choice, role) == image.channel.topic:
            option = f"--{role}-topic"
            raise LogError(f"{getattr(choice, role)} is the image topic of {log}. Choose another with {option}.")
    return image


def _sources(
    candidates: list[Candidate], kind: str, requested: Candidate | None, geometry: dict[Channel, tuple[float, float]]
) -> list[Candidate]:
    """The topics that may be the odometry, with `kind` one of SOURCES, `topic` or empty. Raises LogError where the
    requested one is speeds of wheels without their measures."""
    if requested is not None:
        lacks = GEOMETRY.get(short_type(requested.channel.type))
        if lacks and requested.channel not in geometry:
            options = " and ".join(f"--{name.replace('_', '-')}" for name in lacks)
            raise LogError(f"{requested.channel.topic} is speeds of wheels; they are odometry with {options}, in m.")
        return [requested]
    if kind not in ("", "twist"):
        return []
    posed = sorted((c for c in candidates if c.role == "odometry" and c.count), key=_by_size)
    found = [c for c in posed if c.channel in geometry or short_type(c.channel.type) not in GEOMETRY]
    moving = sorted((c for c in candidates if c.role == "tf" and c.count), key=_by_size)
    return [*found, *([] if kind else moving[:1])]


def _geometry(c: Candidate, choice: TopicChoice) -> tuple[float, float] | None:
    """Factors of linear and angular wheel speeds, by the dimensions in `choice`; None where these are not given."""
    kind = short_type(c.channel.type)
    if kind not in GEOMETRY or any(getattr(choice, name) is None for name in GEOMETRY[kind]):
        return None
    radius = choice.wheel_radius_m or 1.0
    return (1.0, 1.0 / (choice.wheelbase_m or 1.0)) if kind != WHEELS else (radius, radius / (choice.track_m or 1.0))


def _by_size(c: Candidate) -> tuple:
    return -c.count, c.channel


def _partner(image: Candidate, candidates: list[Candidate], back: bool = False) -> Candidate | None:
    """The right image topic of a pair whose left one is `image`, or back, the left one of the right."""
    for left, right in _PAIRS:
        here, there = (right, left) if back else (left, right)
        name = image.channel.topic.replace(here, there)
        if here in image.channel.topic:
            found = [c for c in candidates if c.channel.topic == name and c.role == "image" and c.count]
            return min(found, key=lambda c: c.channel, default=None)
    return None


def _calibrations(image: Candidate, infos: list[Candidate]) -> list[Candidate]:
    """The calibrations that belong to an image, the most likely first."""
    same_frame = [c for c in infos if c.frame and c.frame == image.frame]
    alone = [c for c in infos if not c.frame and "/" not in c.channel.topic.strip("/")]  # `/camera_info`, no frame_id
    best = [c for c in infos if _above(c, image)] or same_frame or alone
    return sorted(best, key=lambda c: (-_shared(c, image), c.frame != image.frame, not c.calibrated, *_by_size(c)))


def _above(info: Candidate, image: Candidate) -> bool:
    """The image lies in the calibration's namespace: `/cam0/camera_info` and `/cam0/image_raw/compressed`."""
    space = info.channel.topic.strip("/").split("/")[:-1]
    space = space[:-1] if space[-1:] == ["info"] else space  # RealSense: /Color_0/info/camera_info, /Color_0/image/data
    return bool(space) and _shared(info, image) >= len(space)


def _shared(a: Candidate, b: Candidate) -> int:
    """Levels of the namespace that two topics have in common, their own names left out."""
    x, y = (c.channel.topic.strip("/").split("/")[:-1] for c in (a, b))
    return next((i for i, (p, q) in enumerate(zip(x, y, strict=False)) if p != q), min(len(x), len(y)))


def _conflict(what: str, topic: str, file: Path, option: str) -> str:
    return f"The {what} is either {topic} or {file}. Leave out --{option} or the file."


def _no_topic(named: list[Candidate], wanted: str, role: str, found: list[str], log: str) -> str:
    what = f"No topic {wanted!r} in {log}." if not named else f"Topic {wanted!r} in {log} is {named[0].channel.type}."
    if not found:
        return f"{what} {_NAMES[role]} topics: none."
    option = role.replace("_", "-")
    near = nearest(wanted, sorted(found), key=lambda topic: topic.strip("/"), cutoff=0.5)
    choices = f"{_NAMES[role]} topics: {', '.join(sorted(set(found)))}"
    if role == "odometry":
        return f"{what}{near} {choices}. Choose one with --odometry, or a source: {', '.join(SOURCES)}."
    return f"{what}{near} {choices}. Choose one with --{option}-topic."
