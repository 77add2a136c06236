"""Processes of one task each, ended whenever the batch is."""

from __future__ import annotations

import os
import subprocess
import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path

ENDED_WHILE_THEY_LOAD = """
import time
from vplog.execution.process_pool import OwnProcesses
for number in range(6):
    with OwnProcesses(4) as processes:
        processes.begin()
        time.sleep(0.08 * number)
"""


def test_processes_that_are_ended_while_they_load_say_nothing(tmp_path: Path) -> None:
    others = [subprocess.Popen(["sh", "-c", "while :; do :; done"]) for _ in range(os.cpu_count() or 1)]
    try:  # a busy machine, on which loading takes its time
        with (tmp_path / "said").open("wb") as said:  # no pipe, which a process left behind would hold open
            script = [sys.executable, "-c", ENDED_WHILE_THEY_LOAD]
            ended = subprocess.run(script, stdout=said, stderr=said, timeout=300, check=False)
    finally:
        for other in others:
            other.kill()
            other.wait()
    assert (ended.returncode, (tmp_path / "said").read_text()) == (0, "")
