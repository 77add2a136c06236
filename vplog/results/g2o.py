"""Pose graphs as g2o text, planar (SE2) or spatial (SE3:QUAT): read from anywhere, written for any solver."""

from __future__ import annotations

import hashlib
import heapq
import re
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from vplog.data import Bools, EdgeKind, Floats, Int32s, Ints, PoseGraph
from vplog.errors import GraphError, nearest_path, plural
from vplog.geometry import se3
from vplog.storage.scratch import replacing

_MOST_BYTES = 1 << 30
"""Largest file read: a million poses with as many edges, at 500 to 770 bytes of each. Arrays take up to 14 times the
bytes of the text they come from."""
_MOST_ID = 2**63 - 1
_BYTE_ORDER_MARK = "\u00ef\u00bb\u00bf"
"""UTF-8 writes it; read as Latin-1."""
_LEFT_OUT = re.compile(r"(VERTEX|EDGE|PARAMS|DATA|ROBOT|FLASER|RAWLASER|TRUEPOSE|LASER)[A-Z0-9_:]*$")
"""Tags of the format's other elements: landmarks, priors, sensor data. A pose graph is solved without them."""
_JOINS_POSES = re.compile("SWITCHABLE|MAXMIX|MIXTURE")
"""Edges between poses that have a switch or several modes, as Vertigo and Olson's max-mixtures write them."""
_QUATERNION_OFF = 0.1
"""Largest difference of a quaternion's length from 1: rounded to one digit passes, another quantity does not."""
_FURTHEST_M = 1e8
"""A coordinate beyond it is no place on earth, in any frame that drives are recorded in (UTM, ECEF: below 1e7)."""


class _Layout(NamedTuple):
    """Tags and numbers of the lines of one dimension, and the place of its information in (6, 6), rotation first."""

    vertex: str
    edge: str
    pose: int
    """Numbers of a pose: x y yaw, or x y z qx qy qz qw."""
    axes: list[int]
    """Our row of each row of the file's information, which has translation before rotation."""


_LAYOUTS = {
    2: _Layout("VERTEX_SE2", "EDGE_SE2", 3, [3, 4, 2]),
    3: _Layout("VERTEX_SE3:QUAT", "EDGE_SE3:QUAT", 7, [3, 4, 5, 0, 1, 2]),
}


@dataclass(frozen=True, eq=False)
class GraphFile:
    """A pose graph as a file has it."""

    graph: PoseGraph
    ids: Ints
    """(N,) the file's name of each pose, increasing."""
    held: int
    """Row of the pose that FIX holds; 0 where nothing is fixed."""
    warnings: list[str]
    """Elements left out and assumptions made, one sentence each."""


@dataclass
class _Lines:
    """Lines of one kind: where they stand, the ids they name, and the text of their numbers."""

    line: list[int] = field(default_factory=list)
    ids: list[str] = field(default_factory=list)
    numbers: list[str] = field(default_factory=list)

    def only(self, wanted: Bools) -> _Lines:
        """The lines chosen by a mask (L,), without their ids."""
        rows = np.flatnonzero(wanted).tolist()
        return _Lines([self.line[row] for row in rows], [], [self.numbers[row] for row in rows])


def read_g2o(path: Path) -> GraphFile:
    """The pose graph of a g2o file.

    Ids may come in any order, with gaps, up to 2^63 - 1 (GTSAM's symbols are such). Edges between consecutive ids are
    odometry, the first of several; all others are loop closures. Where ids are thinned out, so that fewer than half
    of the neighbours have consecutive ids, neighbours in order of ids count as consecutive; where edges join fewer than
    half of those, as in graphs of views, none is odometry. Edges from a pose to itself are left out, with a warning.
    Poses that only edges name are placed along the edges, odometry first. Information is that of the rotation vector,
    as GTSAM reads it.

    Raises GraphError with file and line where that is not a graph of poses.
    """
    lines, fixed, left_out = _split(path)
    dimension = 3 if "VERTEX_SE3:QUAT" in lines or "EDGE_SE3:QUAT" in lines else 2
    layout = _LAYOUTS[dimension]
    other = _LAYOUTS[5 - dimension]
    vertices, edges = lines.get(layout.vertex, _Lines()), lines.get(layout.edge, _Lines())
    for name in (other.vertex, other.edge):
        if name in lines:
            raise _at(
                path, lines[name].line[0], f"{name} in a graph that has {layout.edge}; it must be one or the other"
            )
    if not edges.line:
        toro = {"EDGE2", "EDGE3"} & set(left_out)
        raise GraphError(
            f"{path} has no EDGE_SE2 or EDGE_SE3:QUAT line, so there is no pose graph in it to solve."
            + " It is TORO's: convert it, as GTSAM's load2D and writeG2o do." * bool(toro)
        )

    known, ends = _ids(path, vertices, 1)[:, 0], _ids(path, edges, 2)
    repeated = np.setdiff1d(np.arange(len(known)), np.unique(known, return_index=True)[1])
    if len(repeated):
        again = repeated[0]
        before = vertices.line[int(np.argmax(known == known[again]))]
        raise _at(path, vertices.line[again], f"vertex {known[again]} was already given in line {before}")
    ids = np.unique(np.concatenate([known, ends.ravel()]))
    itself = ends[:, 0] == ends[:, 1]
    warnings = _about_self_edges(edges, ends, itself)
    edges, ends = edges.only(~itself), ends[~itself]
    a, b = (np.searchsorted(ids, ends[:, side]).astype(np.int32) for side in (0, 1))

    places = _numbers(path, vertices, layout.pose)
    values = _numbers(path, edges, layout.pose + len(layout.axes) * (len(layout.axes) + 1) // 2)
    measured = _poses(path, edges, values[:, : layout.pose])
    kind = _kinds(ids, a, b)
    if EdgeKind.ODOMETRY not in kind:
        warnings.append(
            "No odometry: edges join too few poses with consecutive ids. Every edge is judged as a closure."
        )
    poses, given = np.tile(np.eye(4), (len(ids), 1, 1)), np.zeros(len(ids), bool)
    at = np.searchsorted(ids, known)
    poses[at], given[at] = _poses(path, vertices, places), True
    for name, count in left_out.items():
        why = f"write them as {layout.edge} to be judged" if _JOINS_POSES.search(name) else "they are no poses"
        warnings.append(f"{plural(count, 'line')} of {name} left out: {why}.")
    if not given.all():
        if given.any():
            warnings.append(f"{int((~given).sum())} of {len(ids)} poses without a VERTEX line: placed by their edges.")
        _place(poses, given, a, b, measured, kind)
    information = _information(path, edges, values[:, layout.pose :], layout)
    held = 0
    present = set(ids.tolist()) if fixed else set()
    if unknown := [(line, name) for line, name in fixed if name not in present]:
        if not left_out:  # it may be one of these
            raise _at(path, unknown[0][0], f"FIX {unknown[0][1]}, and there is no such vertex")
        warnings.append(f"FIX {unknown[0][1]} is left out: it is no pose.")
        fixed = [(line, name) for line, name in fixed if name in present]
    if fixed:
        held = int(np.searchsorted(ids, fixed[0][1]))
        if len(fixed) > 1:
            warnings.append(f"{len(fixed)} poses are fixed; only the first, {fixed[0][1]}, is held.")
    graph = PoseGraph(poses, a, b, measured, information, kind, dimension)
    return GraphFile(graph, ids, held, warnings)


def _about_self_edges(edges: _Lines, ends: Ints, itself: Bools) -> list[str]:
    """A warning of the edges (L, 2) that join a pose to `itself` (L,), which constrain nothing."""
    if not itself.any():
        return []
    line, name = edges.line[int(np.argmax(itself))], ends[itself][0, 0]
    return [f"{plural(int(itself.sum()), 'edge')} of a pose to itself left out (first: line {line}, vertex {name})."]


def _split(path: Path) -> tuple[dict[str, _Lines], list[tuple[int, int]], Counter[str]]:
    """Lines by kind, the ids that FIX names with their lines, and how many of each other kind there are."""
    lines: dict[str, _Lines] = {}
    fixed: list[tuple[int, int]] = []
    left_out: Counter[str] = Counter()
    ends = {layout.vertex: 1 for layout in _LAYOUTS.values()} | {layout.edge: 2 for layout in _LAYOUTS.values()}
    try:
        if not path.is_file():
            raise GraphError(f"{path} is not a file. Give the path of a .g2o file.{nearest_path(path)}")
        if path.stat().st_size > _MOST_BYTES:
            raise GraphError(
                f"{path} has {path.stat().st_size >> 20} MB; graphs of up to {_MOST_BYTES >> 20} MB are read."
            )
        with path.open(encoding="latin-1") as stream:  # every byte is a character: bad ones fail as what they stand for
            for number, line in enumerate(stream, 1):
                words = line.removeprefix(_BYTE_ORDER_MARK).split(None, 3)
                tag = words[0] if words else "#"
                if tag in ends:
                    named = ends[tag]
                    if len(words) < named + 2:
                        raise _at(path, number, f"{tag} ends too early")
                    found = lines.setdefault(tag, _Lines())
                    found.line.append(number)
                    found.ids.extend(words[1 : 1 + named])
                    found.numbers.append(words[3] if named == 2 else line.split(None, 2)[2])
                elif tag == "FIX":
                    fixed += [(number, _id(path, number, word)) for word in line.partition("#")[0].split()[1:]]
                elif tag[0] != "#":
                    if not _LEFT_OUT.match(tag):
                        raise _at(path, number, f"{tag[:30]!r} is not a g2o element")
                    left_out[tag] += 1
    except OSError as error:
        raise GraphError(f"Cannot read {path}: {error.strerror or error}. Check its permissions.") from None
    return lines, fixed, left_out


def _at(path: Path, line: int, what: str) -> GraphError:
    return GraphError(f"{path}, line {line}: {what}.")


def _id(path: Path, line: int, word: str) -> int:
    if word.isascii() and word.isdigit() and len(word) < 20 and int(word) <= _MOST_ID:
        return int(word)
    raise _at(path, line, f"{word[:30]!r} is no vertex id; ids are whole numbers from 0 to 2^63 - 1")


def _ids(path: Path, lines: _Lines, named: int) -> Ints:
    """(L, named) ids; `named` is how many a line names: 1 of a vertex, 2 of an edge."""
    text = "".join(lines.ids)
    if not text or (text.isascii() and text.isdigit() and max(map(len, lines.ids)) < 19):  # 18 digits fit for sure
        return np.array(list(map(int, lines.ids)), np.int64).reshape(-1, named)
    return np.array(
        [_id(path, lines.line[row // named], word) for row, word in enumerate(lines.ids)], np.int64
    ).reshape(-1, named)


def _numbers(path: Path, lines: _Lines, columns: int) -> Floats:
    """(L, columns) finite numbers."""
    if not lines.line:
        return np.empty((0, columns))
    try:
        result = np.loadtxt(lines.numbers, ndmin=2)
    except ValueError:
        result = np.empty((0, 0))
    if result.shape == (len(lines.line), columns) and np.isfinite(result).all():
        return result
    for line, text in zip(lines.line, lines.numbers, strict=True):  # which one is it?
        words = text.partition("#")[0].split()
        if len(words) != columns:
            raise _at(path, line, f"{len(words)} numbers after the ids instead of {columns}")
        for word in words:
            try:
                finite = np.isfinite(np.loadtxt([word])).all()
            except ValueError:
                finite = False
            if not finite:
                raise _at(path, line, f"{word[:30]!r} is not a finite number")
    raise GraphError(f"{path} cannot be read as numbers.")


def _poses(path: Path, lines: _Lines, numbers: Floats) -> Floats:
    """(L, 4, 4) of x y yaw or x y z qx qy qz qw."""
    planar = numbers.shape[1] == 3
    far = np.flatnonzero((np.abs(numbers[:, : 2 if planar else 3]) > _FURTHEST_M).any(1))
    if len(far):
        value = numbers[far[0], np.argmax(np.abs(numbers[far[0]]))]
        raise _at(path, lines.line[far[0]], f"{value:g} m is further than any place on Earth")
    if planar:
        zero = np.zeros(len(numbers))
        turn = np.stack([zero, zero, numbers[:, 2]], axis=1)
        return se3.pose(se3.so3_exp(turn), np.stack([numbers[:, 0], numbers[:, 1], zero], axis=1))
    length = np.linalg.norm(numbers[:, 3:], axis=1)
    off = np.flatnonzero(np.abs(length - 1) > _QUATERNION_OFF)
    if len(off):
        raise _at(path, lines.line[off[0]], f"the quaternion has length {length[off[0]]:.3g}, not 1")
    return se3.from_vectors(numbers)


def _information(path: Path, lines: _Lines, upper: Floats, layout: _Layout) -> Floats:
    """(L, 6, 6) of the upper triangles, row by row."""
    size = len(layout.axes)
    rows, columns = np.triu_indices(size)
    given = np.zeros((len(upper), size, size))
    given[:, rows, columns] = given[:, columns, rows] = upper
    diagonal = np.diagonal(given, axis1=1, axis2=2)
    bad = np.flatnonzero((diagonal < 0).any(1) | (diagonal <= 0).all(1))
    if len(bad):
        raise _at(path, lines.line[bad[0]], f"diagonal of the information has {diagonal[bad[0]].min():g}, not > 0")
    result = np.zeros((len(upper), 6, 6))
    result[:, np.array(layout.axes)[:, None], layout.axes] = given
    return result


def _kinds(ids: Ints, a: Int32s, b: Int32s) -> list[EdgeKind]:
    """Odometry is the first edge between each two consecutive ids, of a graph that has such a chain: in others a few
    are neighbours by chance, and would be trusted."""
    first, last = np.minimum(a, b), np.maximum(a, b)
    neighbours = last == first + 1
    consecutive = neighbours & (ids[last] - ids[first] == 1)
    if 2 * len(np.unique(first[consecutive])) < len(np.unique(first[neighbours])):
        consecutive = neighbours
    kind = [EdgeKind.LOOP] * len(a)
    met = set()
    for edge in np.flatnonzero(consecutive).tolist():
        if first[edge] not in met:
            met.add(first[edge])
            kind[edge] = EdgeKind.ODOMETRY
    joined = len(np.unique(np.concatenate([a, b])))
    return kind if 2 * len(met) >= joined - 1 else [EdgeKind.LOOP] * len(a)


def _place(poses: Floats, given: np.ndarray, a: Int32s, b: Int32s, a_from_b: Floats, kind: list[EdgeKind]) -> None:
    """Fill in the poses that are not given, along the edges from those that are, odometry before loops.

    Each part of the graph without any given pose starts at the origin, with its first.
    """
    edges_of: list[list[int]] = [[] for _ in poses]
    for edge, (left, right) in enumerate(zip(a.tolist(), b.tolist(), strict=True)):
        edges_of[left].append(edge)
        edges_of[right].append(edge)
    ready: list[tuple[bool, int, int]] = []

    def offer(node: int) -> None:
        for edge in edges_of[node]:
            heapq.heappush(ready, (kind[edge] != EdgeKind.ODOMETRY, edge, node))

    for node in np.flatnonzero(given).tolist():
        offer(node)
    for start in range(len(poses)):
        while ready:
            _, edge, node = heapq.heappop(ready)
            forward = a[edge] == node
            to = int(b[edge] if forward else a[edge])
            if not given[to]:
                poses[to] = poses[node] @ (a_from_b[edge] if forward else se3.inverse(a_from_b[edge]))
                given[to] = True
                offer(to)
        if not given[start]:
            given[start] = True
            offer(start)


def write_g2o(path: Path, graph: PoseGraph, world_from_body: Floats, ids: Ints | None = None, held: int = 0) -> str:
    """Vertices at the poses given (N, 4, 4), the edges, and FIX for row `held`; 17 digits, so nothing is lost. The
    sha256 of the file.

    `ids` (N,) names the poses, their rows where None. The information matrix is that of the rotation vector, as GTSAM
    reads it, not of g2o's half-angle quaternion.
    """
    layout = _LAYOUTS[graph.dimension]
    rows, columns = np.triu_indices(len(layout.axes))
    information = graph.information[:, layout.axes][:, :, layout.axes][:, rows, columns]
    names = np.arange(len(world_from_body)) if ids is None else ids
    digest = hashlib.sha256()
    with replacing(path) as stream:

        def write(line: str) -> None:
            stream.write(line.encode())
            digest.update(line.encode())

        for name, row in zip(names.tolist(), _rows(world_from_body, graph.dimension), strict=True):
            write(f"{layout.vertex} {name} {row}\n")
        edges = zip(
            names[graph.a].tolist(), names[graph.b].tolist(), _rows(graph.a_from_b, graph.dimension),
            information.tolist(), strict=True,
        )  # fmt: skip
        for a, b, row, upper in edges:
            write(f"{layout.edge} {a} {b} {row} {' '.join(map(repr, upper))}\n")
        if len(world_from_body):  # last: GTSAM 4.3 reads no planar edge that comes after another element
            write(f"FIX {names[held]}\n")
    return digest.hexdigest()


def _rows(poses: Floats, dimension: int) -> list[str]:
    if dimension == 2:
        values = np.concatenate([poses[:, :2, 3], np.arctan2(poses[:, 1, 0], poses[:, 0, 0])[:, None]], axis=1)
    else:
        values = se3.vectors(poses)
    return [" ".join(map(repr, row)) for row in values.tolist()]
