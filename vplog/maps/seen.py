"""Drives of a map as closures between them are checked: how they see, and their features, kept or made again."""

from __future__ import annotations

import contextlib
import threading
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from vplog.data import Camera
from vplog.errors import LogError, ResultError
from vplog.extract import extract_frames
from vplog.features.store import FeatureStore
from vplog.loops.calibration import turning_pairs
from vplog.loops.verify import calibration_share, drive_of
from vplog.maps.members import check_unchanged, opened_log
from vplog.parts import stored_features
from vplog.results import run_record, tables
from vplog.results.kept_features import KeptFeatures, write_features
from vplog.scratch import scratch
from vplog.urls import shown

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from vplog.data import Features, Int32s, Ints
    from vplog.loops.candidate import Drive
    from vplog.loops.verify import VerifySettings
    from vplog.maps.members import Member
    from vplog.parts import Extracted
    from vplog.stages import Log

    Fetch = Callable[[Int32s | Ints], None]

_BLOCK = 16
"""Keyframes extracted together where one was not foreseen: its neighbours are asked for next, and to read a log again
costs as much as several."""


@dataclass(frozen=True)
class Sight:
    """How a drive sees, and how far that is trusted."""

    camera: dict[str, Any]
    """As plain values."""
    rotation_share: float
    """By what share of a rotation camera and odometry disagree; 0 without calibration."""


def sight_of(member: Member, verify: VerifySettings, threads: int = 1) -> Sight:
    """Read the camera, and hold its rotations against the odometry's. Raises LogError where the log is gone."""
    camera = opened_log(member).camera()
    if camera.matrix is None:
        return Sight(plain_camera(camera), 0.0)
    with checked_with(member, Sight(plain_camera(camera), 0.0), verify, threads) as (drive, fetch):
        pairs, around = turning_pairs(drive.keyframes, verify.calibration), verify.landmarks.neighbours
        near = pairs[:, :1] + np.arange(-around, around + 1)
        rows = np.concatenate([near.ravel(), pairs[:, 1]])
        fetch(np.unique(rows[(rows >= 0) & (rows < len(drive.keyframes.stamp_ns))]))
        return Sight(plain_camera(camera), calibration_share(drive, threads))


def keep_features(member: Member, verify: VerifySettings) -> bool:
    """Keep what verification looks at of the features that the drive's run left; False where it left none."""
    kept = _kept(member, verify)
    if kept is not None:
        kept.close()
        return True
    found = _left_by_run(member)
    if found is None:
        return False
    member.features.parent.mkdir(parents=True, exist_ok=True)
    write_features(member.features, len(found), found.__getitem__, verify.matching.features, member.key)
    return True


def _kept(member: Member, verify: VerifySettings) -> KeptFeatures | None:
    """The features that the map keeps of the drive as it is now, as many as are looked at."""
    try:
        kept = KeptFeatures(member.features, member.key, verify.matching.features)
    except ResultError:
        return None
    if len(kept) == len(tables.read_keyframes(member.keyframes)[0].stamp_ns):
        return kept
    kept.close()
    return None


def _left_by_run(member: Member) -> Extracted | None:
    """All features of the drive, where its run left them: they are those of its keyframes."""
    found = stored_features(member.cache)
    keyframes, _ = tables.read_keyframes(member.keyframes)
    return found if found is not None and np.array_equal(found.stamp_ns, keyframes.stamp_ns) else None


@contextmanager
def checked_with(
    member: Member, sight: Sight, verify: VerifySettings, threads: int = 1
) -> Iterator[tuple[Drive, Fetch]]:
    """The drive as candidates are checked with, and what gets the features of some keyframes at once.

    Features are those that the map keeps, or that its run left, or are extracted again from its log, which then has to
    be there and the same. Raises LogError where it is not.
    """
    keyframes, _ = tables.read_keyframes(member.keyframes)
    keyframes, camera = replace(keyframes, drive=member.drive), camera_from(sight.camera)

    def checked(features: Callable[[int], Features]) -> Drive:
        return drive_of(keyframes, camera, features, verify, camera.baseline_m)

    kept = _kept(member, verify)
    if kept is not None:
        with contextlib.closing(kept):
            yield checked(kept.__getitem__), lambda _: None
        return
    left = _left_by_run(member)
    if left is not None:
        yield checked(left.__getitem__), lambda _: None
        return
    log = opened_log(member)
    check_unchanged(member)
    with scratch("features") as folder, FeatureStore(folder / "features") as store:
        again = _Again(log, keyframes.stamp_ns, member, store, threads)
        yield checked(again.__getitem__), again.fetch


class _Again:
    """Features of keyframes, extracted from the log when they are asked for. Reads are safe from any thread."""

    def __init__(self, log: Log, stamp_ns: Ints, member: Member, store: FeatureStore, threads: int) -> None:
        self._log, self._stamp_ns, self._member, self._threads = log, stamp_ns, member, threads
        self._store, self._at = store, dict[int, int]()
        self._lock = threading.Lock()

    def fetch(self, rows: Iterable[int]) -> None:
        """Extract what of these rows is not there yet, in one pass of the log. Raises LogError."""
        with self._lock:
            missing = [row for row in sorted({int(row) for row in rows}) if row not in self._at]
            if not missing:
                return
            pipeline, frames = self._member.pipeline, self._log.frames(self._stamp_ns[missing])
            found = extract_frames(frames, pipeline.features, self._threads, pipeline.stereo)
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
