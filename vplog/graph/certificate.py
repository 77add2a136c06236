"""Check whether a solution is the global optimum of its edges: the dual certificate of SE-Sync.

Rosen, Carlone, Bandeira, Leonard, IJRR 2019. An edge measures T_b = T_a a_from_b. If its noise is isotropic, kappa in
rotation and tau in translation, the chi-square

    f(X) = sum over edges of kappa |R_b - R_a R_ab|^2 + tau |t_b - t_a - R_a t_ab|^2 = tr(X M X^T)

is quadratic in X = [R_0 t_0 R_1 t_1 ..] (d, (d + 1) n), and only the rotations are constrained. At a stationary X their
multipliers are Lambda_i = sym(R_i^T (X M)_i). If S = M - Lambda has no negative eigenvalue, every other X' has
f(X') = f(X) + tr(X' S X'^T) >= f(X). Pose 0 is held; because S X^T = 0, it suffices to test S without its rows.

The noise of a graph is not isotropic, so the certificate holds for the minimum of f that the solution leads to. The
solution shares it only if least squares leads from that minimum back to the solution's cost; `certify` checks this.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import LinearOperator, SuperLU, eigsh, splu

from vplog.data import Bools, Floats, Ints, PoseGraph, Solution
from vplog.graph.build import informed, parts, subgraph
from vplog.graph.factors import Factors
from vplog.graph.least_squares import descend as least_squares
from vplog.graph.lm import as_solution, half_chi2
from vplog.graph.sparse.symbolic import dissected

MOST_POSES = 30_000
"""Largest number of poses that is certified. A planar city of this size takes 3 s of CPU; graphs in space need more
than ten times the memory."""
GAP = 1e-6
"""Two costs are equal if they differ by at most this share. Also the largest share of the chi-square that other poses
may gain if a solution is certified."""
_ROUNDING = 1e-13
"""Rounding error of an eigenvalue as a share of the largest entry of S, and of a gain in chi-square."""
_STEPS = 60
"""Maximum number of Newton steps; a descent that starts at a solution takes 3 to 12."""
_CONVERGED = 1e-7
"""A descent has converged if a step promises less than this share of the chi-square: a tenth of GAP."""
_SETTLED = 1e-9
"""Tolerance of the least squares that compare the two minima: far below GAP."""
_DAMPING = 1e-10
"""First damping as a share of the diagonal. Long chains have directions of 1e-9 of the diagonal."""
_DAMPING_CHANGE = 100.0
_MOST_DAMPING = 1e6


@dataclass(frozen=True, eq=False)
class Certificate:
    """Result of the check that a solution is the global optimum of its accepted edges."""

    verdict: str
    """`certified`, `refused` or `not_tried`."""
    reason: str
    """Meaning and limits of the verdict in a few sentences."""
    chi2: float | None = None
    """Chi-square of the edges with isotropic noise at the minimum that the solution leads to."""
    smallest_eigenvalue: float | None = None
    """Smallest eigenvalue of the certificate matrix of the rotations with the first pose held, over all parts."""
    gap: float | None = None
    """Upper bound of the share of `chi2` that other poses can gain; 0 if no eigenvalue is negative."""
    moved_m: float | None = None
    """Largest distance in m from the solution to that minimum, with the first poses aligned."""
    lower_chi2: float | None = None
    """Chi-square with the graph's own noise at better poses that were found on the way, if any."""
    better: Floats | None = None
    """(N, 4, 4) the better poses."""

    def record(self) -> dict[str, Any]:
        """Return the certificate for JSON, without poses."""
        noise = "isotropic by edge: kappa = d' / (2 tr cov(rotation)), tau = d / tr cov(translation)"
        return {**asdict(replace(self, better=None)), "noise": noise}


_CAVEAT = "It does not say whether the closures kept are true."


def certify(graph: PoseGraph, weight: Floats, poses: Floats) -> Certificate:
    """Certify poses (N, 4, 4) that solve the edges of positive weight (E,), each connected part by itself."""
    if len(poses) > MOST_POSES:
        return Certificate("not_tried", f"Not certified: {len(poses)} poses are more than the limit of {MOST_POSES}.")
    used = np.flatnonzero(weight > 0)
    part = parts(len(poses), graph.a[used], graph.b[used])
    better, found = np.array(poses), list[_Part]()
    try:
        for number in np.flatnonzero(np.bincount(part) > 1).tolist():
            rows, edges = np.flatnonzero(part == number), used[part[graph.a[used]] == number]
            alone = replace(subgraph(graph, rows, edges), world_from_body=poses[rows])
            found.append(_certify_part(alone, weight[edges]))
            better[rows] = found[-1].poses
    except (RuntimeError, np.linalg.LinAlgError) as error:  # a singular factor, or Lanczos does not converge
        return Certificate("not_tried", f"Not certified: the linear algebra failed ({error}).")
    chi2 = sum(one.chi2 for one in found)
    result = Certificate(
        "certified" if all(one.certified and one.same_cost for one in found) else "refused",
        "",
        chi2,
        min((one.eigenvalue for one in found), default=0.0),
        sum(one.gap for one in found) / max(chi2, np.finfo(float).tiny),
        max((one.moved_m for one in found), default=0.0),
    )
    if any(one.gain > 0 for one in found):
        result = replace(result, lower_chi2=2.0 * half_chi2(graph, weight, better), better=better)
    return replace(result, reason=_sentence(result, all(one.same_cost for one in found)))


def _sentence(found: Certificate, same_cost: bool) -> str:
    if found.verdict == "certified":
        return (
            f"Certified: with the noise of each edge taken as isotropic, no poses have a lower chi-square of the edges "
            f"kept than {found.chi2:.6g}, the minimum that the solution leads to, {found.moved_m:.3g} m away at most. "
            f"{_CAVEAT}"
        )
    if found.lower_chi2 is not None:
        text = (
            f"Not certified: the solution is a local minimum. Other poses have a chi-square of {found.lower_chi2:.6g}"
        )
    elif not same_cost:
        text = (
            f"Not certified: the minimum of the isotropic chi-square, {found.moved_m:.3g} m away, leads to poses that "
            "are worse than the solution, so it says nothing about the solution"
        )
    elif found.gap == 0.0:  # no eigenvalue refuses it
        text = (
            "Not certified: the descent from the solution to a minimum of the isotropic chi-square did not converge, "
            f"{found.moved_m:.3g} m away. Solve again from the poses written"
        )
    else:
        text = (
            f"Not certified: the smallest eigenvalue of the certificate is {found.smallest_eigenvalue:.3g}, so other "
            f"poses may have a chi-square that is up to {found.gap:.2%} lower"
        )
    return f"{text}. {_CAVEAT}"


def solve_certified(graph: PoseGraph, solution: Solution) -> tuple[Solution, Certificate]:
    """Certify a solution. If the check finds better poses on its way, return these and their certificate instead."""
    found = certify(graph, solution.weight, solution.world_from_body)
    if found.better is None:
        return solution, found
    fit = least_squares(Factors.of(graph), solution.weight, found.better, _STEPS, _SETTLED)
    reason = (
        f"{solution.reason} That was a local minimum with a half chi-square of {solution.error_after:.6g}. From a "
        "better start, least squares"
    )
    other = replace(as_solution(graph, solution.weight, fit, reason), error_before=solution.error_before)
    return other, certify(graph, other.weight, other.world_from_body)


@dataclass(frozen=True, eq=False)
class _Part:
    """Certificate of one connected component."""

    certified: bool
    """Whether the minimum of the isotropic chi-square is its global optimum."""
    same_cost: bool
    """Whether least squares leads from that minimum to the cost of the solution."""
    gain: float
    """By how much half the chi-square falls at the better poses; 0 if there are none."""
    chi2: float
    eigenvalue: float
    gap: float
    """Upper bound of what other poses can gain, in chi-square."""
    moved_m: float
    poses: Floats
    """(n, 4, 4) the solution, or the better poses."""


def _certify_part(graph: PoseGraph, weight: Floats) -> _Part:
    """Certify the poses of a connected graph; all weights (E,) are positive."""
    problem, d, n = Problem.of(graph, weight), graph.dimension, len(graph.world_from_body)
    start = _as_point(graph.world_from_body, d)
    point, chi2 = descend(problem, start)
    moved_m = float(np.linalg.norm((point - start)[:, :, d], axis=1).max())
    value, tolerance = least_eigenvalue(problem, point)
    minimum = np.array(graph.world_from_body)
    minimum[:, :d, :d], minimum[:, :d, 3] = point[:, :, :d], point[:, :, d]
    factors = Factors.of(graph)
    settled, other = (
        least_squares(factors, weight, poses, _STEPS, _SETTLED).world_from_body
        for poses in (graph.world_from_body, minimum)
    )
    cost, other_cost = (half_chi2(graph, weight, poses) for poses in (settled, other))
    same_cost = abs(cost - other_cost) <= GAP * max(cost, 1.0)
    gain = 0.0 if same_cost else max(cost - other_cost, 0.0)
    return _Part(
        certified=value >= -tolerance and is_stationary(problem, point),
        same_cost=same_cost,
        gain=gain,
        chi2=chi2,
        eigenvalue=value,
        gap=_suboptimality(n, d, value),
        moved_m=moved_m,
        poses=other if gain else graph.world_from_body,
    )


def _as_point(poses: Floats, d: int) -> Floats:
    """Return poses (n, 4, 4) as a point of the problem: [R t] (n, d, d + 1)."""
    return poses[:, :d][:, :, [*range(d), 3]]


def _suboptimality(n: int, d: int, eigenvalue: float) -> float:
    """Return the upper bound of the gain of other poses if S without pose 0 has this smallest eigenvalue.

    Two orthonormal frames differ by |R - R'|^2 <= 4 d.
    """
    return 4.0 * d * n * max(0.0, -eigenvalue)


@dataclass(frozen=True, eq=False)
class Problem:
    """f(X) = tr(X M X^T) of one connected part."""

    d: int
    """2 or 3."""
    D: sparse.csr_array
    """((d + 1) edges, (d + 1) n): X D^T are the residuals; M = D^T D."""
    M: sparse.csr_array
    order: Ints
    """(n - 1,) poses 1.., less 1, in elimination order by nested dissection: for 10,000 poses this takes a twentieth of
    the time of SuperLU's minimum degree order."""

    @classmethod
    def of(cls, graph: PoseGraph, weight: Floats) -> Problem:
        """Build the problem of a connected graph; all weights (E,) are positive."""
        d, n, count = graph.dimension, len(graph.world_from_body), len(graph.a)
        kappa, tau = (weight * precision for precision in precisions(graph))
        root = np.sqrt(np.column_stack([*[kappa] * d, tau]))[:, :, None]
        axes = [*range(d), 3]
        b_from_a = np.swapaxes(graph.a_from_b[:, axes][:, :, axes], 1, 2)
        blocks = np.stack([-root * b_from_a, root * np.eye(d + 1)], axis=1).reshape(-1, d + 1, d + 1)
        ends = np.stack([graph.a, graph.b], axis=1).ravel()
        shape = (count * (d + 1), n * (d + 1))
        D = sparse.bsr_array((blocks, ends, np.arange(0, 2 * count + 1, 2)), shape=shape).tocsr()
        order = np.argsort(dissected(n, graph.a.astype(np.int64), graph.b.astype(np.int64)))
        return cls(d, D, (D.T @ D).tocsr(), order[order > 0] - 1)

    def cost(self, point: Floats) -> float:
        """Return the chi-square of a point (n, d, d + 1)."""
        return float(np.square(self.D @ self.columns(point)).sum())

    def columns(self, point: Floats) -> Floats:
        """Return X^T ((d + 1) n, d) of a point (n, d, d + 1)."""
        return np.swapaxes(point, 1, 2).reshape(-1, self.d)

    def certificate_matrix(self, point: Floats) -> sparse.csr_array:
        """Return S = M - Lambda at a point (n, d, d + 1)."""
        n = len(point)
        by_X = (self.D.T @ (self.D @ self.columns(point))).reshape(n, self.d + 1, self.d)
        multiplier = np.zeros((n, self.d + 1, self.d + 1))
        multiplier[:, : self.d, : self.d] = by_X[:, : self.d] @ point[:, :, : self.d]
        return self.M - _diagonal((multiplier + np.swapaxes(multiplier, 1, 2)) / 2.0)


def precisions(graph: PoseGraph) -> tuple[Floats, Floats]:
    """Return kappa and tau (E,) of the isotropic noise with the same trace of covariance.

    tau = d / tr cov(t) and kappa = d' / (2 tr cov(r)) with d' = 1 or 3 angles, because |exp(r) - I|^2 is 2 |r|^2 to
    first order. SE-Sync's g2o reader uses the same values in space and twice this kappa in the plane. Covariances are
    the inverses of the rotation block and of the translation block of the information.
    """
    information, d = informed(graph), graph.dimension
    turns = 1 if d == 2 else 3
    rotation, translation = (
        1.0 / (1.0 / np.maximum(np.linalg.eigvalsh(part), np.finfo(float).tiny)).mean(1)
        for part in (information[:, :turns, :turns], information[:, turns:, turns:])
    )
    return rotation / 2.0, translation


# --- descent --------------------------------------------------------------------------------------------------------


def descend(problem: Problem, start: Floats) -> tuple[Floats, float]:
    """Return the local minimum that a point (n, d, d + 1) leads to with pose 0 held, and its chi-square.

    Newton's method on the manifold. Gauss-Newton replaces the Hessian if it is not positive definite. A step that does
    not reduce the cost is damped.
    """
    point, cost, damping = start, problem.cost(start), 0.0
    for _ in range(_STEPS):
        gradient, hessian, gauss_newton = _derivatives(problem, point)
        while damping <= _MOST_DAMPING:
            damped = sparse.csr_array(hessian + sparse.diags_array(damping * hessian.diagonal()))
            step, promised = _step(damped, gradient, problem.order)
            if promised <= 0 and hessian is not gauss_newton:
                hessian = gauss_newton
                continue
            moved = _moved(point, step.reshape(len(point) - 1, -1))
            gain = cost - problem.cost(moved)
            if promised > 0 and (gain >= 0 or promised <= max(_CONVERGED * cost, _ROUNDING)):
                break
            damping = max(_DAMPING, damping * _DAMPING_CHANGE)
        else:
            break
        if gain >= 0:
            point, cost = moved, cost - gain
        if promised <= max(_CONVERGED * cost, _ROUNDING):
            break
        damping = damping / _DAMPING_CHANGE if damping > _DAMPING else 0.0
    return point, cost


def is_stationary(problem: Problem, point: Floats) -> bool:
    """Return whether Gauss-Newton promises to gain less than GAP of the chi-square at this point."""
    gradient, _, gauss_newton = _derivatives(problem, point)
    return _step(gauss_newton, gradient, problem.order)[1] <= max(GAP * problem.cost(point), _ROUNDING)


def _derivatives(problem: Problem, point: Floats) -> tuple[Floats, sparse.csr_array, sparse.csr_array]:
    """Return half the gradient for small motions of all poses but the first, and half the Hessian by Newton and by
    Gauss-Newton.

    Each row of X moves by its own Jacobian J_c: sum over c of J_c^T M X_c, J_c^T S J_c and J_c^T M J_c.
    """
    jacobian = _jacobian(point)
    held = len(_generators(problem.d)) + problem.d
    stacked = sparse.vstack([J[:, held:] for J in jacobian]).tocsr()
    by_X = problem.D.T @ (problem.D @ problem.columns(point))
    newton, gauss_newton = (
        stacked.T @ sparse.block_diag([A] * problem.d, format="csr") @ stacked
        for A in (problem.certificate_matrix(point), problem.M)
    )
    return stacked.T @ by_X.T.ravel(), newton, gauss_newton


def _step(hessian: sparse.csr_array, gradient: Floats, order: Ints) -> tuple[Floats, float]:
    """Return the step of a Hessian and the gain it promises; both are 0 if the Hessian is not positive definite."""
    factor = _Factor.of(hessian, order)
    if not factor.definite:
        return np.zeros_like(gradient), 0.0
    step = -factor.solve(gradient)
    return step, -float(gradient @ step)


def _generators(d: int) -> Floats:
    """Return the generators (K, d, d) of rotations in d dimensions."""
    pairs = list(combinations(range(d), 2))
    result = np.zeros((len(pairs), d, d))
    for k, (i, j) in enumerate(pairs):
        result[k, i, j], result[k, j, i] = -1.0, 1.0
    return result


def _jacobian(point: Floats) -> list[sparse.csr_array]:
    """Return the Jacobian of each row of X, ((d + 1) n, k n), by the rotations and translations of each pose."""
    d = point.shape[1]
    generators = _generators(d)
    turned = np.einsum("nij,kjl->nilk", point[:, :, :d], generators)
    result = []
    for row in range(d):
        block = np.zeros((len(point), d + 1, len(generators) + d))
        block[:, :d, : len(generators)] = turned[:, row]
        block[:, d, len(generators) + row] = 1.0
        result.append(_diagonal(block))
    return result


def _moved(point: Floats, step: Floats) -> Floats:
    """Return the point after a step (n - 1, k) of rotations and translations; pose 0 is held. A rotation is the one
    nearest to I plus the step."""
    d, step = point.shape[1], np.concatenate([np.zeros((1, step.shape[1])), step])
    generators = _generators(d)
    turn = np.eye(d) + np.einsum("nk,kij->nij", step[:, : len(generators)], generators)
    left, _, right = np.linalg.svd(turn)
    return np.concatenate([point[:, :, :d] @ left @ right, point[:, :, d:] + step[:, len(generators) :, None]], axis=2)


def _diagonal(blocks: Floats) -> sparse.csr_array:
    """Return the matrix with these blocks (n, k, l) along its diagonal."""
    n, k, columns = blocks.shape
    return sparse.bsr_array((blocks, np.arange(n), np.arange(n + 1)), shape=(n * k, n * columns)).tocsr()


@dataclass(frozen=True, eq=False)
class _Factor:
    """L U factors of a symmetric matrix without pivoting; the signs of U's diagonal are those of its eigenvalues."""

    lu: SuperLU
    order: Ints
    """Elimination order of its rows."""

    @classmethod
    def of(cls, matrix: sparse.csr_array, poses: Ints) -> _Factor:
        """Factorise a matrix with equally many rows for each pose but the held one; `poses` in elimination order."""
        size = (len(matrix.indptr) - 1) // len(poses)
        order = (poses[:, None] * size + np.arange(size)).ravel()
        rows: Any = matrix[order]
        permuted = rows[:, order].tocsc()
        lu = splu(permuted, permc_spec="NATURAL", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
        return cls(lu, order)

    @property
    def definite(self) -> bool:
        """Return whether all eigenvalues are positive (Sylvester's law of inertia)."""
        return bool((self.lu.U.diagonal() > 0).all())

    def solve(self, right: Floats) -> Floats:
        result = np.empty_like(right)
        result[self.order] = self.lu.solve(right[self.order])
        return result


# --- certificate ----------------------------------------------------------------------------------------------------


def least_eigenvalue(problem: Problem, point: Floats) -> tuple[float, float]:
    """Return the smallest eigenvalue of S over the rotations with pose 0 held, and its tolerance.

    Positions follow the rotations (Schur complement), so [S + shift I on rotations]^-1 restricted to the rotations is
    (S_R + shift I)^-1. The shift grows from the tolerance until that matrix is positive definite, and Lanczos finds its
    largest eigenvalue. The tolerance lets other poses gain GAP of the chi-square, or rounding if that is more.
    """
    d, n = problem.d, len(point)
    S: Any = problem.certificate_matrix(point)[d + 1 :, d + 1 :]
    rotation = np.tile(np.arange(d + 1) < d, n - 1)
    rounding = _ROUNDING * float(S.diagonal().max())
    tolerance = max(GAP * problem.cost(point) / _suboptimality(n, d, -1.0), rounding)
    shift = tolerance
    while not (factor := _Factor.of(S + sparse.diags_array(shift * rotation), problem.order)).definite:
        shift *= 10.0
    inverse = _Inverse(factor, rotation)
    start = np.random.default_rng(0).normal(size=inverse.shape[0])
    [value] = eigsh(inverse, k=1, which="LA", v0=start, return_eigenvectors=False)
    return float(1.0 / value - shift), tolerance


class _Inverse(LinearOperator):
    """Inverse of a factorised matrix, restricted to some of its rows."""

    def __init__(self, factor: _Factor, rows: Bools) -> None:
        self.factor, self.rows = factor, rows
        super().__init__(np.dtype(np.float64), (int(rows.sum()),) * 2)

    def _matvec(self, x: Floats) -> Floats:
        whole = np.zeros(len(self.rows))
        whole[self.rows] = x.ravel()
        return self.factor.solve(whole)[self.rows]
