"""What stages came to is found again by all that it was made from, and nothing less; a killed run is gone on with."""

from __future__ import annotations

import hashlib
import json
import os
import random
import shutil
import signal
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.forked import Forked
from tests.logs import drives
from tests.logs.drives import ros_messages, write_raw, write_ros2
from tests.logs.messages.test_video import messages, packets
from vplog import logs
from vplog.data import Keyframes
from vplog.errors import LogError, ResultError
from vplog.execution.execution import Execution
from vplog.logs.frames import RecordedFrame
from vplog.loops.propose import Proposals
from vplog.pipeline import Pipeline, load_pipeline, run
from vplog.results.run_record import read_run_json
from vplog.run import feature_extraction
from vplog.run.cache import feature_shards
from vplog.run.cache.codecs import closures_codec, columns_codec, images_codec
from vplog.run.cache.feature_shards import Extracted
from vplog.run.cache.stage_cache import CONTENT_AT, DamagedError, StageCache, inputs_of, sealed
from vplog.run.cache.steps import Steps
from vplog.run.feature_extraction import (
    compute_part,
    extract,
    missing_parts,
    parts_of,
    put_part,
    split_keyframes,
    stored_features,
)
from vplog.run.provenance import head
from vplog.run.run_folder import CacheOptions, staged_run

if TYPE_CHECKING:
    from collections.abc import Callable

    from conftest import Said

    from vplog.verbs.demo.record import Demo

QUICK = (
    "keyframes.distance_m=4", "keyframes.rotation_deg=45", "features.max_features=200", "features.max_megapixels=0.04",
    "library.size=6", "library.seed=1", "places.kind=thumbnail", "propose.per_query=1", "propose.gap_keyframes=10",
    "propose.gap_steps=16", "verify.calibration.pairs=0", "verify.min_matches=100", "pictures.closures=0",
    "pictures.megapixels=0.01",
)  # fmt: skip
"""Few keyframes of the small drive, with few features."""
COUNT = 24
OPTIONS = [option for one in QUICK for option in ("--set", one)]
SAME = ("*.parquet", "result.mcap", "trajectory.tum", "graph.g2o", "library/*")
"""What must be the same byte for byte, however often a run was begun."""
STEPS = ("extract", "choose", "cover", "describe", "propose", "verify")
PART = 8
"""Keyframes of a part here, so that there are several."""


def results(out: Path) -> dict[str, str]:
    files = [file for pattern in SAME for file in sorted(out.glob(pattern))]
    assert len(files) >= 11
    return {file.relative_to(out).as_posix(): hashlib.sha256(file.read_bytes()).hexdigest() for file in files}


def computed(out: Path) -> list[str]:
    """Of the stages that are kept, those that the last run into `out` computed, in part at least."""
    stages = read_run_json(out / "run.json")["stages"]
    return [name for name in STEPS if stages[name]["result"] != "reused"]


@pytest.fixture(autouse=True)
def small_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(feature_extraction, "PART_KEYFRAMES", PART)


@pytest.fixture
def decoded(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Stamps of the frames that are decoded from now on."""
    found: list[int] = []
    original = RecordedFrame.decode

    def counted(frame: RecordedFrame) -> Any:
        found.append(frame.stamp_ns)
        return original(frame)

    monkeypatch.setattr(RecordedFrame, "decode", counted)
    return found


@pytest.fixture(scope="module")
def log(drive: Demo) -> Path:
    return drive.log


@pytest.fixture(scope="module")
def whole(log: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run, never interrupted, with its cache."""
    out = tmp_path_factory.mktemp("whole") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(feature_extraction, "PART_KEYFRAMES", PART)
        run(log, out, load_pipeline("default", QUICK))
    assert computed(out) == list(STEPS)
    return out


@pytest.fixture
def again(whole: Path, tmp_path: Path) -> Path:
    """A copy of that run, to run into."""
    return Path(shutil.copytree(whole, tmp_path / "run"))


KILLED = """
import os, pathlib, signal, sys
from vplog.cli import main
from vplog.run import feature_extraction as parts
parts.PART_KEYFRAMES = {part}
rename, left = pathlib.Path.replace, [{after}]
def replace(self, target):
    left[0] -= 1
    if left[0] == 0 and {before}: os.kill(os.getpid(), signal.SIGKILL)
    rename(self, target)
    if left[0] == 0: os.kill(os.getpid(), signal.SIGKILL)
pathlib.Path.replace = replace
main.main(sys.argv[1:])
"""
"""`vplog`, killed as it writes one file: before that is renamed, or behind it."""


def test_a_killed_run_is_gone_on_with_to_the_same_bytes(
    log: Path, whole: Path, tmp_path: Path, verb: Callable[..., Said], decoded: list[int]
) -> None:
    """Killed twice at random moments, the second time while it is gone on with."""
    out, chance = tmp_path / "run", random.Random(20)
    command = ["run", "-o", str(out), "--threads", "2"]
    for after, told in ((chance.randint(4, 6), [str(log), *OPTIONS]), (chance.randint(4, 14), ["--resume", str(log)])):
        code = KILLED.format(part=PART, after=after, before=chance.random() < 0.5)
        status, _, error = Forked(code, *command, *told).ended()
        assert status == -signal.SIGKILL, error
        assert read_run_json(out / ".cache" / "run.json")["finished"] is False
        assert not (out / "run.json").exists()
    done = list((out / ".cache").glob("extract-*"))
    assert len(done) >= 2
    assert verb(*command, "--resume", "--json").json["stages"]["extract"]["parts_reused"] == len(done)
    assert len(decoded) <= max(COUNT - PART * len(done), 0) + 6
    assert results(out) == results(whole)
    assert not list(out.rglob("*.part"))
    names = {file.name for file in (out / ".cache").iterdir()}
    assert names == {file.name for file in (whole / ".cache").iterdir()}, "nothing half written stays"
    assert "is finished" in verb(*command, "--resume").error


CHANGES = [
    (["pictures.closures=1"], []),
    (["solve.kind=dcs", "noise.source=model"], []),
    (["gps.use=true", "refine.max_rounds=1"], []),
    (["verify.min_matches=90"], ["verify"]),
    (["propose.per_query=3"], ["propose", "verify"]),
    (["places.kind=gist", "places.scales=1", "places.orientations=1"], ["describe", "propose", "verify"]),
    (["library.seed=2"], ["choose", "cover", "describe", "propose"]),
]
"""Settings, and what is computed again of what is kept; other references do not change what thumbnails find."""


@pytest.mark.parametrize(("changed", "anew"), CHANGES, ids=lambda one: "+".join(one) or "nothing")
def test_a_changed_setting_computes_what_depends_on_it(
    changed: list[str], anew: list[str], log: Path, again: Path, decoded: list[int]
) -> None:
    run(log, again, load_pipeline("default", [*QUICK, *changed]))
    assert computed(again) == anew
    assert len(decoded) == (6 if "choose" in anew else 0)


def test_settings_of_features_and_pictures_extract_anew(log: Path, again: Path, decoded: list[int]) -> None:
    """By the keys alone."""
    pipeline = load_pipeline("default", QUICK)
    known = {part.key for part in parts_of(log, pipeline)}
    for changed in ("features.max_features=299", "pictures.quality=74", "stereo.min_disparity_px=2"):
        other = load_pipeline("default", [*QUICK, changed])
        assert not known & {part.key for part in parts_of(log, other)}
    assert known == {part.key for part in parts_of(log, load_pipeline("default", [*QUICK, "verify.min_matches=3"]))}
    assert not known & {part.key for part in parts_of(log, pipeline, logs.TopicChoice(camera_info=""))}
    assert known == {part.key for part in parts_of(log, pipeline, logs.TopicChoice(gps=""))}
    assert missing_parts(again / ".cache", parts_of(log, pipeline)) == []
    assert not decoded


def test_without_a_cache_nothing_is_found_and_nothing_stays(log: Path, whole: Path, again: Path) -> None:
    run(log, again, load_pipeline("default", QUICK), cache=CacheOptions(use=False))
    assert computed(again) == list(STEPS)
    assert not (again / ".cache").exists()
    assert results(again) == results(whole)


def test_damage_is_said_and_made_good(log: Path, whole: Path, again: Path) -> None:
    cache, chance = again / ".cache", random.Random(3)
    [first, second, *_] = sorted(cache.glob("extract-*"))
    flipped = bytearray(first.read_bytes())
    flipped[chance.randrange(len(flipped))] ^= 1 << chance.randrange(8)
    first.write_bytes(flipped)
    second.write_bytes(second.read_bytes()[: -chance.randrange(1, 1000)])
    [described], [proposed] = cache.glob("describe-*"), cache.glob("propose-*")
    described.write_bytes(b"")
    proposed.write_bytes(second.read_bytes())
    (cache / "inputs.json").write_text("[1, 2")
    record = run(log, again, load_pipeline("default", QUICK)).record
    assert record["stages"]["extract"]["parts_reused"] == len(list(cache.glob("extract-*"))) - 2
    assert computed(again) == ["extract", "describe", "propose"]
    assert [said.split(" in ")[0] for said in record["warnings"]] == [
        file.name for file in (first, second, described, proposed)
    ]
    assert results(again) == results(whole)


def test_a_log_is_known_by_its_content_where_its_times_are_new(
    log: Path, again: Path, tmp_path: Path, decoded: list[int]
) -> None:
    pipeline, copy = load_pipeline("default", QUICK), tmp_path / log.name
    shutil.copyfile(log, copy)
    run(copy, again, pipeline)
    assert not decoded
    assert computed(again) == []
    data = bytearray(copy.read_bytes())
    data[-9] ^= 1  # in the file's last record: what is read of it stays the same, but who knows that
    before = copy.stat()
    copy.write_bytes(data)
    os.utime(copy, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert not missing_parts(again / ".cache", parts_of(log, pipeline, cache=again / ".cache"))
    assert missing_parts(again / ".cache", parts_of(copy, pipeline, cache=again / ".cache"))


def test_what_was_lost_and_said_is_told_again(log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    original, bad = RecordedFrame.decode, [part.stamp_ns[3] for part in parts_of(log, load_pipeline("default", QUICK))]

    def damaged(frame: RecordedFrame) -> Any:
        if frame.stamp_ns in bad:
            frame._count_undecodable(frame.image.channel)
            raise LogError("it is damaged")
        return original(frame)

    monkeypatch.setattr(RecordedFrame, "decode", damaged)
    told = [run(log, tmp_path, load_pipeline("default", QUICK)).record for _ in range(2)]
    assert computed(tmp_path) == []
    assert any(f"{len(bad)} of {COUNT} keyframes were lost" in said for said in told[0]["warnings"])
    assert [loss["messages"] for loss in told[0]["losses"]] == [len(bad)]
    for name in ("warnings", "losses", "counts", "library"):
        assert told[0][name] == told[1][name]


def test_a_full_disk_costs_the_cache_but_not_the_run(
    log: Path, again: Path, whole: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    put = StageCache.put

    def full(cache: StageCache, name: str, data: bytes) -> Path:
        if name.startswith(("verify", "propose")):
            raise ResultError("Cannot write it: No space left on device.")
        return put(cache, name, data)

    for file in [*(again / ".cache").glob("verify*"), *(again / ".cache").glob("propose*")]:
        file.unlink()
    monkeypatch.setattr(StageCache, "put", full)
    record = run(log, again, load_pipeline("default", QUICK)).record
    assert [said for said in record["warnings"] if "are not cached" in said and "No space left" in said]
    assert len(record["warnings"]) == 1
    assert results(again) == results(whole)


def test_parts_computed_elsewhere_spare_the_run_all_images(
    log: Path, whole: Path, tmp_path: Path, decoded: list[int]
) -> None:
    pipeline, cache = load_pipeline("default", QUICK), tmp_path / "cache"
    todo = parts_of(log, pipeline)
    assert [len(part.stamp_ns) for part in todo] == [PART] * (COUNT // PART)
    for part in reversed(todo):
        data = compute_part(part, Execution(1 + part.number))
        assert data == (whole / ".cache" / part.file).read_bytes()
        with pytest.raises(ResultError, match="arrived damaged"):
            put_part(cache, part, data[:-1])
        put_part(cache, part, data)
    assert missing_parts(cache, todo) == []
    with pytest.raises(LogError, match="changed during the run"):
        compute_part(replace(todo[0], lengths=""))
    decoded.clear()
    run(log, tmp_path / "run", pipeline, cache=CacheOptions(cache))
    assert len(decoded) == 6, "the references alone"
    assert results(tmp_path / "run") == results(whole)
    assert not (tmp_path / "run" / ".cache").exists()
    features = stored_features(cache)
    assert features is not None
    assert len(features) == COUNT
    assert features[COUNT - 1].thumbnail is not None
    (cache / todo[1].file).unlink()
    assert stored_features(cache) is None


def drive_of(path: Path) -> tuple[Any, Keyframes, list[Any]]:
    """A log, its frames as keyframes, and these in parts."""
    log = logs.open(path)
    keyframes = Keyframes(log.name, log.stamps(), np.tile(np.eye(4), (len(log.stamps()), 1, 1)))
    return (
        log,
        keyframes,
        split_keyframes([path], None, log.camera().name, Pipeline(), keyframes, inputs_of(path, None)),
    )


@pytest.mark.parametrize("kind", ["video", "damaged video", "depth"])
def test_parts_are_those_of_the_whole_drive(kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Parts that end amid the frames between two key frames, and with depth."""
    if kind == "depth":
        monkeypatch.setattr(feature_extraction, "PART_KEYFRAMES", 2)
        path = write_ros2(tmp_path / "drive", ros_messages(drives.Drive(), 2))
    else:
        payloads = list(packets("h264"))
        if kind == "damaged video":
            payloads[15] = b"\0" * len(payloads[15])
        path = write_raw(tmp_path / "drive.mcap", messages("foxglove", payloads))
    log, keyframes, todo = drive_of(path)
    with Steps(path, tmp_path / "cache", Execution(2)) as do:
        found = do(extract, log, logs.TopicChoice(), keyframes, Pipeline())
    for part in todo:
        assert compute_part(part) == (tmp_path / "cache" / part.file).read_bytes()
    assert len(todo) > 2
    assert len(found) + len(found.lost) == len(keyframes.stamp_ns)
    assert bool(found.lost) == (kind == "damaged video")
    assert any(np.isfinite(found[row].depth_m).any() for row in range(len(found))) == (kind == "depth")


@pytest.fixture(scope="module")
def part_file(whole: Path) -> bytes:
    return min((whole / ".cache").glob("extract-*"), key=lambda file: file.stat().st_size).read_bytes()


NUMBERS = st.one_of(
    st.integers(-3, 3), st.integers(-(2**70), 2**70), st.just(128 * 128), st.none(), st.text(max_size=3)
)


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.data())
def test_the_head_of_a_part_is_not_believed(
    part_file: bytes, tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    """Sealed by who knows how: what it names is read from the file, or it is damaged; nothing else happens."""
    content = part_file[CONTENT_AT:]
    [length] = feature_shards._LENGTH.unpack(content[:4])
    head = json.loads(content[4 : 4 + length])
    what = data.draw(st.sampled_from(["rows", "lost", "undecodable", "row", "length", "bytes"]))
    if what == "row":
        row = head["rows"][0]
        row[data.draw(st.integers(0, len(row) - 1))] = data.draw(NUMBERS)
    elif what in head:
        head[what] = data.draw(
            st.one_of(NUMBERS, st.lists(NUMBERS, max_size=3), st.lists(st.lists(NUMBERS, max_size=8)))
        )
    text = json.dumps(head).encode() if what != "bytes" else data.draw(st.binary(max_size=40))
    told = data.draw(st.integers(0, 2**32 - 1)) if what == "length" else len(text)
    file = tmp_path_factory.getbasetemp() / "part"
    file.write_bytes(sealed("0" * 64, feature_shards._LENGTH.pack(told) + text + content[4 + length :]))
    found = Extracted()
    try:
        found.add(file)
    except DamagedError:
        return
    for row in range(len(found)):
        assert len(found[row]) <= len(part_file) / 128


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.data())
def test_no_bytes_harm_the_reader_of_a_stage(
    whole: Path, log: Path, tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    """Of any stage, resealed after a change: a value or an error that the cache makes good, at the cost of its size."""
    readers = {"verify": closures_codec(), "propose": columns_codec(Proposals), "choose": images_codec()}
    name = data.draw(st.sampled_from(sorted(readers)))
    [file] = (whole / ".cache").glob(f"{name}-*")
    content = bytearray(file.read_bytes()[CONTENT_AT:].partition(b"\n")[2])
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, min(len(content) - 1, 600)))] = data.draw(st.integers(0, 255))
    try:
        readers[name].from_bytes(bytes(content))
    except (ValueError, TypeError, KeyError, cv2.error, ResultError):
        return


def test_a_run_begins_where_another_was_killed_at_once_and_keeps_a_library_that_is_given(tmp_path: Path) -> None:
    out, pipeline = tmp_path / "out", load_pipeline("default", QUICK)
    log, staging = tmp_path / "log", out / ".vplog-staging"
    staging.mkdir(parents=True)
    (staging / "run.json").write_text("{")
    (out / ".vplog-lock").touch()
    log.write_text("a log")

    def done(library: Path | None = None) -> None:
        account = head(pipeline, log, 1)
        with staged_run(out, account, [log], library) as made:
            (made / "run.json").write_text(json.dumps(account))

    done()
    assert {file.name for file in out.iterdir()} == {"run.json"}
    (out / "library").mkdir()
    (out / "library" / "library.json").write_text("{}")
    done(out / "library")
    assert (out / "library" / "library.json").exists()
    done()
    assert not (out / "library").exists(), "an earlier run's"


def test_nothing_to_resume_is_one_line(log: Path, whole: Path, tmp_path: Path, verb: Callable[..., Said]) -> None:
    assert "has no run.json" in verb("run", "--resume", "-o", tmp_path / "none").error
    assert "is finished" in verb("run", "--resume", "-o", whole).error
    account = read_run_json(whole / "run.json")
    out = tmp_path / "out"
    out.mkdir()

    def resume(**changed: Any) -> str:
        (out / "run.json").write_text(json.dumps({**account, "finished": False, **changed}))
        return verb("run", "--resume", "-o", out).error

    assert "no longer exists" in resume(log=str(tmp_path / "gone.mcap")) or "No log at" in resume(
        log=str(tmp_path / "gone")
    )
    assert "lacks log" in resume(log=None)
    assert "lacks topics" in resume(topics=None)
    assert "lacks library.from" in resume(library={})
    assert "no_such_setting" in resume(settings={"no_such_setting": 1})
    assert "is not a library" in resume(library={"from": str(tmp_path / "lost")})
    (out / "run.json").write_text(json.dumps({**account, "finished": False}))
    other = tmp_path / "other.mcap"
    assert "Leave out the log" in verb("run", "--resume", other, "-o", out).error
    for option in (
        ["--set", "verify.min_matches=3"],
        ["--gps"],
        ["--no-cache"],
        ["--image-topic", "/a"],
        ["--camera-height-m", "1.5"],
        ["--start", "1"],
        ["--decisions", "d.csv"],
    ):
        said = verb("run", "--resume", "-o", out, *option)
        assert said.code == 2
        assert f"leave out {option[0]}" in said.err
    assert verb("run", "-o", out).code == 2
