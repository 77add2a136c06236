"""A record may come from anyone: no command contacts a server that only a record names."""

from __future__ import annotations

import json
import shutil
from typing import TYPE_CHECKING, Any

import pytest

import vplog
from tests.maps.runs import map_of_run
from vplog.errors import LibraryError, LogError
from vplog.results import run_record
from vplog.run.provenance import library_at, stored_log
from vplog.storage import remote_path

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from conftest import Said

    from vplog.verbs.demo.record import Demo

URLS = [f"{scheme}://server/drive.mcap" for scheme in ("http", "https", "s3", "gs", "az")]
REFUSED = "on a server that the command does not name"


@pytest.fixture
def contacted(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Servers and buckets that were asked for something: none answers."""
    found = list[str]()

    def opened(scheme: str, where: str, *_: object) -> Any:
        found.append(f"{scheme}://{where}")
        raise OSError("it does not answer")

    monkeypatch.setattr(remote_path, "opened", opened)
    return found


def forged(run: Path, to: Path, **fields: Any) -> Path:
    """A copy of a run whose record has other fields."""
    shutil.copytree(run, to, ignore=shutil.ignore_patterns(".cache"))
    forge(to / "run.json", **fields)
    return to


def forge(path: Path, **fields: Any) -> None:
    run_record.write_run_json(path, run_record.read_run_json(path) | fields)


@pytest.mark.parametrize("url", URLS)
def test_the_log_of_a_run_is_asked_of_no_server(
    finished: Path, tmp_path: Path, verb: Callable[..., Said], contacted: list[str], url: str
) -> None:
    run, out = forged(finished, tmp_path / "run", log=url), tmp_path / "out"
    for words in (
        ("evaluate", run, "--truth", "auto"), ("evaluate", run, "--truth", "gps"), ("explain", run, "--worst"),
        ("export", run, "--format", "colmap", "-o", out),
        ("export", run, "--format", "rrd", "--truth", "auto", "-o", out),
        ("report", run, "--truth", "auto"), ("diff", finished, run, "--truth", "gps"),
    ):  # fmt: skip
        said = verb(*words)
        assert (said.code, contacted) == (1, []), words
        assert "Internal error" not in said.err
    for words in (("evaluate", run), ("explain", run, "--worst"), ("report", run, "--truth", "auto")):
        error = verb(*words).error
        assert f"{url} is {REFUSED}" in error
        assert "--log LOG" in error
    with pytest.raises(LogError, match=f"{REFUSED}.*log=LOG"):
        next(vplog.open_run(run).images([0], from_log=True))
    assert contacted == []
    assert "does not answer" in verb("evaluate", run, "--log", url).error
    assert contacted


def test_parts_of_a_log_are_asked_of_no_server(finished: Path, tmp_path: Path, contacted: list[str]) -> None:
    run = forged(finished, tmp_path / "run", parts=[URLS[0], URLS[2]])
    with pytest.raises(LogError, match=REFUSED):
        vplog.evaluate(run, "gps")
    assert contacted == []


def test_the_log_that_is_named_takes_the_place_of_the_recorded_one(
    finished: Path, drive: Demo, tmp_path: Path, contacted: list[str]
) -> None:
    run = forged(finished, tmp_path / "run", log=URLS[0])
    assert vplog.evaluate(run, "gps", log=drive.log) == vplog.evaluate(finished, "gps")
    assert contacted == []


def test_an_unfinished_run_asks_no_server(
    finished: Path, drive: Demo, tmp_path: Path, verb: Callable[..., Said], contacted: list[str]
) -> None:
    record = json.loads((finished / "run.json").read_text())
    for number, url in enumerate(URLS):
        run = forged(finished, tmp_path / f"log{number}", finished=False, log=url)
        error = verb("run", "--resume", "-o", run).error
        assert f"{url} is {REFUSED}" in error
        assert "vplog run --resume LOG" in error
        library = {**record["library"], "from": url}
        run = forged(finished, tmp_path / f"library{number}", finished=False, library=library)
        error = verb("run", "--resume", "-o", run).error
        assert f"{url} is {REFUSED}" in error
        assert f"--library {url}" in error
    assert contacted == []


def test_the_library_of_a_run_is_asked_of_no_server(
    finished: Path, tmp_path: Path, verb: Callable[..., Said], contacted: list[str]
) -> None:
    record = json.loads((finished / "run.json").read_text())
    about = {**record["library"], "from": "https://server/library"}
    run = forged(finished, tmp_path / "run", library=about)
    with library_at(run, {"library": about}) as library:  # that in the folder is the run's
        assert library == run / "library"
    other = {**about, "hash": "0" * 64}
    with pytest.raises(LibraryError, match=f"{REFUSED}.*Copy the library to"), library_at(run, {"library": other}):
        pass
    forge(run / "run.json", library=other)
    shutil.rmtree(run / "library")
    picture = tmp_path / "a.png"
    picture.write_bytes(b"\x89PNG\r\n\x1a\n")
    verb("explain", run, "--worst", "-o", tmp_path / "b.png")
    assert REFUSED in verb("report", run, "--log", record["log"]).err + verb("localize", run, picture).err
    assert contacted == []


def test_what_lies_beside_the_run_on_its_server_is_opened(tmp_path: Path, contacted: list[str]) -> None:
    """The user has named the server with the run."""
    named = remote_path.located("s3://bucket/runs/a")
    with remote_path.stands_for(tmp_path, named), pytest.raises(LogError, match="does not answer"):
        stored_log("s3://bucket/logs/a.mcap", tmp_path, "The log", "")
    assert contacted == ["s3://bucket"]
    for other in ("s3://bucket2/a", "s3://bucke/a", "gs://bucket/a", "http://bucket/a", "s3://BUCKET.evil/a"):
        with remote_path.stands_for(tmp_path, named), pytest.raises(LogError, match=REFUSED):
            stored_log(other, tmp_path, "The log", "")
    assert contacted == ["s3://bucket"]


@pytest.mark.parametrize("text", ["//server/share/a.mcap", r"\\server\share\a.mcap", "http:/server/a.mcap", "file:a"])
def test_what_looks_like_an_address_is_a_path(tmp_path: Path, contacted: list[str], text: str) -> None:
    with pytest.raises(LogError, match="no longer exists"):
        stored_log(text, tmp_path, "The log", "")
    assert contacted == []


@pytest.mark.parametrize("url", URLS)
def test_a_map_asks_no_server(
    finished: Path, tmp_path: Path, verb: Callable[..., Said], contacted: list[str], url: str
) -> None:
    root = map_of_run(tmp_path / "map", finished)
    for file in root.glob("runs/*/drive.json"):
        forge(file, log=url, truth=url)
    (root / ".drives.json.gz").unlink(missing_ok=True)
    evaluated = [verb("evaluate", root, "--json"), verb("evaluate", root, "--truth", "gps", "--json")]
    assert all(REFUSED in said.err for said in evaluated)
    verb("map", "join", root)
    verb("map", "info", root)
    verb("map", "redescribe", root, "--library", finished / "library", "-o", tmp_path / "again")
    log = json.loads((finished / "run.json").read_text())["log"]
    assert REFUSED in verb("localize", root, log).err
    verb("map", "merge", root, "-o", tmp_path / "merged")
    assert contacted == []
