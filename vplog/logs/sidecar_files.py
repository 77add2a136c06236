"""Odometry and calibration from files beside a log."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vplog.data import Odometry
from vplog.errors import LogError
from vplog.geometry import se3
from vplog.geometry.tum import read_tum
from vplog.logs.calibration_file import camera_for, read_calibrations
from vplog.logs.continuity import without_jumps

if TYPE_CHECKING:
    from vplog.data import Floats
    from vplog.logs.calibration_file import CalibratedCamera
    from vplog.logs.formats.container import Notes
    from vplog.logs.topic_selection import TopicChoice


class SidecarFiles:
    """The files of a TopicChoice, read at once: what is wrong with them shows before any work on the log."""

    def __init__(self, choice: TopicChoice, notes: Notes) -> None:
        """Raises LogError where a file cannot be read."""
        self.odometry: Odometry | None = None
        """None without a file."""
        if choice.odometry_file is not None:
            logged = Odometry(*read_tum(choice.odometry_file, LogError, "--odometry-file"), None)
            self.odometry = without_jumps(logged, choice.odometry_file.name, notes)
            notes.add(f"{choice.odometry_file.name} carries no covariance; its noise is that of the drift model.")
        self._path = choice.calibration_file
        self._cameras = [] if self._path is None else read_calibrations(self._path)

    def camera(self, topic: str) -> CalibratedCamera | None:
        """The camera of an image topic; None without a file. Raises LogError where the file does not say which."""
        return None if self._path is None else camera_for(self._cameras, topic, self._path)

    def right_from_left(self, left: str, right: str) -> Floats | None:
        """(4, 4) between the cameras of two image topics; None where the file has no chain that leads there."""
        a, b = self.camera(left), self.camera(right)
        if a is None or b is None or a is b or a.from_first is None or b.from_first is None:
            return None
        return b.from_first @ se3.inverse(a.from_first)
