"""Frames of tf: the tree of static ones, and the odometry by the chain of moving ones from the root to the body."""

from __future__ import annotations

from array import array
from collections import Counter, defaultdict, deque
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import reduce
from itertools import pairwise
from operator import matmul

import numpy as np

from vplog.data import Floats, Ints, Odometry
from vplog.errors import plural
from vplog.geometry import se3
from vplog.logs.formats.container import Notes
from vplog.logs.messages.records import PoseMessage
from vplog.logs.stamps import NONE, Stamps

BODIES = ("base_link", "base_footprint")
"""Names of the body, ROS REP 105 and 120, in order of preference."""
_ROOTS = ("odom", "map", "world")
"""Names of frames that stand still (ROS REP 105): odom first, whose poses do not jump."""
_FARTHEST_M = 1e9
"""m; positions in map coordinates reach 1e7, so a coordinate beyond this is damage."""
_SMALLEST = 1e-6
"""Largest component of a quaternion below which none was set; real ones have length 1, to a few digits."""
_SAME_M, _SAME_RAD = 0.01, np.radians(1.0)
"""Differences of two transforms that are one: a calibration is published again with other roundings."""
Edge = tuple[str, str]
"""Parent and child."""


class FrameTree:
    """Static transforms between named frames; a later transform of the same pair replaces an earlier one."""

    def __init__(self, transforms: Iterable[PoseMessage]) -> None:
        self._from: defaultdict[str, dict[str, Floats]] = defaultdict(dict)
        self.edges: list[Edge] = []
        """Parent and child of each transform."""
        self._changes: Counter[Edge] = Counter()
        """Times that the transform of a pair was replaced by another."""
        self.dropped = 0
        """Transforms that were NaN, infinite or without rotation."""
        for transform in transforms:
            parent, child = frame_name(transform.frame), frame_name(transform.child)
            pose = np.array([*transform.position, *transform.quaternion], np.float64)
            if parent == child or not are_usable(pose[None]).all():
                self.dropped += 1
                continue
            parent_from_child = se3.pose(se3.rotation(pose[3:]), pose[:3])
            if (before := self._from[parent].get(child)) is not None:
                moved = se3.between(before, parent_from_child)
                if np.linalg.norm(moved[:3, 3]) > _SAME_M or se3.angle(moved) > _SAME_RAD:
                    self._changes[parent, child] += 1
            self.add(parent, child, parent_from_child)

    def add(self, parent: str, child: str, parent_from_child: Floats) -> None:
        self.edges.append((parent, child))
        self._from[parent][child], self._from[child][parent] = parent_from_child, se3.inverse(parent_from_child)

    def __contains__(self, frame: str) -> bool:
        return frame_name(frame) in self._from

    def __len__(self) -> int:
        return len(self._from)

    def between(self, a: str, b: str) -> Floats | None:
        """a_from_b (4, 4) by the shortest chain, up and down the tree; None where there is none."""
        chain = self._frames_between(a, b)
        return reduce(matmul, (self._from[x][y] for x, y in pairwise(chain)), np.eye(4)) if chain else None

    def note_changes(self, a: str, b: str, notes: Notes) -> None:
        """Note the transforms between two frames that were replaced by others."""
        for x, y in pairwise(self._frames_between(a, b)):
            if count := self._changes[x, y] + self._changes[y, x]:
                notes.add(
                    f"The static transform {x} -> {y} changes {plural(count, 'time')}; the last is used for the whole "
                    "drive. Where that is wrong, run a part by --start and --stop with the mount in --calibration."
                )

    def _frames_between(self, a: str, b: str) -> tuple[str, ...]:
        """The shortest chain of frames, both ends included; empty where there is none."""
        start, goal = frame_name(a), frame_name(b)
        reached: dict[str, tuple[str, ...]] = {start: (start,)}
        queue = deque([start])
        while queue and goal not in reached:
            here = queue.popleft()
            for frame in sorted(self._from.get(here, ())):
                if frame not in reached:
                    reached[frame] = (*reached[here], frame)
                    queue.append(frame)
        return reached.get(goal, ())


def frame_name(frame: str) -> str:
    """tf1 wrote frames with a leading slash, tf2 without."""
    return frame.lstrip("/")


def are_usable(poses: Floats) -> np.ndarray:
    """(K,) bool: whether each row of (K, 7), x y z, x y z w, is on earth (not NaN, infinite or beyond _FARTHEST_M) and
    has a rotation."""
    sizes = np.abs(poses)
    placed, largest = (sizes[:, :3] < _FARTHEST_M).all(1), sizes[:, 3:].max(1)  # NaN where one is
    return placed & (largest > _SMALLEST) & (largest < 1 / _SMALLEST)


_STANDING_NS = 500_000_000
"""ns between the samples that are stored of a link which does not move."""


@dataclass
class _Link:
    """One edge of the frame tree over time."""

    first: PoseMessage
    times_ns: list[tuple[int, int, int]] = field(default_factory=list)
    """Stamp, log time and position in the file of samples before it moved, `_STANDING_NS` apart: no gap."""
    moves: bool = False
    travels: bool = False
    """Its position changes, not its rotation alone."""
    stamps: Stamps = field(default_factory=Stamps)
    values: array[float] = field(default_factory=lambda: array("d"))
    """x y z, x y z w of every sample; of a link that stands still at first, of some of that time."""

    def add(self, transform: PoseMessage, time_ns: tuple[int, int, int]) -> None:
        if not self.moves:
            if len(self.times_ns) > 1 and time_ns[1] - self.times_ns[-2][1] < _STANDING_NS:
                self.times_ns.pop()
            self.times_ns.append(time_ns)
            return
        for before_ns in self.times_ns:
            self._append(self.first, before_ns)
        self.times_ns.clear()
        self._append(transform, time_ns)

    def _append(self, transform: PoseMessage, time_ns: tuple[int, int, int]) -> None:
        self.stamps.add(*time_ns)
        self.values.extend((*transform.position, *transform.quaternion))


class DynamicTransforms:
    """Collects the transforms of tf topics."""

    def __init__(self, store: bool) -> None:
        self._store = store
        """Store every sample, for odometry; else only whether a frame moves."""
        self._links: dict[Edge, _Link] = {}

    def add(self, transforms: list[PoseMessage], log_ns: int, position: int) -> None:
        for transform in transforms:
            edge = frame_name(transform.frame), frame_name(transform.child)
            link = self._links.get(edge)
            if link is None:
                link = self._links[edge] = _Link(transform)
            link.travels = link.travels or link.first.position != transform.position
            link.moves = link.travels or link.moves or link.first.quaternion != transform.quaternion
            if self._store:
                link.add(transform, (transform.stamp_ns, log_ns, position))

    def static(self) -> list[PoseMessage]:
        """Transforms that never changed."""
        return [link.first for _, link in sorted(self._links.items()) if not link.moves]

    def stamps(self) -> list[Stamps]:
        """Stamps of every link that is followed over time."""
        return [link.stamps for link in self._links.values() if len(link.stamps.log_ns)]

    def odometry(self, tree: FrameTree, topic: str, notes: Notes) -> tuple[Odometry | None, list[str]]:
        """The poses of the body in the frame that stands still, and the frames from there to the body; None and none
        where no chain moves."""
        chain = self._chain(tree, topic, notes)
        moving = [edge for edge in chain if edge in self._links and self._links[edge].moves]
        if not moving:
            return None, []
        frames = [chain[0][0], *(child for _, child in chain)]
        names = " -> ".join(frames)
        tracks = {edge: self._track(edge, topic, notes) for edge in moving}
        fastest = max(moving, key=lambda edge: len(tracks[edge][0]))
        at_ns = tracks[fastest][0]
        for stamps, _ in tracks.values():
            at_ns = at_ns[(at_ns >= stamps[0]) & (at_ns <= stamps[-1])] if len(stamps) else NONE
        if not len(at_ns):
            notes.add(f"{topic}: the transforms {names} have no time in common; there is no odometry.")
            return None, []
        poses = np.tile(np.eye(4), (len(at_ns), 1, 1))
        for edge in chain:
            if edge in tracks:
                stamps, samples = tracks[edge]
                poses = poses @ (samples if len(stamps) == 1 else se3.interpolate_at(stamps, samples, at_ns))
            else:
                static = tree.between(*edge)
                poses = poses @ (np.eye(4) if static is None else static)
        notes.add(f"Odometry is {names} of {topic}, which carries no covariance; its noise is that of the drift model.")
        return Odometry(at_ns, poses, None), frames

    def _chain(self, tree: FrameTree, topic: str, notes: Notes) -> list[Edge]:
        """Edges from the frame that stands still down to the body; empty where nothing moves but joints."""
        edges = [*tree.edges, *sorted(self._links)]
        moving = {edge for edge, link in self._links.items() if link.moves}
        by_root = sorted(edges, key=lambda edge: -_ROOTS.index(_name(edge[0])) if _name(edge[0]) in _ROOTS else -9)
        parents = {child: parent for parent, child in by_root}  # of several parents the root that does not jump
        up = {frame: _ancestors(frame, parents) for edge in edges for frame in edge}
        bodies = [body for name in BODIES for body in sorted(up) if _name(body) == name]
        body = next((body for body in bodies if moving.intersection(up[body])), None)
        if body is None:
            body = "" if bodies else self._unnamed(moving, up)  # on a body that stands, only its parts move
        chain = up.get(body, [])[::-1]
        for root in _ROOTS:
            below = [i for i, (parent, _) in enumerate(chain) if _name(parent) == root]
            if below and moving.intersection(chain[below[0] :]):
                return chain[below[0] :]
        if chain and chain[0][0] in parents:
            notes.add(f"{topic}: the transforms above {body} form a loop without odom, map or world; no odometry.")
            return []
        return chain

    def _unnamed(self, moving: set[Edge], up: dict[str, list[Edge]]) -> str:
        """The body of a log that names none: what travels in a frame that stands still, with the fewest links between
        (an arm moves on the body), then the most samples, then the name. Joints turn about one point."""
        travels = [edge for edge in sorted(moving) if self._links[edge].travels]
        children = [child for _, child in travels if _name(child) not in _ROOTS]
        rooted = [child for child in children if any(_name(parent) in _ROOTS for parent, _ in up[child])] or children
        samples = {child: len(self._links[parent, child].values) for parent, child in moving}
        return min(rooted, key=lambda c: (len(moving.intersection(up[c])), -samples[c], c), default="")

    def _track(self, edge: Edge, topic: str, notes: Notes) -> tuple[Ints, Floats]:
        """Increasing stamps of one link and its poses (T, 4, 4), those out of range left out."""
        link = self._links[edge]
        values = np.array(link.values).reshape(-1, 7)
        stamp_ns, rows = link.stamps.order(f"{topic} {edge[0]} -> {edge[1]}", notes)
        usable = are_usable(values[rows])
        values = values[rows[usable]]
        return stamp_ns[usable], se3.pose(se3.rotation(values[:, 3:]), values[:, :3])


def _ancestors(frame: str, parents: dict[str, str]) -> list[Edge]:
    """Edges from a frame to the top of its tree; in a circle, up to the frame that comes twice."""
    result: list[Edge] = []
    passed = {frame}
    while (parent := parents.get(frame, frame)) not in passed:
        result.append((parent, frame))
        passed.add(frame := parent)
    return result


def _name(frame: str) -> str:
    """A frame's name without its namespace: `robot1/odom` is an odom."""
    return frame.rsplit("/", 1)[-1]
