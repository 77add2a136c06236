"""Keyframes, odometry noise and verified closures become a pose graph; graphs from anywhere are checked."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vplog.data import Bools, Closures, EdgeKind, Floats, Int32s, Ints, Keyframes, PoseGraph, Verdict
from vplog.errors import GraphError, plural
from vplog.geometry import se3

AXES = {2: [2, 3, 4], 3: [0, 1, 2, 3, 4, 5]}
"""Rows and columns of (6, 6) matrices that a graph of this dimension uses."""
_FURTHEST_M = 1e8
"""m; frames of drives (UTM, ECEF) stay below 1e7, and from 1e8 on the last bit of a double is coarser than 10 nm."""
_MOST_INFORMATION = 1e30
"""Most information, of m or rad: a millionth of a nanometre. Beyond it, squares and determinants overflow a double."""
_LEAST_INFORMATION = 1e-30
"""Least of an axis that is known of: less, and the squares of the covariance overflow."""
_LEAST_SHARE = 1e-10
"""Least eigenvalue of an information matrix as a share of its largest: GTSAM factorises them, so none may be zero."""
_CLEARLY = 0.01
"""Least eigenvalue of a unit diagonal, as a simple bound tells it, that leaves nothing to look at."""
_NOISE = 1e-9
"""Negative eigenvalues up to this share of the largest are rounding of whoever wrote the matrix."""


def build_graph(
    keyframes: Keyframes, edge_covariances: Floats, closures: Closures | None
) -> tuple[PoseGraph, Ints, list[str]]:
    """The graph, the ledger row (L,) of each of its loop edges in order, and warnings.

    Odometry edges join consecutive keyframes, with the inverses of `edge_covariances` (N-1, 6, 6, in the later
    body's frame). One loop edge per accepted ledger row follows, a known one where it is by decision: a the match,
    b the query. Raises GraphError where a pose or a matrix is not one.
    """
    poses, n = keyframes.odom_from_body, len(keyframes.stamp_ns)
    if n < 2:
        raise GraphError(
            f"{keyframes.drive or 'The drive'} has {n} keyframes; a graph needs 2. Lower --set keyframes.distance_m."
        )
    if edge_covariances.shape != (n - 1, 6, 6):
        raise GraphError(f"{n} keyframes need ({n - 1}, 6, 6) edge covariances, not {edge_covariances.shape}.")
    _check_matrices(edge_covariances, "covariance", np.arange(n - 1), np.arange(1, n))

    rows = np.flatnonzero(closures.accepted if closures is not None else [])
    a, b = np.arange(n - 1), np.arange(1, n)
    a_from_b = se3.between(poses[:-1], poses[1:])
    information = np.linalg.inv(edge_covariances)
    if closures is not None and len(rows):
        match, query = closures.match[rows], closures.query[rows]
        wrong = np.flatnonzero((match < 0) | (match >= query) | (query >= n))
        if len(wrong):
            row = wrong[0]
            raise GraphError(
                f"Closure {rows[row]} joins keyframes {match[row]} and {query[row]}; "
                f"the match must come before the query, both within 0..{n - 1}."
            )
        a, b = np.concatenate([a, match]), np.concatenate([b, query])
        a_from_b = np.concatenate([a_from_b, closures.match_from_query[rows]])
        information = np.concatenate([information, closures.information[rows] / busier(match, query)[:, None, None]])
    by_decision = [closures.verdict[row] is Verdict.ACCEPTED_BY_DECISION for row in rows.tolist()] if closures else []
    graph = PoseGraph(
        world_from_body=np.array(poses, np.float64),
        a=a.astype(np.int32),
        b=b.astype(np.int32),
        a_from_b=a_from_b,
        information=(information + np.swapaxes(information, 1, 2)) / 2,
        kind=[EdgeKind.ODOMETRY] * (n - 1) + [EdgeKind.KNOWN_LOOP if one else EdgeKind.LOOP for one in by_decision],
    )
    graph, warnings = checked(graph)
    return graph, rows.astype(np.int64), warnings


def busier(match: Int32s | Ints, query: Int32s | Ints) -> Floats:
    """(L,) how many closures the busier end of each has: they share its errors, so each tells that much less."""
    at_match, at_query = np.bincount(match), np.bincount(query)
    return np.maximum(at_match[match], at_query[query]).astype(np.float64)


def checked(graph: PoseGraph) -> tuple[PoseGraph, list[str]]:
    """The graph with positive definite information, and warnings of what was repaired.

    For graphs from anywhere, files included. Raises GraphError with the edge and the value where indices are out of
    range, a number is not finite, a rotation is none, an information matrix is negative, or parts are not connected.
    """
    n, edges = len(graph.world_from_body), len(graph.a)
    shapes = (len(graph.b), len(graph.kind), *graph.a_from_b.shape, *graph.information.shape)
    if shapes != (edges, edges, edges, 4, 4, edges, 6, 6) or graph.world_from_body.shape != (n, 4, 4) or n == 0:
        raise GraphError(f"The graph's arrays do not fit each other: {n} poses, {edges} edges, shapes {shapes}.")
    if graph.dimension not in AXES:
        raise GraphError(f"The graph has dimension {graph.dimension}; it must be 2 or 3.")
    wrong = np.flatnonzero((graph.a < 0) | (graph.b < 0) | (graph.a >= n) | (graph.b >= n) | (graph.a == graph.b))
    if len(wrong):
        edge = wrong[0]
        raise GraphError(f"Edge {edge} joins {graph.a[edge]} and {graph.b[edge]}; the graph has poses 0..{n - 1}.")
    _check_poses(graph.world_from_body, "Pose {row}", graph.dimension)
    _check_poses(graph.a_from_b, "Edge {row}", graph.dimension)
    information = informed(graph)
    _check_matrices(information, "information", graph.a, graph.b)
    lost = np.flatnonzero(parts(n, graph.a, graph.b))
    if len(lost):
        raise GraphError(
            f"Edges do not join pose 0 and pose {lost[0]} ({len(lost)} of {n} are cut off). Solve each part by itself."
        )

    # scaled to a unit diagonal first, so that radians and metres are compared as likes
    diagonal = np.diagonal(information, axis1=1, axis2=2)
    scale = np.sqrt(np.where(diagonal > 0, diagonal, diagonal.max(1, keepdims=True)))
    scale = scale[:, :, None] * scale[:, None, :]
    likes = (information + np.swapaxes(information, 1, 2)) / 2 / scale
    # a row's diagonal entry that outweighs its others bounds the eigenvalues from below (Gershgorin 1931)
    lead = (2.0 * np.diagonal(likes, axis1=1, axis2=2) - np.abs(likes).sum(2)).min(1)
    unsure = np.flatnonzero(lead < _CLEARLY)
    values, vectors = np.linalg.eigh(likes[unsure])
    poor = values[:, 0] < _LEAST_SHARE * values[:, -1]
    if not poor.any():
        return graph, []
    negative, rows = np.flatnonzero(values[:, 0] < -_NOISE * values[:, -1]), unsure[poor]
    values, vectors = np.linalg.eigh(_without_impossible_correlations(likes[rows]))
    open_ = values[:, 0] < _LEAST_SHARE * values[:, -1]
    values = np.maximum(values, 2.0 * _LEAST_SHARE * values[:, -1:])
    mended = (vectors * values[:, None, :]) @ np.swapaxes(vectors, 1, 2) * scale[rows]
    mended[open_] += weakest_information(graph)
    axes = np.array(AXES[graph.dimension])
    repaired = graph.information.copy()
    repaired[rows[:, None, None], axes[:, None], axes] = mended
    warnings = []
    if len(negative):
        edge = unsure[negative[0]]
        warnings.append(
            f"The information of {plural(len(negative), 'edge')} is not positive definite (first: edge {edge}, "
            f"{graph.a[edge]} to {graph.b[edge]}): entries off the diagonal that are too large for its diagonal are "
            "taken as 0, and negative eigenvalues too."
        )
    return replace(graph, information=repaired), warnings


def weakest_information(graph: PoseGraph) -> Floats:
    """(d, d) information of what is known of any edge: it turns by no half circle, and is no longer than all together.

    Else axes of which an edge says nothing would be as uncertain as no false closure is.
    """
    length_m = max(float(np.linalg.norm(graph.a_from_b[:, :3, 3], axis=1).sum()), 1.0)
    sigma = np.repeat([np.pi, length_m], 3)[AXES[graph.dimension]]
    return np.diag(sigma**-2.0)


def _without_impossible_correlations(likes: Floats) -> Floats:
    """The matrices (K, d, d) without entries beyond the geometric mean of their diagonal's: correlations beyond 1."""
    diagonal = np.diagonal(likes, axis1=1, axis2=2)
    most = np.sqrt(diagonal[:, :, None] * diagonal[:, None, :]) * (1.0 + _NOISE)
    return np.where(np.abs(likes) > most, 0.0, likes)


def informed(graph: PoseGraph, edges: Ints | Bools | slice = slice(None)) -> Floats:
    """The information of the axes that the graph uses: (E, 6, 6), or (E, 3, 3) of yaw, x, y for a planar one."""
    information = graph.information[edges]
    if graph.dimension == 3:
        return information
    axes = AXES[graph.dimension]
    return information[:, axes][:, :, axes]


def _check_poses(poses: Floats, name: str, dimension: int) -> None:
    bad = np.flatnonzero(~np.isfinite(poses).all((1, 2)))
    if len(bad):
        where = name.format(row=bad[0])
        value = poses[bad[0]][~np.isfinite(poses[bad[0]])][0]
        raise GraphError(f"{where} holds {value}, so it is no pose ({len(bad)} of {len(poses)} are not).")
    rotation = poses[:, :3, :3]
    # 1e-5: single precision passes, a scaled, sheared or mirrored matrix does not
    off = np.abs(rotation @ np.swapaxes(rotation, 1, 2) - np.eye(3)).max((1, 2))
    bad = np.flatnonzero((off > 1e-5) | (np.linalg.det(rotation) < 0) | (poses[:, 3] != [0, 0, 0, 1]).any(1))
    if len(bad):
        where = name.format(row=bad[0])
        raise GraphError(f"{where} is not a rigid pose: R R^T is off the identity by {off[bad[0]]:.3g}.")
    far = np.flatnonzero((np.abs(poses[:, :3, 3]) > _FURTHEST_M).any(1))
    if len(far):
        where = name.format(row=far[0])
        raise GraphError(f"{where} is {np.abs(poses[far[0], :3, 3]).max():.3g} m out; check its unit, metres.")
    if dimension == 2:
        tilted = np.flatnonzero((np.abs(rotation[:, 2, 2] - 1) > 1e-5) | (poses[:, 2, 3] != 0))
        if len(tilted):
            raise GraphError(f"{name.format(row=tilted[0])} leaves the plane, and the graph is planar.")


def _check_matrices(matrices: Floats, name: str, a: Int32s | Ints, b: Int32s | Ints) -> None:
    finite: Bools = np.asarray(np.isfinite(matrices).all((1, 2)))
    diagonal = np.diagonal(np.where(finite[:, None, None], matrices, 0.0), axis1=1, axis2=2)
    least: Bools = np.asarray(((diagonal < _LEAST_INFORMATION) & (diagonal != 0)).any(1) | (diagonal == 0).all(1))
    most: Bools = np.asarray((diagonal > _MOST_INFORMATION).any(1))
    bad = np.flatnonzero(~finite | least | most)
    if len(bad):
        edge = bad[0]
        entries = np.diagonal(matrices[edge])
        value = entries.min() if least[edge] else entries.max()
        value = value if finite[edge] else matrices[edge][~np.isfinite(matrices[edge])][0]
        raise GraphError(
            f"The {name} of edge {edge} ({a[edge]} to {b[edge]}) holds {value:.6g}; "
            f"it must be finite with a positive diagonal of {_LEAST_INFORMATION:g} to {_MOST_INFORMATION:g}."
        )


def subgraph(graph: PoseGraph, rows: Ints, edges: Ints) -> PoseGraph:
    """Some poses, in order, and some of the edges between them."""
    return replace(
        graph,
        world_from_body=graph.world_from_body[rows],
        a=np.searchsorted(rows, graph.a[edges]).astype(np.int32),
        b=np.searchsorted(rows, graph.b[edges]).astype(np.int32),
        a_from_b=graph.a_from_b[edges],
        information=graph.information[edges],
        kind=[graph.kind[edge] for edge in edges.tolist()],
    )


def parts(n: int, a: Int32s | Ints, b: Int32s | Ints) -> Ints:
    """Number (N,) of the connected part that each of n poses belongs to by the edges a, b, in order of first poses."""
    from scipy import sparse  # a tenth of a second that what needs no graph need not wait

    joined = sparse.coo_array((np.ones(len(a), bool), (a, b)), shape=(n, n))
    return sparse.csgraph.connected_components(joined, directed=False)[1].astype(np.int64)
