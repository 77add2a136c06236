"""Truth by name, on logs that are no more than stamps, odometry and fixes."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import pytest

from tests.evaluate.data import data
from vplog import logs
from vplog.data import Camera, Gps, Odometry, Trajectory
from vplog.errors import TruthError
from vplog.evaluate.place_truth import TruthChoice, open_truth
from vplog.geometry import se3
from vplog.geometry.tum import write_tum

if TYPE_CHECKING:
    from pathlib import Path

    from vplog.data import Floats, Ints
    from vplog.stages import Log

PICTURES = [
    (["60.png", "68.png"], ["000068.png", "000060.png"], [[1], [0]]),
    (["day1_7_left.png", "day1_9_left.png"], ["0009.png", "0007.png"], [[1], [0]]),
    (["60_2.png"], ["60_1.png", "61_1.png"], [[0]]),
    (["61_0.png", "60_1.png"], ["cam0_60_1.png", "cam0_61_1.png"], [[1], [0]]),
    (["hall/0.png", "hall/1.png", "lift/0.png"], ["lift/00.png", "lift/01.png", "hall/01.png"], [[], [2], [0]]),
    (["left/4.png"], ["right/04.png", "right/05.png"], [[0]]),
    (["60_917.png", "61_924.png"], ["cam_60_12_b.png", "cam_61_13_b.png", "cam_62_14_b.png"], [[0], [1]]),
]
"""Names of query and map, and the rows of the same picture."""
METRES_A_DEGREE = 6_378_137.0 * np.pi / 180.0
"""Of longitude at the equator."""


@dataclass(frozen=True)
class Recorded:
    """What truth needs of a log."""

    name: str
    stamp_ns: Ints
    poses: Floats | None = None
    fixes: Floats | None = None
    """(T, 2) m east and north of the equator at longitude 0, at the frames' stamps."""

    body_from_camera: Floats = field(default_factory=lambda: np.eye(4))
    names: list[str] | None = None

    def stamps(self) -> Ints:
        return self.stamp_ns

    def file_names(self) -> list[str] | None:
        return self.names

    def camera(self) -> Camera:
        return Camera("camera", None, "none", np.zeros(0), 640, 480, self.body_from_camera)

    def odometry(self) -> Odometry | None:
        return None if self.poses is None else Odometry(self.stamp_ns, self.poses, None)

    def gps(self) -> Gps | None:
        if self.fixes is None:
            return None
        degrees = self.fixes / METRES_A_DEGREE
        height = np.random.default_rng(0).normal(0, 50, len(degrees))  # satellites tell heights badly
        return Gps(self.stamp_ns, degrees[:, 1], degrees[:, 0], height, np.zeros((len(degrees), 3, 3)))


def straight(name: str, start_s: float, start_m: float, **more: Any) -> Recorded:
    """Ten frames, a second and 2 m apart."""
    stamp_ns = ((start_s + np.arange(10)) * 1e9).astype(np.int64)
    east = np.asarray(start_m + 2.0 * np.arange(10), np.float64)
    poses = se3.pose(np.broadcast_to(np.eye(3), (10, 3, 3)), np.column_stack([east, 0 * east, 0 * east]))
    return Recorded(name, stamp_ns, poses=poses, **more)


def near(radius_m: float, start_m: float) -> list[list[int]]:
    east = 2.0 * np.arange(10)
    return [np.flatnonzero(np.abs(start_m + east - x) <= radius_m).tolist() for x in east]


def found_rows(choice: TruthChoice, query: Recorded, other: Recorded) -> list[list[int]]:
    truth = open_truth(choice, cast("Log", query), cast("Log", other))
    pairs = truth.pairs(truth.query_frames, truth.map_frames)
    return [pairs.rows(q).tolist() for q in range(len(pairs))]


@pytest.mark.parametrize(("query", "other", "rows"), PICTURES)
def test_numbers_in_names_are_of_one_place_in_them(query: list[str], other: list[str], rows: list[list[int]]) -> None:
    """A second number, of a camera or a crop, counts no pictures."""
    here, there = (Recorded("", np.arange(len(names)), names=names) for names in (query, other))
    assert found_rows(TruthChoice("index"), here, there) == rows


@pytest.mark.parametrize(
    ("query", "other"),
    [
        (["img_5_v2.png"], ["1.png", "2.png", "5.png"]),
        (["frame_1000_cam1.png"], ["frame_1004_cam1.png"]),
        (["5.png"], ["2_5_left.png", "5_9_left.png"]),
        (["1_7.png", "2_8.png"], ["a_7_1.png", "a_8_9.png"]),
    ],
)
def test_it_is_not_guessed_which_number_counts(query: list[str], other: list[str]) -> None:
    here, there = (Recorded("", np.arange(len(names)), names=names) for names in (query, other))
    for pair in ((here, there), (there, here)):
        with pytest.raises(TruthError, match="not clear which of them count"):
            found_rows(TruthChoice("index"), *pair)


@pytest.mark.parametrize("seed", range(200))
def test_names_of_two_schemes_pair_the_same_pictures_or_none(seed: int) -> None:
    """Numbers of cameras, sizes, clocks and scores stand before and after the one that counts."""
    rng = np.random.default_rng(seed)

    def scheme() -> tuple[str, str]:
        before = str(rng.choice(["", "img", "cam0_", "2016-04-21_", "run3-", "{clock}_"]))
        return before, str(rng.choice(["", "_v2", "_512x512", " (1)", "_{score}", "_{clock}"]))

    def pictures(before: str, after: str) -> tuple[list[str], Any]:
        frames = np.sort(rng.choice(60, rng.integers(1, 40) if rng.random() < 0.7 else 1, replace=False))
        parts = [{"clock": 5000 + 7 * frame, "score": rng.integers(1000)} for frame in frames.tolist()]
        pairs = zip(frames.tolist(), parts, strict=True)
        return [f"{before.format(**part)}{frame:04}{after.format(**part)}.png" for frame, part in pairs], frames

    one = scheme()
    (query, here), (other, there) = pictures(*one), pictures(*(one if rng.random() < 0.5 else scheme()))
    try:
        logs = (Recorded("", np.arange(len(names)), names=names) for names in (query, other))
        rows = found_rows(TruthChoice("index"), *logs)
    except TruthError:
        return
    assert rows == [np.flatnonzero(there == frame).tolist() for frame in here]


def test_odometry_of_both_drives() -> None:
    query, other = straight("a", 0, 0), straight("b", 100, 6)
    assert found_rows(TruthChoice("poses", distance_m=3.0), query, other) == near(3.0, 6.0)


def test_one_or_two_tum_files(tmp_path: Path) -> None:
    query, other = straight("a", 0, 0), straight("b", 100, 6)
    files = []
    for log in (query, other):
        files.append(tmp_path / f"{log.name}.tum")
        write_tum(files[-1], Trajectory(log.stamp_ns, cast("Any", log.poses)))
    both = tmp_path / "both.tum"
    both.write_text(files[0].read_text() + files[1].read_text())
    for source in (f"{files[0]},{files[1]}", str(both)):
        assert found_rows(TruthChoice(source, distance_m=3.0), query, other) == near(3.0, 6.0)
    with pytest.raises(TruthError, match="covers none of the 10 frames of the map b"):
        found_rows(TruthChoice(str(files[0])), query, other)


def test_fixes_of_both_drives_share_one_plane() -> None:
    """The second drive starts 6 m east of the first one; heights differ and do not matter."""
    east = np.column_stack([2.0 * np.arange(10), np.zeros(10)])
    query, other = straight("a", 0, 0, fixes=east), straight("b", 100, 0, fixes=east + np.array([6.0, 0.0]))
    assert found_rows(TruthChoice("gps", distance_m=3.0), query, other) == near(3.0, 6.0)


def test_the_defaults_are_6_m_and_45_degrees() -> None:
    query, other = straight("a", 0, 0), straight("b", 100, 6)
    assert found_rows(TruthChoice("poses"), query, other) == near(6.0, 6.0)
    for turn_deg, some in ((44.0, True), (46.0, False)):
        turned = se3.pose(se3.so3_exp(np.array([0, 0, np.radians(turn_deg)])), np.zeros(3))
        seen = found_rows(TruthChoice("poses"), query, Recorded("b", other.stamp_ns, cast("Any", other.poses) @ turned))
        assert any(seen) == some


def test_a_camera_that_is_rolled_about_its_axis_sees_the_same_place() -> None:
    """The mount is known: it looks along the body's x. Turned by as much about another axis it sees another place."""
    query, other = straight("a", 0, 0), straight("b", 100, 6)
    looks_along_x = se3.pose(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.zeros(3))
    for axis, some in ((0, True), (1, False), (2, False)):
        turned = se3.pose(se3.so3_exp(np.radians(120.0) * np.eye(3)[axis]), np.zeros(3))
        rolled = replace(other, poses=cast("Any", other.poses) @ turned, body_from_camera=looks_along_x)
        assert any(found_rows(TruthChoice("poses"), replace(query, body_from_camera=looks_along_x), rolled)) == some


def test_a_heading_is_not_for_fixes() -> None:
    log = straight("a", 0, 0)
    with pytest.raises(TruthError, match="takes no --heading-deg: it is for utm, poses and a TUM file"):
        open_truth(TruthChoice("gps", heading_deg=3.0), cast("Log", log), cast("Log", log))


def test_real_loops() -> None:
    """41 of 850 frames come back to one at least 50 older, by the drive's own truth."""
    truth_file = data("drives/kitti00.groundtruth.tum")
    log = logs.open(data("drives/kitti00"))
    truth = open_truth(TruthChoice(str(truth_file)), log, log)
    assert len(truth.query_frames) == 850
    older = truth.query_frames - 50 + 1
    assert truth.pairs(truth.query_frames, truth.map_frames).below(older).positive.sum() == 41
