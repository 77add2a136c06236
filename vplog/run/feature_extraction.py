"""Extraction in parts: stretches of keyframes, each decoded and described by itself, and one file of the stage cache.

    parts = parts_of(path, pipeline, topics)       # what there is to do
    data = compute_part(part)                      # in any process, on any machine that reads the log by its path
    put_part(cache, part, data)                    # where run(path, ..., topics=topics, cache=cache) finds it

A part's bytes are the same whoever computes it, a run among others: frames of a video are decoded from the key frame
before them, depth and stereo frame by frame. Settings of the library do not count: a part does not know which of its
keyframes become references.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from vplog import logs
from vplog.data import Bools, Features, Floats, Frame, Keyframes, Odometry
from vplog.errors import LogError, ResultError
from vplog.execution.execution import Execution
from vplog.execution.run_warnings import warn
from vplog.features.extraction import extract_frames
from vplog.geometry import se3
from vplog.results.previews import PictureSettings, preview
from vplog.run.cache.code_hash import code_of
from vplog.run.cache.feature_shards import Extracted, packed
from vplog.run.cache.stage_cache import (
    AbsentError,
    DamagedError,
    Inputs,
    check_file,
    content_of,
    file_name,
    finished_parts,
    inputs_of,
    key_of,
    sealed,
)
from vplog.run.cache.steps import Steps, step
from vplog.run.keyframes import KeyframeSettings, select_keyframes
from vplog.storage.input_hashes import files_of, hash_inputs
from vplog.storage.remote_path import address, located
from vplog.storage.scratch import replacing
from vplog.storage.urls import shown

if TYPE_CHECKING:
    from vplog.features.extractors import FeatureSettings
    from vplog.features.stereo_depth import StereoSettings
    from vplog.stages import Log

    Decoded = tuple[int, Frame | None, Features | None, str]
    """Stamp, frame, features, and why there are none, as `extract_frames` gives them."""


PART_KEYFRAMES = 64
"""Keyframes of a part: about 6 s of one core and 20 MB. A kill costs at most one part, and who computes one elsewhere
opens the log for it, which reads it through once."""


_LOOKED_AT = 16
"""Keyframes whose light and contrast are measured."""
_SMALL_PX, _DARK, _FLAT = 160 * 160, 16.0, 40.0
"""Pictures are small below so many px, dark below this mean grey, and low in contrast where 98 % of grey levels lie
closer: those of drives by day have 10^5 px, a mean of 80 to 130 and 150 to 250 levels, of a lit park at night 240."""
_STILL_M, _STILL_RAD = 0.02, np.radians(2.0)
"""Motion that the odometry of a body that stands may claim: less than the least spacing of keyframes."""
_POOR_SHARE = 0.1
"""Share of keyframes with few features from which there is a warning."""


class Extraction(Protocol):
    """The settings that extraction takes, as the pipeline has them."""

    @property
    def keyframes(self) -> KeyframeSettings: ...
    @property
    def features(self) -> FeatureSettings: ...
    @property
    def stereo(self) -> StereoSettings: ...
    @property
    def pictures(self) -> PictureSettings: ...


@dataclass(frozen=True)
class ExtractionPart:
    """A stretch of a drive's keyframes; goes to another process as it is."""

    log: tuple[str, ...]
    """Paths or URLs of the files of the drive."""
    lengths: str
    """sha256 over those of all these files."""
    topics: logs.TopicChoice
    pipeline: Extraction
    stamp_ns: tuple[int, ...]
    """Stamps of its keyframes, increasing."""
    number: int
    key: str
    """sha256 over all that its content depends on."""

    @property
    def file(self) -> str:
        """Its name in a cache."""
        return file_name(f"extract-{self.number:06d}", self.key)


def parts_of(
    path: Path | Sequence[Path],
    pipeline: Extraction,
    topics: logs.TopicChoice | None = None,
    cache: Path | None = None,
) -> list[ExtractionPart]:
    """The parts that a run of this drive extracts. With its cache, a log that was only touched is known by its content.

    Raises LogError where there is no such log, or nothing to extract in it.
    """
    log = logs.open_drive(files_of(path), topics)
    if (odometry := log.odometry()) is None:
        raise LogError(f"{log.name} has no odometry of its own, by which its keyframes are selected. Run it whole.")
    keyframes, _ = select_keyframes(log.name, log.stamps(), odometry, pipeline.keyframes)
    return split_keyframes(path, topics, log.camera().name, pipeline, keyframes, inputs_of(path, cache))


def missing_parts(cache: Path, parts: Iterable[ExtractionPart]) -> list[ExtractionPart]:
    """The parts that the cache does not hold, or not whole."""
    return [part for part in parts if not is_whole(cache / part.file, part.key, part.stamp_ns)]


def compute_part(part: ExtractionPart, execution: Execution = Execution()) -> bytes:
    """Decode and describe a part's keyframes: the bytes of its file. The same on any machine.

    Raises LogError where the log cannot be read, or is another one than `parts_of` saw.
    """
    paths = [located(path) for path in part.log]
    log = logs.open_drive(paths, part.topics)
    if inputs_of(paths, None).lengths != part.lengths:
        raise LogError(f"{paths[0]} changed during the run. Run again when it is written or copied to its end.")
    return sealed(part.key, _content(log, part, _frames(log, [part], execution)))


def put_part(cache: Path, part: ExtractionPart, data: bytes) -> None:
    """Put what `compute_part` gave into a drive's cache, as a whole. Raises ResultError."""
    try:
        content_of(data, part.key)
    except DamagedError as error:
        raise ResultError(f"Part {part.number} of {shown(part.log[0])} arrived damaged: {error}. Run again.") from None
    with replacing(cache / part.file, parents=True) as stream:
        stream.write(data)


def stored_features(cache: Path, camera: int = 0) -> Extracted | None:
    """The features of the pictures of a finished run's camera; None where the cache does not hold them all."""
    names, found = finished_parts(cache, camera), Extracted()
    try:
        for name in names:
            check_file(cache / name)
            found.add(cache / name)
    except (AbsentError, DamagedError):
        return None
    return found if names else None


def split_keyframes(
    drive: Path | Sequence[Path],
    topics: logs.TopicChoice | None,
    image: str,
    settings: Extraction,
    keyframes: Keyframes,
    inputs: Inputs,
) -> list[ExtractionPart]:
    """The keyframes in parts, of the images of topic `image`. Raises LogError where there is only one."""
    stamp_ns = keyframes.stamp_ns
    if len(stamp_ns) < 2:
        raise LogError(
            f"{keyframes.drive}: by the odometry nothing moves far enough for a second keyframe, and a graph needs "
            "two. Set keyframes.distance_m lower, or choose another source with --odometry."
        )
    topics, paths = topics or logs.TopicChoice(), tuple(address(file.resolve()) for file in files_of(drive))
    alike = {
        "inputs": inputs.token,
        "topics": image_topics(topics, image),
        "features": settings.features.identity(),
        "stereo": settings.stereo.model_dump(mode="json"),
        "pictures": settings.pictures.model_dump(mode="json", include={"megapixels", "quality"}),
        **code_of(__name__, type(settings.features).__module__),
    }
    stamps = [tuple(stamp_ns[at : at + PART_KEYFRAMES].tolist()) for at in range(0, len(stamp_ns), PART_KEYFRAMES)]
    return [
        ExtractionPart(paths, inputs.lengths, topics, settings, own, number, key_of({**alike, "stamps": own}))
        for number, own in enumerate(stamps)
    ]


def image_topics(topics: logs.TopicChoice, image: str) -> dict[str, Any]:
    """The choice of topics as far as images of topic `image` depend on it; files beside the log by their content."""
    named = topics.model_dump(mode="json", exclude={"gps", "masks", "mask_topics", "cameras", "camera_height_m"})
    named["mask"] = topics.mask or topics.mask_topics.get(image)
    for name, path in topics.files.items():
        hashes = hash_inputs(path)
        named[name] = hashes if path.is_dir() else list(hashes.values())  # a file may be called otherwise
    return named


@step("extract", items=lambda log, topics, keyframes, settings: len(keyframes.stamp_ns))
def extract(
    log: Log,
    topics: logs.TopicChoice,
    keyframes: Keyframes,
    settings: Extraction,
    *,
    steps: Steps,
    execution: Execution,
) -> Extracted:
    """The keyframes' features: of the parts that the cache holds from there, of the others from the log's images.

    Raises LogError where fewer than two keyframes decode, and ResultError where the disk is full.
    """
    cache = steps.cache
    parts = split_keyframes(cache.drive, topics, log.camera().name, settings, keyframes, cache.inputs)
    missing = [
        part for part in parts
        if not (cache.keep and is_whole(cache.folder / part.file, part.key, part.stamp_ns, cache.damaged))
    ]  # fmt: skip
    total = sum(len(part.stamp_ns) for part in parts)
    done = total - sum(len(part.stamp_ns) for part in missing)
    # one stream over all that is missing: workers do not wait at the end of a part
    frames = _frames(log, missing, execution) if missing else ()
    counted = execution.part(done, total).counted("extract", frames, total)
    for part in missing:
        cache.put(part.file, sealed(part.key, _content(log, part, counted)))
    found = Extracted()
    for part in parts:
        found.add(cache.folder / part.file)
        cache.use(part.file)
    _count_losses(log, found.undecodable)
    if len(found) < 2:
        why = f" The first: {found.lost[0]}" if found.lost else ""
        raise LogError(f"{log.name}: {len(found)} of {total} keyframes could be decoded, and a graph needs two.{why}")
    steps.count("extract", len(parts), len(parts) - len(missing))
    return found


def decoded(
    keyframes: Keyframes, found: Extracted, settings: FeatureSettings, odometry: Odometry, camera: str
) -> tuple[Keyframes, Extracted]:
    """The keyframes whose images decode, and their features, none where a picture is the one before once more, with a
    warning where that is so, where images are lost, or where they are poor."""
    rows, total = np.searchsorted(keyframes.stamp_ns, found.stamp_ns), len(keyframes.stamp_ns)
    for why in found.lost[:1]:
        warn(f"{total - len(rows)} of {total} keyframes were lost to damaged images. First: {why}")
    if why := poor_pictures(found, getattr(settings, "least_features", 0)):
        warn(why)
    poses = keyframes.odom_from_body[rows]
    # without metres the motion is that of the pictures, or not known
    if odometry.metric and (stale := stale_pictures(poses, found)).any():
        first_s = (found.stamp_ns[int(stale.argmax())] - found.stamp_ns[0]) / 1e9
        warn(
            f"{stale.sum()} of {total} keyframes of {camera} show the picture of the one before although the odometry "
            f"moves on, the first of them {first_s:.0f} s after the start. They are matched with nothing: did the "
            "camera freeze?"
        )
        found = found.blank(stale)
    return Keyframes(keyframes.drive, keyframes.stamp_ns[rows], poses), found


def stale_pictures(poses: Floats, found: Extracted) -> Bools:
    """(N,) whether each keyframe, of poses (N, 4, 4), shows the picture of the one before although the body has moved
    or turned since that was new. At a standstill pictures may well be the same."""
    repeats = found.repeats()
    moved = se3.between(poses[np.maximum.accumulate(np.where(repeats, 0, np.arange(len(repeats))))], poses)
    return repeats & ((np.linalg.norm(moved[:, :3, 3], axis=1) > _STILL_M) | (se3.angle(moved) > _STILL_RAD))


def poor_pictures(found: Extracted, least: int) -> str:
    """A warning of pictures too poor for place recognition; empty where few have less than `least`
    features and the usual one has light, contrast and size."""
    counts = np.array(found.counts)
    sample = [found[row] for row in np.linspace(0, len(counts) - 1, _LOOKED_AT).astype(int).tolist()]
    width, height = sample[0].width, sample[0].height
    grey = np.array([one.thumbnail for one in sample if one.thumbnail is not None])
    reasons = [f"small ({width} x {height} px)"] if width * height < _SMALL_PX else []
    if len(grey) and (mean := float(np.median(grey.mean(axis=(1, 2))))) < _DARK:
        reasons.append(f"dark (a mean of {mean:.0f} of 255)")
    elif len(grey) and (levels := float(np.median(np.ptp(np.percentile(grey, [1, 99], axis=(1, 2)), axis=0)))) < _FLAT:
        reasons.append(f"low in contrast ({levels:.0f} of 255 levels)")
    few = int((counts < least).sum())
    if not least or (not reasons and few < _POOR_SHARE * len(counts)):
        return ""
    poor = f", and {few} of {len(counts)} have fewer than {least}, too few to recognise a place by" if few else ""
    return (
        f"Pictures are {' and '.join(reasons) or 'blurred, or without texture'}. With contrast and size raised, the "
        f"usual one has {int(np.median(counts))} features{poor}."
    )


def is_whole(
    path: Path, key: str, stamp_ns: Sequence[int], damaged: Callable[[Path, Exception], object] = lambda *_: None
) -> bool:
    """Whether a file holds a part with this key and these keyframes whole; `damaged` gets one that does not."""
    found = Extracted()
    try:
        check_file(path, key)
        found.add(path)
        if not set(found.stamp_ns) <= set(stamp_ns) or found.stamp_ns != sorted(set(found.stamp_ns)):
            raise DamagedError("it holds other keyframes")
    except AbsentError:
        return False
    except DamagedError as error:
        damaged(path, error)
        return False
    return True


def _content(log: Log, part: ExtractionPart, frames: Iterable[Decoded]) -> bytes:
    """Content of the file of a part; `frames` gives its keyframes in order, and maybe more."""
    found, lost = described(islice(frames, len(part.stamp_ns)), part.pipeline.pictures)
    account = getattr(log, "account", None)
    return packed(found, lost, [] if account is None else account.undecodable(part.stamp_ns))


def described(
    frames: Iterable[Decoded], pictures: PictureSettings
) -> tuple[list[tuple[int, Features, bytes]], list[str]]:
    """Stamp, features and picture of the frames that decode, and why others do not."""
    found, lost = [], []
    for stamp_ns, frame, features, why in frames:
        if frame is None or features is None:
            lost.append(why)
        else:
            found.append((stamp_ns, features, preview(frame.image, pictures)))
    return found, lost


def _count_losses(log: Log, undecodable: Iterable[tuple[str, int]]) -> None:
    """Add the losses of stored parts to those of this run; a loss in both counts once."""
    account = getattr(log, "account", None)
    if account is not None:
        for topic, at in undecodable:
            account.add("undecodable_image", {topic: 1}, (topic, at), [(at, at)])


def _frames(log: Log, parts: Sequence[ExtractionPart], execution: Execution) -> Iterator[Decoded]:
    """The keyframes of some parts of a drive, decoded, with their features, in order."""
    stamp_ns = np.array([stamp_ns for part in parts for stamp_ns in part.stamp_ns], np.int64)
    settings = parts[0].pipeline
    return extract_frames(log.frames(stamp_ns), settings.features, execution, settings.stereo)
