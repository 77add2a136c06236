"""Several cameras on one body: the rear one recognises on the way back what the front one saw."""

from __future__ import annotations

import base64
import json
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from tests.graph.drive import ledger
from tests.logs.drives import store
from vplog import logs
from vplog.data import Keyframes, Odometry, Verdict
from vplog.errors import LogError
from vplog.geometry import se3
from vplog.geometry.tum import read_tum
from vplog.logs.formats.container import Channel, Notes
from vplog.logs.topic_selection import Candidate, Selection, TopicChoice, further_cameras
from vplog.loops.propose import Proposals
from vplog.pipeline import load_pipeline, run
from vplog.results import tables
from vplog.results.mcap_read import read_pictures
from vplog.results.run_cameras import CameraPictures
from vplog.results.run_record import read_run_json, write_run_json
from vplog.run import cameras
from vplog.run.keyframes import KeyframeSettings
from vplog.verbs.demo import SMALL, make_drive
from vplog.verbs.demo.record import IMAGE, REAR, TYPES

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from tests.conftest import Said

RIG = SMALL.model_copy(
    update={"laps": 1.05, "frame_rate_hz": 2.0, "width": 320, "height": 180, "rear_camera": True, "turn_back_m": 34.0}
)
QUICK = (
    "--set", "propose.per_query=2", "--set", "features.max_features=500", "--set", "pictures.closures=2",
    "--set", "propose.gap_steps=8", "--set", "places.neighbours=8", "--set", "verify.calibration.pairs=0",
)  # fmt: skip


@pytest.fixture(scope="module")
def rig(made_once: Callable[..., Path]) -> Path:
    """A drive out and back, with cameras ahead and behind."""
    return made_once("rig", lambda folder: make_drive(folder, RIG))


def test_the_rear_camera_closes_the_way_back(rig: Path, verb: Callable[..., Said], tmp_path: Path) -> None:
    out, log = tmp_path / "run", rig / "drive.mcap"
    found = verb("run", log, "-o", out, "--json", *QUICK).json
    assert found["cameras"] == [IMAGE, REAR]
    closures = tables.read_closures(out / "closures.parquet")
    used = closures.of(Verdict.ACCEPTED)
    assert used.sum() >= 4
    assert (closures.query_camera + closures.match_camera)[used].tolist() == [1] * used.sum()
    keyframes, _ = tables.read_keyframes(out / "keyframes.parquet")
    poses = se3.interpolate_at(*read_tum(rig / "truth.tum", LogError, ""), keyframes.stamp_ns)
    true = se3.between(poses[closures.match[used]], poses[closures.query[used]])
    off = se3.log(se3.between(true, closures.match_from_query[used]))
    assert np.median(np.linalg.norm(off[:, 3:], axis=1)) < 0.02  # by one camera alone 0.04 m and 0.2 degrees
    assert np.median(np.linalg.norm(off[:, :3], axis=1)) < np.radians(0.1)
    pairs = list(zip(closures.query.tolist(), closures.match.tolist(), strict=True))
    assert len(set(pairs)) == len(pairs)
    thumbnails = read_pictures(out / "result.mcap").thumbnails
    rear = np.where(closures.query_camera == 1, closures.query, closures.match)[used]
    assert {(1, row) for row in rear.tolist()} <= thumbnails.keys()
    page = (out / "report.html").read_text()
    assert all(base64.b64encode(jpeg).decode() in page for jpeg in thumbnails.values())
    judged = verb("evaluate", out, "--truth", rig / "truth.tum", "--json").json
    assert judged["closures"]["accepted_false"] == 0
    assert judged["closures"]["place_precision"] == 1.0
    assert judged["closures"]["recall"] > 0.0
    assert judged["ate_after"]["rmse_m"] < 0.5 * judged["ate_before"]["rmse_m"]
    shown = verb("explain", out, "--closure", int(np.flatnonzero(used)[0]), "--json").json["picture"]
    assert shown["agree"] >= 20
    assert shown["references"]
    check_exports(out, verb, tmp_path)
    again = verb("run", log, "-o", out, "--json", *QUICK, "--set", "gps.use=false").json
    assert again["stages"]["extract"]["parts_reused"] == again["stages"]["extract"]["parts"]
    assert again["graph_sha256"] == found["graph_sha256"]


def check_exports(run: Path, verb: Callable[..., Said], folder: Path) -> None:
    """Both cameras' pictures, each with its own model, and points that both saw."""
    for kind in ("colmap", "nerfstudio"):
        assert verb("export", run, "--format", kind, "-o", folder / kind).code == 0
    sparse = folder / "colmap" / "sparse" / "0"
    assert [line[:2] for line in (sparse / "cameras.txt").read_text().splitlines()] == ["1 ", "2 "]
    camera_of = {line.split()[0]: line.split()[8] for line in (sparse / "images.txt").read_text().splitlines()[::2]}
    tracks = [line.split()[8::2] for line in (sparse / "points3D.txt").read_text().splitlines()]
    assert sum(len({camera_of[image] for image in track}) == 2 for track in tracks) > 100
    tree = json.loads((folder / "nerfstudio" / "transforms.json").read_text())
    assert "fl_x" not in tree
    assert len({(folder / "nerfstudio" / frame["file_path"]).parent for frame in tree["frames"]}) == 2
    assert all(frame["fl_x"] > 0 for frame in tree["frames"])
    # a picture of the rear camera that was not described, as it is damaged in the log, is not read again
    described, record = run / "descriptors.parquet", read_run_json(run / "run.json")
    before, kept = described.read_bytes(), np.arange(len(tables.read_stamps(described)) - 1)
    column, made_by = tables.read_descriptors(described)
    tables.write_some_descriptors(described, described, kept, column, made_by)
    assert verb("export", run, "--format", "colmap", "-o", folder / "colmap").code == 0
    assert len((sparse / "images.txt").read_text().splitlines()) == 2 * len(kept)
    described.write_bytes(before)
    rear = record["calibrations"][1]
    fisheye = {**record, "calibrations": [record["calibrations"][0], rear | {"distortion_model": "equidistant"}]}
    write_run_json(run / "run.json", fisheye)
    said = verb("export", run, "--format", "nerfstudio", "-o", folder / "fisheye")
    assert "some are fisheyes" in said.error
    assert not list(folder.glob("*fisheye*"))
    unknown = {**record, "calibrations": [record["calibrations"][0], rear | {"matrix": None}]}
    write_run_json(run / "run.json", unknown)
    said = verb("export", run, "--format", "colmap", "-o", folder / "colmap")
    assert (said.code, f"Camera {REAR} is not calibrated" in said.err) == (0, True)
    assert [line[:2] for line in (sparse / "cameras.txt").read_text().splitlines()] == ["1 "]
    write_run_json(run / "run.json", record)


def test_one_camera_that_is_chosen_is_alone(rig: Path, verb: Callable[..., Said], tmp_path: Path) -> None:
    used = {t["name"] for t in verb("info", rig / "drive.mcap", "--json").json["topics"] if t["part"] == "image"}
    assert used == {IMAGE, REAR}
    named = ("run", rig / "drive.mcap", "-o", tmp_path / "run", "--json", *QUICK, "--image-topic", IMAGE)
    assert REAR in verb(*named, "--image-topic", "/raer/image_raw").error
    found = verb(*named).json
    assert found["cameras"] == [IMAGE]
    assert "accepted" not in found["counts"]["verdicts"]


def test_a_camera_that_cannot_be_used_is_left_out_with_a_line(
    rig: Path, verb: Callable[..., Said], tmp_path: Path
) -> None:
    mask = tmp_path / "mask.png"
    mask.write_bytes(b"no image")
    request = ("run", rig / "drive.mcap", "-o", tmp_path / "run", "--mask", f"{REAR}={mask}", *QUICK)
    said = verb(*request)
    assert said.code == 0
    record = read_run_json(tmp_path / "run" / "run.json")
    assert record["cameras"] == [IMAGE]
    assert any(REAR in line and "mask" in line for line in record["warnings"])


def test_vectors_of_a_file_are_those_of_the_first_camera(rig: Path, tmp_path: Path) -> None:
    """Both cameras have as many frames, at the same stamps."""
    frames = len(logs.open(rig / "drive.mcap").stamps())
    np.save(tmp_path / "own.npy", np.random.default_rng(0).standard_normal((frames, 8)).astype(np.float32))
    quick = [one for one in QUICK if one != "--set" and "neighbours" not in one]
    places = ("places.kind=vectors", f"places.file={tmp_path / 'own.npy'}")
    done = run(rig / "drive.mcap", tmp_path / "run", load_pipeline("default", [*quick, *places]))
    assert done.record["cameras"] == [IMAGE]
    assert any(REAR in line and "vectors" in line for line in done.record["warnings"])


def candidate(name: str, role: str = "image", **more: Any) -> Candidate:
    return Candidate(Channel(f"/{name}", "", ""), 10, role, **more)


def test_further_cameras_are_calibrated_and_have_frames_of_their_own() -> None:
    images = ["front/image", "front/image_small", "left/image", "right/image", "rear/image", "dark/image", "top/image"]
    frames = ["front", "front", "left", "right", "rear", "dark", ""]
    found = [candidate(name, frame=frame) for name, frame in zip(images, frames, strict=True)]
    known = ("front", "left", "right", "rear", "top")
    found += [candidate(f"{name}/camera_info", "camera_info", calibrated=True) for name in known]
    found += [candidate("dark/camera_info", "camera_info")]
    front = Selection(image=found[0].channel)
    found += [candidate("low/image", frame="front"), candidate("low/camera_info", "camera_info", calibrated=True)]
    beside = further_cameras(found, front, TopicChoice(), notes := Notes())
    others = {one.channel.topic: left and left.channel.topic for one, left in beside}
    assert others == {"/left/image": None, "/right/image": "/left/image", "/rear/image": None}
    low, top = notes.lines
    assert low.startswith("/low/image is calibrated but not used: it has the frame_id front of another camera.")
    assert top.startswith("/top/image is calibrated but not used: it has no frame_id.")
    for choice in (TopicChoice(mask="/left/image"), TopicChoice(mask_topics={"/rear/image": "/left/image"})):
        assert "/left/image" not in [one.channel.topic for one, _ in further_cameras(found, front, choice, Notes())]


def poses_of(rng: np.random.Generator, count: int) -> np.ndarray:
    return se3.exp(rng.normal(size=(count, 6)))


def test_pictures_are_the_nearest_of_a_keyframe_and_none_is_far() -> None:
    rng = np.random.default_rng(2)
    odometry = Odometry(np.arange(0, 1001, 10), poses_of(rng, 101), None)
    keyframes = Keyframes("drive", np.array([100, 203, 300, 480, 700]), poses_of(rng, 5))
    stamps = np.array([90, 112, 200, 206, 290, 360, 430, 950, 1020])
    row, pictures = cameras.pictures_at(keyframes, stamps, odometry, KeyframeSettings())
    assert pictures.stamp_ns.tolist() == [90, 200, 290, 430]
    assert row.tolist() == [0, 1, 2, 3]
    assert np.allclose(pictures.odom_from_body, odometry.odom_from_body[[9, 20, 29, 43]])
    with pytest.raises(LogError, match="near the stamp"):
        cameras.pictures_at(keyframes, np.array([0, 10, 20]), odometry, KeyframeSettings())


def test_a_picture_is_of_the_nearest_of_several_keyframes_and_has_odometry() -> None:
    odometry = Odometry(np.delete(np.arange(0, 1001, 10), np.s_[70:80]), np.tile(np.eye(4), (91, 1, 1)), None)
    stamp_ns, settings = np.array([60, 130, 160, 260, 540, 740, 940]), KeyframeSettings(max_odometry_gap_s=5e-8)
    keyframes = Keyframes("drive", stamp_ns, np.tile(np.eye(4), (7, 1, 1)))
    row, pictures = cameras.pictures_at(keyframes, np.arange(150, 1000, 200), odometry, settings)
    assert row.tolist() == [2, 3, 4, 6]
    assert pictures.stamp_ns.tolist() == [150, 350, 550, 950]


def test_a_closure_of_pictures_is_carried_to_the_keyframes() -> None:
    """With exact odometry the true closure of two pictures is that of their keyframes, and as many sigmas from any
    other pose as before."""
    rng = np.random.default_rng(3)
    world_from_keyframe, world_from_picture = poses_of(rng, 4), poses_of(rng, 4)
    keyframes, pictures = (
        Keyframes("drive", np.arange(4), poses) for poses in (world_from_keyframe, world_from_picture)
    )
    query, match, row = np.array([3, 2]), np.array([0, 1]), np.arange(4)
    found = ledger(query, match, se3.between(world_from_picture[match], world_from_picture[query]))
    square = rng.normal(size=(2, 6, 6))
    found = replace(found, information=square @ np.swapaxes(square, 1, 2) + np.eye(6))
    both = [CameraPictures(row, pictures)] * 2, (1, 2), [keyframes] * 2
    carried = cameras.of_keyframes(found, *both)
    true = se3.between(world_from_keyframe[match], world_from_keyframe[query])
    assert np.allclose(carried.match_from_query, true)
    assert (carried.query_camera.tolist(), carried.match_camera.tolist()) == ([1, 1], [2, 2])
    moved = replace(found, match_from_query=found.match_from_query @ se3.exp(rng.normal(size=(2, 6)) * 1e-4))
    sigmas = []
    for one, at in (
        (moved, found.match_from_query),
        (cameras.of_keyframes(moved, *both), true),
    ):
        error = se3.log(se3.between(at, one.match_from_query))
        sigmas.append(
            np.einsum("ki,kij,kj->k", error, carried.information if one is not moved else found.information, error)
        )
    assert np.allclose(*sigmas)


def test_of_each_query_the_best_candidates_of_all_cameras_are_verified() -> None:
    def found(query: list[int], score: list[float]) -> Proposals:
        count = len(query)
        return Proposals(
            np.array(query, np.int32), np.arange(count, dtype=np.int32), np.zeros(count, np.int32),
            np.array(score, np.float32), np.zeros(count, np.int32),
        )  # fmt: skip

    best = cameras.best_together({1: found([4, 4, 5], [0.9, 0.2, 0.1]), 2: found([4, 5, 5], [0.5, 0.3, 0.2])}, 2)
    assert {m: list(zip(one.query.tolist(), one.match.tolist(), strict=True)) for m, one in best.items()} == {
        1: [(4, 0)],
        2: [(4, 0), (5, 1), (5, 2)],
    }


def test_a_pair_of_keyframes_is_once_in_the_ledger_as_the_cameras_that_agree_best_have_it() -> None:
    found = ledger(np.array([5, 5, 4, 5, 5]), np.array([1, 1, 0, 1, 2]), np.tile(np.eye(4), (5, 1, 1)))
    verdicts = [Verdict.ACCEPTED, Verdict.TOO_FAR, Verdict.TOO_FAR, Verdict.ACCEPTED, Verdict.ACCEPTED]
    inliers, number = np.array([30, 90, 10, 40, 20], np.int32), np.arange(5, dtype=np.int32)
    found = replace(found, verdict=verdicts, inliers=inliers, query_camera=number)
    assert cameras.once([found]).query_camera.tolist() == [2, 3, 4]
    verdicts = [Verdict.TOO_FEW_INLIERS, Verdict.NO_CALIBRATION, *verdicts[2:]]
    assert cameras.once([replace(found.rows(number[:2].astype(np.int64)), verdict=verdicts[:2])]).query_camera == [0]
    assert len(cameras.once([found.rows(number[:0].astype(np.int64))])) == 0


MASKS = "/rear/mask/compressed"


@pytest.fixture(scope="module")
def masked(rig: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The drive with a topic of masks of the rear camera, of the sides of each of its images."""
    log = tmp_path_factory.mktemp("masked") / "drive.mcap"
    used = np.zeros((RIG.height, RIG.width), np.uint8)
    used[:, 40:-40] = 1
    png, channels = cv2.imencode(".png", used)[1].ravel(), dict[str, int]()
    with (rig / "drive.mcap").open("rb") as stream, log.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2")
        for schema, channel, message in make_reader(stream).iter_messages():
            several = [(channel.topic, message.data)]
            if channel.topic == REAR:
                image: Any = store(2).deserialize_cdr(message.data, TYPES[REAR])
                image.data, image.format = png, "mono8; png compressed"
                several.append((MASKS, bytes(store(2).serialize_cdr(image, TYPES[REAR]))))
            for topic, data in several:
                if topic not in channels:
                    known = writer.register_schema(schema.name, schema.encoding, schema.data) if schema else 0
                    channels[topic] = writer.register_channel(topic, channel.message_encoding, known)
                writer.add_message(channels[topic], message.log_time, data, message.publish_time)
        writer.finish()
    return log


def masks_of(log: Path, choice: TopicChoice) -> np.ndarray:
    """Share of the images in which each px counts."""
    opened = logs.open(log, choice)
    frames = [one.decode() for one in opened.frames(opened.stamps())]
    return np.mean([np.ones(one.image.shape) if one.mask is None else one.mask for one in frames], axis=0)


def test_every_camera_has_a_mask_of_its_own(masked: Path, tmp_path: Path) -> None:
    sides, upper = np.zeros((2, RIG.height, RIG.width), np.uint8)
    sides[:, 40:-40], upper[:100] = 1, 1
    for name, used in (("front", upper), ("rear", sides)):
        cv2.imwrite(str(tmp_path / f"{name}.png"), 255 * used)
    files = {IMAGE: tmp_path / "front.png", REAR: tmp_path / "rear.png"}
    for choice in (
        TopicChoice(masks=files),
        TopicChoice(masks={"": files[IMAGE]}, mask_topics={REAR: MASKS}),
        TopicChoice(masks={IMAGE: files[IMAGE]}, mask_topics={REAR: MASKS}),
    ):
        assert (masks_of(masked, choice) == upper).all()
        assert (masks_of(masked, choice.of_camera(REAR)) == sides).all()
        assert logs.open(masked, choice).further_cameras() == [REAR]
    assert (masks_of(masked, TopicChoice(image=REAR, mask_topics={REAR: MASKS})) == sides).all()
    with pytest.raises(LogError, match="no topic /rear/msk"):
        logs.open(masked, TopicChoice(mask_topics={REAR: "/rear/msk"}))


def test_start_and_stop_are_by_the_images_of_the_first_camera(rig: Path) -> None:
    """Further cameras, which may begin earlier or later, have the pictures near its keyframes."""
    choice = TopicChoice(start_s=2.0, stop_s=4.0)
    whole, some = (logs.open(rig / "drive.mcap", one) for one in (TopicChoice(), choice))
    assert len(some.stamps()) < len(whole.stamps())
    rear = logs.open(rig / "drive.mcap", choice.of_camera(REAR))
    assert len(rear.stamps()) == len(whole.stamps())


def test_masks_of_several_cameras_on_the_command_line(masked: Path, verb: Callable[..., Said], tmp_path: Path) -> None:
    mask = tmp_path / "mask.png"
    cv2.imwrite(str(mask), np.full((RIG.height, RIG.width), 255, np.uint8))
    request = ("run", masked, "-o", tmp_path / "run", "--json", *QUICK, "--mask", f"{IMAGE}={mask}")
    plain = verb(*request).json
    found = verb(*request, "--mask-topic", f"{REAR}={MASKS}").json
    assert found["cameras"] == plain["cameras"] == [IMAGE, REAR]
    assert found["topics"]["mask_topics"] == {REAR: MASKS}
    parts = found["stages"]["extract"]
    assert (parts["parts"], parts["parts_reused"]) == (2, 1)
    assert found["graph_sha256"] != plain["graph_sha256"]
    about = verb("info", masked, "--mask-topic", f"{REAR}={MASKS}").out
    assert f"--mask-topic {REAR}={MASKS}" in about
