"""Maps and `localize` hold the pictures of every camera: what one ahead sees the rear one of a drive back has seen."""

from __future__ import annotations

import shutil
from typing import TYPE_CHECKING

import numpy as np
import pyarrow.parquet as pq
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

import vplog
from vplog import logs
from vplog.errors import LogError, ResultError
from vplog.geometry import se3
from vplog.geometry.tum import read_tum
from vplog.results import tables
from vplog.verbs.demo import SMALL, make_drive
from vplog.verbs.demo.record import IMAGE, REAR

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path
    from typing import Any

    from tests.conftest import Said
    from vplog.data import Floats

RIG = SMALL.model_copy(
    update={
        "laps": 1.3, "frame_rate_hz": 2.0, "width": 320, "height": 180, "rear_camera": True, "turn_back_m": 45.0,
        "odometry_yaw_bias_rad_s": 0.005,
    }
)  # fmt: skip
SETTINGS = [
    "propose.per_query=2", "features.max_features=500", "pictures.closures=0", "places.neighbours=8",
    "verify.calibration.pairs=0",
]  # fmt: skip


def cut(log: Path, out: Path, begin_ns: int, end_ns: int) -> None:
    """The messages of a stretch of time, and all static transforms."""
    channels = dict[str, int]()
    with log.open("rb") as stream, out.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2")
        for schema, channel, message in make_reader(stream).iter_messages():
            static = channel.topic == "/tf_static"
            if schema is None or not (static or begin_ns <= message.log_time < end_ns):
                continue
            if channel.topic not in channels:
                known = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.topic] = writer.register_channel(channel.topic, channel.message_encoding, known)
            writer.add_message(
                channels[channel.topic], max(message.log_time, begin_ns), message.data, message.publish_time
            )
        writer.finish()


@pytest.fixture(scope="module")
def both(made_once: Callable[..., Path]) -> Path:
    """A drive ahead and one back the same way, as logs of their own with two cameras each, and their truth."""

    def fill(folder: Path) -> None:
        make_drive(folder, RIG)
        with (folder / "drive.mcap").open("rb") as stream:
            summary: Any = make_reader(stream).get_summary()
        turn_ns = summary.statistics.message_start_time + int(45.0 / RIG.speed_m_s * 1e9)
        cut(folder / "drive.mcap", folder / "ahead.mcap", 0, turn_ns - 800_000_000)
        cut(folder / "drive.mcap", folder / "back.mcap", turn_ns + 800_000_000, 2**62)

    return made_once("rig_both_ways", fill)


@pytest.fixture(scope="module")
def joined(both: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("rigs") / "map"
    vplog.batch([both / "ahead.mcap", both / "back.mcap"], out, settings=SETTINGS)
    return out


def true_poses(folder: Path, stamp_ns: Any) -> Floats:
    return se3.interpolate_at(*read_tum(folder / "truth.tum", LogError, ""), np.asarray(stamp_ns, np.int64))


def test_a_run_describes_the_pictures_of_every_camera(joined: Path) -> None:
    run = joined / "runs" / "drive=ahead"
    count = len(tables.read_stamps(run / "keyframes.parquet"))
    keyframe, camera = tables.read_pictures(run / "descriptors.parquet")
    assert keyframe[camera == 0].tolist() == list(range(count))
    assert count - 2 <= (camera == 1).sum() <= count
    column, _ = tables.read_descriptors(run / "descriptors.parquet")
    first, _ = tables.read_first_camera(run / "descriptors.parquet")
    assert (len(column), first.to_pylist()) == (len(camera), column.to_pylist()[:count])


def test_drives_both_ways_are_joined_by_cameras_that_look_the_same_way(both: Path, joined: Path) -> None:
    ledgers = tables.read_joins(joined / "joins" / "drive=back" / "match=ahead.parquet")
    [((later, earlier), found)] = ledgers.items()
    used = found.accepted
    assert used.sum() >= 4
    cameras = zip(found.query_camera[used].tolist(), found.match_camera[used].tolist(), strict=True)
    assert set(cameras) <= {(0, 1), (1, 0)}
    stamps = {
        name: tables.read_stamps(joined / "runs" / f"drive={name}" / "keyframes.parquet") for name in (later, earlier)
    }
    query, match = stamps[later][found.query[used]], stamps[earlier][found.match[used]]
    true = se3.between(true_poses(both, match), true_poses(both, query))
    off = np.linalg.norm(se3.log(se3.between(true, found.match_from_query[used]))[:, 3:], axis=1)
    assert np.median(off) < 0.06
    assert (joined / "joins" / "drive=back" / "features-1.parquet").is_file()


@pytest.mark.parametrize("topic", [IMAGE, REAR])
def test_a_picture_is_localised_by_the_camera_that_looked_the_same_way(
    both: Path, joined: Path, verb: Callable[..., Said], topic: str
) -> None:
    run = joined / "runs" / "drive=ahead"
    found = verb("localize", run, both / "back.mcap", "--image-topic", topic, "--json").json
    assert found["localized"] >= 0.5 * found["pictures"]
    body_from_camera = logs.open(both / "back.mcap", logs.TopicChoice(image=topic)).camera().body_from_camera
    keyframes, world_from_body = tables.read_keyframes(run / "keyframes.parquet")
    off = []
    for one in found["answers"]:
        if one["localized"]:
            at, stamps = one["keyframe"], keyframes.stamp_ns
            keyframe, picture = true_poses(both, [stamps[at], one["stamp_ns"]])
            true = world_from_body[at] @ se3.between(keyframe, picture) @ body_from_camera
            pose = se3.from_vectors(np.array([[one[name] for name in tables.POSE_COLUMNS]]))[0]
            off.append(np.linalg.norm(true[:3, 3] - pose[:3, 3]))
    assert np.median(off) < 0.3


def test_a_view_is_answered_by_any_camera(both: Path, joined: Path, verb: Callable[..., Said]) -> None:
    ask = ("map", "query", joined, both / "back.mcap", "--drive", "ahead", "--json", "--sequence")
    run = joined / "runs" / "drive=ahead"
    best = [one for one in verb(*ask, 1).json["answers"] if one["rank"] == 0]
    ends = ([one[name] for one in best] for name in ("query_stamp_ns", "stamp_ns"))
    query, match = (true_poses(both, stamps)[:, :3, 3] for stamps in ends)
    assert np.mean(np.linalg.norm(query - match, axis=1) < 6.0) > 0.6  # by the camera ahead alone as by chance
    found = verb(*ask, 5).json["answers"]
    assert len({(one["query"], one["keyframe"], one["camera"]) for one in found}) == len(found)
    keyframe, camera = tables.read_pictures(run / "descriptors.parquet")
    stamps = tables.read_stamps(run / "descriptors.parquet")
    known = set(zip(keyframe.tolist(), camera.tolist(), stamps.tolist(), strict=True))
    assert {(one["keyframe"], one["camera"], one["stamp_ns"]) for one in found} <= known


def test_a_map_of_an_older_run_has_its_first_camera(joined: Path, verb: Callable[..., Said], both: Path) -> None:
    """Its run.json names several, of which descriptors.parquet has the first."""
    folder = joined.parent / "older"
    shutil.copytree(joined / "runs" / "drive=ahead", folder)
    shutil.rmtree(folder / ".cache", ignore_errors=True)
    path = folder / "descriptors.parquet"
    table = pq.read_table(path)
    first = table.filter(table["camera"].to_numpy() == 0).drop_columns(["camera"])
    pq.write_table(first, path)
    assert tables.read_pictures(path)[1].max() == 0
    found = verb("localize", folder, both / "ahead.mcap", "--json").json
    assert found["localized"] >= 0.8 * found["pictures"]


@pytest.mark.parametrize("camera", [[0, 1, 0], [0, 0, -1], [1, 0, 0]])
def test_cameras_that_do_not_increase_are_refused(joined: Path, camera: list[int], tmp_path: Path) -> None:
    table = pq.read_table(joined / "runs" / "drive=ahead" / "descriptors.parquet").slice(0, 3)
    at = table.schema.get_field_index("camera")
    pq.write_table(
        table.set_column(at, table.schema.field(at), [np.array(camera, np.int32)]), tmp_path / "descriptors.parquet"
    )
    with pytest.raises(ResultError, match="do not increase"):
        tables.read_pictures(tmp_path / "descriptors.parquet")
