"""Scans of a lidar as the log holds them, by their row in time, and where the lidar sits on the body."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from vplog.data import Ints, Lidar, Scan
from vplog.logs.cameras import BODY
from vplog.logs.formats.container import Container, Notes
from vplog.logs.messages.clouds import scan_of
from vplog.logs.messages.decode import decode
from vplog.logs.messages.records import BadMessageError, CloudMessage
from vplog.logs.stamps import rows_of
from vplog.logs.tf_odometry import frame_name

if TYPE_CHECKING:
    from vplog.logs.content import LogContent

_BESIDE_NS = 10**9
"""ns before the first image and behind the last, from which scans are taken, too: the images' motion lies within."""
_TRIED = 10
"""Scans that are tried for the lidar's frame."""


class ScanReader:
    """Reads the scans of the selection's lidar by their place in the container; none where the log has odometry."""

    def __init__(self, container: Container, content: LogContent, notes: Notes) -> None:
        self._container, self._content, self._notes = container, content, notes
        self._channel = content.chosen.lidar if content.odometry is None else None

    def lidar(self, has_images: bool) -> Lidar | None:
        """The lidar with its scans about the images'; None without any."""
        content, channel = self._content, self._channel
        if channel is None or not len(content.scan_ns):
            return None
        placed = content.tree.between(self.body, self._frame)
        if placed is None:
            self._notes.add(
                f"No static transforms lead from {self.body} to {self._frame or 'the lidar'} of {channel.topic}; the "
                "lidar is taken to sit at the body's origin, upright and looking ahead."
            )
            placed = np.eye(4)
        scan_ns = content.scan_ns
        if has_images and len(content.stamp_ns):
            first, last = content.stamp_ns[[0, -1]].tolist()
            scan_ns = scan_ns[(scan_ns >= first - _BESIDE_NS) & (scan_ns <= last + _BESIDE_NS)]
        return Lidar(channel.topic, scan_ns, placed)

    def scans(self, stamp_ns: Ints, log: str) -> Iterator[Scan]:
        """As `vplog.stages.Log.scans`. Raises LogError where a stamp is not one of the lidar's."""
        channel, known_ns = self._channel, self._content.scan_ns
        for row in rows_of(known_ns, stamp_ns, log) if channel is not None else ():
            at_ns = int(known_ns[row])
            try:
                yield scan_of(self._cloud(row), at_ns)
            except BadMessageError:
                topic = "" if channel is None else channel.topic
                self._notes.account.add("undecodable", {topic: 1}, (topic, at_ns), [(at_ns, at_ns)])

    @property
    def body(self) -> str:
        """Frame of the body where the lidar gives the odometry: base_link, else the lidar's own; empty without one."""
        return "" if self._channel is None else BODY if BODY in self._content.tree else self._frame

    @cached_property
    def _frame(self) -> str:
        """Frame of the first scans that decode; empty where none does."""
        for row in range(min(_TRIED, len(self._content.scan_ns))):
            with suppress(BadMessageError):
                return frame_name(self._cloud(row).frame)
        return ""

    def _cloud(self, row: int) -> CloudMessage:
        """Raises BadMessageError."""
        place = self._content.scan_places[row]
        found = None if self._channel is None else decode(self._channel, self._container.read(place))
        if not isinstance(found, CloudMessage):
            raise BadMessageError("it is no point cloud")
        return found
