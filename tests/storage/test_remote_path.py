"""Logs and results by URL, against a server that speaks S3 and a web server that answers ranges, both on loopback."""

from __future__ import annotations

import json
import threading
from contextlib import contextmanager, nullcontext
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest

from tests.maps.bucket import make_folder, serving
from vplog import logs
from vplog.errors import LibraryError, LogError, ResultError, SettingsError
from vplog.run.provenance import library_at, library_of
from vplog.storage import remote_path
from vplog.storage.remote_path import RemotePath, local_copy, local_output, located, stands_for

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from conftest import Said

    from vplog.verbs.demo.record import Demo

QUICK = [
    f"--set={one}"
    for one in (
        "features.max_features=250", "features.max_megapixels=0.04", "features.min_features=0", "library.size=5",
        "places.neighbours=8", "propose.per_query=2", "propose.gap_keyframes=15", "propose.gap_steps=15",
        "verify.calibration.pairs=0",
    )
]  # fmt: skip
"""With closures on the tiny drive."""


class RangeHandler(SimpleHTTPRequestHandler):
    """Files with byte ranges, as web servers answer them."""

    asked: list[int]

    def do_GET(self) -> None:
        path = self.translate_path(self.path)
        wanted = self.headers.get("Range")
        try:
            with open(path, "rb") as file:  # noqa: PTH123
                data = file.read()
        except OSError:
            self.send_error(404)
            return
        if wanted:
            first, last = (int(part) for part in wanted.removeprefix("bytes=").split("-"))
            self.send_response(206)
            self.send_header("Content-Range", f"bytes {first}-{min(last, len(data) - 1)}/{len(data)}")
            data = data[first : last + 1]
        else:
            self.send_response(200)
        type(self).asked.append(len(data))
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        self.wfile.write(data)

    def log_message(self, format: str, *args: object) -> None:
        pass


@contextmanager
def web(folder: Path) -> Iterator[str]:
    RangeHandler.asked = []
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(RangeHandler, directory=str(folder)))
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}"
    finally:
        server.shutdown()
        server.server_close()


@pytest.fixture(scope="module")
def bucket() -> Iterator[str]:
    """A bucket on a server that speaks S3."""
    with serving():
        yield "s3://bucket"


def put(source: Path, url: str) -> None:
    with local_output(located(url)) as folder:
        folder.mkdir()
        (folder / source.name).write_bytes(source.read_bytes())


def test_a_key_that_may_only_write_writes(bucket: str, drive: Demo, monkeypatch: pytest.MonkeyPatch) -> None:
    """To it nothing is there, neither by name nor by content."""

    def refused(*_: object) -> bool:
        raise PermissionError("answers 403")

    with monkeypatch.context() as patch:
        for name in ("is_file", "stat", "open"):
            patch.setattr(RemotePath, name, refused)
        put(drive.truth, f"{bucket}/only-written")
    assert located(f"{bucket}/only-written/{drive.truth.name}").read_bytes() == drive.truth.read_bytes()


def test_a_small_disk_takes_what_leaves_a_tenth_of_it_free(
    bucket: str, drive: Demo, monkeypatch: pytest.MonkeyPatch
) -> None:
    put(drive.truth, f"{bucket}/small")
    there, size = located(f"{bucket}/small/{drive.truth.name}"), drive.truth.stat().st_size
    for free, fits in ((2 * size, True), (size + size // 20, False)):
        monkeypatch.setattr("shutil.disk_usage", lambda _, free=free: SimpleNamespace(free=free))
        with nullcontext() if fits else pytest.raises(LogError, match="no room"), local_copy(there) as here:
            assert here.read_bytes() == drive.truth.read_bytes()


def test_a_log_on_s3_reads_as_the_file_does(drive: Demo, bucket: str) -> None:
    put(drive.log, f"{bucket}/one")
    there, here = logs.open(located(f"{bucket}/one/drive.mcap")), logs.open(drive.log)
    assert (there.stamps() == here.stamps()).all()
    stamps = here.stamps()[[3, 20]]
    for one, other in zip(there.frames(stamps), here.frames(stamps), strict=True):
        assert (one.decode().image == other.decode().image).all()
    odometry, known = there.odometry(), here.odometry()
    assert odometry is not None
    assert known is not None
    assert len(odometry.stamp_ns) == len(known.stamp_ns)
    assert there.name == "drive"


def test_folders_that_a_console_made_are_no_files(bucket: str) -> None:
    """A folder of images on a store reads as on a disk, with and without the objects that stand for its folders."""
    picture = cv2.imencode(".png", np.random.default_rng(0).integers(0, 255, (120, 160), np.uint8))[1].tobytes()
    place = located(f"{bucket}/console")
    with local_output(place) as folder:
        for number in range(3):
            (folder / "deep" / "cam0").mkdir(parents=True, exist_ok=True)
            (folder / "deep" / "cam0" / f"{number:04}.png").write_bytes(picture)
        (folder / "deep" / "empty").touch()
    for markers in ((), ("console", "console/deep", "console/deep/cam0")):
        for name in markers:
            make_folder(name)
        assert [path.name for path in located(f"{bucket}/console/deep").iterdir()] == ["cam0", "empty"]
        assert [path.name for path in located(f"{bucket}/console").rglob("*")] == [
            "0000.png", "0001.png", "0002.png", "empty",
        ]  # fmt: skip
        log = logs.open(located(f"{bucket}/console"))
        assert [frame.decode().image.shape for frame in log.frames(log.stamps())] == [(120, 160)] * 3
        with local_copy(located(f"{bucket}/console")) as copy:
            assert sorted(file.name for file in copy.rglob("*.png")) == ["0000.png", "0001.png", "0002.png"]
    make_folder("nothing")
    assert not located(f"{bucket}/nothing").exists()


def test_a_run_goes_from_s3_to_s3_and_is_evaluated_there(
    tiny: Demo, drive: Demo, bucket: str, verb: Callable[..., Said]
) -> None:
    put(tiny.log, f"{bucket}/two")
    found = verb("run", f"{bucket}/two/drive.mcap", "-o", f"{bucket}/runs/own", "--threads", 2, "--json", *QUICK).json
    assert found["run"] == f"{bucket}/runs/own"
    assert found["log"] == f"{bucket}/two/drive.mcap"
    assert list(found["inputs"]) == ["drive.mcap"]
    names = {path.name for path in located(f"{bucket}/runs/own").iterdir()}
    assert {"run.json", "result.mcap", "closures.parquet", "trajectory.tum"} <= names
    assert json.loads((located(f"{bucket}/runs/own") / "run.json").read_text())["finished"] is True
    put(tiny.truth, f"{bucket}/two")
    truth = f"{bucket}/two/{tiny.truth.name}"
    assert verb("evaluate", f"{bucket}/runs/own", "--truth", truth, "--json").json["closures"]["keyframes"] > 20
    assert "Cannot read s3://" in verb("evaluate", f"{bucket}/runs/own", "--truth", f"{truth}.not").error
    assert verb("evaluate", f"{bucket}/runs/own", "--truth", "gps", "--json").json["ate_after"]["rmse_m"] > 0
    other = verb("run", drive.log, "-o", f"{bucket}/runs/own", "--threads", 2, *QUICK).error
    assert f"{bucket}/runs/own is the run of" in other
    assert json.loads((located(f"{bucket}/runs/own") / "run.json").read_text())["log"] == found["log"]
    for words in (("ask",), ("report",), ("explain", "--closure", 0)):
        assert "nothing is written beside it" in verb(words[0], f"{bucket}/runs/own", *words[1:]).error


def test_a_web_server_is_asked_for_parts(drive: Demo, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(remote_path, "_BLOCK_BYTES", 1 << 18)
    with web(drive.log.parent) as url:
        log = logs.open(located(f"{url}/drive.mcap"))
        frame = next(log.frames(log.stamps()[-1:]))
        assert frame.decode().image.shape[0] > 100
        assert max(RangeHandler.asked) < drive.log.stat().st_size
        with pytest.raises(LogError, match="no such file"):
            logs.open(located(f"{url}/none.mcap"))
        with pytest.raises(SettingsError, match="for reading"), local_output(located(f"{url}/out")):
            pass


def test_what_is_not_there_is_said_in_one_line(bucket: str, tmp_path: Path, verb: Callable[..., Said]) -> None:
    assert "no such file" in verb("info", f"{bucket}/nothing.mcap").error
    assert "nothing at" in verb("evaluate", f"{bucket}/nothing", "--truth", "gps").error
    with pytest.raises(ResultError, match="Cannot write"), local_output(located("s3://no-such-bucket/a")) as folder:
        folder.mkdir()
        (folder / "run.json").write_text("{}")
    wrong = verb("info", "ftp://somewhere/a.mcap")
    assert wrong.code == 2
    assert "ftp:// is not known" in wrong.err
    refused = verb("info", "http://127.0.0.1:1/a.mcap")
    assert refused.code == 1
    assert "Cannot read http://127.0.0.1:1/a.mcap" in refused.error


def test_a_single_file_is_sent(bucket: str, tmp_path: Path, verb: Callable[..., Said]) -> None:
    graph = tmp_path / "in.g2o"
    graph.write_text("VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0\nEDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n")
    verb("optimize", graph, "-o", f"{bucket}/solved/out.g2o")
    verb("optimize", graph, "-o", tmp_path / "out.g2o")
    with located(f"{bucket}/solved/out.g2o").open("rb") as stream:
        assert stream.read() == (tmp_path / "out.g2o").read_bytes()
    for asked in (("map", "export", tmp_path), ("export", tmp_path, "--format", "tum"), ("report", tmp_path)):
        said = verb(*asked, "-o", f"{bucket}/file")
        assert said.code == 2
        assert "must be a local f" in said.err  # a file or a folder


def test_a_copy_is_known_by_what_it_is_of(bucket: str, tmp_path: Path) -> None:
    (tmp_path / "library.json").write_text("{}")
    put(tmp_path / "library.json", f"{bucket}/library")
    with local_copy(located(f"{bucket}/library")) as folder:
        assert library_of(folder) == f"{bucket}/library"
        assert library_of(tmp_path) == str(tmp_path)
    run, about = tmp_path / "run", {"library": {"from": f"{bucket}/library"}}
    with stands_for(run, located(f"{bucket}/run")), library_at(run, about) as library:
        assert (library / "library.json").read_text() == "{}"
    with library_at(tmp_path / "run", {"library": {"from": str(tmp_path)}}) as library:
        assert library == tmp_path
    with pytest.raises(LibraryError, match="lost its library"), library_at(tmp_path / "run", {"library": 3}):
        pass


def test_a_run_by_url_is_begun_again(bucket: str, verb: Callable[..., Said]) -> None:
    said = verb("run", "--resume", "-o", f"{bucket}/run")
    assert said.code == 2
    assert "uploaded when finished" in said.err


def test_nothing_is_sent_of_what_failed(bucket: str) -> None:
    with pytest.raises(ValueError, match="stop"), local_output(located(f"{bucket}/failed")) as folder:
        folder.mkdir()
        (folder / "a").write_text("a")
        raise ValueError("stop")
    assert not located(f"{bucket}/failed").exists()


def test_paths_stay_paths(tmp_path: Path) -> None:
    assert located(tmp_path) == tmp_path
    assert located("a/b") == Path("a/b")
    remote = RemotePath("s3://bucket/folder/drive.mcap")
    assert (remote.name, remote.stem, remote.suffix) == ("drive.mcap", "drive", ".mcap")
    assert str(remote.relative_to(RemotePath("s3://bucket/folder"))) == "drive.mcap"
    named = RemotePath("s3://bucket/a%20b") / "drive=x%2Fy" / "z"
    assert named.place[1] == "a b/drive=x%2Fy/z", "a URL is unquoted, a name is as it is"
    assert RemotePath(str(named)).place[1] == named.place[1]
    assert named.relative_to(RemotePath("s3://bucket/a%20b")).as_posix() == "drive=x%2Fy/z"
    with local_copy(tmp_path) as same:
        assert same == tmp_path
