"""Cameras and features of the drives of a map, as the verification of closures between drives needs them."""

from __future__ import annotations

import contextlib
import threading
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from vplog.data import Camera
from vplog.errors import LogError, ResultError
from vplog.execution.execution import Execution
from vplog.features.extraction import extract_frames
from vplog.features.store import FeatureStore
from vplog.loops.calibration import turning_pairs
from vplog.loops.verify import calibration_share, drive_of
from vplog.maps.joining.members import check_unchanged, opened_log
from vplog.results import run_record, tables
from vplog.results.kept_features import KeptFeatures, write_features
from vplog.run.feature_extraction import stored_features
from vplog.storage.scratch import scratch
from vplog.storage.urls import shown

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from vplog.data import Features, Int32s, Ints
    from vplog.loops.candidate import Drive
    from vplog.loops.verify import VerifySettings
    from vplog.maps.joining.members import Member
    from vplog.run.feature_extraction import Extracted
    from vplog.stages import Log

    Fetch = Callable[[Int32s | Ints], None]

_BLOCK = 16
"""Keyframes extracted together where one was not announced: its neighbours are needed next, and to read a log again
costs as much as several."""


@dataclass(frozen=True)
class CameraTrust:
    """The camera of a drive, and how far its calibration is trusted."""

    camera: dict[str, Any]
    """Plain values."""
    rotation_share: float
    """Share of a rotation by which camera and odometry disagree; 0 without calibration."""


def camera_trust(member: Member, verify: VerifySettings, threads: int = 1) -> CameraTrust:
    """The camera of the log, its rotations compared with the odometry's. Raises LogError where the log is gone."""
    camera = opened_log(member).camera()
    if camera.matrix is None:
        return CameraTrust(plain_camera(camera), 0.0)
    with opened_drive(member, CameraTrust(plain_camera(camera), 0.0), verify, threads) as (drive, fetch):
        pairs, around = turning_pairs(drive.keyframes, verify.calibration), verify.landmarks.neighbours
        near = pairs[:, :1] + np.arange(-around, around + 1)
        rows = np.concatenate([near.ravel(), pairs[:, 1]])
        fetch(np.unique(rows[(rows >= 0) & (rows < len(drive.keyframes.stamp_ns))]))
        return CameraTrust(plain_camera(camera), calibration_share(drive, Execution(threads)))


def keep_features(member: Member, verify: VerifySettings) -> bool:
    """Store the features for verification that the drive's run left in its cache; False where it left none."""
    stored = _stored(member, verify)
    if stored is not None:
        stored.close()
        return True
    found = _from_run(member)
    if found is None:
        return False
    member.features.parent.mkdir(parents=True, exist_ok=True)
    write_features(member.features, len(found), found.__getitem__, verify.matching.features, member.key)
    return True


def _stored(member: Member, verify: VerifySettings) -> KeptFeatures | None:
    """The features that the map stores of the drive, unless they are of another state of it or too few."""
    try:
        stored = KeptFeatures(member.features, member.key, verify.matching.features)
    except ResultError:
        return None
    if len(stored) == len(tables.read_keyframes(member.keyframes)[0].stamp_ns):
        return stored
    stored.close()
    return None


def _from_run(member: Member) -> Extracted | None:
    """All features of the drive in the cache of its run; None where they are not there or of other keyframes."""
    found = stored_features(member.cache)
    keyframes, _ = tables.read_keyframes(member.keyframes)
    return found if found is not None and np.array_equal(found.stamp_ns, keyframes.stamp_ns) else None


@contextmanager
def opened_drive(
    member: Member, known: CameraTrust, verify: VerifySettings, threads: int = 1
) -> Iterator[tuple[Drive, Fetch]]:
    """The drive for verification, and a function that extracts the features of some keyframes at once.

    Features are those that the map stores, or in the cache of its run, or extracted again from its log. Raises LogError
    where that is gone or another one.
    """
    keyframes, _ = tables.read_keyframes(member.keyframes)
    keyframes, camera = replace(keyframes, drive=member.drive), camera_from(known.camera)

    def checked(features: Callable[[int], Features]) -> Drive:
        return drive_of(keyframes, camera, features, verify, camera.baseline_m)

    stored = _stored(member, verify)
    if stored is not None:
        with contextlib.closing(stored):
            yield checked(stored.__getitem__), lambda _: None
        return
    cached = _from_run(member)
    if cached is not None:
        yield checked(cached.__getitem__), lambda _: None
        return
    log = opened_log(member)
    check_unchanged(member)
    with scratch("features") as folder, FeatureStore(folder / "features") as store:
        extracted = ReextractedFeatures(log, keyframes.stamp_ns, member, store, threads)
        yield checked(extracted.__getitem__), extracted.fetch


class ReextractedFeatures:
    """Features of keyframes, extracted from the log on demand. Reads are safe from any thread."""

    def __init__(self, log: Log, stamp_ns: Ints, member: Member, store: FeatureStore, threads: int) -> None:
        self._log, self._stamp_ns, self._member, self._threads = log, stamp_ns, member, threads
        self._store, self._at = store, dict[int, int]()
        self._lock = threading.Lock()

    def fetch(self, rows: Iterable[int]) -> None:
        """Extract the features of those rows that lack them, in one pass of the log. Raises LogError."""
        with self._lock:
            missing = [row for row in sorted({int(row) for row in rows}) if row not in self._at]
            if not missing:
                return
            pipeline, frames = self._member.pipeline, self._log.frames(self._stamp_ns[missing])
            found = extract_frames(frames, pipeline.features, Execution(self._threads), pipeline.stereo)
            for row, (stamp_ns, _, features, why) in zip(missing, found, strict=False):
                if features is None or stamp_ns != self._stamp_ns[row]:
                    raise LogError(
                        f"{shown(self._member.log)} does not have keyframe {row} of {self._member.drive}. {why}"
                    )
                self._store.append(features)
                self._at[row] = len(self._store) - 1
            if missing[-1] not in self._at:
                raise LogError(f"{shown(self._member.log)} does not have all keyframes of {self._member.drive}.")

    def __getitem__(self, row: int) -> Features:
        if row not in self._at:
            first = row - row % _BLOCK
            self.fetch(range(first, min(first + _BLOCK, len(self._stamp_ns))))
        return self._store[self._at[row]]


def plain_camera(camera: Camera) -> dict[str, Any]:
    """A camera as plain values."""
    return run_record.plain(dict(vars(camera)))


def camera_from(values: dict[str, Any]) -> Camera:
    """The camera of `plain_camera`. Raises ResultError where the values are not one."""
    try:
        matrix, body_from_camera = values["matrix"], np.array(values["body_from_camera"], np.float64).reshape(4, 4)
        return Camera(
            name=str(values["name"]),
            matrix=None if matrix is None else np.array(matrix, np.float64).reshape(3, 3),
            distortion_model=str(values["distortion_model"]),
            distortion=np.array(values["distortion"], np.float64).reshape(-1),
            width=int(values["width"]),
            height=int(values["height"]),
            body_from_camera=body_from_camera,
            baseline_m=None if values["baseline_m"] is None else float(values["baseline_m"]),
            disparity_zero_px=float(values["disparity_zero_px"]),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise ResultError(f"A camera in MAP/joins is damaged: {error}. Move that folder away, and run again.") from None
