"""What lets a reader in by URL, as the signature of a link or a password, is in nothing that is written or said."""

from __future__ import annotations

import json
import random
import shutil
from functools import partial
from http.server import ThreadingHTTPServer
from threading import Thread
from typing import TYPE_CHECKING, Any

import pytest

from tests.forked import VPLOG, Forked
from tests.storage.test_remote_path import QUICK, RangeHandler
from vplog.errors import SettingsError
from vplog.storage.input_hashes import hash_inputs, stat_signature
from vplog.storage.remote_path import RemotePath, located, reason
from vplog.storage.urls import shown, without_secrets

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from conftest import Said

    from vplog.verbs.demo.record import Demo

    Verb = Callable[..., Said]

SECRET = "5eCr3tS1gnature"  # noqa: S105 (opens nothing)
QUERY = f"X-Amz-Signature={SECRET}&token={SECRET}&id=7#{SECRET}"


class SignedHandler(RangeHandler):
    """Files for those who have the signature alone."""

    def is_signed(self) -> bool:
        if SECRET in self.path.partition("?")[2]:
            return True
        self.send_error(403)
        return False

    def do_GET(self) -> None:  # noqa: N802
        if self.is_signed():
            super().do_GET()

    def do_HEAD(self) -> None:  # noqa: N802
        if self.is_signed():
            super().do_HEAD()


@pytest.fixture
def server(tiny: Demo, tmp_path: Path) -> Iterator[str]:
    folder = tmp_path / "served"
    folder.mkdir()
    shutil.copy(tiny.log, folder / "drive.mcap")
    shutil.copy(tiny.truth, folder / "truth.tum")
    SignedHandler.asked = []
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(SignedHandler, directory=str(folder)))
    thread = Thread(target=server.serve_forever, daemon=True)
    thread.start()
    yield f"http://127.0.0.1:{server.server_address[1]}"
    server.shutdown()
    server.server_close()


def check(folder: Path, *said: Said) -> None:
    """Raises where any byte of any file, its name, or anything said holds the secret."""
    for one in said:
        assert SECRET not in one.out + one.err
    for path in folder.rglob("*"):
        assert SECRET not in str(path)
        assert not path.is_file() or SECRET.encode() not in path.read_bytes(), path


def test_no_verb_writes_or_says_a_signature(server: str, verb: Verb, tmp_path: Path) -> None:
    log, truth, out = f"{server}/drive.mcap?{QUERY}", f"{server}/truth.tum?{QUERY}", tmp_path / "out"
    out.mkdir()
    said = [verb("info", log, "--html", out / "info.html"), verb("info", log, "--json")]
    assert said[1].json["command"].startswith("vplog run LOG"), "the URL without its query would not work"
    said.append(verb("run", log, "-o", out / "run", "--threads", 2, "--json", *QUICK))
    assert said[-1].json["log"] == f"{server}/drive.mcap"
    said += [
        verb("evaluate", out / "run", "--truth", truth, "--json"), verb("evaluate", out / "run", "--truth", "gps"),
        verb("report", out / "run", "--truth", truth, "--json", "-o", out / "report.html"),
        verb("explain", out / "run", "--closure", 0, "--log", log, "--json"),
        verb("explain", out / "run", "--closure", 0),
        verb("batch", log, "-o", out / "map", "--library", out / "run" / "library", *QUICK),
        verb("batch", log, "-o", out / "map", "--json"), verb("map", "info", out / "map", "--json"),
        verb("map", "query", out / "map", log, "--json"),
        verb("library", log, "-o", out / "library", *QUICK[:2], "--set=library.size=4"),
        verb("map", "redescribe", out / "map", "--library", out / "library", "-o", out / "again"),
        verb("map", "merge", out / "map", "-o", out / "merged"),
        verb("map", "export", out / "map", "-o", out / "places.parquet"),
        verb("compare", log, "--min-gap", 15, "--methods", "thumbnail", "--truth", truth, "-o", out / "compare"),
    ]  # fmt: skip
    check(out, *said)
    assert [number for number, one in enumerate(said) if one.code] == [4, 7, 13]  # as is said below
    for one in said:
        assert "Internal error" not in one.err
        assert "Traceback" not in one.err
    assert "URLs are kept without their query" in said[4].error
    assert "--truth FILE.tum" in said[4].error
    assert said[6].code == 0
    assert "Say where it is: --log LOG" in said[7].error
    assert json.loads(said[9].out)["drives"][0]["state"] == "unchanged", "a link that is signed anew is the same log"
    assert said[11].code == 0
    assert "vplog batch LOG -o" in said[13].out + said[13].err


def test_a_run_by_a_signed_link_is_gone_on_with_when_it_is_given_again(
    server: str, verb: Verb, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log, out = f"{server}/drive.mcap?{QUERY}", tmp_path / "out" / "run"
    from vplog.run import back_end

    def stop(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(back_end, "decided", stop)
        stopped = verb("run", log, "-o", out, "--threads", 2, *QUICK)
    assert stopped.code == 130
    refused = verb("run", "--resume", "-o", out)
    assert f"vplog run --resume LOG -o {out}" in refused.error
    other = verb("run", "--resume", f"{server}/other.mcap?{QUERY}", "-o", out)
    assert "not of" in other.error
    done = verb("run", "--resume", log, "-o", out, "--json")
    assert done.json["finished"]
    check(tmp_path / "out", stopped, refused, other, done)


@pytest.mark.parametrize(
    "words",
    [
        ["info", f"ftp://u:{SECRET}@host/a?{QUERY}"], ["info", f"http://u:{SECRET}@127.0.0.1:1/a"],
        ["info", f"http://u:{SECRET}/x@127.0.0.1/a"], ["info", f"s3://key:{SECRET}@bucket/a"],
        ["info", f"s3://key:a/{SECRET}@bucket/a"], ["info", f"s3://bucket/a?{QUERY}"],
        ["info", f"http://127.0.0.1:1/a?{QUERY}"], ["info", "a", f"http://h/b?{QUERY}"],
        ["optimize", f"https://host/a.g2o?{QUERY}", "-o", "OUT"], ["run", f"http://127.0.0.1:1/a?{QUERY}", "-o", "OUT"],
        ["run", "a.mcap", "--pipeline", f"https://host/a.yaml?{QUERY}", "-o", "OUT"],
        ["run", "a.mcap", "--odometry-file", f"https://host/a.tum?{QUERY}", "-o", "OUT"],
        ["run", "a.mcap", "--library", f"http://127.0.0.1:1/lib?{QUERY}", "-o", "OUT"],
        ["batch", f"http://127.0.0.1:1/a?{QUERY}", f"http://127.0.0.1:1/a?{QUERY}", "-o", "OUT"],
        ["batch", f"http://127.0.0.1:1/a?{QUERY}", "-o", "OUT"], ["map", "info", f"http://127.0.0.1:1/m?{QUERY}"],
        ["run", "a.mcap", "-o", f"http://127.0.0.1:1/out?{QUERY}"],
        ["compare", "a", "--min-gap", "1", "--methods", "gist", "--truth", f"http://h/t.tum?{QUERY}"],
        *([word, *more, f"http://h/a\n.mcap?a=b \"x\" \u00fc {SECRET}"] for word, more in (
            ("optimize", ("-o", "OUT")), ("config", ("--pipeline",)), ("config", ("--set",)), ("info", ("a",)),
            ("run", ("a", "-o", "OUT", "--mask")), ("schemas", ("-o",)), ("compare", ("a", "--methods")), ("b", ()),
        )),
    ],
    ids=lambda words: " ".join(words)[:40].replace(SECRET, ""),
)  # fmt: skip
def test_what_fails_is_said_without_secrets(words: list[str], verb: Verb, tmp_path: Path) -> None:
    said = verb(*(str(tmp_path / "out") if word == "OUT" else word for word in words))
    assert said.code in (1, 2)
    assert "Internal error" not in said.err
    check(tmp_path, said)


def test_a_file_that_a_server_lacks_is_said(server: str, verb: Verb, finished: Path) -> None:
    error = verb("evaluate", finished, "--truth", f"{server}/none.tum?{QUERY}").error
    assert f"Cannot read {server}/none.tum: the server has no such file." in error


@pytest.mark.parametrize("option", ["--odometry-file", "--calibration", "--decisions", "--mask"])
def test_a_url_where_a_local_file_is_wanted_is_said(option: str, verb: Verb, tmp_path: Path) -> None:
    said = verb("run", "a.mcap", option, f"https://host/a.tum?{SECRET}", "-o", tmp_path / "out")
    assert said.code == 2
    assert "must be a local file, not https://host/a.tum" in said.err


def test_a_redirection_is_said_without_secrets(verb: Verb) -> None:
    from tests.storage.test_http import saying

    moved = f"HTTP/1.1 302 Found\r\nLocation: file:///x?{QUERY}\r\n\r\n".encode()
    with saying(lambda _: moved) as url:
        assert SECRET not in verb("info", url).error


def test_urls_are_cut_and_paths_are_not() -> None:
    assert shown("https://h:80/a%20b.mcap?sig=1#x") == "https://h:80/a%20b.mcap"
    assert shown("http://h/a b.mcap?sig=a b") == "http://h/a b.mcap"
    assert shown("https://u:p@s@h/a@2.mcap") == "https://h/a@2.mcap"
    assert shown("http:/h/a?sig=1") == "http:/h/a"
    assert shown("https://u%3Ap%40h/a\uff1fsig=1") == shown("https://u:p%2540h/a\uff03sig=1") == "https://h/a"
    assert without_secrets("No https://u%3Ap%40h/a\uff1fsig=1.") == "No https://h/a"
    assert shown("https://h:80/a@b;c?sig='1'#\"2\"") == "https://h:80/a@b;c"
    assert shown("https://h/a;jsessionid=1") == "https://h/a"
    for password in ("p/1", "p?1", "p#1", "p@1", "p:1"):
        assert shown(f"ftp://u:{password}@[::1]:80/a") == "ftp://[::1]:80/a"
    assert (
        without_secrets('"https://h/a?b="c" is 404, <https://h/d?e> too') == '"https://h/a" is 404, <https://h/d> too'
    )
    assert shown("/logs/a#1?.mcap") == "/logs/a#1?.mcap"
    assert without_secrets("Cannot read https://u:p@h/a?b=c, or s3://k/d.") == "Cannot read https://h/a or s3://k/d."
    assert without_secrets("(/logs/a?b) and a: b?c") == "(/logs/a?b) and a: b?c"
    path = RemotePath(f"http://h/a.mcap?{QUERY}")
    assert SECRET not in f"{path} {path!r} {path.name} {path.relative_to(RemotePath('http://h'))}"
    assert SECRET in path.url
    assert SECRET not in reason(OSError(f"no answer from {path.url}"))


_SIGNED = (
    "X-Amz-Algorithm=AWS4-HMAC-SHA256{and_}X-Amz-Signature{is_}{secret}", "X-Goog-Signature{is_}{secret}{and_}x=1",
    "sv{is_}2024{and_}se=2026-01-01T00%3A00Z{and_}sig{is_}{secret}", "SIG{is_}{secret}", "access_token{is_}{secret}",
    "Policy=eyJ~-_{and_}Signature{is_}ab~{secret}__{and_}Key-Pair-Id=K2", "token{is_}{secret}=={and_}id=7",
)  # fmt: skip
_BEFORE = ("?", "#", "&", ";", "%3F", "%3f", "%23", "%26", "%3B", "%253F", "??", "?a&", "%3Fa=1&", ";a=1?", "&amp;")


@pytest.mark.parametrize("seed", range(20))
def test_no_link_however_malformed_shows_its_secret(seed: int) -> None:
    rng = random.Random(seed)
    for _ in range(100):
        scheme = rng.choice(["http", "https", "HTTPS", "s3", "gs", "ftp", "abfs"]) + rng.choice(["://", ":/", ":///"])
        host = rng.choice(["host", "h.example.org:8080", "127.0.0.1:1", "[::1]:80", "bucket"])
        path = rng.choice(["/a.mcap", "/a b.mcap", "/date=2024-01-02/a%20b.db3", "/"])
        mark = rng.choice(["", "/", "?", "#", "@", ":", " ", "%40", "&", ";"])
        user = rng.choice(["", f"u:{SECRET}@", f"u:p{mark}{SECRET}@", f"u:{SECRET}{mark}p@", f":{SECRET}@"])
        and_, is_ = rng.choice(["&", ";", "%26", ","]), rng.choice(["=", "%3D", "%3d", "%253D"])
        query = rng.choice(_BEFORE) + rng.choice(_SIGNED).format(and_=and_, is_=is_, secret=SECRET)
        url = f"{scheme}{user}{host}{path}{rng.choice(['', query])}"
        assert shown(url) == f"{scheme}{host}{path}", url
        if " " not in path:
            for sentence in ("Cannot read {}: 404.", 'No such file: "{}"', "({})", "{}"):
                said = without_secrets(sentence.format(url))
                assert SECRET not in said, url
                assert f"{scheme}{host}{path}" in said, url


def test_names_with_marks_are_found_again() -> None:
    here: Any = located("s3://bucket/a#1") / "b?c#d%e"
    assert here.place[1] == "a#1/b?c#d%e"
    again: Any = located(str(here))
    assert again.place[1] == here.place[1]
    with pytest.raises(SettingsError, match="%3F"):
        located("s3://bucket/a?b")
    assert str(located("http://[::1]:80/a")) == "http://[::1]:80/a"


def test_logs_that_differ_in_their_queries_are_two(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(RemotePath, "version", lambda self: self.url[-1])
    monkeypatch.setattr(RemotePath, "is_dir", lambda _: False)
    paths: list[Any] = [RemotePath(f"http://h/get?id={number}") for number in range(4)]
    assert sorted(hash_inputs(paths).values()) == sorted(stat_signature(paths).values()) == ["0", "1", "2", "3"]


def test_a_traceback_is_shown_without_secrets(tmp_path: Path) -> None:
    words = ["info", f"http://127.0.0.1:1/a?b c={QUERY} {SECRET}", "--debug"]
    _, out, err = Forked(VPLOG, *words).ended()
    assert "Traceback" in err
    assert SECRET not in out + err
