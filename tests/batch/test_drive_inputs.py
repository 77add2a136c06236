"""What a batch takes for drives: folders, patterns, lists, manifests, here and in a bucket."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tests.maps.bucket import serving
from vplog.batch.drive_inputs import _beside, drive_inputs
from vplog.batch.plan import with_topics
from vplog.errors import LogError, ResultError, SettingsError
from vplog.logs import TopicChoice
from vplog.storage.remote_path import RemotePath, located, send

if TYPE_CHECKING:
    from collections.abc import Iterator

NAMES = (
    "a/one.mcap", "a/two.bag", "a/.hidden.mcap", "b/bag/metadata.yaml", "b/bag/bag_0.mcap", "b/run/run.json",
    "b/run/result.mcap", "split/x_0.mcap", "split/x_1.mcap", "ten/d10.mcap.zst", "ten/d9.mcap", "notes.txt",
)  # fmt: skip
LOGS = ["a/one.mcap", "a/two.bag", "b/bag", "split", "ten/d9.mcap", "ten/d10.mcap.zst"]
"""Drives among these files, in order."""


@pytest.fixture
def fleet(tmp_path: Path) -> Path:
    for name in NAMES:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    return tmp_path


def found(*places: Path) -> list[str]:
    return [str(one.log) for one in drive_inputs(places)]


def test_folders_patterns_and_lists(fleet: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    here = [str(fleet / name) for name in LOGS]
    assert found(fleet) == here
    assert found(fleet / "split") == [str(fleet / "split")], "one drive in parts"
    assert found(fleet / "gone.mcap") == [str(fleet / "gone.mcap")], "its own run says so"
    assert found(fleet / "**" / "*_0.mcap") == [str(fleet / "b/bag/bag_0.mcap"), str(fleet / "split/x_0.mcap")]
    listed = fleet / "list.txt"
    listed.write_text("# drives\n\nten\na/*.bag\ns3://bucket/far.mcap\n")
    expected = [*here[-2:], str(fleet / "a/two.bag"), "s3://bucket/far.mcap"]
    assert found(Path(f"@{listed}")) == expected
    with pytest.raises(LogError, match="No log matches"):
        found(fleet / "*.db3")
    with pytest.raises(SettingsError, match=r"Cannot read the list of logs gone.txt"):
        found(Path("@gone.txt"))


def test_a_prefix_of_a_bucket(fleet: Path) -> None:
    with serving():
        for name in NAMES:
            send(RemotePath(f"s3://bucket/fleet/{name}"), fleet / name)
        (fleet / "drives.csv").write_text("log,vehicle\na/one.mcap,v1\ns3://other/x.mcap,v2\n")
        send(RemotePath("s3://bucket/fleet/drives.csv"), fleet / "drives.csv")
        assert found(located("s3://bucket/fleet/")) == [f"s3://bucket/fleet/{name}" for name in LOGS]
        assert found(located("s3://bucket/fleet/*/two.bag")) == ["s3://bucket/fleet/a/two.bag"]
        assert found(located("s3://bucket/fl*/**/bag")) == ["s3://bucket/fleet/b/bag"]
        assert found(located("s3://bucket/fleet/drives.csv")) == ["s3://bucket/fleet/a/one.mcap", "s3://other/x.mcap"]
        with pytest.raises(LogError, match=r"No log matches s3://bucket/fleet/\*.bag"):
            found(located("s3://bucket/fleet/*.bag"))
        send(RemotePath("s3://bucket/fleet") / "50%20.mcap", fleet / "notes.txt")
        assert found(located("s3://bucket/fleet/*.mcap")) == ["s3://bucket/fleet/50%2520.mcap"]
        files = [f"s3://bucket/fleet/{name}" for name in ("50%2520.mcap", "drives.csv", "notes.txt")]
        assert set(found(located("s3://bucket/fleet/*"))) == {*files, *(f"s3://bucket/fleet/{name}" for name in LOGS)}


@pytest.mark.parametrize("name", ["b", "lost+found"])
def test_a_folder_that_cannot_be_read_fails_alone(name: str, fleet: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    iterdir, closed = Path.iterdir, fleet / name

    def refused(path: Path) -> Iterator[Path]:
        if path == closed:
            raise PermissionError(13, "Permission denied", str(path))
        return iterdir(path)

    closed.mkdir(exist_ok=True)
    monkeypatch.setattr(Path, "iterdir", refused)
    logs = [*LOGS[:2], "b", *LOGS[3:]] if name == "b" else LOGS
    assert found(fleet) == [str(fleet / name) for name in logs]


def test_the_image_topic_of_a_row_stands_without_other_cameras(tmp_path: Path) -> None:
    (tmp_path / "drives.csv").write_text("log,image_topic\na.mcap,/front\nb.mcap,\n")
    drives = with_topics(drive_inputs([tmp_path / "drives.csv"]), TopicChoice(image="/left", cameras=("/right",)))
    assert [(one.topics.image, one.topics.cameras) for one in drives] == [("/front", None), ("/left", ("/right",))]


def test_a_manifest_has_topics_truth_and_tags_of_each_drive(tmp_path: Path) -> None:
    header = ("log", "name", "odometry", "calibration", "start", "truth", "weather")
    cells = (
        ("a.mcap", "monday", "/odom", "c.yaml", "1.5", "t.tum", "rain"),
        ("/logs/b.mcap", None, None, None, None, "gps", None),
    )
    rows = [dict(zip(header, row, strict=True)) for row in cells]
    pq.write_table(pa.Table.from_pylist(rows), tmp_path / "drives.parquet")
    lines = [",".join(one or "" for one in row) for row in (header, *cells)]
    (tmp_path / "drives.csv").write_text("\n".join(lines))
    first, second = drive_inputs([tmp_path / "drives.csv"])
    assert [first, second] == drive_inputs([tmp_path / "drives.parquet"])
    assert (first.log, first.name) == (tmp_path / "a.mcap", "monday")
    own = {"odometry": "/odom", "calibration_file": tmp_path / "c.yaml", "start_s": 1.5}
    assert first.topics.model_dump(exclude_unset=True) == own
    common = TopicChoice(odometry="twist", image="/left")
    assert [one.topics.odometry for one in with_topics([first, second], common)] == ["/odom", "twist"]
    assert with_topics([first], common)[0].topics.image == "/left"
    assert first.about == {"tags": {"weather": "rain"}, "truth": str(tmp_path / "t.tum")}
    assert (second.log, second.name, second.topics) == (Path("/logs/b.mcap"), "", TopicChoice())
    assert second.about == {"tags": {}, "truth": "gps"}


@pytest.mark.parametrize(
    ("text", "wrong"),
    [
        ("log,start\na,\nb,soon\n", "drives.csv:3, column start: start_s must be a number"),
        ("log,start\na,1\n,2\n", "drives.csv:3, column log: is empty"),
        ("log,name\na,x\nb,x\n", "drives.csv:2, column name: 'x' is that of another drive"),
        (
            "log,mask\na,s3://bucket/mask.png\n",
            "drives.csv:2, column mask: s3://bucket/mask.png is not on",
        ),
        ("log,tag,tag\na,x,y\n", "drives.csv: column 'tag' has no name, or that of another"),
        ("path\na\n", "drives.csv has no column log"),
        ("log,tag\na\n", "drives.csv:2 does not hold 2 fields"),
    ],
)
def test_one_line_says_what_is_wrong_in_a_manifest(text: str, wrong: str, tmp_path: Path) -> None:
    (tmp_path / "drives.csv").write_text(text)
    with pytest.raises(SettingsError) as error:
        drive_inputs([tmp_path / "drives.csv"])
    assert wrong in str(error.value)
    (tmp_path / "drives.parquet").write_bytes(b"PAR1 no")
    with pytest.raises(ResultError, match=r"drives.parquet cannot be read"):
        drive_inputs([tmp_path / "drives.parquet"])


def test_a_list_of_a_server_names_no_file_of_this_machine(tmp_path: Path) -> None:
    remote: Any = RemotePath("https://example.org/fleet/drives.csv")
    assert str(_beside(remote, "a.mcap")) == "https://example.org/fleet/a.mcap"
    with pytest.raises(SettingsError, match="a file of this machine"):
        _beside(remote, str(tmp_path / "private.mcap"))
    assert _beside(tmp_path / "drives.csv", "/logs/a.mcap") == Path("/logs/a.mcap")
