"""The tree of static frames."""

from __future__ import annotations

from collections import defaultdict, deque
from typing import TYPE_CHECKING

import numpy as np

from vplog.geometry import se3

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from vplog.data import Floats
    from vplog.logs.messages.records import PoseMessage

FARTHEST_M = 1e9
"""m; positions in map coordinates reach 1e7, so a coordinate beyond this is damage."""
SMALLEST = 1e-6
"""Largest component of a quaternion below which none was set; real ones have length 1, to a few digits."""


class FrameTree:
    """Static transforms between named frames; a later transform of the same pair replaces an earlier one."""

    def __init__(self, transforms: Iterable[PoseMessage]) -> None:
        self._from: defaultdict[str, dict[str, Floats]] = defaultdict(dict)
        self.edges: list[tuple[str, str]] = []
        """Parent and child of each transform."""
        self.dropped = 0
        """Transforms that were NaN, infinite or without rotation."""
        for transform in transforms:
            parent, child = clean(transform.frame), clean(transform.child)
            parent_from_child = usable_pose(transform.position, transform.quaternion)
            if parent_from_child is None or parent == child:
                self.dropped += 1
                continue
            self.edges.append((parent, child))
            self._from[parent][child], self._from[child][parent] = parent_from_child, se3.inverse(parent_from_child)

    def __contains__(self, frame: str) -> bool:
        return clean(frame) in self._from

    def __len__(self) -> int:
        return len(self._from)

    def between(self, a: str, b: str) -> Floats | None:
        """a_from_b (4, 4) by the shortest chain, up and down the tree; None where there is none."""
        start, goal = clean(a), clean(b)
        reached = {start: np.eye(4)}
        queue = deque([start])
        while queue and goal not in reached:
            here = queue.popleft()
            for frame, here_from_frame in sorted(self._from.get(here, {}).items()):
                if frame not in reached:
                    reached[frame] = reached[here] @ here_from_frame
                    queue.append(frame)
        return reached.get(goal)


def clean(frame: str) -> str:
    """tf1 wrote frames with a leading slash, tf2 without."""
    return frame.lstrip("/")


def usable_pose(position: Sequence[float], quaternion: Sequence[float]) -> Floats | None:
    """(4, 4), or None where nothing on earth is there (NaN, infinite, beyond FARTHEST_M) or no rotation is set."""
    pose = np.array([*position, *quaternion], np.float64)
    return se3.pose(se3.rotation(pose[3:]), pose[:3]) if are_usable(pose[None]).all() else None


def are_usable(poses: Floats) -> np.ndarray:
    """(K,) bool: whether `usable_pose` of x y z, x y z w in each row of (K, 7) is one."""
    sizes = np.abs(poses)
    placed, largest = (sizes[:, :3] < FARTHEST_M).all(1), sizes[:, 3:].max(1)  # NaN where one is
    return placed & (largest > SMALLEST) & (largest < 1 / SMALLEST)
