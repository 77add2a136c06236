"""Selection of the topic of each part of a log.

An image topic is depth where its encoding is 16UC1, 16SC1, 32FC1 or 64FC1, or compressedDepth, or mono16 or a PNG of
16 bits under a name with `depth`; 16UC1 without px that lack a measurement is a thermal camera's, where its name says
so or no camera shares its frame.
Static transforms are those of all topics whose name ends in `static`. Of several topics that could play one of the
other parts the first by these rules does, unless TopicChoice names another:
- image: encodings that can be decoded first, thermal cameras last, then calibrated ones, then those that are not the
  right one of a pair, then those that do not look back by their name, then most messages, then name;
- right: the topic named like the image's with `right` for one `left` or all (or another of PAIRS), the longest
  namespace in common first; used where no depth is;
- depth: with the image's frame_id first, then the longest namespace in common with it, then most messages, then name;
- camera_info: of those whose namespace holds the image (`/cam0/camera_info` and `/cam0/image_raw/compressed`), else of
  those with the image's frame_id: longest namespace in common, then the same frame_id, calibrated, most messages, name;
- odometry: the source with the highest score once the log is read (`odometry_sources.py`): pose topics, and tf, whose
  chain from its root to the body is taken;
- gps: sentences of NMEA last, then most messages, then name;
- imu: accelerometers alone last, then most messages, then name;
- lidar: clouds that are another sensor's or were computed by their name last, then most messages, then name. It is read
  where it is requested as the odometry, or no topic of poses or velocities is there.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from pydantic import Field

from vplog.errors import LogError, nearest
from vplog.logs.formats.container import Channel, Notes
from vplog.logs.messages.records import GEOMETRY, NMEA, TWISTS, WHEELS, short_type
from vplog.settings import Settings

EVERY_IMAGE = "*"
"""Choice of all images of a folder and of the folders in it, whatever their names and sizes."""
SOURCES = ("twist", "gps", "truth", "visual", "lidar")
"""Odometry that no topic is chosen for: velocities added up, positions of fixes, the ground truth of a data set, and
that of the images and of a lidar, which a run computes."""
COMMAND = re.compile(
    "(?<![a-z])(goal|set_?point|target|desired|reference|command|cmd|ref|plan|way_?point|initial_?pose|clicked)s?(?![a-z])",
    re.IGNORECASE,
)
"""Words for where a robot is to be, or is commanded to be."""
OPTIONS = {
    "image": "image-topic", "depth": "depth-topic", "right": "right-topic", "camera_info": "camera-info-topic",
    "odometry": "odometry-topic", "gps": "gps-topic", "odometry_file": "odometry-file",
    "calibration_file": "calibration", "imu": "imu-topic", "start_s": "start", "stop_s": "stop",
    "mask": "mask-topic", "wheelbase_m": "wheelbase-m", "track_m": "track-m", "wheel_radius_m": "wheel-radius-m",
    "camera_height_m": "camera-height-m", "gps_any_status": "gps-any-status",
    "image_offset_s": "image-offset-s",
}  # fmt: skip
"""Option of the command line for each field of TopicChoice."""
_NO_LIDAR = re.compile(r"depth|camera|stereo|radar|map|cluster|obstacle|segment|ground|filtered", re.IGNORECASE)
"""Words in the names of clouds of other sensors, and of what was computed from a lidar's."""


class TopicChoice(Settings):
    """Topics to use instead of those the rules pick."""

    image: str | None = None
    """Topic of the camera's images; of a folder with those of several cameras the group of one, or `*` for all."""
    cameras: tuple[str, ...] | None = None
    """Image topics of further cameras on the body. None takes every calibrated one whose mount is known, unless `image`
    is chosen, and then none."""
    depth: str | None = None
    """Topic of the depth images; an empty string uses none."""
    right: str | None = None
    """Topic of the right images of a stereo pair, whose left ones are `image`; an empty string uses none."""
    camera_info: str | None = None
    """Topic of the camera's calibration; an empty string uses none."""
    odometry: str | None = None
    """Topic of the odometry, or of a lidar that gives it, or a source of SOURCES; an empty string uses none."""
    odometry_file: Path | None = None
    """TUM file of poses beside the log that is the odometry: of the body, or of the camera where the log's static
    transforms have no base_link and the poses do not go along x; its clock is that of the images' stamps."""
    calibration_file: Path | None = None
    """YAML file beside the log that calibrates the camera, or both of a pair: ROS camera_info, a Kalibr camchain or
    EuRoC's sensor.yaml; and those further cameras that it names."""
    gps: str | None = None
    """Topic of the satellite fixes; an empty string uses none."""
    gps_any_status: bool = False
    """Use fixes whose status says that there is no fix, as some drivers write it for every fix."""
    mask: str | None = None
    """Topic of masks of the camera's images, in which a px of zero is masked."""
    mask_topics: dict[str, str] = Field(default_factory=dict)
    """By image topic of further cameras, the topic of their masks."""
    masks: dict[str, Path] = Field(default_factory=dict)
    """By image topic, empty for that in use, the file of its mask, or a folder with one for each image."""
    imu: str | None = None
    """Topic of the IMU whose gyroscope turns velocities that are the odometry, and whose measurements visual odometry
    takes; an empty string uses none."""
    wheelbase_m: float | None = Field(default=None, gt=0, le=100)
    """m between the axles, for ackermann_msgs/AckermannDriveStamped."""
    track_m: float | None = Field(default=None, gt=0, le=100)
    """m between left and right wheels, for wheel speeds in sensor_msgs/JointState."""
    wheel_radius_m: float | None = Field(default=None, gt=0, le=100)
    """m; for wheel speeds in sensor_msgs/JointState."""
    camera_height_m: float | None = Field(default=None, gt=0, le=100)
    """m of the camera over flat ground, by which the visual odometry of a single camera has metres."""
    image_offset_s: float | None = Field(default=None, ge=-1e9, le=1e9)
    """s to add to the stamps of all images, for cameras whose clock or driver is late."""
    start_s: float | None = Field(default=None, ge=0, le=1e9)
    """s after the first image, before which images are left out."""
    stop_s: float | None = Field(default=None, ge=0, le=1e9)
    """s after the first image, from which on images are left out."""

    @property
    def image_offset_ns(self) -> int:
        """ns to add to the stamps of images."""
        return round((self.image_offset_s or 0.0) * 1e9)

    def of_camera(self, topic: str) -> TopicChoice:
        """Choice of topics with a further camera as the one in use, and no others. Of all its images, as the keyframes
        say which are taken: `start_s` and `stop_s` count from the first camera's first image."""
        own = {"depth": None, "right": None, "camera_info": None, "cameras": (), "start_s": None, "stop_s": None}
        own |= {"mask": self.mask_topics.get(topic), "mask_topics": {}}
        masks = {image: path for image, path in self.masks.items() if image}
        return self.model_copy(update={**own, "image": topic, "masks": masks})

    @property
    def of_further_camera(self) -> bool:
        """Whether it is by `of_camera`: others leave `cameras` out beside an image topic."""
        return self.image is not None and self.cameras == ()

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
    """Whether images of its encoding can be decoded to grey; of an IMU, whether it measures turns."""


_PARTS = (
    "image",
    "depth",
    "camera_info",
    "odometry",
    "gps",
    "right",
    "right_info",
    "depth_info",
    "imu",
    "mask",
    "lidar",
)


@dataclass(frozen=True)
class Selection:
    """The topics in use, None where no topic plays the part."""

    image: Channel | None = None
    depth: Channel | None = None
    camera_info: Channel | None = None
    odometry: Channel | None = None
    """As requested, or as chosen among `sources` once these are read."""
    gps: Channel | None = None
    gps_any_status: bool = False
    """As in TopicChoice."""
    image_offset_ns: int = 0
    """ns to add to the stamps of images."""
    right: Channel | None = None
    right_info: Channel | None = None
    depth_info: Channel | None = None
    """The calibration of the depth, where it has one of its own."""
    imu: Channel | None = None
    """The IMU whose gyroscope turns velocities, where these are the odometry, or which visual odometry takes."""
    mask: Channel | None = None
    lidar: Channel | None = None
    """The lidar that gives the odometry, where no topic does."""
    sources: tuple[Channel, ...] = ()
    """Topics that may be the odometry; the transforms over time are one source, named by the largest topic."""
    kind: str = ""
    """The one of SOURCES that is requested, `topic` of a topic or none at all, or empty."""
    geometry: dict[Channel, tuple[float, float]] = field(default_factory=dict)
    """Factors of the linear and angular velocities of sources that are wheel speeds."""
    tf_static: tuple[Channel, ...] = ()
    tf: tuple[Channel, ...] = ()
    """Transforms over time: odometry may come from them, and those that never change are static ones."""

    @property
    def parts(self) -> dict[Channel, str]:
        """Part of each topic in use, as in `vplog.data.Topic.part`."""
        many = [(channel, name) for name in ("tf_static", "tf") for channel in getattr(self, name)]
        one = [(channel, name) for name in _PARTS if (channel := getattr(self, name)) is not None]
        return dict(many) | dict(one)

    @property
    def channels(self) -> list[Channel]:
        return list(dict.fromkeys((*self.parts, *self.sources)))

    def with_odometry(self, odometry: Channel | None, has_static: bool, turned: bool) -> Selection:
        """The selection once the source of odometry is known, whether transforms over time never change, and whether
        the odometry is velocities or still to be computed, which take an IMU."""
        tf = self.tf if odometry in self.tf or has_static else ()
        return replace(self, odometry=odometry, sources=(), tf=tf, imu=self.imu if turned else None)


_NAMES = {
    "image": "Image", "depth": "Depth", "right": "Image", "camera_info": "Calibration", "odometry": "Odometry",
    "gps": "GPS", "imu": "IMU", "mask": "Image",
}  # fmt: skip
_ROLES = {"right": "image", "mask": "image"}
"""Parts whose topics are candidates of another part until topics are assigned."""
PAIRS = (("left", "right"), ("Left", "Right"), ("LEFT", "RIGHT"), ("infra1", "infra2"), ("cam0", "cam1"),
          ("image_0", "image_1"), ("image_2", "image_3"), ("rgb_0", "rgb_1"))  # fmt: skip
"""Words that tell the topics of a stereo pair apart: most drivers', RealSense's, EuRoC's, KITTI's and VSLAM-LAB's."""
_BACKWARD = re.compile(r"(?<![a-z])(back|rear)(?![a-z])", re.IGNORECASE)
"""Words in the topics of cameras that look back."""


MOST_TOPICS = 1000
"""Maximum number of topics that are compared with each other, those with the most messages. A swarm of a hundred robots
has some 500 that can be used."""


def select(candidates: list[Candidate], choice: TopicChoice, log: str) -> Selection:
    """The topics to use by the rules above. Raises LogError where a topic named in `choice` cannot play its part."""
    _check_files(choice)
    _check_mask_topics(candidates, choice)
    candidates = sorted(candidates, key=lambda c: (c.role == "imu" and not c.supported, -c.count, c.channel))
    usable, pick = [c for c in candidates if c.count][:MOST_TOPICS], partial(_pick, candidates, choice, log)
    known = candidates if choice.image else usable
    image = _pick(known, choice, log, "image", "depth", lambda c: _image_order(c, usable))
    for topic in choice.cameras or ():
        _pick(candidates, choice.of_camera(topic), log, "image", "depth")  # raises where it is not there
    found = {"image": image} | ({} if image is None else _of_image(image, usable, choice, log, pick))
    if image is not None and choice.mask is None:
        choice = choice.model_copy(update={"mask": choice.mask_topics.get(image.channel.topic)})
    if choice.mask:
        found["mask"] = _pick(candidates, choice, log, "mask", "depth", image=image)
    kind = _odometry_kind(candidates, choice)
    requested = pick("odometry", "tf") if kind == "topic" and choice.odometry_file is None and choice.odometry else None
    geometry = {c.channel: factors for c in candidates if (factors := _geometry(c, choice))}
    sources = _sources(usable, kind, requested, geometry)
    # whether tf has odometry, and a command is one, shows when they are read
    posed = [c for c in sources if kind or (c.role != "tf" and not COMMAND.search(c.channel.topic))]
    turned = kind == "twist" or all(short_type(c.channel.type) in (*TWISTS, *GEOMETRY) for c in posed)
    visual = image is not None and choice.odometry_file is None and (kind == "visual" or not (posed or kind))
    found["odometry"], found["imu"] = requested, pick("imu") if (posed and turned) or visual else None
    found["gps"] = pick("gps", key=lambda c: short_type(c.channel.type) == NMEA)
    if kind == "lidar" or not (kind or posed):
        found["lidar"] = _lidar(usable, choice)
    static = tuple(sorted(c.channel for c in candidates if c.role == "tf_static"))
    tf = tuple(c.channel for c in usable if c.role == "tf")
    channels = {part: c.channel for part, c in found.items() if c is not None}
    return Selection(
        **channels,
        sources=tuple(c.channel for c in sources),
        tf_static=static,
        tf=tf,
        kind=kind,
        geometry=geometry,
        gps_any_status=choice.gps_any_status,
        image_offset_ns=choice.image_offset_ns,
    )


def _image_order(c: Candidate, usable: list[Candidate]) -> tuple[bool, ...]:
    """Sorts the image topics: those that decode and are calibrated first, left before right, forward before back."""
    info = _calibration(c, usable)
    sixteen_bits = c.encoding.startswith("16UC1")  # a thermal camera comes behind one that sees
    is_right, backward = _partner(c, usable, back=True) is not None, bool(_BACKWARD.search(c.channel.topic))
    return not c.supported, sixteen_bits, not (info and info.calibrated), is_right, backward


def _of_image(
    image: Candidate, usable: list[Candidate], choice: TopicChoice, log: str, pick: Callable[..., Candidate | None]
) -> dict[str, Candidate | None]:
    """Depth and right images of a camera, and its calibrations. Raises LogError where both are named."""
    depth = None
    if choice.depth is not None or not choice.right:
        depth = pick("depth", "image", lambda c: (c.frame != image.frame, -_shared(c, image)), image)
    right = pick("right", image=image) if choice.right is not None else _partner(image, usable)
    if choice.right and choice.depth:
        raise LogError(
            f"{log}: depth comes from {choice.depth} or from the pair {image.channel.topic} and {choice.right}, "
            "not both. Leave out --depth-topic or --right-topic."
        )
    info, depth_info = _calibration(image, usable), None if depth is None else _calibration(depth, usable)
    right_info = _calibration(right, usable) if right is not None else None
    found = {"depth": depth, "right": right, "depth_info": None if depth_info is info else depth_info}
    if choice.calibration_file is not None:  # which may be of the left camera alone
        return found | {"right_info": right_info}
    info = info if choice.camera_info is None else pick("camera_info")
    return found | {"right_info": right_info, "camera_info": info}


def _odometry_kind(candidates: list[Candidate], choice: TopicChoice) -> str:
    """`Selection.kind`: the one of SOURCES that is requested, `topic` of a topic or a file, empty without a request."""
    if choice.odometry is None and choice.odometry_file is None:
        return ""
    named = [c for c in candidates if c.channel.topic == choice.odometry]
    if any(c.role == "lidar" and c.count for c in named):
        return "lidar"
    return choice.odometry if choice.odometry in SOURCES and not named else "topic"


def _lidar(usable: list[Candidate], choice: TopicChoice) -> Candidate | None:
    """The lidar requested as odometry, else the one with most scans that is no depth camera by its name."""
    clouds = [c for c in usable if c.role == "lidar"]
    requested = [c for c in clouds if c.channel.topic == choice.odometry]
    return min(requested or clouds, key=lambda c: bool(_NO_LIDAR.search(c.channel.topic)), default=None)


def further_cameras(
    candidates: list[Candidate], used: Selection, choice: TopicChoice, notes: Notes
) -> list[tuple[Candidate, Candidate | None]]:
    """Calibrated cameras beside the one in use, each by its best topic: with another frame_id than any before it; and,
    where its name is that of the right one of a pair, the left one. Other cameras, by their calibrations, are noted."""
    usable = sorted((c for c in candidates if c.count), key=lambda c: (-c.count, c.channel))[:MOST_TOPICS]
    requested = used.right if choice.right else None  # any other is a pair by its name, and may look elsewhere
    first = [c for c in usable if c.channel in (used.image, requested)]
    taken, infos = {c.frame for c in first}, {_calibration(c, usable) for c in first}
    found = []
    for c in usable:
        info = _calibration(c, usable) if c.role == "image" and c.supported else None
        if not (info and info.calibrated) or _is_mask(c, choice):
            continue
        left = _partner(c, usable, back=True)
        if c.frame and c.frame not in taken:
            found.append((c, left))
        elif info not in infos and left is None:
            named = f"the frame_id {c.frame} of another camera" if c.frame else "no frame_id"
            notes.add(
                f"{c.channel.topic} is calibrated but not used: it has {named}. Where it is no other picture "
                "of that one, take it with a further --image-topic, its mount from --calibration."
            )
        taken.add(c.frame)
        infos.add(info)
    return found


def _is_mask(c: Candidate, choice: TopicChoice) -> bool:
    return c.channel.topic in (choice.mask, *choice.mask_topics.values())


def _check_mask_topics(candidates: list[Candidate], choice: TopicChoice) -> None:
    """Raises LogError where a topic that masks are chosen by is not in the log."""
    known = {c.channel.topic for c in candidates}
    for camera, masks in choice.mask_topics.items():
        if missing := [topic for topic in (camera, masks) if topic not in known]:
            raise LogError(
                f"--mask-topic {camera}={masks}: the log has no topic {missing[0]}. Topics: {', '.join(sorted(known))}."
            )


def _check_files(choice: TopicChoice) -> None:
    """Raises LogError where a file and a topic are to be the same."""
    for what, topic, file, option in (
        ("calibration", choice.camera_info, choice.calibration_file, "camera-info-topic"),
        ("odometry", choice.odometry, choice.odometry_file, "odometry-topic"),
    ):
        if topic and file is not None:
            raise LogError(f"The {what} is either {topic} or {file}. Leave out --{option} or the file.")


def _pick(
    candidates: list[Candidate], choice: TopicChoice, log: str, role: str, also: str = "",
    key: Callable[[Candidate], Any] = lambda _: 0, image: Candidate | None = None,
) -> Candidate | None:  # fmt: skip
    """The first of a role by `key`, then by size, beside the `image`; a requested one may have the role `also`."""
    wanted, own = getattr(choice, role), _ROLES.get(role, role)
    if image is not None and wanted == image.channel.topic:
        raise LogError(f"{wanted} is the image topic of {log}. Choose another with --{role}-topic.")
    found = [c for c in candidates if c.role == own and c.count and (role != "depth" or c is not image)]
    found = [c for c in found if role == "mask" or not _is_mask(c, choice)]
    if not wanted:
        return min(found, key=key, default=None) if wanted is None else None
    named = [c for c in candidates if c.channel.topic == wanted]
    fitting = [c for c in named if c.role in (own, also)]
    if not fitting:
        raise LogError(_no_topic(named, wanted, role, [c.channel.topic for c in found], log))
    return min(fitting, key=key)


def _sources(
    usable: list[Candidate], kind: str, requested: Candidate | None, geometry: dict[Channel, tuple[float, float]]
) -> list[Candidate]:
    """The topics that may be the odometry, with `kind` one of SOURCES, `topic` or empty. Raises LogError where the
    requested one is speeds of wheels without their measures."""
    if requested is not None:
        options = wheel_options(requested.channel)
        if options and requested.channel not in geometry:
            raise LogError(f"{requested.channel.topic} is speeds of wheels; they are odometry with {options}, in m.")
        return [requested]
    if kind not in ("", "twist"):
        return []
    posed = [c for c in usable if c.role == "odometry"]
    found = [c for c in posed if c.channel in geometry or short_type(c.channel.type) not in GEOMETRY]
    return found if kind else [*found, *[c for c in usable if c.role == "tf"][:1]]


def wheel_options(channel: Channel) -> str:
    """Options that make odometry of speeds of wheels; empty for other types."""
    return " and ".join(f"--{name.replace('_', '-')}" for name in GEOMETRY.get(short_type(channel.type), ()))


def _geometry(c: Candidate, choice: TopicChoice) -> tuple[float, float] | None:
    """Factors of linear and angular wheel speeds, by the dimensions in `choice`; None where these are not given."""
    kind = short_type(c.channel.type)
    if kind not in GEOMETRY or any(getattr(choice, name) is None for name in GEOMETRY[kind]):
        return None
    radius = choice.wheel_radius_m or 1.0
    return (1.0, 1.0 / (choice.wheelbase_m or 1.0)) if kind != WHEELS else (radius, radius / (choice.track_m or 1.0))


def _partner(image: Candidate, usable: list[Candidate], back: bool = False) -> Candidate | None:
    """The right image topic of a pair whose left one is `image`, or back, the left one of the right."""
    names = list[str]()
    for pair in PAIRS:
        here, there = pair[::-1] if back else pair
        parts = image.channel.topic.split(here)
        names += [there.join([here.join(parts[:at]), here.join(parts[at:])]) for at in range(1, len(parts))]
        names.append(there.join(parts))
    found = [c for c in usable if c.role == "image" and c.channel.topic in names]
    others = (c for c in found if c.channel.topic != image.channel.topic)
    return min(others, key=lambda c: (-_shared(c, image), names.index(c.channel.topic), c.channel), default=None)


def _calibration(image: Candidate, usable: list[Candidate]) -> Candidate | None:
    """The calibration that most likely belongs to an image."""
    infos = [c for c in usable if c.role == "camera_info"]
    same_frame = [c for c in infos if c.frame and c.frame == image.frame]
    alone = [c for c in infos if not c.frame and "/" not in c.channel.topic.strip("/")]  # `/camera_info`, no frame_id
    best = [c for c in infos if _above(c, image)] or same_frame or alone
    return min(best, key=lambda c: (-_shared(c, image), c.frame != image.frame, not c.calibrated), default=None)


def _above(info: Candidate, image: Candidate) -> bool:
    """The image lies in the calibration's namespace: `/cam0/camera_info` and `/cam0/image_raw/compressed`."""
    space = _namespace(info)
    space = space[:-1] if space[-1:] == ["info"] else space  # RealSense: /Color_0/info/camera_info, /Color_0/image/data
    return bool(space) and _shared(info, image) >= len(space)


def _namespace(c: Candidate) -> list[str]:
    return c.channel.topic.strip("/").split("/")[:-1]


def _shared(a: Candidate, b: Candidate) -> int:
    """Levels of the namespace that two topics have in common."""
    x, y = _namespace(a), _namespace(b)
    return next((i for i, (p, q) in enumerate(zip(x, y, strict=False)) if p != q), min(len(x), len(y)))


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
