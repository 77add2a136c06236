"""Drives of a map, with the log, the camera and the features that the verification of closures between them needs."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vplog import logs
from vplog.data import Int32s, Ints
from vplog.errors import LogError, ResultError
from vplog.features.store import FeatureStore
from vplog.loops.calibration import compared_pairs
from vplog.loops.verify import VerifySettings, calibration_share, drive_of
from vplog.maps.storage.layout import described_with, folder_name
from vplog.pipeline import Pipeline
from vplog.results import run_record, tables
from vplog.results.feature_table import FeatureTable, write_features
from vplog.results.run_cameras import CameraPictures, camera_from, camera_pictures, camera_topics, recorded_camera
from vplog.run.feature_extraction import Extracted, stored_features
from vplog.run.provenance import stored_log
from vplog.run.reextraction import ReextractedFeatures
from vplog.storage.input_hashes import hash_inputs
from vplog.storage.json_records import key_of, plain
from vplog.storage.scratch import scratch

if TYPE_CHECKING:
    from vplog.execution.execution import Execution
    from vplog.loops.candidate import Drive
    from vplog.maps.storage.map_store import Store
    from vplog.stages import Log

    Fetch = Callable[[Int32s | Ints], None]

_FRONT_END = ("keyframes", "features", "stereo", "places")
"""Settings that a drive's keyframes, features and places depend on, unlike those of later stages."""


@dataclass(frozen=True)
class Member:
    """A drive of a map, as it goes to another process or machine, which must see the map and the log there."""

    drive: str
    keyframes: Path
    cache: Path
    """Stage cache of its run, with its features while it is new."""
    features: Path
    """Stored features, for later drives."""
    log: str
    named: str
    """The map, or the URL of the log, as the user named it: a log on another server is not opened."""
    inputs: dict[str, str]
    """sha256 of the log's files, by name."""
    topics: logs.TopicChoice
    pipeline: Pipeline
    key: str
    """sha256 over all that its keyframes, features and places depend on."""
    cameras: tuple[str, ...] = ("",)
    """Topics of its cameras, the first one's first."""
    camera: int = 0
    """Number of the camera that topics and features are of."""
    calibrations: list[Any] | None = None
    """The cameras that its run computed with, as plain values; None where its record lacks them."""

    def of_camera(self, number: int) -> Member:
        """The drive with a further camera as the one in use."""
        if number == 0:
            return self
        return replace(
            self, camera=number, topics=self.topics.of_camera(self.cameras[number]), key=key_of([self.key, number]),
            features=self.features.with_name(f"features-{number}.parquet"),
        )  # fmt: skip

    @property
    def each_camera(self) -> list[Member]:
        """The drive with each of its cameras in turn as the one in use."""
        return [self.of_camera(number) for number in range(len(self.cameras))]

    @property
    def pictures(self) -> CameraPictures:
        """The pictures of the camera in use. Raises ResultError."""
        row, keyframes = camera_pictures(self.keyframes.parent, self.camera)
        return CameraPictures(row, replace(keyframes, drive=self.drive))


def member_of(store: Store, about: dict[str, Any], url: str | None = None) -> Member:
    """Return a drive by its drive.json; `url` is the path or URL of its log if the user gave that in this command.
    Raises VplogError if its run folder is of another version or damaged."""
    drive = about["drive"]
    file, record = store.file(drive, "keyframes.parquet"), store.file(drive, "run.json")
    settings = tables.read_table_metadata(file).settings
    pipeline = Pipeline.read(settings, str(file))
    account = run_record.read_run_json(record)
    topics, cameras = account.get("topics"), tuple(camera_topics(account))
    if len(cameras) > 1:
        described = store.run(drive, ["descriptors.parquet", "trajectory.parquet"]) / "descriptors.parquet"
        cameras = cameras[: int(tables.read_pictures(described)[1].max(initial=0)) + 1]  # a map may describe fewer
    made_from = {
        "inputs": about["inputs"],
        "library": described_with(about),
        "code": about.get("code"),
        "topics": about.get("topics"),
        "gps": pipeline.gps.use,
        **{name: settings.get(name) for name in _FRONT_END},
    }
    return Member(
        drive, file, store.root / ".cache" / folder_name(drive),
        store.root / "joins" / folder_name(drive) / "features.parquet", url or about["log"], url or str(store),
        about["inputs"],
        logs.TopicChoice.read(topics if isinstance(topics, dict) else {}, str(record)), pipeline,
        key_of(made_from), cameras, calibrations=account.get("calibrations"),
    )  # fmt: skip


def opened_log(member: Member) -> Log:
    """The log of a drive. Raises LogError where it is not there any more, or has changed."""
    path = stored_log(member.log, member.named, f"The log of {member.drive}", "Give it again: vplog batch LOG -o MAP")
    try:
        log, found = logs.open_drive([path], member.topics), hash_inputs(path)
    except OSError as error:
        raise LogError(f"The log of {member.drive}, {path}, cannot be read: {error.strerror or error}.") from None
    if any(member.inputs.get(name) != text for name, text in found.items()):
        raise LogError(f"The log of {member.drive}, {path}, has changed since. Run `vplog batch` with it again.")
    return log


@dataclass(frozen=True)
class CameraTrust:
    """The camera of a drive, and how far its calibration is trusted."""

    camera: dict[str, Any]
    """The camera's record as plain values."""
    rotation_share: float
    """Share of a rotation by which camera and odometry disagree; 0 without calibration."""
    further: tuple[CameraTrust, ...] = ()
    """Each further camera, and how far its calibration is trusted."""

    @property
    def each(self) -> tuple[CameraTrust, ...]:
        """All cameras of the drive with their trust, the first camera first."""
        return self, *self.further


def untried_camera(member: Member) -> CameraTrust:
    """The camera that the drive's run computed with, as calibrated. Raises ResultError."""
    camera = recorded_camera({"calibrations": member.calibrations}, member.camera)
    return CameraTrust(plain(dict(vars(camera))), 0.0)


def camera_trust(member: Member, verify: VerifySettings, execution: Execution) -> CameraTrust:
    """The camera of the drive's run, its rotations compared with the odometry's. Raises VplogError."""
    unknown = untried_camera(member)
    if unknown.camera["matrix"] is None:
        return unknown
    with opened_drive(member, unknown, verify, execution) as (drive, fetch):
        pairs, around = compared_pairs(drive.keyframes, verify.calibration), verify.landmarks.neighbours
        near = pairs[:, :1] + np.arange(-around, around + 1)
        rows = np.concatenate([near.ravel(), pairs[:, 1]])
        fetch(np.unique(rows[(rows >= 0) & (rows < len(drive.keyframes.stamp_ns))]))
        return replace(unknown, rotation_share=calibration_share(drive, execution))


def keep_features(member: Member, verify: VerifySettings) -> None:
    """Store the features for verification that the drive's run left in its cache, if any."""
    if (stored := _stored(member, verify)) is not None:
        stored.close()
    elif (found := _from_run(member)) is not None:
        member.features.parent.mkdir(parents=True, exist_ok=True)
        write_features(member.features, len(found), found.__getitem__, verify.matching.features, member.key)


def _stored(member: Member, verify: VerifySettings) -> FeatureTable | None:
    """The features that the map stores of the drive, unless they are of another state of it or too few."""
    try:
        stored = FeatureTable(member.features, member.key, verify.matching.features)
    except ResultError:
        return None
    if len(stored) == len(member.pictures.row):
        return stored
    stored.close()
    return None


def _from_run(member: Member) -> Extracted | None:
    """All features of the drive in the cache of its run; None where they are not there or of other keyframes."""
    found, stamp_ns = stored_features(member.cache, member.camera), member.pictures.keyframes.stamp_ns
    return found if found is not None and np.array_equal(found.stamp_ns, stamp_ns) else None


@contextmanager
def opened_drive(
    member: Member, known: CameraTrust, verify: VerifySettings, execution: Execution
) -> Iterator[tuple[Drive, Fetch]]:
    """The drive for verification, and a function that extracts the features of some keyframes at once.

    Features are those that the map stores, or in the cache of its run, or extracted again from its log. Raises LogError
    where that is gone or another one.
    """
    keyframes, camera = member.pictures.keyframes, camera_from(known.camera, "Run `vplog map join` again.")

    with ExitStack() as stack:
        features: Any = _stored(member, verify)
        if features is not None:
            stack.enter_context(closing(features))
        elif (features := _from_run(member)) is None:
            log = opened_log(member)
            store = stack.enter_context(FeatureStore(stack.enter_context(scratch("features")) / "features"))
            features = ReextractedFeatures(log, keyframes.stamp_ns, member.pipeline, store, execution)
        yield drive_of(keyframes, camera, features.__getitem__, verify), getattr(features, "fetch", lambda _: None)
