from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from tests.benchmarks import back_ends
from tests.benchmarks.worlds import world
from tests.graph.drive import CLOSURE_SIGMA, Drive, position_error, ring, without_loops
from vplog.data import EdgeKind, Floats, Gps, Ints, Keyframes, Odometry, PoseGraph
from vplog.errors import GraphError
from vplog.geometry import se3
from vplog.geometry.geodesy import geodetic, local_enu
from vplog.graph.build import build_graph
from vplog.graph.consistency import residual_sigma
from vplog.graph.factors import Factors
from vplog.graph.least_squares import descend
from vplog.graph.lm import LmSettings
from vplog.graph.solve import GncSettings, decided
from vplog.graph.variance_components import Sigmas
from vplog.pipeline import Pipeline
from vplog.refinement.gps_factors import Fixes, GpsSettings, antennas, cost_of_fixes, fixes_on
from vplog.refinement.refine import Refined, RefineSettings, refine
from vplog.run.back_end import solve

DEGREE_M = 111_195.0
"""m of a degree on a sphere of 6371 km: for making fixes, not for reading them."""


def misread(drive: Drive, metres: float = 1.0, covariance: float = 1.0) -> Drive:
    """The drive with odometry whose metres are too long by a factor, and a covariance too large by another."""
    odometry = np.array([kind == EdgeKind.ODOMETRY for kind in drive.graph.kind])
    a_from_b, information = drive.graph.a_from_b.copy(), drive.graph.information.copy()
    a_from_b[odometry, :3, 3] *= metres
    information[odometry] /= covariance
    poses = np.array(drive.keyframes.odom_from_body)
    for k, step in enumerate(a_from_b[odometry]):
        poses[k + 1] = poses[k] @ step
    graph = replace(drive.graph, world_from_body=poses, a_from_b=a_from_b, information=information)
    stamps = drive.keyframes.stamp_ns
    return replace(
        drive, graph=graph, keyframes=Keyframes("ring", stamps, poses), odometry=Odometry(stamps, poses, None)
    )


def refined(graph: PoseGraph, fixes: Fixes | None = None, of_loops: bool = False) -> Refined:
    of_odometry = np.array([kind == EdgeKind.ODOMETRY or of_loops for kind in graph.kind])
    return refine(graph, LmSettings()(graph), of_odometry, RefineSettings(), fixes)


def satellites(drive: Drive, sigma_m: float = 1.0, antenna_m: tuple[float, float, float] | None = None) -> Gps:
    """A fix at every keyframe, with noise, in a frame that is turned against the odometry's."""
    n = len(drive.true)
    arm = np.zeros(3) if antenna_m is None else np.array(antenna_m)
    place = drive.true[:, :3, 3] + drive.true[:, :3, :3] @ arm
    turned = place @ se3.so3_exp(np.array([[0.0, 0.0, 2.0]]))[0].T
    noisy = turned + np.random.default_rng(7).normal(size=(n, 3)) * sigma_m
    return Gps(
        drive.keyframes.stamp_ns, 48.0 + noisy[:, 1] / DEGREE_M,
        8.0 + noisy[:, 0] / (DEGREE_M * np.cos(np.radians(48.0))), 300.0 + noisy[:, 2],
        np.broadcast_to(np.eye(3) * sigma_m**2, (n, 3, 3)).copy(), None if antenna_m is None else arm,
    )  # fmt: skip


@pytest.mark.parametrize("covariance", [1 / 64, 1.0, 64.0], ids=str)
def test_the_noise_is_found_whatever_the_log_claims(covariance: float) -> None:
    drive = ring(240, 80)
    plain, found = refined(drive.graph), refined(misread(drive, covariance=covariance).graph)
    assert found.sigmas.translation**2 * covariance == pytest.approx(plain.sigmas.translation**2, rel=0.15)
    assert 0.5 < plain.sigmas.translation**2 < 2.0
    np.testing.assert_allclose(
        found.solution.world_from_body[:, :3, 3], plain.solution.world_from_body[:, :3, 3], atol=0.02
    )


def seen_from_afar(seed: int = 3) -> Drive:
    """The ring with closures between views some eight metres apart, as a camera with depth has them."""
    drive, random = ring(240, 80), np.random.default_rng(seed)
    loops = np.array([kind == EdgeKind.LOOP for kind in drive.graph.kind])
    a = np.clip(drive.graph.a + random.choice([-9, -7, 7, 9], len(loops)), 0, 239)[loops]
    b = drive.graph.b[loops]
    a_from_b = se3.between(drive.true[a], drive.true[b]) @ se3.exp(random.normal(size=(len(b), 6)) * CLOSURE_SIGMA)
    graph = drive.graph
    ends, poses = graph.a.copy(), graph.a_from_b.copy()
    ends[loops], poses[loops] = a, a_from_b
    return replace(drive, graph=replace(graph, a=ends, a_from_b=poses))


@pytest.mark.parametrize("metres", [0.9, 1.0, 1.12], ids=str)
def test_a_shared_error_of_the_closures_metres_is_found_where_it_is_significant(metres: float) -> None:
    """A stereo pair whose baseline is off; the odometry's own metres are not touched by it."""
    drive = seen_from_afar()
    measured = drive.graph.a_from_b.copy()
    loops = np.array([kind == EdgeKind.LOOP for kind in drive.graph.kind])
    measured[loops, :3, 3] *= metres
    found = refined(replace(drive.graph, a_from_b=measured))
    assert found.scale == 1.0
    of_closures = found.graph.a_from_b[loops, :3, 3] / measured[loops, :3, 3]
    assert of_closures.mean() * metres == pytest.approx(1.0, abs=0.01)
    sound = refined(drive.graph).solution.world_from_body
    error = position_error(found.solution.world_from_body, drive.true)
    assert error < 1.1 * position_error(sound, drive.true)


def test_metres_are_left_alone_where_nothing_else_has_any() -> None:
    """Closures with the odometry's own scale say nothing of it, and must not shrink the world to agree better."""
    drive = misread(seen_from_afar(), 1.03)
    graph = drive.graph
    loops = np.array([kind == EdgeKind.LOOP for kind in graph.kind])
    a_from_b = graph.a_from_b.copy()
    a_from_b[loops, :3, 3] *= 1.03
    assert refined(replace(graph, a_from_b=a_from_b), of_loops=True).scale == pytest.approx(1.0, abs=0.002)


def test_odometry_that_nothing_checks_is_left_as_it_is() -> None:
    drive = ring(60, 5)
    alone = without_loops(drive.graph)
    found = refined(alone)
    assert (found.sigmas, found.scale) == (Sigmas(), 1.0)
    assert found.graph is alone
    assert (
        0.3 < refined(ring(60, 3).graph).sigmas.translation ** 2 < 3.0
    )  # few closures change little of what is claimed


def test_gps_fixes_scale_place_and_heading() -> None:
    drive = misread(ring(240, 0), 1.02)
    fixes = fixes_on(satellites(drive, antenna_m=(0.5, 0.0, 1.0)), drive.odometry, drive.keyframes, GpsSettings())
    found = refined(drive.graph, fixes)
    assert found.scale * 1.02 == pytest.approx(1.0, abs=0.01)
    assert found.inlier.mean() > 0.95
    assert found.world_from_enu is not None
    there = (fixes.enu_m @ found.world_from_enu[:3, :3].T) + found.world_from_enu[:3, 3]
    off = np.linalg.norm(antennas(found.solution.world_from_body, fixes) - there, axis=1)
    assert np.median(off) < 2.0
    plain = LmSettings()(drive.graph).world_from_body

    def aligned(poses: np.ndarray) -> float:
        a, b = poses[:, :3, 3] - poses[:, :3, 3].mean(0), drive.true[:, :3, 3] - drive.true[:, :3, 3].mean(0)
        left, _, right = np.linalg.svd(b.T @ a)
        return float(np.sqrt(((a @ (left @ right).T - b) ** 2).sum(1).mean()))

    assert aligned(found.solution.world_from_body) < 0.5 * aligned(plain)


def test_fixes_that_jump_are_not_believed() -> None:
    drive = ring(240, 20)
    gps = satellites(drive)
    jumps = np.zeros(len(gps.stamp_ns), bool)
    jumps[[5, 40, 41, 42, 43, 120, 200, 201]] = True
    moved = replace(gps, latitude_deg=gps.latitude_deg + jumps * 40.0 / DEGREE_M)
    fixes = fixes_on(moved, drive.odometry, drive.keyframes, GpsSettings())
    found = refined(drive.graph, fixes)
    assert not found.inlier[jumps].any()
    assert found.inlier[~jumps].mean() > 0.95
    clean = refined(drive.graph, fixes_on(gps, drive.odometry, drive.keyframes, GpsSettings()))
    np.testing.assert_allclose(
        found.solution.world_from_body[:, :3, 3], clean.solution.world_from_body[:, :3, 3], atol=0.5
    )


def test_a_jump_that_lasts_is_left_out_whole() -> None:
    """24 of 291 fixes are 17 m off, and odometry is bad enough to be bent to half of them."""
    drawn = world(9700048, "plain")
    gps = GpsSettings(use=True)
    solved = solve(drawn.odometry, drawn.keyframes, drawn.closures, drawn.gps, Pipeline(gps=gps))
    assert solved.refined.fixes is not None
    assert not solved.refined.inlier[~drawn.fix_sound].any()


@pytest.mark.parametrize(
    ("covariance", "variances"),
    [
        (np.nan, [9.0, 9.0, 36.0]),
        (0.0, [9.0, 9.0, 36.0]),
        (-1.0, [9.0, 9.0, 36.0]),
        (np.diag([1.0, 4.0, 0.0]), [1.0, 4.0, 36.0]),
        (np.array([[0.0, 0.5, 0.0], [0.5, 4.0, 0.0], [0.0, 0.0, 9.0]]), [9.0, 4.0, 9.0]),
    ],
    ids=["nan", "zero", "negative", "2d", "no_east"],
)
def test_unknown_covariance_is_assumed_and_said(covariance: float | Floats, variances: list[float]) -> None:
    drive = ring(60, 5)
    gps = satellites(drive)
    gps = replace(gps, covariance=np.tile(np.broadcast_to(covariance, (3, 3)), (60, 1, 1)))
    fixes = fixes_on(gps, drive.odometry, drive.keyframes, GpsSettings())
    np.testing.assert_allclose(fixes.covariance, np.broadcast_to(np.diag(variances), (60, 3, 3)))
    assert any("60 of 60 GPS fixes have no usable covariance" in warning for warning in fixes.warnings)


def test_fixes_share_the_say_of_a_keyframe() -> None:
    drive = ring(60, 5)
    gps = satellites(drive)
    every = np.repeat(np.arange(60), 3)
    often = Gps(
        gps.stamp_ns[every] + np.tile([-1_000_000, 0, 1_000_000], 60), gps.latitude_deg[every],
        gps.longitude_deg[every], gps.altitude_m[every], gps.covariance[every],
    )  # fmt: skip
    fixes = fixes_on(often, drive.odometry, drive.keyframes, GpsSettings())
    inside = fixes.row[(fixes.row > 0) & (fixes.row < 59)]
    assert (np.bincount(inside)[1:59] == 3).all()
    np.testing.assert_allclose(fixes.covariance[fixes.row == 30], np.broadcast_to(3.0 * np.eye(3), (3, 3, 3)))


def test_fixes_hang_on_keyframes_of_their_own_piece_of_the_odometry() -> None:
    """20 m along x at 10 m/s, a sample and a fix each tenth of a second, and a break of 1.3 s after the first 10 m."""
    seconds = np.concatenate([np.arange(11), np.arange(24, 35)]) / 10.0
    x = np.arange(22) - (np.arange(22) > 10)  # the position is held across the gap
    odometry = Odometry(
        (seconds * 1e9).astype(np.int64), se3.pose(np.tile(np.eye(3), (22, 1, 1)), x[:, None] * np.eye(3)[0]),
        None, breaks=np.array([11]),
    )  # fmt: skip
    rows = np.array([0, 7, 15, 21])
    keyframes = Keyframes("gap", odometry.stamp_ns[rows], odometry.odom_from_body[rows])
    stamps = np.arange(0, 3_500_000_000, 100_000_000)
    zero = np.zeros(len(stamps))
    gps = Gps(stamps, 48.0 + zero, 8.0 + zero, zero, np.tile(np.eye(3), (len(stamps), 1, 1)), np.zeros(3))
    fixes = fixes_on(gps, odometry, keyframes, GpsSettings())
    assert len(fixes) == 22  # none from within the break
    np.testing.assert_array_equal(keyframes.stamp_ns[fixes.row] > 10**9, np.arange(22) > 10)
    np.testing.assert_allclose(fixes.arm_m[:, 0], x - x[rows][fixes.row], atol=1e-9)


def test_too_little_gps_is_one_clear_error() -> None:
    drive = ring(60, 5)
    with pytest.raises(GraphError, match="no GPS fixes"):
        fixes_on(None, drive.odometry, drive.keyframes, GpsSettings())
    late = satellites(drive)
    late = replace(late, stamp_ns=late.stamp_ns + 10**12)
    with pytest.raises(GraphError, match="0 of 60 GPS fixes"):
        fixes_on(late, drive.odometry, drive.keyframes, GpsSettings())


def test_residuals_of_the_refined_graph_are_those_of_its_noise() -> None:
    found = refined(misread(ring(240, 80), covariance=50.0).graph)
    odometry = np.array([kind == EdgeKind.ODOMETRY for kind in found.graph.kind])
    chi2 = residual_sigma(found.graph, found.solution.world_from_body)[odometry] ** 2
    assert 0.1 < chi2.mean() < 6.0  # 6 degrees an edge, most of which the edge itself takes


def test_local_enu_holds_an_origin() -> None:
    local = local_enu(satellites(ring(30, 2)))
    np.testing.assert_array_equal(local.enu_m[0], 0.0)
    assert local.origin[0] == pytest.approx(48.0, abs=0.001)


def test_closures_that_lead_away_from_gps_are_not_believed() -> None:
    """All shifted alike by less than the odometry's noise claims to be: only GPS can tell."""
    drive = misread(ring(120, loops=40, seed=1), covariance=400.0)
    fixes = fixes_on(satellites(drive, 0.3), drive.odometry, drive.keyframes, GpsSettings())
    loops = np.array([kind == EdgeKind.LOOP for kind in drive.graph.kind])
    measured = drive.graph.a_from_b.copy()
    aside = np.eye(4)
    aside[:3, 3] = [8.0, 0.0, 0.0]
    measured[loops] = aside @ measured[loops]
    poisoned = replace(drive.graph, a_from_b=measured)

    def kept(graph: PoseGraph, there: Fixes | None) -> int:
        cost = None if there is None else partial(cost_of_fixes, fixes=there)
        return int(decided(graph, GncSettings(), cost).solution.weight[loops].sum())

    assert kept(drive.graph, fixes) == kept(poisoned, None) == 40
    assert kept(poisoned, fixes) == 0
    # one in ten fixes far away changes nothing
    jumped = replace(fixes, enu_m=fixes.enu_m + np.where(np.arange(len(fixes)) % 10 == 0, 500.0, 0.0)[:, None])
    assert kept(drive.graph, jumped) == 40
    assert kept(poisoned, jumped) == 0


@pytest.mark.parametrize(("false", "sigma_m", "seed"), [(2, 1.0, 0), (2, 1.0, 1), (1, 1.0, 2), (1, 2.5, 3)])
def test_false_closures_are_not_excused_by_errors_of_fixes_that_they_make_alike(
    false: int, sigma_m: float, seed: int
) -> None:
    """What they bend is smooth, as a receiver's errors that wander are; and fixes that jump are there anyway."""
    drive = ring(240, loops=0, false=false, seed=seed)
    fixes = fixes_on(satellites(drive, sigma_m), drive.odometry, drive.keyframes, GpsSettings())
    jump = np.isin(np.arange(len(fixes)) // 20, [2, 7])
    fixes = replace(fixes, enu_m=fixes.enu_m + np.where(jump, 30.0, 0.0)[:, None] * [1.0, 1.0, 0.5])
    odometry = np.array([kind == EdgeKind.ODOMETRY for kind in drive.graph.kind])
    loose = drive.graph.information / np.where(odometry, 9.0, 1.0)[:, None, None]
    factors, cost = Factors.of(replace(drive.graph, information=loose)), []
    for weight in (odometry.astype(float), np.ones(len(odometry))):
        poses = descend(factors, weight, drive.graph.world_from_body, 100, 1e-4).world_from_body
        cost.append(cost_of_fixes(factors, weight, poses, fixes))
    assert cost[0] < cost[1]


def test_fixes_far_noisier_than_they_claim_outvote_no_closures() -> None:
    """Receivers tell what they think: here centimetres, and metres are true."""
    drive = ring(120, loops=40, seed=1)
    loops = np.array([kind == EdgeKind.LOOP for kind in drive.graph.kind])
    loose = replace(drive.graph, information=drive.graph.information / np.where(loops, 1.0, 900.0)[:, None, None])
    noisy = satellites(drive, 5.0)
    fixes = fixes_on(replace(noisy, covariance=noisy.covariance / 1e4), drive.odometry, drive.keyframes, GpsSettings())
    cost = partial(cost_of_fixes, fixes=fixes)
    assert decided(loose, GncSettings(), cost).solution.weight[loops].sum() >= 39


@pytest.mark.parametrize(("seed", "correlation"), [(1, 0.8), (3, 0.9)])
def test_wandering_fixes_that_claim_too_little_noise_outvote_no_closures(seed: int, correlation: float) -> None:
    """Errors of first order autoregression; the odometry's noise is claimed large enough to follow them."""
    drive, random = ring(120, loops=40, seed=1), np.random.default_rng(seed)
    loops = np.array([kind == EdgeKind.LOOP for kind in drive.graph.kind])
    loose = replace(drive.graph, information=drive.graph.information / np.where(loops, 1.0, 25.0)[:, None, None])
    error = random.normal(size=(120, 3))
    for k in range(1, 120):
        error[k] = correlation * error[k - 1] + np.sqrt(1.0 - correlation**2) * error[k]
    exact = satellites(drive, 1e-6)
    exact = replace(exact, covariance=np.broadcast_to(0.01 * np.eye(3), (120, 3, 3)))
    fixes = fixes_on(exact, drive.odometry, drive.keyframes, GpsSettings())
    cost = partial(cost_of_fixes, fixes=replace(fixes, enu_m=fixes.enu_m + error))
    assert decided(loose, GncSettings(), cost).solution.weight[loops].sum() == 40


def test_fixes_whose_errors_wander_count_for_less() -> None:
    drive = ring(240, 40)
    white = satellites(drive, 1.0)
    random = np.random.default_rng(3)
    wandering = np.cumsum(random.normal(size=(240, 2)), axis=0)
    wandering = (wandering - wandering.mean(0)) / wandering.std(0)
    alike = replace(
        satellites(drive, 0.1),
        covariance=white.covariance,
        latitude_deg=satellites(drive, 0.1).latitude_deg + wandering[:, 0] / DEGREE_M,
    )
    factor = []
    for gps in (white, alike):
        fixes = fixes_on(gps, drive.odometry, drive.keyframes, GpsSettings())
        found = refined(drive.graph, fixes).fixes
        assert found is not None
        factor.append(float(found.covariance[0, 0, 0] / fixes.covariance[0, 0, 0]))
    assert 0.5 < factor[0] < 2.0
    assert factor[1] > 2.0


@pytest.mark.parametrize("claimed", [1 / 5, 5.0])
def test_noise_of_fixes_is_found_whatever_they_claim(claimed: float) -> None:
    drive = misread(ring(240, 40), metres=1.05)
    gps = satellites(drive, 1.0)
    gps = replace(gps, covariance=gps.covariance * claimed**2)
    found = refined(drive.graph, fixes_on(gps, drive.odometry, drive.keyframes, GpsSettings()))
    assert found.fixes is not None
    assert np.sqrt(np.median(found.fixes.covariance[:, 0, 0])) == pytest.approx(1.0, rel=0.25)
    assert found.scale == pytest.approx(1 / 1.05, abs=0.01)


CAMERA = se3.pose(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.zeros(3))
"""A camera that looks ahead: x right, y down, z forward."""


def road(
    true: Floats, stamps: Ints, sigma: Floats, random: np.random.Generator
) -> tuple[Keyframes, Odometry, PoseGraph]:
    """A drive without closures whose odometry errs by `sigma` (6,) at each step."""
    n, poses = len(true), np.tile(np.eye(4), (len(true), 1, 1))
    for k, step in enumerate(se3.between(true[:-1], true[1:]) @ se3.exp(random.normal(size=(n - 1, 6)) * sigma)):
        poses[k + 1] = poses[k] @ step
    keyframes, odometry = Keyframes("road", stamps, poses), Odometry(stamps, poses, None)
    return keyframes, odometry, build_graph(keyframes, np.tile(np.diag(sigma**2), (n - 1, 1, 1)), None)[0]


@pytest.mark.parametrize("bend_deg", [0.0, 5.0])
@pytest.mark.parametrize("mount", [np.eye(4), CAMERA, CAMERA @ se3.exp(np.array([-0.35, 0, 0, 0, 0, 0]))], ids=str)
def test_fixes_along_a_straight_road_do_not_turn_it_about_itself(bend_deg: float, mount: np.ndarray) -> None:
    """Body z up, or a camera's odometry in its own first frame, looking ahead or 20 degrees down."""
    random, n = np.random.default_rng(1), 60
    yaw = 0.7 + np.linspace(0.0, np.radians(bend_deg), n)
    place = np.cumsum(np.stack([np.cos(yaw), np.sin(yaw), 0.0 * yaw], axis=1) * 2.0, axis=0)
    true = se3.pose(se3.so3_exp(np.stack([0.0 * yaw, 0.0 * yaw, yaw], axis=1)), place) @ mount
    sigma = np.repeat([0.002, 0.02], 3)
    stamps = np.arange(n, dtype=np.int64) * 500_000_000
    keyframes, odometry, graph = road(true, stamps, sigma, random)
    noisy = place + random.normal(size=(n, 3)) * [1.5, 1.5, 3.0]
    gps = Gps(
        stamps, 48.0 + noisy[:, 1] / DEGREE_M, 8.0 + noisy[:, 0] / (DEGREE_M * np.cos(np.radians(48.0))),
        300.0 + noisy[:, 2], np.tile(np.diag([1.5, 1.5, 3.0]) ** 2, (n, 1, 1)), None,
    )  # fmt: skip
    found = refined(graph, fixes_on(gps, odometry, keyframes, GpsSettings()))
    assert found.world_from_enu is not None
    up = found.world_from_enu[:3, 2] @ found.solution.world_from_body[:, :3, :3]  # in the frames of the bodies
    assert np.degrees(np.arccos((up * true[:, 2, :3]).sum(1))).max() < 8.0


def test_fixes_of_centimetres_are_not_judged_in_the_frame_of_poor_ones() -> None:
    """A third of the drive has no corrections: its fixes claim 3 m and are 4 m off, all to one side."""
    drive = ring(240, 80)
    gps, poor = satellites(drive, 0.02), np.arange(240) >= 160
    gps = replace(
        gps,
        latitude_deg=gps.latitude_deg + poor * 4.0 / DEGREE_M,
        covariance=np.where(poor, 9.0, 4e-4)[:, None, None] * np.eye(3),
    )
    found = refined(drive.graph, fixes_on(gps, drive.odometry, drive.keyframes, GpsSettings()))
    assert found.inlier[~poor].mean() > 0.9


def test_fixes_without_altitude_do_not_lay_a_climbing_road_flat() -> None:
    """4 km at 10 %, straight and winding; the altitudes are 0 and without weight, as of NMEA's RMC."""
    random, n = np.random.default_rng(1), 200
    yaw = np.concatenate([np.zeros(n // 2), 0.6 * np.sin(np.arange(n // 2) / 8.0)])
    heading, climb = np.stack([0.0 * yaw, 0.0 * yaw, yaw], axis=1), np.array([0.0, -np.arctan(0.1), 0.0])
    rotation = se3.so3_exp(heading) @ se3.so3_exp(np.tile(climb, (n, 1)))
    true = se3.pose(rotation, np.cumsum(20.0 * rotation[:, :, 0], axis=0))
    sigma = np.repeat([0.0005, 0.1], 3)
    stamps = np.arange(n, dtype=np.int64) * 1_000_000_000
    keyframes, odometry, graph = road(true, stamps, sigma, random)
    noisy = true[:, :3, 3] * [1.0, 1.0, 0.0] + random.normal(size=(n, 3)) * [1.0, 1.0, 0.0]
    latitude, longitude, _ = geodetic(noisy, (48.0, 8.0, 0.0)).T
    gps = Gps(stamps, latitude, longitude, np.zeros(n), np.tile(np.diag([1.0, 1.0, 1e10]), (n, 1, 1)), None)
    fixes = fixes_on(gps, odometry, keyframes, GpsSettings())
    found = refine(graph, LmSettings()(graph), graph.odometry, RefineSettings(scale=False), fixes)
    assert found.world_from_enu is not None
    there = se3.inverse(found.world_from_enu) @ found.solution.world_from_body
    off = (there - true)[:, :2, 3]
    assert np.linalg.norm(off - off.mean(0), axis=1).max() < 1.5
    assert np.ptp(there[:, 2, 3]) == pytest.approx(np.ptp(true[:, 2, 3]), rel=0.1)


@pytest.mark.parametrize("seed", [856073560])
def test_fixes_whose_noise_does_not_settle_outvote_no_closures(seed: int) -> None:
    """Jumping ones, and correlated ones that claim a third of their sigma."""
    drawn = world(seed, "plain")
    np.testing.assert_array_equal(back_ends.vplog_run(drawn).kept, drawn.is_true)
