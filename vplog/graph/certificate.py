"""Whether a solution is the global optimum of its edges: the dual certificate of SE-Sync, and the way on where not.

Rosen, Carlone, Bandeira, Leonard, IJRR 2019. An edge says T_b = T_a a_from_b. With its noise taken as isotropic, kappa
in rotation and tau in translation, the chi-square

    f(X) = sum over edges of kappa |R_b - R_a R_ab|^2 + tau |t_b - t_a - R_a t_ab|^2 = tr(X M X^T)

is quadratic in X = [R_0 t_0 R_1 t_1 ..] (d, (d + 1) n), and the rotations alone are constrained. At a stationary X
their multipliers are Lambda_i = sym(R_i^T (X M)_i), and where S = M - Lambda has no negative eigenvalue, every other X'
has f(X') = f(X) + tr(X' S X'^T) >= f(X). As S X^T = 0 it suffices to look at S with pose 0 held: without its rows.

X may have p > d rows: rotations are then the first d columns of (p, p) ones, and a point (n, p, p + 1) is these and the
positions. A negative eigenvalue shows the way down there (theorem 8), and what is found is rounded to d rows again.
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
from vplog.graph.consistency import odometry_chain
from vplog.graph.factors import Factors
from vplog.graph.initialise import relaxed
from vplog.graph.lm import LmSettings, solve_weighted
from vplog.graph.sparse.symbolic import dissected

MOST_POSES = 30_000
"""Poses up to which a certificate is tried: on a planar city 3 s of CPU, and 12 s at 100 000, but graphs in space fill
more than ten times the memory."""
GAP = 1e-6
"""Share of the chi-square that another solution may gain at most for this one to be called the optimum."""
_ROUNDING = 1e-13
"""Eigenvalues up to this share of the largest entry of S, and gains in chi-square up to this, are rounding."""
_STEPS = 60
"""Newton steps after which a descent ends; from a solution it takes 3-12."""
_CONVERGED = 1e-7
"""A descent has converged when a step promises less than this share of the chi-square, a tenth of GAP; after a Newton
step as short, rounding is what is left."""
_DAMPING = 1e-10
"""First damping, as a share of the diagonal, what it is changed by, and the largest, where no step helps. Long chains
have directions of a billionth of the diagonal."""
_DAMPING_CHANGE = 100.0
_MOST_DAMPING = 1e6
_ROUNDS = 4
"""Other starts that are tried."""
_MOST_LIFTED = 2_000
"""Poses up to which the staircase is climbed: a step takes tens of seconds at 5000."""
_LOOSE = 1e-5
"""`_CONVERGED` of descents on the way from one local minimum to another."""
_ROWS_MORE = 3
"""Rows beyond d that a way down is looked for in. With two, every closed path of frames can be drawn together, so that
none is caught in turns too many; SE-Sync has needed no more on the public graphs."""


@dataclass(frozen=True, eq=False)
class Certificate:
    """Certificate of a solution as the global optimum of its inlier edges."""

    verdict: str
    """`certified`, `refused` or `not_tried`."""
    reason: str
    """Meaning and limits of the verdict, in a few sentences."""
    chi2: float | None = None
    """Chi-square of the edges with isotropic noise, at the optimum that the solution leads to."""
    smallest_eigenvalue: float | None = None
    """Least eigenvalue of the certificate matrix of rotations with the first pose held, over all parts."""
    gap: float | None = None
    """Share of chi2 by which other poses can be better at most; 0 where no eigenvalue is negative."""
    moved_m: float | None = None
    """Largest distance in m from the solution to that optimum, both laid on the first pose."""
    lower_chi2: float | None = None
    """Chi-square of the better poses that were found where it is refused."""
    better: Floats | None = None
    """(N, 4, 4) the better poses."""

    def record(self) -> dict[str, Any]:
        """The certificate as JSON has it, without poses."""
        noise = "isotropic by edge: kappa = d' / (2 tr cov(rotation)), tau = d / tr cov(translation)"
        return {**asdict(replace(self, better=None)), "noise": noise}


_CAVEAT = "It does not say whether the closures kept are true."


def certify(graph: PoseGraph, weight: Floats, poses: Floats, search: bool = False) -> Certificate:
    """The certificate of poses (N, 4, 4) that solve the edges of positive weight (E,), each connected part by itself.

    The poses go to the stationary point of the isotropic chi-square that they lead to first. With `search`, better
    poses are looked for where that is not the optimum.
    """
    if len(poses) > MOST_POSES:
        return Certificate(
            "not_tried", f"Not certified: {len(poses)} poses are more than {MOST_POSES}, the most tried."
        )
    on = np.flatnonzero(weight > 0)
    part = parts(len(poses), graph.a[on], graph.b[on])
    better, found = np.array(poses), list[_Part]()
    try:
        for number in np.flatnonzero(np.bincount(part) > 1).tolist():
            rows, edges = np.flatnonzero(part == number), on[part[graph.a[on]] == number]
            own = replace(subgraph(graph, rows, edges), world_from_body=poses[rows])
            found.append(_certify_part(own, weight[edges], search))
            better[rows] = found[-1].poses
    except (RuntimeError, np.linalg.LinAlgError) as error:  # a singular factor, no convergence of Lanczos
        return Certificate("not_tried", f"Not certified: the linear algebra failed ({error}).")
    chi2, lower = sum(one.chi2 for one in found), sum(one.lower_chi2 for one in found)
    result = Certificate(
        "certified" if all(one.certified for one in found) else "refused",
        "",
        chi2,
        min((one.eigenvalue for one in found), default=0.0),
        sum(one.gap for one in found) / max(chi2, np.finfo(float).tiny),
        max((one.moved_m for one in found), default=0.0),
    )
    if result.verdict == "refused" and lower < chi2 * (1 - GAP):
        result = replace(result, lower_chi2=lower, better=better)
    return replace(result, reason=_sentence(result, search))


def _sentence(found: Certificate, search: bool) -> str:
    if found.verdict == "certified":
        return (
            f"Certified: with the noise of each edge taken as isotropic, no poses have a lower chi-square of the edges "
            f"kept than {found.chi2:.6g}, the minimum that the solution leads to, {found.moved_m:.3g} m away at most. "
            f"{_CAVEAT}"
        )
    if found.gap == 0.0:  # no eigenvalue refuses it
        return (
            "Not certified as the optimum: the descent from the solution to a minimum of the isotropic chi-square did "
            f"not settle, {found.moved_m:.3g} m away. Solve again from the poses written. {_CAVEAT}"
        )
    text = f"Not certified as the optimum: the certificate's least eigenvalue is {found.smallest_eigenvalue:.3g}"
    if found.lower_chi2 is not None:
        text += f", and other poses have a chi-square of {found.lower_chi2:.6g} in place of {found.chi2:.6g}"
    else:
        text += f", so others may be up to {found.gap:.2%} better in chi-square"
        text += "; none were found" if search else "; look for them with vplog optimize --certify"
    return f"{text}. {_CAVEAT}"


def solve_certified(graph: PoseGraph, solution: Solution) -> tuple[Solution, Certificate]:
    """The solution with its certificate; where that is refused and better poses are found, the solution from there."""
    found = certify(graph, solution.weight, solution.world_from_body, search=True)
    if found.better is None:
        return solution, found
    settings = LmSettings()
    other = solve_weighted(
        Factors.of(graph), solution.weight, found.better, settings.max_iterations, settings.tolerance,
        f"{solution.reason} That was no optimum of the edges kept: from a better start the half chi-square is not "
        f"{solution.error_after:.6g}. ",
    )  # fmt: skip
    if other.error_after >= solution.error_after * (1 - GAP):
        return solution, found
    return replace(other, error_before=solution.error_before), certify(graph, other.weight, other.world_from_body)


@dataclass(frozen=True, eq=False)
class _Part:
    """Certificate of one connected component."""

    certified: bool
    chi2: float
    eigenvalue: float
    gap: float
    """Bound of what other poses can gain, in chi-square."""
    moved_m: float
    lower_chi2: float
    poses: Floats
    """(n, 4, 4) of the lowest chi-square known."""


def _certify_part(graph: PoseGraph, weight: Floats, search: bool) -> _Part:
    """Certificate of a connected graph at its solution, all edges (E,) being of positive weight."""
    problem, d, n = Problem.of(graph, weight), graph.dimension, len(graph.world_from_body)
    start = _as_point(graph.world_from_body, d)
    point, chi2 = descend(problem, start)
    moved_m = float(np.linalg.norm((point - start)[:, :, d], axis=1).max())
    value, direction, tolerance = least_eigenvalue(problem, point)
    certified = value >= -tolerance and is_stationary(problem, point)
    best, lowest = (point, chi2) if certified or not search else better_point(problem, graph, weight, point, direction)
    poses = np.array(graph.world_from_body)
    poses[:, :d, :d], poses[:, :d, 3] = best[:, :, :d], best[:, :, d]
    return _Part(certified, chi2, value, _suboptimality(n, d, value), moved_m, lowest, poses)


def _as_point(poses: Floats, d: int) -> Floats:
    """(n, d, d + 1) of poses (n, 4, 4)."""
    return poses[:, :d][:, :, [*range(d), 3]]


def _suboptimality(n: int, d: int, eigenvalue: float) -> float:
    """Most that other poses can gain where S, pose 0 held, has this least eigenvalue.

    Laid on pose 0, two orthonormal frames are |R - R'|^2 <= 4 d apart.
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
    """(n - 1,) poses 1.. less 1 in order of elimination, by nested dissection: at 10 000 poses a twentieth of the time
    that SuperLU takes with minimum degree."""

    @classmethod
    def of(cls, graph: PoseGraph, weight: Floats) -> Problem:
        """The problem of a connected graph whose edges (E,) are of positive weight."""
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
        """The chi-square."""
        return float(np.square(self.D @ self.columns(point)).sum())

    def columns(self, point: Floats) -> Floats:
        """X^T ((d + 1) n, p) of a point (n, p, p + 1)."""
        frames = np.concatenate([point[:, :, : self.d], point[:, :, -1:]], axis=2)
        return np.swapaxes(frames, 1, 2).reshape(-1, point.shape[1])

    def certificate_matrix(self, point: Floats) -> sparse.csr_array:
        """S = M - Lambda at a point."""
        n, p = point.shape[:2]
        by_X = (self.D.T @ (self.D @ self.columns(point))).reshape(n, self.d + 1, p)
        multiplier = np.zeros((n, self.d + 1, self.d + 1))
        multiplier[:, : self.d, : self.d] = by_X[:, : self.d] @ point[:, :, : self.d]
        return self.M - _diagonal((multiplier + np.swapaxes(multiplier, 1, 2)) / 2.0)


def precisions(graph: PoseGraph) -> tuple[Floats, Floats]:
    """kappa, tau (E,) of the isotropic noise with the same trace of covariance, rotation and translation by themselves.

    tau = d / tr cov(t), kappa = d' / (2 tr cov(r)) of d' = 1 or 3 angles, as |exp(r) - I|^2 = 2 |r|^2 to first order.
    SE-Sync's g2o reader has that in space, and in the plane twice this kappa. Covariances are the inverses of blocks of
    the information.
    """
    information, d = informed(graph), graph.dimension
    turns = 1 if d == 2 else 3
    rotation, translation = (
        1.0 / (1.0 / np.maximum(np.linalg.eigvalsh(part), np.finfo(float).tiny)).mean(1)
        for part in (information[:, :turns, :turns], information[:, turns:, turns:])
    )
    return rotation / 2.0, translation


# --- descent --------------------------------------------------------------------------------------------------------


def descend(problem: Problem, start: Floats, tolerance: float = _CONVERGED) -> tuple[Floats, float]:
    """The local minimum that a point (n, p, p + 1) leads to with pose 0 held, and its chi-square.

    Newton's method on the manifold, Gauss-Newton where its Hessian is not positive definite, damped where a step does
    not help.
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
            moved = _moved(point, step.reshape(len(point) - 1, -1), problem.d)
            gain = cost - problem.cost(moved)
            if promised > 0 and (gain >= 0 or promised <= max(tolerance * cost, _ROUNDING)):
                break
            damping = max(_DAMPING, damping * _DAMPING_CHANGE)
        else:
            break
        if gain >= 0:
            point, cost = moved, cost - gain
        if promised <= max(tolerance * cost, _ROUNDING):
            break
        damping = damping / _DAMPING_CHANGE if damping > _DAMPING else 0.0
    return point, cost


def is_stationary(problem: Problem, point: Floats) -> bool:
    """Whether a descent has ended here and not at its limit: Gauss-Newton promises less than GAP of the chi-square."""
    gradient, _, gauss_newton = _derivatives(problem, point)
    return _step(gauss_newton, gradient, problem.order)[1] <= max(GAP * problem.cost(point), _ROUNDING)


def _derivatives(problem: Problem, point: Floats) -> tuple[Floats, sparse.csr_array, sparse.csr_array]:
    """Half the gradient by small motions of all poses but the first, and half the Hessian, of Newton and Gauss-Newton.

    Each row of X moves by its own Jacobian J_c: sum over c of J_c^T M X_c, J_c^T S J_c and J_c^T M J_c.
    """
    jacobian = _jacobian(point, problem.d)
    held = len(_generators(len(jacobian), problem.d)) + len(jacobian)
    stacked = sparse.vstack([J[:, held:] for J in jacobian]).tocsr()
    by_X = problem.D.T @ (problem.D @ problem.columns(point))
    newton, gauss_newton = (
        stacked.T @ sparse.block_diag([A] * len(jacobian), format="csr") @ stacked
        for A in (problem.certificate_matrix(point), problem.M)
    )
    return stacked.T @ by_X.T.ravel(), newton, gauss_newton


def _step(hessian: sparse.csr_array, gradient: Floats, order: Ints) -> tuple[Floats, float]:
    """The step that a Hessian proposes and what that promises to gain; nothing where it is not positive definite."""
    factor = _Factor.of(hessian, order)
    if not factor.definite:
        return np.zeros_like(gradient), 0.0
    step = -factor.solve(gradient)
    return step, -float(gradient @ step)


def _generators(p: int, d: int) -> Floats:
    """(K, p, p) of the turns of a (p, p) frame that move its first d columns."""
    pairs = [(i, j) for i, j in combinations(range(p), 2) if i < d]
    result = np.zeros((len(pairs), p, p))
    for k, (i, j) in enumerate(pairs):
        result[k, i, j], result[k, j, i] = -1.0, 1.0
    return result


def _jacobian(point: Floats, d: int) -> list[sparse.csr_array]:
    """Jacobian of each row of X, ((d + 1) n, k n): by the k turns and shifts of each pose."""
    p = point.shape[1]
    generators = _generators(p, d)
    turned = np.einsum("nij,kjl->nilk", point[:, :, :p], generators)[:, :, :d]
    result = []
    for row in range(p):
        block = np.zeros((len(point), d + 1, len(generators) + p))
        block[:, :d, : len(generators)] = turned[:, row]
        block[:, d, len(generators) + row] = 1.0
        result.append(_diagonal(block))
    return result


def _moved(point: Floats, step: Floats, d: int) -> Floats:
    """The point after a step (n - 1, k) of turns and shifts, pose 0 held; a turn is the rotation nearest to I + it."""
    p, step = point.shape[1], np.concatenate([np.zeros((1, step.shape[1])), step])
    generators = _generators(p, d)
    turn = np.eye(p) + np.einsum("nk,kij->nij", step[:, : len(generators)], generators)
    left, _, right = np.linalg.svd(turn)
    return np.concatenate([point[:, :, :p] @ left @ right, point[:, :, p:] + step[:, len(generators) :, None]], axis=2)


def _diagonal(blocks: Floats) -> sparse.csr_array:
    """The matrix with these blocks (n, k, l) along its diagonal."""
    n, k, columns = blocks.shape
    return sparse.bsr_array((blocks, np.arange(n), np.arange(n + 1)), shape=(n * k, n * columns)).tocsr()


@dataclass(frozen=True, eq=False)
class _Factor:
    """L U of a symmetric matrix without pivoting, so that the signs of U's diagonal are those of its eigenvalues."""

    lu: SuperLU
    order: Ints
    """Elimination order of its rows."""

    @classmethod
    def of(cls, matrix: sparse.csr_array, poses: Ints) -> _Factor:
        """Factors of a matrix with equally many rows for each pose but the held one; `poses` in elimination order."""
        size = (len(matrix.indptr) - 1) // len(poses)
        order = (poses[:, None] * size + np.arange(size)).ravel()
        rows: Any = matrix[order]
        permuted = rows[:, order].tocsc()
        lu = splu(permuted, permc_spec="NATURAL", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
        return cls(lu, order)

    @property
    def definite(self) -> bool:
        """Whether all eigenvalues are positive (Sylvester's law of inertia)."""
        return bool((self.lu.U.diagonal() > 0).all())

    def solve(self, right: Floats) -> Floats:
        result = np.empty_like(right)
        result[self.order] = self.lu.solve(right[self.order])
        return result


# --- certificate ----------------------------------------------------------------------------------------------------


def least_eigenvalue(problem: Problem, point: Floats) -> tuple[float, Floats, float]:
    """The least eigenvalue of S over the rotations, pose 0 held, its vector (n, d + 1), and the tolerance for it.

    Positions follow the rotations (the Schur complement), so that [S + shift I on rotations]^-1 on these is (S_R +
    shift I)^-1. The shift grows from the tolerance until that is positive definite; Lanczos finds its largest one.
    The tolerance is what leaves other poses GAP of the chi-square to gain, or rounding.
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
    [value], vector = eigsh(inverse, k=1, which="LA", v0=start)
    direction = np.concatenate([np.zeros(d + 1), inverse.solved(vector[:, 0])]).reshape(n, d + 1)
    return float(1.0 / value - shift), direction, tolerance


class _Inverse(LinearOperator):
    """The inverse of a factorised matrix at some of its rows."""

    def __init__(self, factor: _Factor, rows: Bools) -> None:
        self.factor, self.rows = factor, rows
        super().__init__(np.dtype(np.float64), (int(rows.sum()),) * 2)

    def _matvec(self, x: Floats) -> Floats:
        return self.solved(x)[self.rows]

    def solved(self, right: Floats) -> Floats:
        """At all rows, with zeros at the others on the right."""
        whole = np.zeros(len(self.rows))
        whole[self.rows] = right.ravel()
        return self.factor.solve(whole)


# --- away from a local minimum --------------------------------------------------------------------------------------


def better_point(
    problem: Problem, graph: PoseGraph, weight: Floats, point: Floats, direction: Floats
) -> tuple[Floats, float]:
    """The best of local minima other than `point`, which a direction (n, d + 1) of negative curvature leaves, and its
    chi-square: from the relaxed rotations, and by the staircase as long as that leads to better ones."""
    d, best, lowest = graph.dimension, point, problem.cost(point)
    linear = relaxed(Factors.of(graph), weight, odometry_chain(graph)[0])
    starts = [] if linear is None else [_as_point(linear, d)]
    for _ in range(_ROUNDS):
        if not starts and len(point) <= _MOST_LIFTED:
            starts = [rounded(staircase(problem, best, direction), d)]
        if not starts:
            break
        other, chi2 = descend(problem, starts.pop())
        if chi2 < lowest * (1 - GAP):
            best, lowest = other, chi2
            value, direction, tolerance = least_eigenvalue(problem, best)
            if value >= -tolerance:
                break
    return best, lowest


def staircase(problem: Problem, point: Floats, direction: Floats) -> Floats:
    """The Riemannian staircase (algorithm 1): local minima in ever more rows, until one is the optimum there."""
    for _ in range(_ROWS_MORE):
        point = escape(problem, point, direction)
        value, direction, tolerance = least_eigenvalue(problem, point)
        if value >= -tolerance / _LOOSE:
            break
    return point


def escape(problem: Problem, point: Floats, direction: Floats) -> Floats:
    """The local minimum in one row more that a direction (n, d + 1) of negative curvature leads to."""
    n, p = point.shape[:2]
    lifted = np.zeros((n, p + 1, p + 2))
    lifted[:, :p, :p], lifted[:, :p, p + 1], lifted[:, p, p] = point[:, :, :p], point[:, :, p], 1.0
    ends = [j for i, j in combinations(range(p + 1), 2) if i < problem.d]
    step = np.zeros((n, len(ends) + p + 1))
    step[:, np.flatnonzero(np.array(ends) == p)] = direction[:, : problem.d]
    step[:, -1] = direction[:, problem.d]
    step /= np.linalg.norm(direction[:, : problem.d], axis=1).max()  # a turn of 45 degrees at most
    cost = problem.cost(lifted)
    while problem.cost(moved := _moved(lifted, step[1:], problem.d)) >= cost and np.abs(step).max() > 1e-8:
        step /= 2.0
    return descend(problem, moved, _LOOSE)[0]


def rounded(point: Floats, d: int) -> Floats:
    """The nearest point of d rows (section 4.3): the d directions that the frames span most, and rotations in them."""
    frames = point[:, :, :d]
    _, vectors = np.linalg.eigh(np.einsum("nij,nkj->ik", frames, frames))
    onto = vectors[:, -d:].T
    if np.linalg.det(onto @ frames).sum() < 0:
        onto[0] *= -1.0
    left, _, right = np.linalg.svd(onto @ frames)
    left[:, :, -1] *= np.linalg.det(left @ right)[:, None]
    return np.concatenate([left @ right, onto @ point[:, :, -1:]], axis=2)
