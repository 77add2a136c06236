"""The finished picture in result.mcap: what is shown, where, and that the format's own reader takes every message."""

from __future__ import annotations

import base64
import importlib.util
import json
import os
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from tests.rerun import rerun
from tests.results.example import COUNT, METADATA, make_run
from tests.results.test_mcap import decode, of
from vplog.data import USED, Gps, Trajectory, Verdict
from vplog.errors import ResultError
from vplog.geometry import se3
from vplog.maps.geo_bounds import earth_from_record, earth_record
from vplog.results import foxglove, geo, mcap_read
from vplog.results.contracts import TOPICS
from vplog.results.geo import Earth
from vplog.results.mcap import McapExtras, ReferenceBoxes, camera_topic, write_mcap
from vplog.results.previews import PictureSettings, jpeg, preview, scaled_size, shrink
from vplog.run.figures.run_figures import earth_of
from vplog.storage.image_file import decode_image

if TYPE_CHECKING:
    from vplog.data import Camera

RUN = make_run()
CAMERA: Camera = replace(
    RUN.camera,
    name="/front/image raw",
    matrix=np.array([[400.0, 0.0, 319.5], [0.0, 410.0, 239.5], [0.0, 0.0, 1.0]]),
    distortion_model="equidistant",
    distortion=np.array([0.1, 0.2, 0.3, 0.4]),
)
SIZE = (320, 240)


def picture(value: int, width: int = SIZE[0], height: int = SIZE[1]) -> bytes:
    return jpeg(np.full((height, width), value, np.uint8), 75)


def explained(row: int) -> ReferenceBoxes | None:
    windows = np.array([[0.0, 0.0, 0.5, 0.5], [0.5, 0.5, 1.0, 1.0]])
    boxes = np.array([[0.25, 0.25, 0.75, 0.75], [np.nan] * 4])
    return None if row == 1 else ReferenceBoxes([row % 2, 5], windows, boxes)


ROWS: Any = np.arange(COUNT // 3)
GPS = Gps(
    RUN.keyframes.stamp_ns[::3] + 5,
    49.0 + 1e-5 * ROWS,
    8.0 + 1e-5 * ROWS,
    100.0 + ROWS,
    np.where(ROWS[:, None, None] % 2, np.eye(3), np.nan),
)
SHOWN = McapExtras(
    camera=CAMERA,
    image=picture,
    image_size=SIZE,
    explained=explained,
    references={number: picture(200 + number, 80, 60) for number in (0, 1)},
    pictures={3: picture(30), 1: picture(10)},
    gps=GPS,
    earth=Earth((49.0, 8.0, 100.0), np.eye(4)),
    about={"inputs": {"a.mcap": "00ff"}},
)


def write(path: Path, shown: McapExtras = SHOWN) -> bytes:
    write_mcap(path, RUN.keyframes, RUN.solution.world_from_body, RUN.graph, RUN.closures, METADATA, shown)
    return path.read_bytes()


def test_images_calibration_and_boxes_share_the_keyframes_stamps(tmp_path: Path) -> None:
    messages = decode(write(tmp_path / "r.mcap"))
    assert [time for _, time, _ in messages] == sorted(time for _, time, _ in messages)
    topic = camera_topic(CAMERA)
    assert topic == "/cam/front_image_raw"
    stamps = RUN.keyframes.stamp_ns.tolist()
    for row, (time, message) in enumerate(of(messages, f"{topic}/image")):
        assert time == message.timestamp.ToNanoseconds() == stamps[row]
        assert (message.data, message.format, message.frame_id) == (picture(row), "jpeg", "camera")
    assert [time for time, _ in of(messages, f"{topic}/calibration")] == stamps
    boxed = stamps[:1] + stamps[2:]
    annotated = of(messages, f"{topic}/annotations")
    assert [time for time, _ in annotated] == boxed
    for time, message in annotated:
        [window] = message.points  # the other window was found nowhere
        assert window.timestamp.ToNanoseconds() == time
        assert [(p.x, p.y) for p in window.points] == [(1, 1), (159, 1), (159, 119), (1, 119)]
        assert "reference" in message.texts[-1].text
    (began, blank), *shown = of(messages, "/reference/image")
    assert (began, blank.frame_id) == (stamps[0], "reference")
    for (time, image), (other, boxes) in zip(shown, of(messages, "/reference/annotations"), strict=True):
        number = stamps.index(time) % 2
        assert (time, image.frame_id, image.data) == (other, "reference", SHOWN.references[number])
        assert [(p.x, p.y) for p in boxes.points[0].points] == [(21, 16), (59, 16), (59, 44), (21, 44)]


def test_the_calibration_projects_onto_the_smaller_image(tmp_path: Path) -> None:
    """A ray meets the same place of the scene in either image, by the centres of their pixels."""
    [(_, message), *_] = of(decode(write(tmp_path / "r.mcap")), f"{camera_topic(CAMERA)}/calibration")
    assert (message.width, message.height) == SIZE
    assert (message.distortion_model, list(message.D)) == ("kannala_brandt", CAMERA.distortion.tolist())
    small = np.reshape(message.K, (3, 3))
    rays = np.array([[0.3, -0.2, 1.0], [0.0, 0.0, 1.0], [-0.6, 0.5, 1.0]])
    assert CAMERA.matrix is not None
    share = [(rays @ matrix.T)[:, :2] + 0.5 for matrix in (small, CAMERA.matrix)]
    np.testing.assert_allclose(share[0] / SIZE, share[1] / [CAMERA.width, CAMERA.height], atol=1e-12)


def test_without_images_the_boxes_fit_the_logs_own(tmp_path: Path) -> None:
    messages = decode(write(tmp_path / "r.mcap", replace(SHOWN, image=None)))
    topic = camera_topic(CAMERA)
    assert not of(messages, f"{topic}/image")
    _, message = of(messages, f"{topic}/annotations")[0]
    assert [(p.x, p.y) for p in message.points[0].points] == [(1, 1), (319, 1), (319, 239), (1, 239)]
    _, calibration = of(messages, f"{topic}/calibration")[0]
    assert (calibration.width, calibration.height) == (CAMERA.width, CAMERA.height)


def test_fixes_and_the_way_on_earth(tmp_path: Path) -> None:
    messages = decode(write(tmp_path / "r.mcap"))
    fixes = of(messages, "/gps")
    assert [time for time, _ in fixes] == GPS.stamp_ns.tolist()
    for row, (_, fix) in enumerate(fixes):
        assert (fix.latitude, fix.longitude, fix.altitude) == (
            GPS.latitude_deg[row], GPS.longitude_deg[row], GPS.altitude_m[row],
        )  # fmt: skip
        assert len(fix.position_covariance) == (9 if row % 2 else 0)
    [(_, message)] = of(messages, "/gps/optimised")
    earth = SHOWN.earth
    assert earth is not None
    stamps = RUN.keyframes.stamp_ns
    tree = geo.feature_collection(earth, RUN.solution.world_from_body, stamps, RUN.closures)
    assert json.loads(message.geojson) == tree
    assert len(tree["features"]) == 1 + RUN.closures.accepted.sum()


def test_every_candidate_of_geometry_is_in_the_graph_of_the_rejected(tmp_path: Path) -> None:
    [(_, scene)] = of(decode(write(tmp_path / "r.mcap")), "/graph/rejected")
    rejected = len(RUN.closures) - sum(
        verdict in (*USED, Verdict.REJECTED_BY_SOLVER) for verdict in RUN.closures.verdict
    )
    assert len(scene.entities[0].lines[0].points) == 2 * rejected


def test_pictures_references_and_fixes_come_back(tmp_path: Path) -> None:
    write(tmp_path / "r.mcap")
    found = mcap_read.read_pictures(tmp_path / "r.mcap")
    assert found.pictures == dict(SHOWN.pictures)
    assert found.references == dict(SHOWN.references)
    assert found.gps is not None
    for name in ("stamp_ns", "latitude_deg", "longitude_deg", "altitude_m", "covariance"):
        np.testing.assert_array_equal(getattr(found.gps, name), getattr(GPS, name))


def test_pictures_without_rows_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mcap_read, "_picture_rows", lambda _: [])
    write(tmp_path / "new.mcap")
    with pytest.raises(ResultError, match="cannot be read"):
        mcap_read.read_pictures(tmp_path / "new.mcap")


@pytest.mark.parametrize("cut", [0, 7, 100, 5000, -10])
def test_a_damaged_file_is_one_line(tmp_path: Path, cut: int) -> None:
    data = write(tmp_path / "r.mcap")
    (tmp_path / "cut.mcap").write_bytes(data[:cut])
    with pytest.raises(ResultError, match="cannot be read") as caught:
        mcap_read.read_pictures(tmp_path / "cut.mcap")
    assert "\n" not in str(caught.value)


def test_topics_are_those_of_the_contract(tmp_path: Path) -> None:
    topics = {topic for topic, _, _ in decode(write(tmp_path / "r.mcap"))}
    assert topics == {topic.replace("/cam/NAME", camera_topic(CAMERA)) for topic in TOPICS}


@pytest.mark.parametrize("name", ["", "///", "a b/ü\n", "x" * 300])
def test_a_cameras_name_becomes_a_topic(name: str) -> None:
    topic = camera_topic(replace(CAMERA, name=name))
    assert topic.startswith("/cam/")
    assert len(topic) > len("/cam/")
    assert not set(topic[5:]) - set("ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789_.-")


def test_previews_are_small() -> None:
    settings = PictureSettings(megapixels=0.01)
    images = [np.random.default_rng(row).integers(0, 255, (60 + row, 400), np.uint8) for row in range(5)]
    kept = [preview(image, settings) for image in images]
    for row in (4, 0, 2):
        size = scaled_size(400, 60 + row, 0.01)
        assert size[0] * size[1] <= 1.02e4
        assert decode_image(kept[row]).shape == size[::-1]
        assert kept[row] == jpeg(shrink(images[row], 0.01), settings.quality)
    assert preview(images[0], PictureSettings(megapixels=0)) == b""


def test_a_picture_is_never_enlarged() -> None:
    assert scaled_size(30, 20, 1.0) == (30, 20)
    assert scaled_size(1, 100_000, 0.001) == (1, 10_000)
    assert scaled_size(0, 0, 1.0) == (1, 1)


# By the format's own JavaScript packages


@pytest.fixture(scope="module")
def node() -> list[str]:
    """Node with @mcap/core, @mcap/support and @mcap/nodejs, found through NODE_PATH or among the global packages."""
    program = shutil.which("node")
    if program is None:
        pytest.skip("node is not installed")
    probe = "['core','support','nodejs'].forEach(name => require.resolve('@mcap/' + name))"
    if subprocess.run([program, "-e", probe], capture_output=True, check=False, env=environment()).returncode:
        pytest.skip("npm install -g @mcap/core @mcap/support @mcap/nodejs (or name their folder in NODE_PATH)")
    return [program, str(Path(__file__).parent / "read_mcap.cjs")]


def environment() -> dict[str, str]:
    if "NODE_PATH" in os.environ or not (npm := shutil.which("npm")):
        return dict(os.environ)
    done = subprocess.run([npm, "root", "-g"], capture_output=True, text=True, check=False)
    return {**os.environ, "NODE_PATH": done.stdout.strip()}


def test_the_formats_own_reader_decodes_every_message(tmp_path: Path, node: list[str]) -> None:
    """Every CRC holds, every message is what its schema says, and all are as many as our reader sees."""
    messages = decode(write(tmp_path / "r.mcap"))
    done = subprocess.run(
        [*node, str(tmp_path / "r.mcap")], capture_output=True, text=True, check=False, env=environment()
    )
    assert done.returncode == 0, done.stderr
    found: dict[str, Any] = json.loads(done.stdout)
    assert found["done"]
    assert found["streamed"]["DataEnd"] == found["streamed"]["Footer"] == 1
    assert json.loads(found["metadata"]["vplog"]["inputs"]) == SHOWN.about["inputs"]
    assert json.loads(found["metadata"]["vplog"]["settings"]) == METADATA.settings
    assert sorted(found["attachments"]) == ["reference-0.jpg", "reference-1.jpg"]
    for topic, told in found["topics"].items():
        mine = of(messages, topic)
        assert [int(stamp) for stamp in told["stamps"]] == [time for time, _ in mine]
        kind = TOPICS[topic.replace(camera_topic(CAMERA), "/cam/NAME")][0]
        assert told["schema"] == kind
    last = found["topics"][f"{camera_topic(CAMERA)}/image"]["last"]
    assert (base64.b64decode(last["data"]), last["format"]) == (picture(COUNT - 1), "jpeg")
    transform = found["topics"]["/tf"]["last"]["transforms"][0]
    assert transform["translation"]["x"] == pytest.approx(RUN.solution.world_from_body[-1, 0, 3])
    assert len(found["topics"]["/loop_closures"]["stamps"]) == len(RUN.closures)


@pytest.mark.skipif(importlib.util.find_spec("rerun_cli") is None, reason="rerun-sdk is not installed")
def test_rerun_converts_the_whole_picture_and_finds_no_fault(tmp_path: Path) -> None:
    write(tmp_path / "r.mcap")
    rerun(tmp_path, "mcap", "convert", "r.mcap", "-o", "r.rrd")
    rerun(tmp_path, "rrd", "verify", "r.rrd")
    chunks = rerun(tmp_path, "rrd", "print", "r.rrd").splitlines()
    topic = camera_topic(CAMERA)
    for entity, rows, component in (
        (f"{topic}/image", COUNT, "EncodedImage:blob"),
        (f"{topic}/calibration", COUNT, "Pinhole:image_from_camera"),
        (f"{topic}/annotations", COUNT - 1, "foxglove.ImageAnnotations:message"),
        ("/reference/image", 1 + COUNT - 1, "EncodedImage:blob"),
        ("/closures/picture", 1 + 2, "EncodedImage:blob"),
        ("/closures/calibration", 1, "Pinhole:image_from_camera"),
        ("/reference/calibration", 1, "Pinhole:image_from_camera"),
        ("/gps", COUNT // 3, "GeoPoints:positions"),
        ("/tf", COUNT, "Transform3D:translation"),
    ):
        found = [int(c.split("with ")[1].split()[0]) for c in chunks if f"- {entity} -" in c and component in c]
        assert sum(found) == rows, entity


def test_the_cameras_of_a_rig_come_back_by_number(tmp_path: Path) -> None:
    behind = se3.pose(np.diag([-1.0, -1.0, 1.0]), np.array([0.1, 0.2, 0.3]))
    write(tmp_path / "r.mcap", replace(SHOWN, further_cameras=[behind]))
    found = mcap_read.read_camera_poses(tmp_path / "r.mcap")
    np.testing.assert_allclose(found, [CAMERA.body_from_camera, behind], atol=1e-9)


def test_a_way_across_the_antimeridian_does_not_go_around_the_earth() -> None:
    earth = Earth((-17.0, 179.9999, 0.0), np.eye(4))
    poses = se3.pose(np.eye(3), np.array([[0.0, 0.0, 0.0], [100.0, 0.0, 0.0]]))
    tree = geo.feature_collection(earth, poses, np.array([0, 1]), RUN.closures.rows(np.zeros(0, np.int64)))
    (first, second) = tree["features"][0]["geometry"]["coordinates"]
    assert 0.0 < second[0] - first[0] < 0.01


def test_a_run_without_metres_lies_on_earth_by_a_similarity() -> None:
    poses = RUN.solution.world_from_body
    trajectory = Trajectory(RUN.keyframes.stamp_ns, poses)
    enu = 3.0 * poses[:, :3, 3]
    where = geo.on_earth(Earth((49.0, 8.0, 100.0), np.eye(4)), se3.pose(np.eye(3), enu))
    unknown = np.full((len(enu), 3, 3), np.nan)
    fixes = Gps(trajectory.stamp_ns, where[:, 1], where[:, 0], where[:, 2], unknown)
    mount = se3.pose(np.eye(3), np.array([1.5, 0.0, 1.0]))  # in metres, while the camera's path is in the unit
    own = poses @ se3.inverse(mount)
    earth = earth_of(Trajectory(trajectory.stamp_ns, own), fixes, None, mount)
    earth = earth_from_record(earth_record(earth, own))
    assert earth is not None
    np.testing.assert_allclose(geo.on_earth(earth, own), where, atol=1e-5)
    ahead = np.array([100.0, 0.0, 0.0])  # of the antenna
    there = geo.on_earth(Earth((49.0, 8.0, 100.0), np.eye(4)), poses @ se3.pose(np.eye(3), ahead))
    placed = Gps(trajectory.stamp_ns, there[:, 1], there[:, 0], there[:, 2], unknown, ahead)
    earth = earth_of(trajectory, placed, None)
    assert earth is not None
    body = geo.on_earth(Earth((49.0, 8.0, 100.0), np.eye(4)), poses)
    np.testing.assert_allclose(geo.on_earth(earth, poses)[:, :2], body[:, :2], atol=1e-6)
    still = np.zeros(len(enu))
    frozen = replace(fixes, latitude_deg=still, longitude_deg=still, altitude_m=still)
    assert earth_of(trajectory, frozen, None, np.eye(4)) is None


def test_the_antenna_comes_back_with_its_fixes(tmp_path: Path) -> None:
    write(tmp_path / "r.mcap", replace(SHOWN, gps=replace(GPS, antenna_m=np.array([1.0, 2.0, 3.0]))))
    for found in (mcap_read.read_fixes(tmp_path / "r.mcap"), mcap_read.read_pictures(tmp_path / "r.mcap").gps):
        assert found is not None
        np.testing.assert_array_equal(found.antenna_m, [1.0, 2.0, 3.0])


def test_points_far_from_the_origin_are_told_to_the_millimetre() -> None:
    """As in UTM, whose northings have seven digits."""
    far = se3.pose(np.eye(3), np.array([[500_123.4567, 5_432_109.8765, 123.4], [500_124.5678, 5_432_111.2345, 123.5]]))
    message = foxglove.points(0, far, foxglove.GREY)
    origin = message.pose.position
    stored = np.frombuffer(message.data, np.dtype([("position", "<f4", 3), ("color", "u1", 4)]))["position"]
    np.testing.assert_allclose(stored + np.array([origin.x, origin.y, origin.z]), far[:, :3, 3], atol=1e-3)
