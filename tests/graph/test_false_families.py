"""The likelihood of families of false closures, against dense matrices."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.graph.drive import ring
from vplog.data import EdgeKind, Floats, PoseGraph
from vplog.geometry import se3
from vplog.graph.build import informed
from vplog.graph.consistency import OdometryChain
from vplog.graph.displacements import Displacements
from vplog.graph.factors import Factors
from vplog.graph.false_families import Likelihood
from vplog.graph.least_squares import descend

PAIRS = ((2, 30), (4, 33), (7, 35), (9, 41), (12, 44), (20, 52))
"""Ends of the false closures."""
FALSE = np.array([0, 0, 0, 1, 1, 1])
"""Their families."""
LOG_2PI = float(np.log(2.0 * np.pi))


def displaced_graph(seed: int, family: np.ndarray) -> PoseGraph:
    """A ring with four true closures and families (6,) of false ones."""
    graph, random = ring(60, 4, seed=seed).graph, np.random.default_rng(seed)
    shifts = se3.exp(np.array([[0.0, 0, 0.3, 8.0, 3.0, 0.0], [0.0, 0, -0.2, -6.0, 5.0, 0.0]]))
    true, sigma = graph.world_from_body, 1.0 / np.sqrt(np.diagonal(graph.information[-1]))
    measured = np.array([
        se3.inverse(true[a]) @ shifts[number] @ true[b] @ se3.exp((sigma * random.normal(size=6))[None])[0]
        for (a, b), number in zip(PAIRS, family, strict=True)
    ])  # fmt: skip
    a, b = np.array(PAIRS, np.int32).T
    return replace(
        graph, a=np.append(graph.a, a), b=np.append(graph.b, b), a_from_b=np.concatenate([graph.a_from_b, measured]),
        kind=[*graph.kind, *[EdgeKind.LOOP] * len(PAIRS)],
        information=np.concatenate([graph.information, np.tile(graph.information[-1], (len(PAIRS), 1, 1))]),
    )  # fmt: skip


def explained(graph: PoseGraph) -> tuple[Likelihood, Displacements, Floats, Floats]:
    """Likelihood of the true closures alone, the false ones, weights (E,) and poses (N, 4, 4)."""
    factors, weight = Factors.of(graph), np.ones(len(graph.a))
    weight[-len(PAIRS) :] = 0.0
    poses = descend(factors, weight, graph.world_from_body, 100, 1e-12).world_from_body
    false = np.arange(len(graph.a) - len(PAIRS), len(graph.a))
    claims = Displacements(graph, false, OdometryChain.of(graph)).on(poses)
    return Likelihood(factors, weight, poses), claims, weight, poses


def dense(graph: PoseGraph, weight: Floats, poses: Floats, family: np.ndarray) -> float:
    """Log density of the false closures given the others, with the covariance of all poses."""
    N, n = len(poses), len(PAIRS)
    information, omega = np.zeros((6 * N, 6 * N)), informed(graph)
    information[:6, :6] += 1e12 * np.eye(6)
    for edge in np.flatnonzero(weight):
        a, b = int(graph.a[edge]), int(graph.b[edge])
        J = np.zeros((6, 6 * N))
        J[:, 6 * a : 6 * a + 6] = -se3.adjoint(se3.between(poses[b], poses[a]))
        J[:, 6 * b : 6 * b + 6] = np.eye(6)
        information += J.T @ omega[edge] @ J
    local, displacement = se3.between(poses[:1], poses), {}
    for (a, b), number, edge in zip(PAIRS, family, range(len(weight) - n, len(weight)), strict=True):
        displacement.setdefault(number, local[a] @ graph.a_from_b[edge] @ se3.inverse(local[b]))
    for _ in range(3):
        J, H, error = np.zeros((6 * n, 6 * N)), np.zeros((6 * n, 6 * len(displacement))), np.zeros(6 * n)
        numbers = list(displacement)
        for k, ((a, b), number) in enumerate(zip(PAIRS, family, strict=True)):
            moved, rows = displacement[number] @ local[b], slice(6 * k, 6 * k + 6)
            predicted = se3.inverse(local[a]) @ moved
            error[rows] = se3.log(se3.between(graph.a_from_b[len(weight) - n + k], predicted))
            J[rows, 6 * a : 6 * a + 6] = -se3.adjoint(se3.inverse(predicted))
            J[rows, 6 * b : 6 * b + 6] = np.eye(6)
            column = 6 * numbers.index(number)
            H[rows, column : column + 6] = se3.adjoint(se3.inverse(moved))
        spread = J @ np.linalg.inv(information) @ J.T
        for k in range(n):
            spread[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] += np.linalg.inv(omega[len(weight) - n + k])
        inverse = np.linalg.inv(spread)
        normal = H.T @ inverse @ H
        step = -np.linalg.solve(normal, H.T @ inverse @ error)
        for number, twist in zip(numbers, step.reshape(-1, 6), strict=True):
            displacement[number] = se3.exp(twist[None])[0] @ displacement[number]
    chi2 = error @ inverse @ error
    count = 6 * (n - len(numbers))
    return -0.5 * float(np.linalg.slogdet(spread)[1] + np.linalg.slogdet(normal)[1] + chi2 + count * LOG_2PI)


@pytest.mark.parametrize("family", [FALSE, np.zeros(6, np.int64)])
def test_the_density_is_that_of_dense_matrices(family: np.ndarray) -> None:
    graph = displaced_graph(1, family)
    likelihood, claims, weight, poses = explained(graph)
    none = likelihood.explained(claims, np.full(6, -1)).log_density
    together = likelihood.explained(claims, family).log_density
    assert together - none == pytest.approx(dense(graph, weight, poses, family), abs=0.1)


def test_closures_without_a_family_do_not_count() -> None:
    likelihood, claims, _, _ = explained(displaced_graph(2, FALSE))
    alone = likelihood.explained(claims, np.arange(6)).log_density
    assert alone == pytest.approx(likelihood.explained(claims, np.full(6, -1)).log_density)


def test_merged_families_are_as_likely_as_one_family() -> None:
    """The merge follows from the displacements and their covariance, without another factorisation."""
    likelihood, claims, _, _ = explained(displaced_graph(3, np.zeros(6, np.int64)))
    merged = likelihood.explained(claims, np.array([5, 5, 5, 8, 8, 8])).merged()
    assert merged is not None
    assert merged.family.tolist() == [5] * 6
    one = likelihood.explained(claims, merged.family)
    assert merged.log_density == pytest.approx(one.log_density, abs=0.2)
    assert merged.displacement == pytest.approx(one.displacement, abs=0.02)
    assert merged.covariance == pytest.approx(one.covariance, rel=0.05, abs=1e-3)
    assert merged.merged() is None
