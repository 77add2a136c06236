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
from tests.benchmarks.world_parameters import KINDS, STRATA
from tests.benchmarks.worlds import draw, make, position_error, score, world
from vplog.geometry import se3
from vplog.geometry.geodesy import local_enu
from vplog.graph.build import checked, parts

if TYPE_CHECKING:
    from pathlib import Path

    from tests.benchmarks.back_ends import Answer
    from tests.benchmarks.worlds import World


def small(seed: int, stratum: str | None = "plain", **changed: Any) -> World:
    drawn = draw(seed, stratum)
    keyframes = {"isolated": 300, "sessions": 200}.get(drawn.stratum, 100)
    return make(replace(drawn, keyframes=keyframes, closures=40, **changed))


def arrays(value: object) -> list[np.ndarray]:
    """Every array in a dataclass, and in those within."""
    if isinstance(value, np.ndarray):
        return [value]
    if not is_dataclass(value) or isinstance(value, type):
        return []
    return [array for field in fields(value) for array in arrays(getattr(value, field.name))]


@pytest.mark.parametrize(("seed", "stratum"), [(4, "plain"), (13, "plain"), *((4, name) for name in STRATA[1:])])
def test_a_seed_is_one_world(seed: int, stratum: str) -> None:
    one, two = world(seed, stratum), world(seed, stratum)
    assert one.parameters == two.parameters
    assert one.closures.scale == two.closures.scale
    pairs = list(zip(arrays(one), arrays(two), strict=True))
    assert len(pairs) > 20
    assert all(np.array_equal(a, b, equal_nan=True) for a, b in pairs)
    assert not np.array_equal(one.truth[:100], world(seed + 1, stratum).truth[:100])


@pytest.mark.parametrize(("seed", "figures"), [
    (2, (498, 93, 16673.207, 522.83983)),
    (4, (183, 41, 46565.789, 325.96594)),
    (16, (520, 96, 61045.795, 548.56974)),
    (30, (373, 60, 72054.009, 819.68705)),
])  # fmt: skip
def test_plain_worlds_stay_as_they_are(seed: int, figures: tuple[float, ...]) -> None:
    """Reports of different versions are compared world by world."""
    assert summed(world(seed, "plain")) == pytest.approx(figures, rel=1e-6)


def summed(made: World) -> tuple[float, ...]:
    closures = made.closures.match_from_query
    return len(made.truth), made.is_true.sum(), np.abs(made.keyframes.odom_from_body).sum(), np.abs(closures).sum()


def test_parameters_cover_what_is_promised() -> None:
    drawn = [draw(seed) for seed in range(200)]
    assert {one.kind for one in drawn} == {"road", "aisles", "room", "drone"}
    assert {one.claim for one in drawn} == {"right", "wrong", "constant", "missing"}
    assert {one.false_kind for one in drawn} == {"none", "random", "grouped", "aliased", "family"}
    assert {one.gps for one in drawn} == {"none", "white", "correlated", "jumping"}
    assert 0.2 < np.mean([one.gps != "none" for one in drawn]) < 0.45
    assert any(one.no_true for one in drawn)
    assert all(one.false_share <= 0.6 or one.no_true for one in drawn)
    assert 0.4 < np.mean([one.stratum == "plain" for one in drawn]) < 0.6
    assert all(sum(one.stratum == stratum for one in drawn) > 5 for stratum in STRATA)
    spacings = {one.spacing for one in drawn if one.stratum == "spaced"}
    assert min(spacings) <= 2
    assert max(spacings) >= 20
    assert max(one.spacing for one in drawn) <= 80


@pytest.mark.parametrize("seed", range(10))
def test_the_stratum_changes_few_parameters(seed: int) -> None:
    plain, spaced = draw(seed, "plain").as_json(), draw(seed, "spaced").as_json()
    assert {name for name in plain if plain[name] != spaced[name]} <= {"stratum", "spacing", "keyframes"}


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("stratum", ["spaced", "isolated"])
def test_closures_are_spaced(stratum: str, seed: int) -> None:
    made = world(seed, stratum)
    spacing = made.parameters.spacing
    gaps = np.diff(np.unique(made.closures.query))
    assert made.is_true.any()
    assert (gaps >= spacing).all()
    assert spacing <= 30 or stratum == "isolated"
    assert spacing > 30 or stratum == "spaced"


@pytest.mark.parametrize("kind", KINDS)
def test_a_late_revisit_shares_one_displacement(kind: str) -> None:
    layout = {"road": "loop", "drone": "circuit"}.get(kind, kind)
    exact = {"drift": 0.03, "sigma": 1e-3, "sigma_turn": 1e-4, "depth_error": 0.0, "scales": ("stereo",), "spacing": 1}
    spread = []
    for seed in range(5):
        made = small(seed, "late", kind=kind, layout=layout, false_kind="none", false_share=0.0, no_true=False, **exact)
        match, query, odom = made.closures.match, made.closures.query, made.keyframes.odom_from_body
        assert len(query) >= 5
        assert (query - match > 0.7 * len(made.truth)).all()
        moved, at = odom[match] @ made.closures.match_from_query @ se3.inverse(odom[query]), odom[query, :3, 3].mean(0)
        shift = se3.transform(moved, at[None])[:, 0] - at
        spread.append(np.linalg.norm(shift.std(0)) / np.linalg.norm(shift.mean(0)))
    assert np.median(spread) < 0.5  # drift of the lap is larger than that of the end


@pytest.mark.parametrize("seed", range(12))
def test_sessions_are_joined_by_closures_alone(seed: int) -> None:
    made = world(seed, "sessions")
    session, odom, graph = made.session, made.keyframes.odom_from_body, made.graph()
    assert 2 <= session[-1] + 1 <= 4
    assert np.bincount(session).min() >= 20
    assert (session[graph.a] == session[graph.b])[graph.odometry].all()
    assert graph.odometry.sum() == len(made.truth) - 1 - session[-1]
    for last, first in zip(made.breaks, made.odometry.breaks, strict=True):
        assert session[first] == session[last] + 1
        np.testing.assert_array_equal(odom[last], odom[first])  # nothing is known, so the pose is held
        assert np.linalg.norm(made.truth[first, :3, 3] - made.truth[last, :3, 3]) > 0.0
    match, query = made.closures.match[made.is_true], made.closures.query[made.is_true]
    for later in range(1, session[-1] + 1):
        assert ((session[query] == later) & (session[match] < later)).sum() >= 3
    true = made.true_graph()
    assert not parts(len(made.truth), true.a, true.b).any()


@pytest.mark.parametrize("seed", range(8))
def test_a_stalled_robot_stands_still_while_its_odometry_moves(seed: int) -> None:
    made = world(seed, "stalled")
    true, odom = steps_m(made.truth), steps_m(made.keyframes.odom_from_body)
    assert 20 <= made.is_wrong.sum() <= 180
    assert true[made.is_wrong].max() < 0.1
    assert odom[made.is_wrong].min() > 0.5 * odom[~made.is_wrong].min()
    np.testing.assert_allclose(odom[~made.is_wrong], true[~made.is_wrong], rtol=0.5, atol=0.2)
    stalled = np.flatnonzero(made.is_wrong) + 1
    ends = np.isin([made.closures.match[made.is_true], made.closures.query[made.is_true]], stalled)
    assert made.parameters.no_true or ends.all(0).any()


def test_stalled_keyframes_see_places_of_other_times() -> None:
    joined = 0
    for seed in range(8):
        made = world(seed, "stalled")
        stalled = np.flatnonzero(made.is_wrong) + 1
        ends = np.isin([made.closures.match[made.is_true], made.closures.query[made.is_true]], stalled)
        joined += int((ends[0] != ends[1]).sum())
    assert joined > 0


@pytest.mark.parametrize("seed", range(6))
def test_frozen_odometry_reports_no_motion(seed: int) -> None:
    made = world(seed, "frozen")
    odom = made.keyframes.odom_from_body
    assert (5 <= made.is_wrong.sum() <= 60).all()
    np.testing.assert_array_equal(odom[1:][made.is_wrong], odom[:-1][made.is_wrong])
    assert steps_m(made.truth)[made.is_wrong].min() > 0.0
    assert steps_m(odom)[~made.is_wrong].min() > 0.0


@pytest.mark.parametrize("stratum", ["stalled", "frozen"])
def test_the_oracle_alone_knows_which_edges_are_wrong(stratum: str) -> None:
    made = small(1, stratum, claim="right", accumulated=False)
    odom, claimed = made.keyframes.odom_from_body, made.odometry_claimed
    assert claimed is not None
    error = se3.log(se3.between(se3.between(made.truth[:-1], made.truth[1:]), se3.between(odom[:-1], odom[1:])))
    wrong = made.is_wrong
    assert np.median(se3.mahalanobis2(error[wrong], claimed[wrong])) > 50.0
    assert np.median(se3.mahalanobis2(error[wrong], made.odometry_covariance[wrong])) < 6.0
    np.testing.assert_allclose(claimed[~wrong], made.odometry_covariance[~wrong])


def steps_m(poses: np.ndarray) -> np.ndarray:
    return np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)


@pytest.mark.parametrize(
    ("seed", "stratum"),
    [*((seed, "plain") for seed in range(8)), *((seed, STRATA[1 + seed % 6]) for seed in range(12))],
)
def test_true_closures_are_true_and_false_ones_false(seed: int, stratum: str) -> None:
    made = small(seed, stratum)
    graph, warnings = checked(made.graph())
    assert not warnings
    assert len(graph.a) == len(made.truth) - 1 - len(made.breaks) + len(made.is_true)
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


@pytest.mark.parametrize(
    ("seed", "stratum"), [(4, "plain"), (16, "plain"), (24, "plain"), *((16, name) for name in STRATA[1:])]
)
def test_nothing_beats_the_oracle(seed: int, stratum: str) -> None:
    made = small(seed, stratum, gps="none", no_true=False, false_kind="random", false_share=0.3)
    best = score(made, oracle(made).poses, made.is_true)
    assert (best.true_lost, best.false_kept) == (0, 0)
    for method in (odometry, plain, gnc, *([vplog_optimize] if stratum == "plain" else [])):
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
    assert {"kind", "mis-told", "false closures", "stratum"} <= set(report["by"])


@pytest.mark.parametrize("lossy", [None, "late"])
def test_no_stratum_may_lose_its_true_closures(
    lossy: str | None, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    strata = ("late", *["plain"] * 5)

    def answers(made: World) -> dict[str, tuple[Answer, float]]:
        best = oracle(made)
        kept = made.is_true & (made.parameters.stratum != lossy)
        return {"vplog run": (replace(best, kept=kept), 0.1), "odometry": (odometry(made), 0.0), "oracle": (best, 0.0)}

    monkeypatch.setattr(backend, "world", lambda seed, _=None: small(seed, strata[seed], gps="none"))
    monkeypatch.setattr(backend, "METHODS", dict.fromkeys(("vplog run", "odometry", "oracle")))
    monkeypatch.setattr(backend, "answers", answers)
    assert backend.main(["--seeds", "0:6"]) == (1 if lossy else 0)
    told = [line for line in capsys.readouterr().out.splitlines() if "lost, " in line]
    assert [("late" in line, "MISSED" in line) for line in told] == [(True, bool(lossy)), (False, False)]


@pytest.mark.parametrize("stratum", ["plain", "sessions", "stalled"])
def test_a_world_is_drawn(tmp_path: Path, stratum: str) -> None:
    made = small(4, stratum)
    backend.show(made, odometry(made), tmp_path / "world.png")
    assert (tmp_path / "world.png").read_bytes().startswith(b"\x89PNG")
