"""The landmarks of a finished drive, by which pictures are localised in it: made once, and stored beside it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from vplog import logs
from vplog.data import Features, Floats
from vplog.errors import ResultError
from vplog.execution.execution import Execution
from vplog.features.store import FeatureStore
from vplog.loops.candidate import Drive
from vplog.loops.undistort import project
from vplog.loops.verify import VerifySettings, drive_of
from vplog.results.landmark_table import write_landmarks
from vplog.results.run_cameras import camera_pictures, camera_topics, recorded_camera
from vplog.results.run_record import CACHE
from vplog.run.cache.code_hash import code_of
from vplog.run.feature_extraction import Extraction, stored_features
from vplog.run.provenance import reopened
from vplog.run.reextraction import ReextractedFeatures
from vplog.storage.json_records import key_of
from vplog.storage.scratch import scratch

MOST = 150
"""Landmarks of a keyframe, the strongest: where a quarter is found again, half being out of sight and half not matched,
there are nearly twice the inliers that a pose needs."""
_LOOKED_AT = 16
"""Keyframes that tell whether depths are measured; one may be blinded."""


class DriveSettings(Extraction, Protocol):
    """The settings that landmarks take, as the pipeline has them."""

    @property
    def verify(self) -> VerifySettings: ...


def landmarks_file(camera: int) -> str:
    """Name of the file of a camera, by its number in the run."""
    return f"landmarks-{camera}.parquet" if camera else "landmarks.parquet"


@contextmanager
def run_drive(
    folder: Path, record: dict[str, Any], settings: DriveSettings, camera: int, execution: Execution
) -> Iterator[Drive]:
    """The pictures of a finished run's camera as closures are verified: with the features in its cache, or extracted
    from its log again. Raises VplogError where the log is gone."""
    _, keyframes = camera_pictures(folder, camera)
    topics = logs.TopicChoice.read(record.get("topics") or {}, f"{folder}/run.json")
    topics = topics.of_camera(camera_topics(record)[camera]) if camera else topics
    log = reopened(folder, record, None, topics, f"Run it again with its cache: vplog run LOG -o {folder}")
    with ExitStack() as stack:
        features: Any = stored_features(folder / CACHE, camera)
        if features is None or not np.array_equal(features.stamp_ns, keyframes.stamp_ns):
            store = stack.enter_context(FeatureStore(stack.enter_context(scratch("features")) / "features"))
            features = ReextractedFeatures(log, keyframes.stamp_ns, settings, store, execution)
        used = recorded_camera(record, camera)
        yield drive_of(keyframes, used, features.__getitem__, settings.verify)


def landmark_key(folder: Path, record: dict[str, Any], settings: DriveSettings, camera: int) -> str:
    """sha256 over all that the landmarks of a finished run's camera depend on, but for the files beside its log."""
    pictures = camera_pictures(folder, camera).keyframes
    made_from = {
        "inputs": record.get("inputs"), "topics": record.get("topics"), "most": MOST,
        "keyframes": pictures.stamp_ns.tolist(), "odometry": pictures.odom_from_body.tolist(), "camera": camera,
        "features": settings.features.identity(), "stereo": settings.stereo.model_dump(mode="json"),
        "verify": settings.verify.model_dump(mode="json"), **code_of(__name__, type(settings.features).__module__),
    }  # fmt: skip
    return key_of(made_from)


def write_drive_landmarks(path: Path, drive: Drive, key: str, execution: Execution) -> None:
    """Write the landmarks of all keyframes. Raises ResultError where the camera has no calibration."""
    if drive.camera.matrix is None:
        name = drive.keyframes.drive
        raise ResultError(
            f"The camera of {name} has no calibration, so nothing is localised in it. Run it again with --calibration."
        )

    def work(row: int) -> tuple[Features, Floats]:
        return _strongest(drive, row)

    count = len(drive.keyframes.stamp_ns)
    found = execution.counted("landmarks", execution.map(work, range(count)), count)
    measured = any(np.isfinite(drive.features(row).depth_m).any() for row in range(min(count, _LOOKED_AT)))
    scale = "stereo" if drive.stereo else "depth" if measured else "odometry"
    write_landmarks(path, found, drive.camera, scale, key)


def _strongest(drive: Drive, row: int) -> tuple[Features, Floats]:
    """The strongest landmarks of a keyframe, as features with their depths, and the sigmas of their inverse depths."""
    found = drive.landmarks(row)
    known = np.flatnonzero(found.known)[:MOST]
    own, rho = drive.features(row).rows(known), found.rho[known]
    px = project(drive.camera, np.column_stack([found.rays[known], np.ones(len(known))]))
    own = replace(own, points=px.astype(np.float32), depth_m=(1.0 / rho).astype(np.float32))
    return own, np.sqrt(found.covariance[known, 2, 2])
