"""How well a set of true closures explains all of them: the logarithm of its marginal likelihood.

True closures are measurements of the solved graph; the poses are integrated over (Laplace's approximation, exact where
the graph is linear), and some of the residuals may be larger than the noise of the others. False ones come in runs,
since neighbouring keyframes look alike: a run measures a place that is displaced by the same motion, and different runs
may share their displacement, as where one aisle is taken for the next. So a run of false closures is one accident, and
so is a family of runs.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vplog.geometry import se3
from vplog.graph.build import AXES, informed, parts, subgraph
from vplog.graph.consistency import OdometryChain, degrees_of_freedom, is_loop, residual_sigma
from vplog.graph.displacements import Compared, Displacements, log_common
from vplog.graph.least_squares import GAUGE_SIGMA, Objective
from vplog.graph.leave_one_out import tension

if TYPE_CHECKING:
    from collections.abc import Iterator

    from vplog.data import Floats, Ints, PoseGraph
    from vplog.graph.factors import Factors

_BESIDE = 3
"""Keyframes between neighbours of a run, at both ends: they see the same things."""
_LONGEST = 20
"""Closures of a run that count as one accident; beyond that the view has changed."""
_RECENT = 10
"""Last members of a family by which the next one is predicted."""
_SAMPLE = 200
"""Poses all pairs of which are looked at."""
_SAMPLE_OF_TILTS = 50
"""Poses by whose pairs it is seen how far the drive's poses turn against each other."""
_CONCENTRATIONS = (2.0 ** np.arange(-4, 13)).tolist()
"""Concentrations of the Chinese restaurant process of families: from one family to as many as there are runs."""
TAIL = 3.0
"""Noise of closures that err by much as a multiple of that of the others."""
_TAIL_SHARES = np.array([0.0, 0.01, 0.02, 0.05, 0.1, 0.2])[:, None]
"""Shares of them among the true ones, as likely as each other."""
_MULTIPLES = 2.0 ** np.arange(-5.0, 6.5, 0.5)
"""Noise of single closures as multiples of the sigma that they have on average."""
_LOG_2PI = math.log(2.0 * math.pi)
_LEAST_SIDE = 0.1
"""Shortest side of the box of places as a share of its longest: a flat drive still has false closures off its plane."""


_LEAST_SIDE_M = 5.0
"""m; a camera that hardly moves sees as much, and takes any of it for another part of it."""


_VIEW_RAD = 0.2
"""Rotations that SIFT features stand."""
_VIEW_M = 0.5


def _student() -> Floats:
    """(M, 23) probability of each of `_MULTIPLES` under t distributions of several degrees of freedom and scales, as
    likely as each other; the first is the normal one."""
    found = [np.where(_MULTIPLES == 1.0, 1.0, 0.0)]
    for freedom in (1.0, 2.0, 4.0, 8.0):
        for scale in _MULTIPLES[(_MULTIPLES >= 0.125) & (_MULTIPLES <= 1.0)].tolist():
            log_precision = 2.0 * np.log(scale / _MULTIPLES)
            density = np.exp(0.5 * freedom * (log_precision - np.exp(log_precision)))  # gamma, by its logarithm
            found.append(density / density.sum())
    return np.array(found)


_STUDENT = _student()


class _Run(NamedTuple):
    """A run of false closures, as one measurement from an earlier to a later pose."""

    a: int
    b: int
    a_from_b: Floats
    covariance: Floats
    """(d, d) in the frame of b."""


class Views(NamedTuple):
    """How two keyframes that see the same stand to each other."""

    covariance: Floats
    """(d, d) of their relative pose."""
    gap: int
    """Least number of keyframes from one to the other."""

    @classmethod
    def of(cls, graph: PoseGraph, loops: Ints, places: Floats) -> Views:
        """By the edges `loops` (K,), for poses (N, 4, 4)."""
        axes, relative = np.array(AXES[graph.dimension]), forward(graph, loops)[2]
        covariance = np.linalg.inv(informed(graph, loops)).mean(0) + np.diag(_of_a_view(places)[axes] ** 2)
        if len(loops) > 1:
            covariance = covariance + np.cov(se3.log(relative)[:, axes].T)
        return cls(covariance, int(np.abs(graph.a[loops].astype(np.int64) - graph.b[loops]).min()))

    def log_room(self, chain: OdometryChain) -> float:
        """As `log_room`, where odometry drifts as the `chain` does: a false closure is as dense as views are on average
        over all pairs of poses, so what drift cannot tell from a pair that sees the same is no surprise."""
        stride = -(-len(chain.poses) // _SAMPLE)
        one, two = np.triu_indices(-(-len(chain.poses) // stride), 1)
        known = chain.part[stride * one] == chain.part[stride * two]
        apart = known & (two - one >= self.gap // stride)
        known = apart if apart.any() else known  # closures between pieces say nothing of a gap within one
        a, b = stride * one[known], stride * two[known]
        error = se3.log(se3.between(chain.poses[a], chain.poses[b]))[:, chain.axes]
        covariance = chain.covariance(a, b) + self.covariance
        log_volume = np.linalg.slogdet(covariance)[1] + len(chain.axes) * _LOG_2PI
        log_density = -0.5 * (se3.mahalanobis2(error, covariance) + log_volume)
        return math.log(max(len(a), 1)) - float(np.logaddexp.reduce(log_density, initial=-math.inf))


class Accidents:
    """Runs of closures of a graph as accidents: what a run comes to is the same in all sets that it is false in."""

    def __init__(self, graph: PoseGraph, views: Views | None = None) -> None:
        """`views` are of all closures where those of the graph are too few to tell."""
        self.graph, self.chain = graph, OdometryChain.of(graph)
        self.room = log_room(graph, self.chain.poses) if views is None else views.log_room(self.chain)
        self._parted: dict[bytes, list[Ints]] = {}
        self._measured: dict[bytes, tuple[float, _Run | None]] = {}
        self._names: dict[int, int] = {}
        self._compared = Compared()

    def among(self, loops: Ints) -> Iterator[Ints]:
        """Runs of the edges `loops` (K,) that agree with each other: of those that do not, each lot is an accident of
        its own."""
        for run in runs(self.graph, loops):
            key = run.tobytes()
            if key not in self._parted:
                self._parted[key] = [run[members] for members in self._families(run)] if len(run) > 1 else [run]
            yield from self._parted[key]

    def _families(self, run: Ints) -> list[Ints]:
        return families(Displacements(self.chain, *forward(self.graph, run)), self.room)[0]

    def as_one(self, run: Ints) -> tuple[float, _Run | None]:
        """See `_as_one`."""
        key = run.tobytes()
        if key not in self._measured:
            self._measured[key] = _as_one(self.graph, run, self.chain)
        return self._measured[key]

    def one_a_run(self, loops: Ints) -> PoseGraph:
        """The graph with one edge for each run of the edges `loops` (K,), and no others but odometry: what neighbouring
        keyframes see is one witness of where the drive has gone. Runs that disagree with themselves are in none."""
        graph, axes = self.graph, AXES[self.graph.dimension]
        found = {int(run[len(run) // 2]): self.as_one(run)[1] for run in self.among(loops)}
        a, b, measured = graph.a.copy(), graph.b.copy(), graph.a_from_b.copy()
        information = graph.information.copy()
        for edge, one in found.items():
            if one is not None:
                a[edge], b[edge], measured[edge] = one.a, one.b, one.a_from_b
                information[edge][np.ix_(axes, axes)] = np.linalg.inv(one.covariance)
        used = [edge for edge, one in found.items() if one is not None]
        whole = replace(graph, a=a, b=b, a_from_b=measured, information=information)
        rows = np.sort(np.concatenate([np.flatnonzero(~is_loop(graph)), np.array(used, np.int64)]))
        return subgraph(whole, np.arange(len(graph.world_from_body)), rows)

    def families(self, together: list[_Run]) -> tuple[list[Ints], float]:
        """See `families`; of sets that differ in a few runs, most families are the same."""
        a, b = np.array([run.a for run in together]), np.array([run.b for run in together])
        measured, noise = np.array([run.a_from_b for run in together]), np.array([run.covariance for run in together])
        names = [self._names.setdefault(id(run), len(self._names)) for run in together]  # they stay in memory
        return families(Displacements(self.chain, a, b, measured, noise, names, self._compared), self.room)


def log_evidence(factors: Factors, weight: Floats, poses: Floats, accidents: Accidents) -> float:
    """Log density of all closures where those of positive weight (E,), 0 or 1, are true.

    `poses` are their least squares, `accidents` the graph's.
    """
    graph, room = factors.graph, accidents.room
    loops = ~graph.odometry
    true, false = np.flatnonzero(loops & (weight > 0)), np.flatnonzero(loops & (weight == 0))
    total, count = _log_false(accidents, false)
    places = sum(1 for _ in runs(graph, true))
    # each place is true or an accident, the share of true ones unknown: the beta function
    total += math.lgamma(places + 1) + math.lgamma(count + 1) - math.lgamma(places + count + 2)
    return total + (_log_true(factors, weight, poses, true, room) if len(true) else 0.0)


def _log_true(factors: Factors, weight: Floats, poses: Floats, true: Ints, room: float) -> float:
    """Log density of the true closures under the odometry: N(0, A C A^T + R) by the matrix determinant lemma."""
    graph = factors.graph
    d = degrees_of_freedom(graph)
    loose = len(factors.loose(weight))
    held = (1 + loose) * d * -2.0 * math.log(GAUGE_SIGMA)
    joined = int(factors.piece.max()) - loose  # pieces of odometry whose place only closures tell
    determinant = Objective(factors, weight).information(poses).log_determinant() - held
    known = np.linalg.slogdet(informed(graph, weight > 0))[1].sum()
    chi2 = weight * residual_sigma(graph, poses) ** 2
    gaussian = 0.5 * (known - determinant - chi2.sum()) - 0.5 * _LOG_2PI * d * (len(true) - joined) - joined * room
    return float(gaussian) + log_tails(chi2[true], d)


def log_tails(chi2: Floats, d: int) -> float:
    """Log of how much likelier residuals of d dimensions, squared (K,), are where some closures err more than others.

    A share of them, which may be none, has `TAIL` times the noise: Tukey's contaminated normal distribution (A survey
    of sampling from contaminated distributions, 1960). The noise stays as it is: residuals below it, as those of
    closures that nothing checks, tell nothing, and what errs by far more than `TAIL` times it is not explained.
    """
    wide = 0.5 * chi2 * (1.0 - TAIL**-2) - d * math.log(TAIL)
    with np.errstate(divide="ignore"):
        gain = np.logaddexp(np.log1p(-_TAIL_SHARES), np.log(_TAIL_SHARES) + wide).sum(1)
    return float(np.logaddexp.reduce(gain)) - math.log(len(gain))


class StudentT(NamedTuple):
    """Residuals of closures of positive weight where their noise is Student's t in place of normal; see `student_t`."""

    log_gain: float
    """Log of how much likelier they are."""
    multiple: Floats
    """(E,) expected noise of each closure as a multiple of the sigma that they have on average; 1 elsewhere."""
    log_density: Floats
    """(E,) of each closure about the prediction of all others; NaN elsewhere."""


def student_t(factors: Factors, weight: Floats, poses: Floats, multiple: Floats) -> StudentT:
    """The residuals of the closures of positive weight where their noise is Student's t.

    `multiple` (E,) is by what the factors have the sigma of each closure multiplied already. The closer to those that
    come out, the better the gain: it is exact for each closure given the others.

    Each is compared with the prediction of all others, so those of closures that nothing checks tell nothing. t is a
    normal distribution whose variance is drawn for each closure (Lange, Little and Taylor, Robust statistical modeling
    using the t distribution, JASA 1989); its degrees of freedom and scale are integrated over, the normal among them.
    """
    loops = np.flatnonzero(~factors.graph.odometry & (weight > 0))
    closures = tension(factors, weight, poses, loops)
    gain = np.empty((len(loops), len(_MULTIPLES)))
    for column, times in enumerate(_MULTIPLES.tolist()):
        less = 1.0 - (times / multiple[loops, None]) ** 2
        ratio = 1.0 - closures.redundancy * less  # of the variances of a residual's prediction error
        gain[:, column] = -0.5 * (np.log(ratio) + closures.whitened**2 * less / ratio).sum(1)
    most = gain.max(1, keepdims=True)
    each = np.maximum(np.exp(gain - most) @ _STUDENT.T, 1e-300)
    density = np.log(each).sum(0) + most.sum()
    log_gain = float(np.logaddexp.reduce(density))
    # of each closure's square by the solution's posterior, in sigmas that they have on average
    square = multiple[loops] ** 2 * (closures.whitened**2 + 1.0 - closures.redundancy).sum(1)
    size = closures.whitened.shape[1]
    fits = np.log(np.maximum(np.exp(density - log_gain) @ _STUDENT, 1e-300)) - size * np.log(_MULTIPLES)
    fits = fits - 0.5 * square[:, None] * _MULTIPLES**-2.0
    share = np.exp(fits - fits.max(1, keepdims=True))
    expected, log_density = np.ones(len(weight)), np.full(len(weight), np.nan)
    normal = -0.5 * (closures.cost + size * _LOG_2PI) - closures.log_spread
    log_density[loops] = normal + most[:, 0] + np.log(each @ np.exp(density - log_gain))
    expected[loops] = 1.0 / np.sqrt((share @ _MULTIPLES**-2.0) / share.sum(1))
    return StudentT(log_gain - math.log(len(density)), expected, log_density)


def log_room(graph: PoseGraph, places: Floats) -> float:
    """Log of how much less likely a closure is where it is false than its density where it is true.

    A false closure pairs any two of the poses (N, 4, 4), a true one two that see the same; and its relative pose is as
    the others' are, which is what verification lets pass. At most all of the box of positions: metres cubed times
    8 pi^2, or squared times 2 pi, the volume of the rotations in units of small rotation vectors.
    """
    side = 2.0 * np.ptp(places[:, :3, 3], axis=0)[: graph.dimension]
    side = np.maximum(side, max(_LEAST_SIDE * side.max(), _LEAST_SIDE_M))
    box = float(np.log(side).sum()) + math.log(2.0 * math.pi if graph.dimension == 2 else 8.0 * math.pi**2)
    loops = np.flatnonzero(is_loop(graph))
    axes = np.array(AXES[graph.dimension])
    if len(loops) <= 2 * len(axes):
        return box
    spread, gap = Views.of(graph, loops, places)
    of_views = 0.5 * (len(axes) * (_LOG_2PI + 1.0) + float(np.linalg.slogdet(spread)[1]))  # entropy of a Gaussian
    variance = np.array([np.diag(spread)[axes < 3].mean(), np.diag(spread)[axes >= 3].mean()])
    pairs = len(places) ** 2 / 2.0
    return min(box, math.log(pairs / max(len(loops), pairs * _share_near(places, variance, gap))) + of_views)


def _share_near(places: Floats, variance: Floats, gap: int) -> float:
    """Share of the pairs of poses (N, 4, 4), at least `gap` apart, that are as near as closures are: within sigmas
    of the variances (2,) of rotation vectors and translations per axis."""
    stride = -(-len(places) // _SAMPLE)
    R, t = places[::stride, :3, :3], places[::stride, :3, 3]
    one, two = np.triu_indices(len(R), max(gap // stride, 1))
    if not len(one):
        return 0.0
    cosine = 0.5 * (np.einsum("nij,nij->n", R[one], R[two]) - 1.0)
    angle2 = np.arccos(np.clip(cosine, -1.0, 1.0)) ** 2
    distance2 = ((t[one] - t[two]) ** 2).sum(1)
    return float((angle2 / variance[0] + distance2 / variance[1] <= 6.0).mean())


def _of_a_view(places: Floats) -> Floats:
    """Sigmas (6,) of the relative poses, rad and m, from which views of one place are recognised at least, and which
    poses (N, 4, 4) of the drive have: a robot on wheels never tilts against itself by what features stand."""
    step = np.linalg.norm(np.diff(places[:, :3, 3], axis=0), axis=1)
    reach = _BESIDE * float(np.median(step)) if len(step) else 0.0
    some = places[:: -(-len(places) // _SAMPLE_OF_TILTS)]
    one, two = np.triu_indices(len(some), 1)
    relative = se3.log(se3.between(some[one], some[two]))
    most = np.sqrt((relative**2).mean(0)) if len(one) else np.full(6, np.inf)
    return np.minimum(np.repeat([_VIEW_RAD, max(reach, _VIEW_M)], 3), most)


def runs(graph: PoseGraph, loops: Ints) -> Iterator[Ints]:
    """The edges `loops` (K,) in runs of neighbouring keyframes at both ends, in order."""
    first, second = np.minimum(graph.a[loops], graph.b[loops]), np.maximum(graph.a[loops], graph.b[loops])
    order = np.lexsort((second, first))
    at, to = first[order].astype(np.int64), second[order].astype(np.int64)
    begin = np.searchsorted(at, at - _BESIDE)
    near = [
        start + np.flatnonzero(np.abs(to[start : this + 1] - to[this]) <= _BESIDE)
        for this, start in enumerate(begin.tolist())
    ]
    this = np.repeat(np.arange(len(loops)), [len(others) for others in near])
    label = parts(len(loops), np.concatenate([*near, this[:0]]), this)
    by_run = np.lexsort((to, label))
    for run in np.split(by_run, np.cumsum(np.bincount(label))[:-1]):
        for start in range(0, len(run), _LONGEST):
            yield loops[order[run[start : start + _LONGEST]]]


def _log_false(accidents: Accidents, false: Ints) -> tuple[float, int]:
    """Log density of the false closures, and how many runs they are."""
    total, count, together, room = 0.0, 0, [], accidents.room
    for run in accidents.among(false):
        count += 1
        inner, one = accidents.as_one(run)
        if one is None or inner < -room * (len(run) - 1):  # they do not agree with each other
            total -= room * len(run)
        else:
            total += inner
            together.append(one)
    if together:
        total += accidents.families(together)[1]
    return total, count


def _as_one(graph: PoseGraph, run: Ints, chain: OdometryChain) -> tuple[float, _Run | None]:
    """Log density of the members of a run given a displacement common to them, and the run as one measurement.

    Seen from the middle one's ends, they differ by their own noise and by that of the odometry between them.
    """
    axes, X, size = chain.axes, chain.poses, len(run)
    d = len(axes)
    a, b, measured, noise = forward(graph, run)
    middle = size // 2
    at, to = int(a[middle]), int(b[middle])
    if size == 1:
        return 0.0, _Run(at, to, measured[0], noise[0])
    if (chain.part[a] != chain.part[at]).any() or (chain.part[b] != chain.part[to]).any():
        return 0.0, None
    there = se3.between(X[at][None], X[a]) @ measured @ se3.between(X[b], X[to][None])
    error = se3.log(se3.between(measured[middle][None], there))[:, axes]
    covariance = np.zeros((size, d, size, d))
    from_first = se3.between(X[to], X[0])
    for end, frame in ((b, from_first), (a, se3.inverse(measured[middle]) @ se3.between(X[at], X[0]))):
        Ad = se3.adjoint(frame)[axes][:, axes]
        legs = Ad @ (chain.total[end] - chain.total[end[middle]]) @ Ad.T
        legs, side = np.abs(np.sign(end - end[middle]))[:, None, None] * legs, np.sign(end - end[middle])
        far = np.abs(end - end[middle])
        k, j = np.nonzero(side[:, None] * side > 0)  # members on one side share the odometry to the nearer one
        shared = np.where(far[k] <= far[j], k, j)
        covariance[k, :, j, :] += side[shared][:, None, None] * legs[shared]
    Ad = se3.adjoint(se3.between(X[to][None], X[b]))[:, axes][:, :, axes]
    covariance[range(size), :, range(size), :] += Ad @ noise @ np.swapaxes(Ad, 1, 2)
    inner, displaced, information = log_common(error, covariance.reshape(size * d, size * d))
    if not math.isfinite(inner):
        return 0.0, None
    twist = np.zeros(6)
    twist[axes] = displaced
    noise = np.asarray(np.linalg.inv(information), np.float64)
    return inner, _Run(at, to, measured[middle] @ se3.exp(twist[None])[0], noise)


def forward(graph: PoseGraph, edges: Ints) -> tuple[Ints, Ints, Floats, Floats]:
    """The edges from their earlier pose a to their later one b: a, b, a_from_b and covariance in the frame of b."""
    axes = AXES[graph.dimension]
    back = (graph.a[edges] > graph.b[edges])[:, None, None]
    noise = np.linalg.inv(informed(graph, edges))
    Ad = se3.adjoint(graph.a_from_b[edges])[:, axes][:, :, axes]
    return (
        np.minimum(graph.a[edges], graph.b[edges]).astype(np.int64),
        np.maximum(graph.a[edges], graph.b[edges]).astype(np.int64),
        np.where(back, se3.inverse(graph.a_from_b[edges]), graph.a_from_b[edges]),
        np.where(back, Ad @ noise @ np.swapaxes(Ad, 1, 2), noise),
    )


def agreeing(accidents: Accidents, loops: Ints) -> list[Ints]:
    """The edges `loops` (K,) in sets that claim one displacement, largest first; runs that disagree are in none."""
    members, together = [], []
    for run in accidents.among(loops):
        _, one = accidents.as_one(run)
        if one is not None:
            members.append(run)
            together.append(one)
    if not together:
        return []
    found, _ = accidents.families(together)
    sets = [np.concatenate([members[run] for run in family.tolist()]) for family in found]
    return sorted(sets, key=len, reverse=True)


def families(claims: Displacements, room: float) -> tuple[list[Ints], float]:
    """The claims in families that share a displacement, and the log density of all of them.

    One after the other, each is of the family that predicts it best, the likelier the larger that is, or displaced
    anywhere in the room, as at the tables of a Chinese restaurant whose concentration is the likeliest.
    """
    found: list[list[int]] = []
    of: list[int] = []
    density: list[float] = []  # of each family's last members
    total = 0.0
    near = claims.near(room)
    for this in range(claims.count):
        best, chosen, joint, density_here = -room, len(found), 0.0, -room
        for family in sorted({of[other] for other in near[this]}):
            grown = claims.log_joint([*found[family][-_RECENT:], this])
            own = grown - density[family]
            if own + math.log(len(found[family])) > best:
                best, chosen, joint, density_here = own + math.log(len(found[family])), family, grown, own
        if chosen == len(found):
            found.append([])
            density.append(0.0)
        found[chosen].append(this)
        of.append(chosen)
        total += density_here
        density[chosen] = joint if len(found[chosen]) <= _RECENT else claims.log_joint(found[chosen][-_RECENT:])
    return [np.array(family) for family in found], total + log_partition([len(family) for family in found])


def log_partition(sizes: list[int]) -> float:
    """Log of Ewens's probability of a partition into families of these sizes, by the likeliest concentration."""
    count = sum(sizes)
    within = sum(math.lgamma(size) for size in sizes)
    likeliest = max(
        len(sizes) * math.log(alpha) + math.lgamma(alpha) - math.lgamma(alpha + count) for alpha in _CONCENTRATIONS
    )
    return within + likeliest
