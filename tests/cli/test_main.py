"""The verbs as users call them: what is printed where, how they exit, and what bad input leads to."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

import vplog
from tests.cli.test_help import verbs
from tests.forked import VPLOG, Forked
from tests.joined import rewritten
from vplog.cli import main
from vplog.results.run_record import read_run_json
from vplog.verbs.demo.record import GPS, IMAGE, ODOMETRY, TYPES

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from conftest import Said
    from mcap.records import Message

    from vplog.verbs.demo.record import Demo

    Verb = Callable[..., Said]
    Change = Callable[[str, int, bytes], bytes | None]

QUICK = (
    "--set", "features.max_features=250", "--set", "features.max_megapixels=0.04", "--set", "features.min_features=0",
    "--set", "propose.per_query=2", "--set", "library.size=4", "--set", "places.neighbours=8",
    "--set", "propose.gap_keyframes=15", "--set", "propose.gap_steps=15", "--set", "verify.calibration.pairs=0",
)  # fmt: skip
"""For runs of which only the course matters, with closures on the tiny drive."""
_STORE = get_typestore(Stores.ROS2_HUMBLE)


def changed(source: Path, target: Path, change: Change) -> Path:
    """A copy of a log with change(topic, number on its topic, data) of every message, without those that are None."""
    numbers: dict[str, int] = {}

    def counted(topic: str, message: Message) -> bytes | None:
        numbers[topic] = numbers.get(topic, -1) + 1
        return change(topic, numbers[topic], message.data)

    return rewritten(source, target, counted)


def without(*topics: str) -> Change:
    return lambda name, _, data: None if name in topics else data


def with_position(value: Callable[[int, float], float]) -> Change:
    """Odometry with x changed: value(number, x)."""

    def change(topic: str, number: int, data: bytes) -> bytes:
        if topic != ODOMETRY:
            return data
        message: Any = _STORE.deserialize_cdr(data, TYPES[ODOMETRY])
        message.pose.pose.position.x = value(number, message.pose.pose.position.x)
        return bytes(_STORE.serialize_cdr(message, TYPES[ODOMETRY]))

    return change


def record_of(folder: Path) -> dict[str, Any]:
    return read_run_json(folder / "run.json")


# What every verb has in common


def test_help_names_every_verb_and_explains_it(verb: Verb) -> None:
    said = verb("--help")
    assert said.code == 0
    found = list(verbs(main._parser()))
    assert len(found) > 20
    for one in found:
        words = one.prog.split()[1:]
        assert not words or words[0] in said.out
        of_verb = verb(*words, "--help")
        assert of_verb.code == 0
        if words and words[0] != "help" and words != ["map"]:
            assert "--json" in of_verb.out
            assert "--debug" in of_verb.out


def test_version(verb: Verb) -> None:
    assert verb("--version").out == f"vplog {vplog.__version__}\n"


@pytest.mark.parametrize(
    "arguments",
    [
        (),
        ("fly",),
        ("run",),
        ("run", "a.mcap"),
        ("run", "a.mcap", "-o", "out", "--fast"),
        ("run", "a.mcap", "-o", "out", "--threads", "0"),
        ("run", "a.mcap", "-o", "out", "--threads", "many"),
        ("evaluate",),
        ("info", "a.mcap", "b.mcap"),
        ("map",),
        ("explain", "out", "--closure", "K"),
        ("export", "out", "--format", "tum"),
    ],
    ids=" ".join,
)
def test_wrong_usage_exits_with_2(verb: Verb, arguments: tuple[str, ...]) -> None:
    said = verb(*arguments)
    assert (said.code, said.out) == (2, "")
    assert said.err.startswith("usage: vplog")
    assert "Traceback" not in said.err


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ("infp drive.mcap", "Did you mean info?"),
        ("map exprt M -o x.parquet", "Did you mean export?"),
        ("fly", "Verbs: info, library, run,"),
        ("--json info drive.mcap", "--json goes after the verb: vplog VERB --json"),
        ("run A -o OUT --otput x", "Did you mean --output?"),
        ("run A --otput x", "no option --otput. Did you mean --output?"),
        ("run A -o OUT --odometry-fil x", "--odometry-file"),
        ("run A -o OUT --closure 3", "It is an option of vplog explain."),
        ("evaluate RUN --truth gps --methods bobb", "It is an option of vplog compare, vplog study."),
        ("run A -o OUT --threads many", "argument --threads: must be a whole number from 1 to 1000000000, not 'many'"),
        ("run A -o OUT --threads 0", "from 1 to"),
        ("batch A -o MAP --retries -1", "from 0 to"),
        ("compare A --methods bobb --truth gps --distance-m near", "must be a number above 0, not 'near'"),
        ("export RUN --format kity -o FILE", "'kity' is none of tum, kitti, euroc,"),
        ("export RUN --format kity -o FILE", "Did you mean kitti?"),
        ("evaluate RUN --truth gps --truth-offset-s soon", "must be a number between -1e+09 and 1e+09, not 'soon'"),
        ("explain RUN --closure Q:M", "not 'Q:M'"),
        ("explain RUN --closure 1:2:3", "(QUERY:MATCH)"),
        ("explain RUN --closure 3,4", "(QUERY:MATCH)"),
        ("library A -o LIB --thread 3", "no option --thread. Did you mean --threads?"),
        ("info A B", "one argument too many: B"),
        ("run --closuer none A", "no option --closuer. Did you mean --closure of vplog explain?"),
        (
            "run A -o OUT -odometry-topic /odom",
            "no option -odometry-topic. Write it with two hyphens: --odometry-topic.",
        ),
        ("egport RUN --format kitti -o FILE", "Did you mean export?"),
        ("run A -o OUT --topic /cam", "Write it in full: --image-topic, --depth-topic,"),
        ("help fly", "Verbs: info"),
        ("query MAP LOG", "Did you mean vplog map query?"),
        ("run A -o OUT \u2014resume", "\u2014resume begins with another dash. Write --resume"),
        ("run A -o OUT --resume=yes", "argument --resume: takes no value, not 'yes'"),
        ("run -o OUT", "LOG"),
    ],
)
def test_wrong_usage_says_what_is_meant_in_one_line(verb: Verb, arguments: str, said: str) -> None:
    answer = verb(*arguments.split())
    assert (answer.code, answer.out) == (2, "")
    usage, *_, error = answer.err.splitlines()
    assert usage.startswith("usage: vplog")
    assert said in error
    assert error.split(": error: ")[1].count("All options: vplog") == 1
    assert "invalid" not in error


@pytest.mark.parametrize(
    "arguments",
    [
        ("x" * 300,), ("info", "x" * 300), ("localize", "M", "P", "-o", "x" * 300), ("schemas", "-o", "x" * 300),
        ("run", "A", "-o", "OUT", "--mask", "x" * 300), ("info", "a\nb"), ("run", "--resume", "-o", "a\nb"),
        ("map", "info", "a\x1bb\n"), ("info", "a", "b\nc"), ("info", "\udcff"),
        ("run", "A", "-o", "\udcff/a"), ("config", "--pipeline", "x" * 300 + ".yaml"),
    ],
    ids=lambda words: " ".join(word[:9] for word in words),
)  # fmt: skip
def test_a_name_that_is_too_long_or_has_line_ends_is_an_error_in_one_line(
    verb: Verb, arguments: tuple[str, ...]
) -> None:
    said = verb(*arguments)
    assert said.code in (1, 2)
    *usage, error = said.err.splitlines()
    assert error.startswith("vplog")
    assert "error: " in error
    assert "\x1b" not in error
    assert said.code == 2 or not usage


@pytest.mark.parametrize("words", ["info {}", "map merge {} -o OUT", "run --resume -o {}", "library A -o {}"])
def test_a_link_to_itself_is_refused(verb: Verb, tmp_path: Path, words: str) -> None:
    loop = tmp_path / "loop"
    loop.symlink_to(loop)
    said = verb(*words.format(loop).split())
    assert said.code == 2
    assert f"{loop} is a link that leads to itself" in said.err


@pytest.mark.parametrize("words", ["info s3://", "diff A gs:///run", "batch http:// -o B", "run https://?a -o B"])
def test_a_url_without_a_server_is_refused(verb: Verb, words: str) -> None:
    said = verb(*words.split())
    assert said.code in (1, 2)
    assert re.search("names no (bucket|server). Write [a-z0-9]+://", said.err)


def test_a_path_that_does_not_exist_names_the_nearest(
    verb: Verb, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("drive.mcap", "truth.tum", "calibration.yaml", "graph.g2o"):
        (tmp_path / name).write_bytes(b"")
    (tmp_path / "runs").mkdir()
    for words, meant in {
        "info drive.mcp": "drive.mcap",
        "optimize grahp.g2o -o out.g2o": "graph.g2o",
        "evaluate run --truth truth.tum": "runs",
        "map info rums": "runs",
        "config --pipeline calibratoin.yaml": "calibration.yaml",
    }.items():
        said = verb(*words.split())
        assert said.code == 1
        assert f"Did you mean {meant}?" in said.err


def test_what_export_lacks_is_said_beside_what_its_output_may_be(verb: Verb) -> None:
    assert "-o FILE|FOLDER|-" in verb("export", "RUN", "-o", "-").err


def test_every_unknown_option_of_every_verb_is_named_before_anything_else(verb: Verb) -> None:
    for one in verbs(main._parser()):
        said = verb(*one.prog.split()[1:], "--frobnicate", "7")
        assert said.code == 2
        assert "no option --frobnicate" in said.err


@pytest.mark.parametrize(
    "arguments",
    ["A B -o OUT --threads 2", "-o OUT A --threads 2 B", "A -o OUT B --threads 2", "--threads 2 -o OUT A B",
     "-oOUT A B", "A --output=OUT B", "-o OUT -- A B"],
)  # fmt: skip
def test_logs_may_stand_anywhere_among_the_options(arguments: str) -> None:
    from pathlib import Path

    found = main._parser().parse_args(["run", *arguments.split()])
    assert found.logs == [Path("A"), Path("B")]
    assert found.output == Path("OUT")
    two = main._parser().parse_args(["compare", "--truth", "index", "A", "--methods", "bobb", "B", "--sequence", "3"])
    assert (two.query, two.map, two.sequence) == (Path("A"), Path("B"), 3)
    assert main._parser().parse_args(["compare", "--truth", "index", "--methods", "bobb", "A"]).map is None
    box = main._parser().parse_args(["map", "export", "M", "--box=-33.9,18,-33,19", "-o", "F", "R"])
    assert (box.sources, box.box) == ([Path("M"), Path("R")], (-33.9, 18.0, -33.0, 19.0))


def test_help_is_a_verb_too(verb: Verb) -> None:
    assert verb("help").out == verb("--help").out
    assert verb("help", "run").out == verb("run", "--help").out
    assert verb("help", "map", "query").out == verb("map", "query", "--help").out
    assert verb("-V").out == verb("--version").out


def test_a_mistyped_topic_finds_the_one_meant(verb: Verb, drive: Demo) -> None:
    for typed in (IMAGE.strip("/"), IMAGE.upper(), IMAGE[:-2]):
        error = verb("info", drive.log, "--image-topic", typed).error
        assert f"Did you mean {IMAGE}?" in error


def test_json_of_info(verb: Verb, drive: Demo) -> None:
    said = verb("info", drive.log, "--json")
    assert said.err == ""
    assert said.json["kind"] == "mcap"
    assert {topic["name"]: topic["count"] for topic in said.json["topics"]}[IMAGE] == len(drive.stamp_ns)
    assert drive.camera.matrix is not None
    np.testing.assert_allclose(said.json["camera"]["matrix"], drive.camera.matrix)


def test_info_in_words_names_topics_and_the_command_to_run(verb: Verb, drive: Demo) -> None:
    said = verb("info", drive.log)
    assert said.code == 0
    assert IMAGE in said.out
    assert ODOMETRY in said.out
    assert f"vplog run {drive.log} -o OUT" in said.out


def test_json_of_library_and_run(compiled: None, verb: Verb, tiny: Demo, tmp_path: Path) -> None:
    made = verb("library", tiny.log, "-o", tmp_path / "library", *QUICK, "--json")
    assert made.err == ""
    assert made.json["references"] == 4
    ran = verb("run", tiny.log, "-o", tmp_path / "run", "--library", tmp_path / "library", *QUICK, "--json")
    assert ran.err == ""
    assert ran.json["finished"] is True
    assert ran.json["library"]["hash"] == made.json["hash"]
    assert {**record_of(tmp_path / "run"), "run": str(tmp_path / "run")} == ran.json


def test_json_of_evaluate_config_and_schemas(verb: Verb, drive: Demo, finished: Path, tmp_path: Path) -> None:
    for truth in (str(drive.truth), "gps"):
        said = verb("evaluate", finished, "--truth", truth, "--json")
        assert said.err == ""
        assert said.json["ate_after"]["count"] > 0
    assert verb("config", "--json").json == record_of(finished)["settings"]
    assert verb("schemas", "-o", tmp_path / "schemas", "--json").json["written"]


def test_evaluate_says_by_which_criteria(verb: Verb, drive: Demo, finished: Path, tmp_path: Path) -> None:
    found = verb("evaluate", finished, "--truth", drive.truth, "--json").json
    closures = found["closures"]
    assert closures["accepted_true"] + closures["accepted_false"] + closures["not_judged"] == closures["accepted"] > 0
    said = verb("evaluate", finished, "--truth", drive.truth).out
    for text in (
        f"{closures['accepted_true']} of them true", f"within {closures['criterion']['translation_m']:.2f} m and 5 deg",
        "within 6 m and 45 deg between optical axes", "(SE(3))", "per 100 m", "segments of",
    ):  # fmt: skip
        assert text in said
    narrow = ("evaluate", finished, "--truth", drive.truth, "--distance-m", 0.02, "--heading-deg", 2, "--align", "sim3")
    other = verb(*narrow, "--json").json
    assert other["closures"]["accepted_true"] == closures["accepted_true"]  # the pose's bounds are others
    assert other["closures"]["same_place"] < closures["same_place"]
    assert other["ate_after"]["alignment"] == "Sim(3)"
    assert "within 0.02 m and 2 deg between optical axes" in verb(*narrow).out
    for option in (("--distance-m", 3), ("--heading-deg", 9), ("--truth-offset-s", 1), ("--align", "origin")):
        assert str(option[0]) in verb("evaluate", finished, "--truth", "gps", *option).error


def test_evaluate_with_a_clock_that_is_said_to_be_off_and_a_truth_of_the_camera(
    verb: Verb, drive: Demo, finished: Path, tmp_path: Path
) -> None:
    from vplog.data import Trajectory
    from vplog.evaluate.truth import read_truth
    from vplog.geometry import se3
    from vplog.geometry.tum import write_tum
    from vplog.results.mcap_read import read_camera_poses

    true, (camera,) = read_truth(drive.truth), read_camera_poses(finished / "result.mcap")
    plain = verb("evaluate", finished, "--truth", drive.truth, "--json").json
    late, of_camera = tmp_path / "late.tum", tmp_path / "camera.tum"
    write_tum(late, Trajectory(true.stamp_ns - 400_000_000, true.world_from_body))
    write_tum(of_camera, Trajectory(true.stamp_ns, true.world_from_body @ camera))
    shifted = verb("evaluate", finished, "--truth", late, "--truth-offset-s", 0.4, "--json").json
    assert shifted["ate_after"]["rmse_m"] == pytest.approx(plain["ate_after"]["rmse_m"], abs=1e-6)
    assert shifted["closures"] == plain["closures"]
    assert verb("evaluate", finished, "--truth", late, "--json").json["ate_after"] != plain["ate_after"]
    found = verb("evaluate", finished, "--truth", of_camera)
    assert "The truth is that of the camera" in found.err
    assert f"{plain['closures']['accepted_true']} of them true" in found.out
    assert not np.array_equal(se3.inverse(camera), camera)
    positions, poses = tmp_path / "positions.tum", np.tile(np.eye(4), (len(true.stamp_ns), 1, 1))
    poses[:, :3, 3] = true.world_from_body[:, :3, 3]
    write_tum(positions, Trajectory(true.stamp_ns, poses))
    found = verb("evaluate", finished, "--truth", positions, "--json").json
    assert found["ate_after"]["rmse_m"] == pytest.approx(plain["ate_after"]["rmse_m"], abs=1e-6)
    assert (found["rpe_after"], found["drift_after"]) == (None, None)
    assert "RPE" not in verb("evaluate", finished, "--truth", positions).out


def test_evaluate_and_config_in_words(verb: Verb, drive: Demo, finished: Path, tmp_path: Path) -> None:
    assert "ATE rmse" in verb("evaluate", finished, "--truth", drive.truth).out
    assert "ATE rmse" in verb("evaluate", finished, "--truth", "gps").out
    file = tmp_path / "mine.yaml"
    file.write_text(verb("config").out)
    assert verb("config", "--pipeline", file, "--json").json == verb("config", "--json").json


def test_set_changes_one_setting_and_keeps_the_method(verb: Verb) -> None:
    default = verb("config", "--json").json
    for name, value in (("places.references", 3), ("solve.max_iterations", 7), ("features.max_features", 99)):
        stage, setting = name.split(".")
        changed = verb("config", "--set", f"{name}={value}", "--json").json
        assert changed == {**default, stage: {**default[stage], setting: value}}


def test_the_command_runs_in_a_process_of_its_own(drive: Demo) -> None:
    command = [sys.executable, "-m", "vplog", "info", drive.log, "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert json.loads(done.stdout)["kind"] == "mcap"


def test_debug_shows_the_traceback(capfd: pytest.CaptureFixture[str]) -> None:
    from vplog.errors import LogError

    with pytest.raises(LogError):
        main.main(["info", "missing.mcap", "--debug"])
    capfd.readouterr()


# Logs that cannot be used


def missing(folder: Path, _: Path) -> Path:
    return folder / "missing.mcap"


def empty(folder: Path, _: Path) -> Path:
    (folder / "empty.mcap").touch()
    return folder / "empty.mcap"


def wrong_magic(folder: Path, log: Path) -> Path:
    (folder / "other.mcap").write_bytes(b"RIFF" + log.read_bytes()[4:])
    return folder / "other.mcap"


def no_images(folder: Path, log: Path) -> Path:
    return changed(log, folder / "blind.mcap", without(IMAGE))


def no_odometry(folder: Path, log: Path) -> Path:
    return changed(log, folder / "lost.mcap", without(ODOMETRY, GPS))


def no_messages(folder: Path, log: Path) -> Path:
    return changed(log, folder / "nothing.mcap", lambda *_: None)


def one_frame(folder: Path, log: Path) -> Path:
    return changed(log, folder / "one.mcap", lambda topic, n, data: None if topic == IMAGE and n else data)


def no_decodable_image(folder: Path, log: Path) -> Path:
    def cut(topic: str, _: int, data: bytes) -> bytes:
        return data[:100] + bytes(len(data) - 100) if topic == IMAGE else data

    return changed(log, folder / "black.mcap", cut)


def only_nan_odometry(folder: Path, log: Path) -> Path:
    indoors = changed(log, folder / "indoors.mcap", without(GPS))
    return changed(indoors, folder / "nan.mcap", with_position(lambda *_: np.nan))


def image_folder(folder: Path, _: Path) -> Path:
    import cv2

    (folder / "images").mkdir()
    for number in range(3):
        cv2.imwrite(str(folder / "images" / f"{number:03d}.png"), np.full((48, 64), 60 * number, np.uint8))
    return folder / "images"


@pytest.mark.parametrize(
    ("make", "why"),
    [
        (missing, "no such file"),
        (empty, "empty"),
        (wrong_magic, "RIFF"),
        (no_images, "image"),
        (no_messages, "odometry"),
        (one_frame, "two"),
        (no_decodable_image, "decodes"),
        (image_folder, "odometry"),
    ],
    ids=lambda value: value.__name__ if callable(value) else "",
)
def test_a_log_that_cannot_be_run_is_one_line(
    verb: Verb, tiny: Demo, tmp_path: Path, make: Callable[[Path, Path], Path], why: str
) -> None:
    log = make(tmp_path, tiny.log)
    error = verb("run", log, "-o", tmp_path / "run", *QUICK).error
    assert why in error
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("make", [no_odometry, only_nan_odometry])
def test_a_log_without_odometry_is_run_by_its_images_unless_it_may_not(
    verb: Verb, tiny: Demo, tmp_path: Path, make: Callable[[Path, Path], Path]
) -> None:
    log = make(tmp_path, tiny.log)
    assert "has no odometry" in verb("run", log, "-o", tmp_path / "run", "--odometry", "", *QUICK).error
    assert not (tmp_path / "run").exists()
    found = verb("run", log, "-o", tmp_path / "run", "--json", *QUICK).json
    assert found["scale"] == "unknown"
    assert any("visual odometry of its images is used" in line for line in found["warnings"])


def test_topics_that_are_not_there_are_named_with_the_choices(verb: Verb, drive: Demo, tmp_path: Path) -> None:
    error = verb("run", drive.log, "-o", tmp_path / "run", "--image-topic", "/nowhere").error
    assert "/nowhere" in error
    assert IMAGE in error
    assert ODOMETRY in verb("info", drive.log, "--odometry-topic", "/nowhere").error
    error = verb("run", drive.log, "-o", tmp_path / "run", "--odometry", "twist").error
    assert "no odometry by --odometry twist" in error
    assert "/nowhere" in verb("library", drive.log, "-o", tmp_path / "library", "--image-topic", "/nowhere").error
    assert not (tmp_path / "library").exists()


# Settings, folders and truths that do not fit


@pytest.mark.parametrize(
    ("options", "why"),
    [
        (("--pipeline", "nonsense"), "default, fast, paper"),
        (("--pipeline", "nonsense.yaml"), "nonsense.yaml"),
        (("--set", "propose.nonsense=1"), "propose.nonsense"),
        (("--set", "nonsense.per_query=1"), "nonsense"),
        (("--set", "propose.per_query=0"), "propose.per_query"),
        (("--set", "propose.per_query=many"), "many"),
        (("--set", "propose.per_query=.nan"), "propose.per_query"),
        (("--set", "propose=1"), "propose"),
        (("--set", "library.size=0"), "library.size"),
        (("--set", "library.seed=-1"), "library.seed"),
        (("--set", "propose.per_query.more=1"), "per_query"),
        (("--set", "propose.per_query"), "stage.setting=value"),
        (("--set", "propose.per_query=["), "YAML"),
        (("--set", "solve.kind=nonsense"), "gnc"),
    ],
    ids=lambda value: value[1] if isinstance(value, tuple) else "",
)
def test_settings_that_do_not_fit_are_one_line(
    verb: Verb, drive: Demo, tmp_path: Path, options: tuple[str, ...], why: str
) -> None:
    assert why in verb("run", drive.log, "-o", tmp_path / "run", *options).error
    assert why in verb("config", *options).error
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("text", ["[1, 2]", "a: [", "a: 1\n" * 300_000, "\x00"], ids=["list", "broken", "big", "zero"])
def test_pipeline_files_that_are_none(verb: Verb, tmp_path: Path, text: str) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text(text)
    assert str(file) in verb("config", "--pipeline", file).error


def test_output_that_cannot_be_a_run_folder(verb: Verb, drive: Demo, tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "holiday.jpg").touch()
    (tmp_path / "file").write_text("mine")
    for out, why in (("photos", "not a run"), ("file", "file"), ("file/below", "file")):
        assert why in verb("run", drive.log, "-o", tmp_path / out).error
    assert (tmp_path / "file").read_text() == "mine"
    assert [path.name for path in (tmp_path / "photos").iterdir()] == ["holiday.jpg"]


def test_output_of_the_other_verbs_that_cannot_be_written(verb: Verb, drive: Demo, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    for out in ("file", "file/below"):
        assert "file" in verb("schemas", "-o", tmp_path / out).error
        assert "file" in verb("library", drive.log, "-o", tmp_path / out, *QUICK).error
    assert "file" in verb("demo", "-o", tmp_path / "file" / "below").error
    assert (tmp_path / "file").read_text() == "mine"


@pytest.mark.parametrize("damage", ["missing", "no record", "cut record", "cut table", "empty table", "other settings"])
def test_a_library_that_cannot_be_used_is_one_line(
    verb: Verb, drive: Demo, finished: Path, tmp_path: Path, damage: str
) -> None:
    library = tmp_path / "library"
    if damage != "missing":
        shutil.copytree(finished / "library", library)
    if damage == "no record":
        (library / "library.json").unlink()
    elif damage == "cut record":
        (library / "library.json").write_text('{"hash": ')
    elif damage == "cut table":
        table = library / "features.parquet"
        table.write_bytes(table.read_bytes()[:-100])
    elif damage == "empty table":
        (library / "references.parquet").write_bytes(b"")
    changed = ("--set", "places.references=3") if damage == "other settings" else ()
    error = verb("run", drive.log, "-o", tmp_path / "run", "--library", library, *QUICK, *changed).error
    assert str(library) in error
    if "table" not in damage:
        assert not (tmp_path / "run").exists(), "told before the run began"


def test_a_truth_that_does_not_fit_is_one_line(verb: Verb, drive: Demo, finished: Path, tmp_path: Path) -> None:
    assert "missing.tum" in verb("evaluate", finished, "--truth", tmp_path / "missing.tum").error
    assert "Cannot read" in verb("evaluate", finished, "--truth", tmp_path).error
    for name, data in (
        ("garbage", bytes(range(256)) * 20),
        ("words", b"one two three\n"),
        ("empty", b""),
        ("short", b"1 2 3\n"),
        ("nan", b"1700000000 nan 0 0 0 0 0 1\n"),
    ):
        (tmp_path / name).write_bytes(data)
        assert name in verb("evaluate", finished, "--truth", tmp_path / name).error
    (tmp_path / "other.tum").write_text("".join(f"{t} {t} 0 0 0 0 0 1\n" for t in range(20)))
    assert "clock" in verb("evaluate", finished, "--truth", tmp_path / "other.tum").error


def test_what_is_no_finished_run_cannot_be_evaluated(verb: Verb, drive: Demo, finished: Path, tmp_path: Path) -> None:
    assert "run.json" in verb("evaluate", tmp_path / "nowhere", "--truth", drive.truth).error
    assert "run.json" in verb("evaluate", drive.log.parent, "--truth", drive.truth).error
    run = tmp_path / "run"
    shutil.copytree(finished, run)
    whole = record_of(run)
    for record, why in (
        ({**whole, "finished": False}, "did not finish"),
        ({}, "did not finish"),
        ([], "JSON object"),
        ({"finished": True}, "run.json"),
        ({**whole, "settings": 3}, "run.json"),
        ({**whole, "settings": {**whole["settings"], "propose": {"per_query": 0}}}, "per_query"),
    ):
        (run / "run.json").write_text(json.dumps(record))
        assert why in verb("evaluate", run, "--truth", drive.truth).error
    (run / "run.json").write_text(json.dumps({**whole, "log": None}))
    assert "run.json" in verb("evaluate", run, "--truth", "gps").error
    (run / "run.json").write_text(json.dumps({**whole, "log": str(tmp_path / "moved.mcap")}))
    assert "moved.mcap" in verb("evaluate", run, "--truth", "gps").error
    (run / "run.json").write_text(json.dumps(whole))
    (run / "trajectory.parquet").write_bytes(b"")
    assert "trajectory.parquet" in verb("evaluate", run, "--truth", drive.truth).error


def test_a_log_without_gps_has_no_gps_truth(verb: Verb, drive: Demo, finished: Path, tmp_path: Path) -> None:
    log = changed(drive.log, tmp_path / "indoors.mcap", without(GPS))
    shutil.copytree(finished, tmp_path / "run")
    (tmp_path / "run" / "run.json").write_text(json.dumps({**record_of(finished), "log": str(log)}))
    assert "GPS" in verb("evaluate", tmp_path / "run", "--truth", "gps").error


# Logs that are damaged, and still worth a run


def run_quick(verb: Verb, log: Path, out: Path, *options: str) -> dict[str, Any]:
    return verb("run", log, "-o", out, *QUICK, *options, "--json").json


def assert_all_finite(run: Path) -> None:
    from vplog.results import tables

    trajectory, _ = tables.read_trajectory(run / "trajectory.parquet")
    _, keyframes = tables.read_keyframes(run / "keyframes.parquet")
    assert np.isfinite(trajectory.world_from_body).all()
    assert np.isfinite(keyframes).all()


def test_a_log_cut_in_the_middle_is_run_as_far_as_it_goes(verb: Verb, tiny: Demo, tmp_path: Path) -> None:
    data = tiny.log.read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[: len(data) * 6 // 10])
    record = run_quick(verb, tmp_path / "cut.mcap", tmp_path / "run")
    assert 2 <= record["counts"]["keyframes"] < len(tiny.stamp_ns)
    assert record["warnings"]
    assert_all_finite(tmp_path / "run")


def test_undecodable_images_are_left_out_and_counted(verb: Verb, tiny: Demo, tmp_path: Path) -> None:
    def spoil(topic: str, number: int, data: bytes) -> bytes:
        return data[:120] + bytes(len(data) - 120) if topic == IMAGE and number % 8 == 3 else data

    log = changed(tiny.log, tmp_path / "spots.mcap", spoil)
    count = len(tiny.stamp_ns)
    lost = len(range(3, count, 8))
    record = run_quick(verb, log, tmp_path / "run")
    assert record["counts"]["keyframes"] == count - lost
    assert any(warning.startswith(f"{lost} of {count} keyframes") for warning in record["warnings"])
    assert_all_finite(tmp_path / "run")


def test_odometry_that_is_not_finite_is_left_out_and_counted(verb: Verb, tiny: Demo, tmp_path: Path) -> None:
    values = [np.nan, np.inf, -np.inf, 1e300]

    def spoil(number: int, x: float) -> float:
        return values[number // 50 % 4] if number % 50 == 7 else x

    log = changed(tiny.log, tmp_path / "nan.mcap", with_position(spoil))
    record = run_quick(verb, log, tmp_path / "run")
    assert any("odom" in warning.lower() for warning in record["warnings"])
    assert_all_finite(tmp_path / "run")


def test_frames_without_odometry_are_left_out_with_a_warning(verb: Verb, tiny: Demo, tmp_path: Path) -> None:
    log = changed(
        tiny.log, tmp_path / "half.mcap", lambda topic, n, data: None if topic == ODOMETRY and n > 160 else data
    )
    record = run_quick(verb, log, tmp_path / "run", "--odometry", ODOMETRY)
    assert 0.4 < record["counts"]["keyframes"] / len(tiny.stamp_ns) < 0.6
    assert record["warnings"]
    assert_all_finite(tmp_path / "run")


def test_standing_still_all_the_time_is_said(verb: Verb, tiny: Demo, tmp_path: Path) -> None:
    """The odometry says that nothing moves, whatever the camera sees."""
    first: list[Any] = []

    def hold(topic: str, _: int, data: bytes) -> bytes:
        if topic != ODOMETRY:
            return data
        message: Any = _STORE.deserialize_cdr(data, TYPES[ODOMETRY])
        first.append(message.pose)
        message.pose = first[0]
        for velocity in (message.twist.twist.linear, message.twist.twist.angular):
            velocity.x = velocity.y = velocity.z = 0.0
        return bytes(_STORE.serialize_cdr(message, TYPES[ODOMETRY]))

    still = changed(tiny.log, tmp_path / "still.mcap", hold)
    assert "nothing moves" in verb("run", still, "-o", tmp_path / "run", "--odometry", ODOMETRY, *QUICK).error


# Runs that are cut short


def begun(tiny: Demo, out: Path) -> Forked:
    """A run that has begun to keep what it comes to."""
    code = f"""
from vplog.run import feature_extraction as parts
parts.PART_KEYFRAMES = 4  # the first is soon there
{VPLOG}
"""
    process = Forked(code, "run", tiny.log, "-o", out, *QUICK, "--threads", 1)
    while not list(out.glob(".cache/*.stage")):
        assert process.poll() is None, process.ended()
        time.sleep(0.01)
    return process


@pytest.mark.parametrize(("sent", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_interrupted_in_the_middle(tiny: Demo, tmp_path: Path, sent: signal.Signals, code: int) -> None:
    process = begun(tiny, tmp_path / "run")
    process.send(sent)
    status, out, err = process.ended()
    assert (status, out) == (code, "")
    assert err.startswith("vplog: interrupted")
    assert len(err.splitlines()) == 1, err
    assert err.endswith(f"Go on with: vplog run --resume -o {tmp_path / 'run'}\n")
    assert "(extract) are kept in" in err
    assert record_of(tmp_path / "run" / ".cache")["finished"] is False
    assert {path.name for path in (tmp_path / "run").iterdir()} == {".cache"}
    assert not list((tmp_path / "run").rglob("*.part"))


def test_killed_in_the_middle_and_run_again(verb: Verb, tiny: Demo, tmp_path: Path) -> None:
    process = begun(tiny, tmp_path / "run")
    process.send(signal.SIGKILL)
    assert process.ended()[0] == -signal.SIGKILL
    assert "did not finish" in verb("evaluate", tmp_path / "run", "--truth", tiny.truth).error
    assert run_quick(verb, tiny.log, tmp_path / "run")["finished"] is True
    assert [path.name for path in (tmp_path / "run").rglob(".*")] == [".cache"]
    assert verb("evaluate", tmp_path / "run", "--truth", tiny.truth, "--json").json["ate_after"]["count"] > 0


@pytest.mark.parametrize("limit", [2_000, 100_000])
def test_a_full_disk_is_one_line(tiny: Demo, tmp_path: Path, limit: int) -> None:
    """A limit on the size of a file stands in for the disk: too small for run.json, or for the features."""
    code = f"import resource; resource.setrlimit(resource.RLIMIT_FSIZE, ({limit}, {limit})); {VPLOG}"
    status, out, err = Forked(code, "run", tiny.log, "-o", tmp_path / "run", *QUICK).ended()
    assert (status, out) == (1, "")
    assert err.startswith("vplog: error: Cannot")
    assert len(err.splitlines()) == 1, err
    assert not (tmp_path / "run").exists()


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no /dev/full on this system")  # noqa: PTH110
def test_results_that_cannot_be_printed_are_one_line() -> None:
    with open("/dev/full", "w") as full:  # noqa: PTH123
        command = [sys.executable, "-m", "vplog", "config"]
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr.startswith("vplog: error: Cannot")
    assert len(done.stderr.splitlines()) == 1, done.stderr


@pytest.mark.parametrize(
    ("arguments", "streams", "status"),
    [
        ("--help", "| true", 0), ("config", "| true", 0), ("config", "2>&-", 0),
        ("evaluate gone --truth gone", "2>&1 | true", 1), ("evaluate gone --truth gone", "2>/dev/full", 1),
        ("evaluate gone --truth gone", "2>&-", 1), ("conf", "2>&1 | true", 2),
        ("run", "2>/dev/full", 2), ("conf", "2>&-", 2),
    ],
)  # fmt: skip
def test_the_exit_status_is_that_of_the_verb(arguments: str, streams: str, status: int) -> None:
    """Whether its output has a reader or not; with streams that the interpreter flushes at its end."""
    command = f"{sys.executable} -m vplog {arguments} {streams}; exit ${{PIPESTATUS[0]}}"
    environment = os.environ | {"PYTHONUNBUFFERED": ""}
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, check=False, env=environment)
    assert (done.returncode, "Exception ignored" in done.stderr) == (status, False), done.stderr
    assert status or not done.stderr


def test_an_interrupt_behind_another_error_is_one(monkeypatch: pytest.MonkeyPatch, verb: Callable[..., Said]) -> None:
    """As compiled code raises it."""

    def stopped(*_: Any, **__: Any) -> None:
        try:
            raise KeyboardInterrupt
        except KeyboardInterrupt:
            raise SystemError("returned a result with an exception set")  # noqa: B904

    monkeypatch.setattr("vplog.verbs.info.preflight", stopped)
    told = verb("info", "drive.mcap")
    assert (told.code, "interrupted" in told.err) == (130, True)


def test_an_early_interrupt_of_a_resumed_run_names_the_command(monkeypatch: pytest.MonkeyPatch, verb: Verb) -> None:
    def stopped(*_: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("vplog.verbs.resume.resume_request", stopped)
    told = verb("run", "--resume", "-o", "my run")
    assert (told.code, told.err.endswith("Go on with: vplog run --resume -o 'my run'\n")) == (130, True)


@pytest.mark.parametrize("arguments", ["run {} -o OUT", "run LOG -o OUT --mask {}", "info LOG {}", "map info {}"])
def test_no_secret_of_the_command_is_shown(verb: Verb, arguments: str) -> None:
    """Of a URL with blanks too, which only the command tells from the sentence around it."""
    url = "https://127.0.0.1:9/a b.mcap?name=a b&Signature=SECRET x"
    told = verb(*(url if word == "{}" else word for word in arguments.split()))
    assert told.code in (1, 2)
    assert "SECRET" not in told.out + told.err
