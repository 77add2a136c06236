"""What is printed fits the terminal and can be copied from it: names are whole at any width, a pipe has no width."""

from __future__ import annotations

import fcntl
import os
import pty
import struct
import subprocess
import sys
import termios
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from tests.cli.test_main import changed, without
from tests.logs.drives import Drive as Recorded
from tests.logs.drives import ros_messages, write_ros2
from vplog.cli import printing
from vplog.results import tables
from vplog.results.run_record import read_run_json
from vplog.run.outputs import _outcome
from vplog.verbs.demo.record import IMAGE

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from conftest import Said

    from vplog.verbs.demo.record import Demo

    Verb = Callable[..., Said]

WIDTHS = (20, 40, 60, 80, 200, None)
LONG = "/vehicle/sensors/front_left_wide_angle_camera_number_one/rectified/image/compressed"


def on_a_terminal(columns: int, *arguments: object) -> tuple[int, str]:
    """Status and output of vplog whose stdin, stdout and stderr are a terminal of this width."""
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 50, columns, 0, 0))
    environment = {name: value for name, value in os.environ.items() if name not in ("COLUMNS", "LINES")}
    command = [sys.executable, "-m", "vplog", *map(str, arguments)]
    with subprocess.Popen(command, stdin=theirs, stdout=theirs, stderr=theirs, env=environment) as process:
        os.close(theirs)
        parts: list[bytes] = []
        while True:
            try:
                part = os.read(ours, 65536)
            except OSError:  # what Linux says where the other end is closed
                break
            if not part:
                break
            parts.append(part)
        os.close(ours)
    return process.returncode, b"".join(parts).decode().replace("\r\n", "\n")


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log whose camera has a long name."""
    messages = ros_messages(Recorded(), 2)
    for message in messages:
        message.topic = message.topic.replace("/cam/image/compressed", LONG)
    return write_ros2(tmp_path_factory.mktemp("print") / "drive", messages)


@pytest.mark.parametrize("columns", [40, 200])
def test_a_terminal_gets_whole_topics_and_whole_words(recording: Path, columns: int, verb: Verb) -> None:
    code, text = on_a_terminal(columns, "info", recording)
    assert code == 0, text
    assert any(LONG in line for line in text.splitlines())
    assert "\u2026" not in text
    assert f"vplog run {recording} -o OUT" in text
    piped = verb("info", recording).out
    known = set(piped.split()) | {f"{word}," for word in piped.split()} | {"type", "count", "Hz", "role", "used", "why"}
    for line in text.splitlines():
        broken = [word for word in line.split() if word not in known]
        assert not broken, line
        assert (
            len(line) <= columns
            or len(line.split()) <= 3
            or "vplog run" in line
            or LONG in line
            or str(recording) in line
        )


def test_a_pipe_has_no_width(recording: Path, verb: Verb, monkeypatch: pytest.MonkeyPatch) -> None:
    wide = verb("info", recording).out
    monkeypatch.setenv("COLUMNS", "40")
    assert verb("info", recording).out == wide
    [row] = [line for line in wide.splitlines() if line.startswith(LONG)]
    assert row.endswith("used as camera")
    [scale] = [line for line in wide.splitlines() if line.startswith("scale")]
    assert scale.endswith(".")


def test_no_cell_of_a_table_is_cut_at_any_width(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    rng = np.random.default_rng(19)
    letters = list("abcdefghijklmnopqrstuvwxyz/_-0123456789\u00e9\u5b57")
    for _ in range(60):
        columns, count = int(rng.integers(2, 9)), int(rng.integers(0, 6))
        titles = ["".join(rng.choice(letters, 5)) for _ in range(columns)]
        rows = [["".join(rng.choice(letters, rng.integers(1, 60))) for _ in range(columns)] for _ in range(count)]
        for width in WIDTHS:
            monkeypatch.setattr(printing, "terminal_width", lambda _, width=width: width)
            printing.print_table(titles, rows)
            out = capsys.readouterr().out
            for row in rows:
                for cell in row:
                    assert any(cell in line for line in out.splitlines()), (width, cell, out)
            if width is None:
                assert len(out.splitlines()) == count + 1


def test_what_would_move_the_cursor_is_shown(capsys: pytest.CaptureFixture[str]) -> None:
    printing.print_table(("topic",), [("/a\x1b[2J\n/b",)])
    assert "/a\\x1b[2J\\n/b" in capsys.readouterr().out


def test_lines_wrap_between_words(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    text = f"No topic '/left' in run.mcap. Image topics: {LONG}, /right. Choose one with --image-topic, or not-at-all."
    for width in WIDTHS:
        monkeypatch.setattr(printing, "terminal_width", lambda _, width=width: width)
        printing.print_line("warning", text)
        out = capsys.readouterr().out
        assert out.split() == ["warning", *text.split()]
        assert (len(out.splitlines()) == 1) == (width is None or width == 200)
        assert all(len(line) <= (width or 1000) or LONG in line for line in out.splitlines() if width != 20)


def test_lines_on_stderr_wrap_too_and_by_its_own_width(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    text = f"error: No topic '/left' in run.mcap. Image topics: {LONG}, /right. Choose one with --image-topic."
    for width in WIDTHS:
        monkeypatch.setattr(printing, "terminal_width", lambda of, width=width: width if of is sys.stderr else 30)
        printing.print_status(text)
        err = capsys.readouterr().err
        assert err.split() == ["vplog:", *text.split()]
        assert (len(err.splitlines()) == 1) == (width is None or width == 200)


@pytest.mark.parametrize("columns", [50, None])
def test_an_evaluation_wraps_between_words(
    columns: int | None, finished: Path, drive: Demo, verb: Verb, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = verb("evaluate", finished, "--truth", drive.truth).out.split()
    monkeypatch.setattr(printing, "terminal_width", lambda _: columns)
    out = verb("evaluate", finished, "--truth", drive.truth).out
    assert out.split() == words
    assert all(len(line) <= (columns or 1000) for line in out.splitlines())


# What came of a run


def test_a_run_ends_with_what_came_of_it_where_to_look_and_what_next(
    finished: Path, capsys: pytest.CaptureFixture[str]
) -> None:

    record = read_run_json(finished / "run.json")
    outcome = record["solution"]
    printing.print_run(finished, record)
    out = capsys.readouterr().out
    first, last = out.splitlines()[0], out.splitlines()[-1]
    assert f"the trajectory moved by up to {outcome['moved_m']:.2f} m, by {outcome['closures']} closures at" in first
    assert f"{finished}/report.html" in out
    assert last == f"next      vplog export {finished} --format kitti -o FILE"
    assert f"next      vplog evaluate {finished} --truth FILE.tum" in out
    assert not [word for word in ("chi-square", "Least squares", "iteration", "sigma") if word in out]
    reason = record["solution"]["reason"]
    assert any(word in (finished / "report.html").read_text() for word in reason.split(". "))


def test_the_outcome_is_that_of_the_tables(finished: Path) -> None:
    outcome = read_run_json(finished / "run.json")["solution"]
    after, odometry = tables.read_trajectory(finished / "trajectory.parquet")
    relative = np.linalg.inv(odometry.odom_from_body[0]) @ odometry.odom_from_body
    moved = (after.world_from_body[0] @ relative - after.world_from_body)[:, :3, 3]
    assert outcome["moved_m"] == pytest.approx(np.sqrt((moved**2).sum(1)).max())
    closures = tables.read_closures(finished / "closures.parquet")
    assert outcome["closures"] == np.nansum(closures.weight > 0.5)
    assert 1 <= outcome["places"] <= outcome["closures"]
    assert _outcome(after, odometry, closures, 10**6)["places"] == 1


@pytest.mark.parametrize(
    ("outcome", "gps", "said"),
    [
        ((0.0, 0, 0), None, "the trajectory is the odometry's. No closure passed."),
        ((1.234, 1, 1), None, "the trajectory moved by up to 1.23 m, by 1 closure at 1 place"),
        ((5.0, 12, 3), {}, "the trajectory moved by up to 5.00 m, by 12 closures at 3 places"),
        ((5.0, 2, 2), {"fixes": 3}, "by 2 closures at 2 places and the satellite fixes"),
        ((5.0, 0, 0), {"fixes": 3}, "moved by up to 5.00 m, by the satellite fixes"),
    ],
)
def test_what_came_of_a_run_is_said_in_metres(outcome: tuple[float, int, int], gps: Any, said: str) -> None:
    solution = dict(zip(("moved_m", "closures", "places"), outcome, strict=True), reason="No closure passed.")
    assert printing._outcome_text({"gps": gps, "solution": solution}).endswith(said)


def test_a_joint_run_says_what_next(joint: Path, capsys: pytest.CaptureFixture[str]) -> None:

    printing.print_joint(joint, read_run_json(joint / "run.json"))
    out = capsys.readouterr().out
    assert f"next      vplog evaluate {joint} --truth FILE.tum" in out
    assert "report.html" in out
    assert "sigma" not in out


def test_a_command_of_an_odd_name_can_be_copied(drive: Demo, verb: Verb, tmp_path: Path) -> None:
    import shlex

    log = changed(drive.log, tmp_path / "my drive's.mcap", without("/none"))
    [line] = [line for line in verb("info", log).out.splitlines() if line.startswith("run ")]
    assert shlex.split(line)[1:4] == ["vplog", "run", str(log)]
    assert IMAGE in verb("info", log).out
