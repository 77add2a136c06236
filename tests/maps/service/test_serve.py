"""Queries and localisations over HTTP are those of the verbs, of the newest state of the map, and bounded."""

from __future__ import annotations

import json
import math
import shutil
import socket
import struct
import threading
import time
import zlib
from contextlib import contextmanager
from http.client import HTTPConnection
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest

import vplog
from tests.maps.runs import map_of_run, put_rows
from tests.storage.test_image_file import chunk
from vplog.data import Frame
from vplog.errors import ResultError, SettingsError
from vplog.execution.execution import Execution
from vplog.logs.messages import pixels
from vplog.maps import geo_bounds
from vplog.maps.localization.places import opened as opened_places
from vplog.maps.service import http, open_state
from vplog.maps.service.open_state import NewestState
from vplog.maps.storage import map_store
from vplog.maps.storage.map_store import folder_name

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from conftest import Said

    from vplog.verbs.demo.record import Demo


@contextmanager
def listening(root: Path, **limits: Any) -> Iterator[tuple[NewestState, str]]:
    """The open state, and host and port of its server, which ends with the process."""
    newest, where = NewestState(root, None, Execution()), list[str]()
    ready = threading.Event()

    def told(url: str) -> None:
        where.append(url.removeprefix("http://"))
        ready.set()

    threading.Thread(
        target=http.serve, args=(newest, "127.0.0.1", 0, http.Limits(**limits), None, told), daemon=True
    ).start()
    assert ready.wait(30)
    yield newest, where[0]


@contextmanager
def served(root: Path, **limits: Any) -> Iterator[tuple[NewestState, Callable[..., tuple[int, dict[str, Any]]]]]:
    """The open state, and what asks the service."""
    with listening(root, **limits) as (newest, at):

        def ask(path: str, body: bytes | None = None, idle: list[HTTPConnection] | None = None) -> tuple[int, Any]:
            connection = HTTPConnection(at, timeout=60)
            if idle is not None:
                idle.append(connection)  # which stays open
            connection.request("GET" if body is None else "POST", path, body)
            answer = connection.getresponse()
            return answer.status, json.loads(answer.read())

        yield newest, ask


@pytest.fixture(scope="module")
def root(finished: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return map_of_run(tmp_path_factory.mktemp("served") / "map", finished)


def test_answers_are_those_of_the_verb(
    root: Path,
    finished: Path,
    drive: Demo,
    verb: Callable[..., Said],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    run = shutil.copytree(finished, tmp_path / "run")
    with served(root) as (_, ask):
        status, about = ask("/map")
        assert (status, about["drives"], about["recogniser"]) == (200, 3, "bobb")
        body = (finished / "descriptors.parquet").read_bytes()
        status, found = ask("/query?top=3", body)
        assert status == 200
        log = ("map", "query", root, drive.log, "--top", 3, "--sequence", 1, "--json")
        names = ("query", "rank", "drive", "keyframe", "score")
        assert [[one[name] for name in names] for one in found["answers"]] == [
            [one[name] for name in names] for one in verb(*log).json["answers"]
        ]
        _, found = ask("/query?drive=ten&top=1", body)
        only = verb(*log, "--drive", "ten").json["answers"]
        assert {one["drive"] for one in found["answers"]} == {one["drive"] for one in only} == {"ten"}
        opened = vplog.open_log(drive.log)
        frame = next(iter(opened.frames(opened.stamps()[:1]))).decode()
        picture = cv2.imencode(".png", frame.image)[1].tobytes()
        _, found = ask("/query?top=1", picture)
        assert found["answers"][0]["keyframe"] == 0
        assert frame.camera.matrix is not None
        (fx, _, cx), (_, fy, cy), _ = frame.camera.matrix.tolist()
        # the drives of this map have no features of their own
        monkeypatch.setattr(open_state, "opened", lambda _, execution: opened_places(run, execution))
        _, found = ask(f"/localize?fx={fx}&fy={fy}&cx={cx}&cy={cy}", picture)
        assert found["localized"]
        assert found["keyframe"] <= 2


def test_a_drive_that_comes_later_is_found(root: Path, finished: Path) -> None:
    with served(root, refresh_s=0.1) as (newest, ask):
        before = newest.now
        with map_store.writing(root) as store:
            put_rows(store, "new", finished, before.state.hash, slice(5, 9))
        began = time.monotonic()
        while newest.now is before and time.monotonic() - began < 30:
            time.sleep(0.05)
        _, found = ask("/query?drive=new", (finished / "descriptors.parquet").read_bytes())
        assert {one["drive"] for one in found["answers"]} == {"new"}
        assert len(before.answers(list(before.state.from_arrow(_column(finished))), http.MapQuery(1))[0]) > 0


def _column(finished: Path) -> Any:
    return http.tables.read_descriptors(finished / "descriptors.parquet")[0]


def test_damaged_drives_are_left_out_and_faults_of_the_map_are_its_own(
    finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    copied, body = map_of_run(tmp_path / "map", finished), (finished / "descriptors.parquet").read_bytes()

    def damage(drive: str) -> None:
        (copied / "runs" / folder_name(drive) / "descriptors.parquet").write_bytes(b"damaged")

    damage("ten")
    with served(copied, refresh_s=3600) as (newest, ask):
        about = ask("/map")[1]
        assert about["drives"] == 2
        assert "ten is damaged and left out" in about["warnings"][0]
        damage("back 1/2")
        status, found = ask("/query?top=3", body)
        assert status == 200
        assert {one["drive"] for one in found["answers"]} == {"all"}
        assert sum("is damaged and left out" in one for one in found["warnings"]) == 2
        assert ask("/query?drive=nowhere", body)[0] == 400

        def broken(*_: object) -> None:
            raise ResultError("The map has gone.")

        with monkeypatch.context() as patch:
            patch.setattr(open_state, "best_places", broken)
            assert ask("/query", body) == (503, {"detail": "The map has gone."})
        (copied / "map.json").write_text("{")
        assert not newest.refresh()
        assert "map.json" in ask("/map")[1]["warnings"][-1]
        assert ask("/query", body)[0] == 200


def test_requests_are_bounded_and_told_why(root: Path, finished: Path) -> None:
    with served(root, waiting=2, megabytes=0.5, views=3) as (_, ask):
        assert ask("/query", bytes(600_000))[0] == 413
        assert ask("/query", (finished / "descriptors.parquet").read_bytes())[0] == 413
        assert ask("/query", b"")[0] == 400
        status, told = ask("/query", b"no image")
        assert (status, told["detail"]) == (400, "The body is neither an image nor a descriptors.parquet.")
        assert ask("/query?near=1,2", b"x")[0] == 422
        image = cv2.imencode(".png", np.zeros((48, 64), np.uint8))[1].tobytes()
        assert ask("/query?drive=nowhere", image)[1]["detail"].startswith(f"{root.name} has no drive 'nowhere'.")
        for intrinsics in ("fx=100", *(f"fx={fx}&fy=100&cx=32&cy=24" for fx in ("0", "-1", "nan", "inf"))):
            assert ask(f"/localize?{intrinsics}", image)[0] == 400
        assert ask("/redoc")[0] == ask("/docs")[0] == 404


def large_png(width: int, height: int) -> bytes:
    """An RGBA image of zeros, without being in memory."""
    packer = zlib.compressobj()
    pixels = b"".join([packer.compress(bytes(1 + 4 * width)) for _ in range(height)] + [packer.flush()])
    head = struct.pack(">IIBBBBB", width, height, 8, 6, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")


def test_images_that_are_large_in_memory_are_refused_by_their_header(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    decoded = list[int]()
    monkeypatch.setattr(pixels, "decode_image", lambda data, *_: decoded.append(len(data)))
    with served(root) as (_, ask):
        for path in ("/query", "/localize?fx=100&fy=100&cx=32&cy=24"):
            status, told = ask(path, large_png(16_000, 16_000))
            assert (status, decoded) == (413, [])
            assert "5120 MB" in told["detail"]
            assert "768 MB" in told["detail"]


def test_requests_wait_for_the_memory_that_others_decode_in(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each of these images takes 0.8 MB, and only two of them may be decoded at once."""
    at_once, most, lock = [0], [0], threading.Lock()

    def counted(*_: object) -> dict[str, Any]:
        with lock:
            at_once[0] += 1
            most[0] = max(at_once)
        time.sleep(0.05)
        with lock:
            at_once[0] -= 1
        return {"answers": []}

    monkeypatch.setattr(http, "_answered", counted)
    image, statuses = large_png(200, 200), list[int]()
    with served(root, threads=8, decoded_mb=2.0) as (_, ask):
        threads = [threading.Thread(target=lambda: statuses.append(ask("/query", image)[0])) for _ in range(12)]
        for one in threads:
            one.start()
        for one in threads:
            one.join()
    assert statuses == [200] * 12
    assert most == [2]


def test_views_that_are_large_in_memory_are_refused_by_their_footer(root: Path, finished: Path) -> None:
    body = (finished / "descriptors.parquet").read_bytes()
    with served(root, decoded_mb=0.01) as (_, ask):
        assert ask("/query", body)[0] == 413


def test_a_large_jpeg_is_found_at_reduced_size(root: Path, drive: Demo, monkeypatch: pytest.MonkeyPatch) -> None:
    opened = vplog.open_log(drive.log)
    frame = next(iter(opened.frames(opened.stamps()[:1]))).decode()
    height, width = frame.image.shape
    times = math.ceil(math.sqrt(16 * 2**21 / (height * width)))
    large = cv2.resize(frame.image, (times * width, times * height), interpolation=cv2.INTER_CUBIC)
    jpeg = cv2.imencode(".jpg", large)[1].tobytes()
    frames = list[Frame]()

    def taken(_: object, frame: Frame, __: object) -> Any:
        frames.append(frame)
        raise ResultError("It is taken.")

    monkeypatch.setattr(http, "localize_frame", taken)
    monkeypatch.setattr(NewestState, "localized_in", lambda _: None)
    with served(root) as (_, ask):
        assert ask("/query?top=1", jpeg)[1]["answers"][0]["keyframe"] == 0
        ask("/localize?fx=2&fy=2&cx=0&cy=0", jpeg)
    [frame] = frames
    assert frame.image.shape == (times * height // 4, times * width // 4)
    assert frame.camera.matrix is not None
    assert frame.camera.matrix[0].tolist() == [0.5, 0.0, -0.375]  # the middle of a pixel is its origin


def test_answers_name_no_folder_of_the_server(finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    copied, body = map_of_run(tmp_path / "map", finished), (finished / "descriptors.parquet").read_bytes()
    image = cv2.imencode(".png", np.zeros((48, 64), np.uint8))[1].tobytes()
    (copied / "runs" / folder_name("ten") / "descriptors.parquet").write_bytes(b"damaged")
    with served(copied, refresh_s=3600) as (newest, ask):
        said = [
            ask("/map"), ask("/query?drive=nowhere", body), ask("/query?top=1", body), ask("/query", image[:-20]),
            ask("/query", body[:-20]), ask("/localize", image), ask("/query", b"PAR1" + bytes(99)),
        ]  # fmt: skip
        (copied / "map.json").write_text("{")
        newest.refresh()
        said.append(ask("/map"))
        for why in (f"There is no {copied}/runs/a.", "It is at s3://bucket/map/runs/a, not in /home/user/a."):
            monkeypatch.setattr(http, "_answered", lambda *_, why=why: (_ for _ in ()).throw(ResultError(why)))
            said.append(ask("/query", body))
    assert [status for status, _ in said] == [200, 400, 200, 400, 400, 200, 400, 200, 400, 400]
    for _, answer in said:
        for secret in (str(tmp_path), "/tmp", "request-", "/home", "bucket"):  # noqa: S108
            assert secret not in json.dumps(answer)


def test_a_client_that_hangs_up_leaves_no_traceback(root: Path, capfd: pytest.CaptureFixture[str]) -> None:
    with listening(root) as (_, at):
        host, port = at.split(":")
        for _ in range(3):
            with socket.create_connection((host, int(port))) as client:
                client.sendall(b"POST /query HTTP/1.1\r\nHost: x\r\nContent-Length: 1000\r\n\r\nPAR1")
                time.sleep(0.1)
        time.sleep(0.3)
    assert "Traceback" not in capfd.readouterr().err


def test_a_refresh_that_fails_is_reported_and_tried_again(
    root: Path, finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    copied = map_of_run(tmp_path / "map", finished)
    with served(copied, refresh_s=0.1) as (newest, ask):
        before = newest.now
        with monkeypatch.context() as patch:
            patch.setattr(NewestState, "_marked", lambda _: 1 / 0)
            wait_for(lambda: newest.problem)
            assert "division by zero" in ask("/map")[1]["warnings"][-1]
        assert "ZeroDivisionError" in capfd.readouterr().err
        (copied / "joint.json").write_text("{}")
        wait_for(lambda: newest.now is not before)
        assert ask("/map")[1]["warnings"] == []


def wait_for(condition: Callable[[], object]) -> None:
    ended = time.monotonic() + 30
    while not condition():
        assert time.monotonic() < ended
        time.sleep(0.05)


def test_what_comes_while_the_queue_is_full_is_refused(
    root: Path, finished: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun, go_on = threading.Event(), threading.Event()

    def slow(*_: object) -> dict[str, Any]:
        begun.set()
        go_on.wait(30)
        return {"answers": []}

    monkeypatch.setattr(http, "_answered", slow)
    with served(root, waiting=2) as (_, ask):
        first = threading.Thread(target=ask, args=("/query", b"one"))
        first.start()
        assert begun.wait(30)
        statuses = []
        threads = [threading.Thread(target=lambda: statuses.append(ask("/query", b"two")[0])) for _ in range(3)]
        for one in threads:
            one.start()
        time.sleep(0.5)
        go_on.set()
        for one in [first, *threads]:
            one.join()
        assert 503 in statuses


def test_connections_that_are_idle_are_no_requests(root: Path) -> None:
    """Clients with a pool of connections leave them open."""
    with served(root, waiting=2) as (_, ask):
        idle = list[HTTPConnection]()
        assert [ask("/map", None, idle)[0] for _ in range(6)] == [200] * 6


def test_localisations_that_wait_block_nothing_else(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    begun, go_on = threading.Event(), threading.Event()

    def slow(*_: object) -> Any:
        begun.set()
        go_on.wait(30)
        raise ResultError("It is over.")

    monkeypatch.setattr(http, "localize_frame", slow)
    monkeypatch.setattr(NewestState, "localized_in", lambda _: None)
    image = cv2.imencode(".png", np.zeros((48, 64), np.uint8))[1].tobytes()
    with served(root) as (_, ask):
        threads = [threading.Thread(target=ask, args=("/localize", image)) for _ in range(3)]
        for one in threads:
            one.start()
        assert begun.wait(30)
        about = threading.Thread(target=ask, args=("/map",), daemon=True)
        about.start()
        about.join(5)
        assert not about.is_alive()
        go_on.set()
        for one in threads:
            one.join()


def test_boxes_around_a_point_and_drives_within_them() -> None:
    south, west, north, east = geo_bounds.box_around(48.0, 11.0, 48.0, 11.0, 1000.0)
    assert 0.0089 < north - 48.0 < 0.0091
    assert (east - 11.0) / (north - 48.0) == pytest.approx(1.0 / np.cos(np.radians(north)), rel=1e-6)
    assert (south + north, west + east) == pytest.approx((96.0, 22.0))
    assert geo_bounds.box_around(89.999, 0.0, 89.999, 0.0, 1000.0)[1::2] == (-180.0, 180.0)
    over = geo_bounds.box_around(0.0, 179.999, 0.0, 179.999, 1000.0)
    assert over[1] > 179.0
    assert over[3] < -179.0
    drives = {
        "east": {"earth": {"bounds": [-0.001, 179.9995, 0.001, 179.9999]}},
        "west": {"earth": {"bounds": [-0.001, -179.9999, 0.001, -179.9995]}},
        "far": {"earth": {"bounds": [10.0, 0.0, 10.1, 0.1]}},
        "nowhere": {},
    }
    bounds = geo_bounds.DriveBounds(drives)
    chosen, warnings = bounds.within((), over, "MAP")
    assert chosen.tolist() == [0, 1]
    assert warnings == ["Not searched: 1 drive of 4 without a place on earth."]
    assert bounds.within(["far"], None, "MAP")[0].tolist() == [2]
    with pytest.raises(ResultError, match="No drive of MAP is in the box"):
        bounds.within(["far"], over, "MAP")
    with pytest.raises(SettingsError, match="no drive 'none'"):
        bounds.within(["none"], None, "MAP")


def test_a_join_is_a_new_state(root: Path, finished: Path, tmp_path: Path) -> None:
    copied = map_of_run(tmp_path / "map", finished)
    newest = NewestState(copied, None, Execution())
    assert not newest.refresh()
    (copied / "joint.json").write_text("{}")
    assert newest.refresh()
