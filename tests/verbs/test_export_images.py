"""A finished run as a scene: COLMAP opens it, its points lie before its cameras, which look as the run's."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from textwrap import dedent
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest

from vplog import logs
from vplog.data import Camera
from vplog.errors import ResultError
from vplog.geometry import se3
from vplog.loops.structure import points_of, tracks
from vplog.loops.undistort import project
from vplog.results import tables
from vplog.results.colmap import camera_model
from vplog.results.run_record import read_single_run
from vplog.verbs.export import export

if TYPE_CHECKING:
    from collections.abc import Callable

    from conftest import Said

    Verb = Callable[..., Said]

K = np.array([[300.0, 0, 160], [0, 310, 100], [0, 0, 1]])


@pytest.fixture(scope="module")
def log(finished: Path) -> Any:
    record = read_single_run(finished)
    return logs.open(Path(record["log"]))


@pytest.fixture(scope="module")
def scene(finished: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("scene") / "colmap"
    found = export(finished, "colmap", out)
    assert [path.rsplit("/", 1)[1] for path in found["written"]] == ["cameras.txt", "images.txt", "points3D.txt"]
    return out


def colmap(script: str, *arguments: object) -> Any:
    """What a script that has pycolmap prints, in JSON: in a process that has none of our libraries."""
    if find_spec("pycolmap") is None:
        pytest.skip("pycolmap is not installed")
    command = [sys.executable, "-c", f"import json, sys, pycolmap\n{dedent(script)}", *map(str, arguments)]
    return json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


def test_colmap_opens_it(scene: Path, finished: Path, log: Any) -> None:
    seen = colmap(
        """
        model = pycolmap.Reconstruction(sys.argv[1])
        points = lambda image: list(image.get_observation_points2D())[:5]
        print(json.dumps({
            "images": model.num_reg_images(),
            "points": model.num_points3D(),
            "track_length": model.compute_mean_track_length(),
            "reprojection_error": model.compute_mean_reprojection_error(),
            "K": next(iter(model.cameras.values())).calibration_matrix().tolist(),
            "poses": {
                row: [image.name, image.cam_from_world().matrix().tolist()] for row, image in model.images.items()
            },
            "errors": [
                (image.project_point(model.points3D[one.point3D_id].xyz) - one.xy).tolist()
                for image in model.images.values() for one in points(image)
            ],
        }))
        """,
        scene / "sparse" / "0",
    )
    keyframes, world_from_body = tables.read_keyframes(finished / "keyframes.parquet")
    camera = log.camera()
    assert seen["images"] == len(keyframes.stamp_ns)
    assert seen["points"] > 10 * len(keyframes.stamp_ns)
    assert seen["track_length"] > 2
    assert seen["reprojection_error"] < 2.0
    np.testing.assert_allclose(np.array(seen["K"])[:2, :2], camera.matrix[:2, :2])
    expected = world_from_body @ camera.body_from_camera
    for row, (name, camera_from_world) in seen["poses"].items():
        found = np.vstack([camera_from_world, [0, 0, 0, 1]])
        np.testing.assert_allclose(np.linalg.inv(found), expected[int(row) - 1], atol=1e-6)
        picture: Any = cv2.imread(str(scene / "images" / name))
        assert picture.shape == (camera.height, camera.width, 3)
    assert len(seen["errors"]) > len(seen["poses"])
    assert np.linalg.norm(seen["errors"], axis=1).max() < 8


def test_points_lie_before_the_cameras_that_see_them(scene: Path, log: Any) -> None:
    """Read back by hand, as the format is written down."""
    lines = [line.split() for line in (scene / "sparse/0/points3D.txt").read_text().splitlines()]
    images = (scene / "sparse/0/images.txt").read_text().splitlines()
    poses = np.array([line.split()[1:8] for line in images[::2]], float)

    observed = [np.array(line.split(), float).reshape(-1, 3) for line in images[1::2]]
    errors = []
    for line in lines[:: max(len(lines) // 100, 1)]:
        for image, at in np.array(line[8:], int).reshape(-1, 2):
            x, y, point = observed[image - 1][at]
            assert int(point) == int(line[0])
            w, i, j, k = poses[image - 1, :4]
            rotation = np.array(
                [
                    [1 - 2 * (j * j + k * k), 2 * (i * j - k * w), 2 * (i * k + j * w)],
                    [2 * (i * j + k * w), 1 - 2 * (i * i + k * k), 2 * (j * k - i * w)],
                    [2 * (i * k - j * w), 2 * (j * k + i * w), 1 - 2 * (i * i + j * j)],
                ]
            )
            place = rotation @ np.array(line[1:4], float) + poses[image - 1, 4:]
            assert place[2] > 0
            errors.append(np.linalg.norm(project(log.camera(), place[None])[0] - [x - 0.5, y - 0.5]))

    assert max(errors) < 4.01
    assert len(errors) > 100


def test_nerfstudio_has_the_same_cameras(verb: Verb, finished: Path, scene: Path, log: Any, tmp_path: Path) -> None:
    out = tmp_path / "nerf"
    verb("export", finished, "--format", "nerfstudio", "-o", out, "--json")
    tree = json.loads((out / "transforms.json").read_text())
    camera = log.camera()
    assert (tree["w"], tree["h"], tree["fl_x"]) == (camera.width, camera.height, camera.matrix[0, 0])
    assert tree["cx"] == camera.matrix[0, 2] + 0.5
    _, world_from_body = tables.read_keyframes(finished / "keyframes.parquet")
    for frame, pose in zip(tree["frames"], world_from_body @ camera.body_from_camera, strict=True):
        name = frame["file_path"]
        assert (out / name).read_bytes() == (scene / name).read_bytes()
        found = np.array(frame["transform_matrix"])
        np.testing.assert_allclose(found[:3, 2], -pose[:3, 2])  # it looks along -z
        np.testing.assert_allclose(found[:3, 3], pose[:3, 3])
    head, _, body = (out / tree["ply_file_path"]).read_bytes().partition(b"end_header\n")
    rows = np.frombuffer(body, [("xyz", "<f4", 3), ("rgb", "u1", 3)])
    assert f"element vertex {len(rows)}\n" in head.decode()
    known = [line.split() for line in (scene / "sparse/0/points3D.txt").read_text().splitlines()]
    np.testing.assert_allclose(rows["xyz"], np.array([line[1:4] for line in known], float), rtol=1e-5, atol=1e-5)
    assert rows["rgb"].tolist() == [[int(value) for value in line[4:7]] for line in known]


def test_an_export_replaces_an_export_and_nothing_else(verb: Verb, finished: Path, scene: Path, tmp_path: Path) -> None:
    before = (scene / "sparse/0/points3D.txt").read_bytes()
    verb("export", finished, "--format", "colmap", "-o", scene)
    assert (scene / "sparse/0/points3D.txt").read_bytes() == before
    (tmp_path / "mine.txt").touch()
    assert "other things" in verb("export", finished, "--format", "colmap", "-o", tmp_path).error
    assert "folder" in verb("export", finished, "--format", "nerfstudio", "-o", "-").error
    own = {"images/1.jpg": b"mine", "sparse/0/points3D.txt": b"mine", "transforms.json": b"{}"}
    for name, data in own.items():
        (tmp_path / "scene" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "scene" / name).write_bytes(data)
    for _ in range(2):
        error = verb("export", finished, "--format", "colmap", "-o", tmp_path / "scene").error
        assert "other things in it, not an export" in error
        assert {name: (tmp_path / "scene" / name).read_bytes() for name in own} == own
    again = shutil.copytree(scene, tmp_path / "again")
    (again / "images" / "mine.jpg").touch()
    verb("export", finished, "--format", "nerfstudio", "-o", again)
    assert (again / "transforms.json").is_file()
    assert not (again / "sparse").exists()
    assert (again / "images" / "mine.jpg").exists(), "no file of the export before"
    gone = verb("export", finished, "--format", "colmap", "-o", tmp_path / "x", "--log", tmp_path / "no.mcap")
    assert "There is no log at" in gone.error


@pytest.mark.parametrize(
    ("model", "distortion", "expected"),
    [
        ("none", [], "PINHOLE"),
        ("plumb_bob", [0.0] * 5, "PINHOLE"),
        ("plumb_bob", [-0.2, 0.05, 0.001, -0.002], "OPENCV"),
        ("plumb_bob", [-0.2, 0.05, 0.001, -0.002, 0.01], "FULL_OPENCV"),
        ("rational_polynomial", [0.3, -0.1, 0.001, 0.002, 0.05, 0.5, -0.02, 0.01], "FULL_OPENCV"),
        ("equidistant", [0.01, -0.02, 0.003, 0.001], "OPENCV_FISHEYE"),
        ("equidistant", [], "OPENCV_FISHEYE"),
    ],
)
def test_colmap_projects_through_every_lens_as_we_do(model: str, distortion: list[float], expected: str) -> None:
    camera = Camera("c", K, model, np.array(distortion), 320, 200, np.eye(4))
    name, parameters = camera_model(camera)
    assert name == expected
    points = np.random.default_rng(0).uniform([-0.4, -0.3, 1], [0.4, 0.3, 1], (50, 3))
    theirs = colmap(
        """
        import numpy
        name, parameters, points = map(json.loads, sys.argv[1:])
        camera = pycolmap.Camera(model=name, width=320, height=200, params=parameters)
        print(json.dumps(camera.img_from_cam(numpy.array(points)).tolist()))
        """,
        *map(json.dumps, (name, list(parameters.values()), points.tolist())),
    )
    np.testing.assert_allclose(theirs, project(camera, points) + 0.5, atol=1e-6)


@pytest.mark.parametrize(
    ("camera", "message"),
    [
        (Camera("c", None, "none", np.zeros(0), 320, 200, np.eye(4)), "not calibrated"),
        (Camera("c", K + np.diag([5, 0], 1), "none", np.zeros(0), 320, 200, np.eye(4)), "skewed"),
        (Camera("c", K, "rational_polynomial", np.full(12, 0.01), 320, 200, np.eye(4)), "thin prism"),
    ],
)
def test_a_lens_without_a_model_is_one_line(camera: Camera, message: str) -> None:
    with pytest.raises(ResultError, match=message):
        camera_model(camera)


def test_tracks_join_matches_and_leave_out_what_joins_two_points() -> None:
    def rows(*pairs: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
        return np.array([a for a, _ in pairs], np.int64), np.array([b for _, b in pairs], np.int64)

    found = [rows((0, 1), (2, 2)), rows((1, 0), (2, 1)), rows((0, 0), (2, 3))]
    image, row, track = tracks([3, 3, 4], [(0, 1), (1, 2), (0, 2)], found)
    # 0:0 - 1:1 - 2:0 is one point; 0:2 - 1:2 - 2:1 is joined with 2:3 of the same image
    assert image.tolist() == [0, 1, 2]
    assert row.tolist() == [0, 1, 0]
    assert len(set(track.tolist())) == 1


def test_points_are_those_of_the_world_and_outliers_leave_them() -> None:
    rng = np.random.default_rng(0)
    camera = Camera("c", K, "plumb_bob", np.array([-0.1, 0.02, 0.0, 0.0]), 320, 200, np.eye(4))
    world = rng.uniform([-2, -1, 6], [2, 1, 12], (80, 3))
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, 0, 3] = np.linspace(-1, 1, 5)
    image, track = np.repeat(np.arange(5), 80), np.tile(np.arange(80), 5)
    px = np.concatenate([project(camera, se3.transform(se3.inverse(pose), world)) for pose in poses])
    px += rng.normal(0, 0.3, px.shape)
    wrong = rng.choice(len(px), 20, replace=False)
    px[wrong] += 40
    found = points_of(poses, [camera] * 5, image, track, px.astype(np.float32))
    assert len(found.world) > 70
    assert (np.diff(found.image) >= 0).all()
    assert found.error_px.mean() < 0.5
    distance = np.linalg.norm(found.world[:, None] - world[None], axis=2).min(axis=1)
    assert np.median(distance) < 0.05
    assert len(found.px) <= len(px) - 20
