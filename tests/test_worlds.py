"""Random worlds for back ends are the same by seed and as true as they say, and no back end beats the oracle."""

from __future__ import annotations

import json
from dataclasses import fields, is_dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from tests.benchmarks import backend
from tests.benchmarks.back_ends import gnc, odometry, oracle, plain, vplog_optimize
from tests.benchmarks.world_closures import tolerance_m
from tests.benchmarks.worlds import draw, make, position_error, score, world
from vplog.geometry import se3
from vplog.geometry.geodesy import local_enu
from vplog.graph.build import checked

if TYPE_CHECKING:
    from pathlib import Path

    from tests.benchmarks.worlds import World


def small(seed: int, **changed: Any) -> World:
    return make(replace(draw(seed), keyframes=100, closures=40, **changed))


def arrays(value: object) -> list[np.ndarray]:
    """Every array in a dataclass, and in those within."""
    if isinstance(value, np.ndarray):
        return [value]
    if not is_dataclass(value) or isinstance(value, type):
        return []
    return [array for field in fields(value) for array in arrays(getattr(value, field.name))]


@pytest.mark.parametrize("seed", [4, 13])
def test_a_seed_is_one_world(seed: int) -> None:
    one, two = world(seed), world(seed)
    assert one.parameters == two.parameters
    assert one.closures.scale == two.closures.scale
    pairs = list(zip(arrays(one), arrays(two), strict=True))
    assert len(pairs) > 20
    assert all(np.array_equal(a, b, equal_nan=True) for a, b in pairs)
    assert not np.array_equal(one.truth[:100], world(seed + 1).truth[:100])


def test_parameters_cover_what_is_promised() -> None:
    drawn = [draw(seed) for seed in range(200)]
    assert {one.kind for one in drawn} == {"road", "aisles", "room", "drone"}
    assert {one.claim for one in drawn} == {"right", "wrong", "constant", "missing"}
    assert {one.false_kind for one in drawn} == {"none", "random", "grouped", "aliased", "family"}
    assert {one.gps for one in drawn} == {"none", "white", "correlated", "jumping"}
    assert 0.2 < np.mean([one.gps != "none" for one in drawn]) < 0.45
    assert any(one.no_true for one in drawn)
    assert all(one.false_share <= 0.6 or one.no_true for one in drawn)


@pytest.mark.parametrize("seed", range(8))
def test_true_closures_are_true_and_false_ones_false(seed: int) -> None:
    made = small(seed)
    graph, warnings = checked(made.graph())
    assert not warnings
    assert len(graph.a) == len(made.truth) - 1 + len(made.is_true)
    match, query = made.closures.match, made.closures.query
    assert (match < query).all()
    true = se3.between(made.truth[match], made.truth[query])
    parameters, right = made.parameters, made.closures.match_from_query.copy()
    by_odometry = [scale == "odometry" for scale in made.closures.scale]
    right[:, :3, 3] /= np.where(made.by_depth, 1.0 + parameters.depth_error, 1.0)[:, None]
    right[by_odometry, :3, 3] /= 1.0 + parameters.scale_error
    error = se3.log(se3.between(true, right))
    chi2 = se3.mahalanobis2(error, made.closure_covariance)
    assert (chi2[made.is_true] < 40.0).all()  # 6 degrees; a millionth is beyond
    off = np.linalg.norm((right - true)[~made.is_true, :3, 3], axis=1)
    assert (off > tolerance_m(parameters, made.truth) / 2.0).all()  # less by its own noise


def test_fixes_are_where_the_log_has_them() -> None:
    made = small(4, gps="white", gps_sigma=0.1, kind="road", layout="blocks")
    assert made.gps is not None
    there = se3.transform(made.world_from_enu(), local_enu(made.gps).enu_m)
    np.testing.assert_allclose(there, made.fix_enu, atol=1e-5)
    away = np.linalg.norm(made.fix_enu - made.truth[made.fix_row, :3, 3], axis=1)
    assert np.median(away) < 0.5


@pytest.mark.parametrize("seed", [4, 16, 24])
def test_nothing_beats_the_oracle(seed: int) -> None:
    made = small(seed, gps="none", no_true=False, false_kind="random", false_share=0.3)
    best = score(made, oracle(made).poses, made.is_true)
    assert (best.true_lost, best.false_kept) == (0, 0)
    for method in (odometry, plain, gnc, vplog_optimize):
        answer = method(made)
        # 1.1: what is most likely is not what is nearest each time
        assert best.error_m <= 1.1 * score(made, answer.poses, answer.kept).error_m, method.__name__


def test_errors_are_evos() -> None:
    """Rigid alignment takes a motion as one, and no scale."""
    truth = np.random.default_rng(0).normal(size=(20, 3))
    moved = se3.transform(se3.exp(np.array([0.3, -0.2, 1.0, 5.0, 6.0, 7.0])), truth)
    assert position_error(moved, truth, align=True) < 1e-9
    assert position_error(moved, truth, align=False) > 1.0
    assert position_error(2.0 * truth, truth, align=True) > 0.5


def test_an_interval_is_wilsons() -> None:
    """Brown, Cai and DasGupta, Statistical Science 2001: 0 of 10 is up to 0.278."""
    assert backend.wilson(0, 10) == pytest.approx((0.0, 0.278), abs=1e-3)
    assert backend.wilson(5, 10) == pytest.approx((0.237, 0.763), abs=1e-3)


def test_the_command_tells_of_every_method(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(backend, "world", small)
    monkeypatch.setattr(backend, "METHODS", dict.fromkeys(("vplog run", "odometry", "oracle")))
    monkeypatch.setattr(backend, "answers", lambda made: {
        "vplog run": (odometry(made), 0.1), "odometry": (odometry(made), 0.0), "oracle": (oracle(made), 0.0)
    })  # fmt: skip
    assert backend.main(["--seeds", "0:3", "--json", str(tmp_path / "report.json")]) == 1  # all true ones lost
    out, report = capsys.readouterr().out, json.loads((tmp_path / "report.json").read_text())
    assert "lost" in out
    assert "MISSED" in out
    assert report["all"]["vplog run"]["worse"] == 0.0
    assert report["all"]["vplog run"]["lost"] == 1.0
    assert [row["seed"] for row in report["worlds"]] == [0, 1, 2]
    assert {"kind", "mis-told", "false closures"} <= set(report["by"])


def test_a_world_is_drawn(tmp_path: Path) -> None:
    made = small(4)
    backend.show(made, odometry(made), tmp_path / "world.png")
    assert (tmp_path / "world.png").read_bytes().startswith(b"\x89PNG")
