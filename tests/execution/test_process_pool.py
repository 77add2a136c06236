"""Processes of one task each, ended whenever the batch is."""

from __future__ import annotations

import os
import subprocess
import sys

ENDED_WHILE_THEY_LOAD = """
import time
from vplog.execution.process_pool import OwnProcesses
for number in range(6):
    with OwnProcesses(4) as processes:
        processes.begin()
        time.sleep(0.08 * number)
"""


def test_processes_that_are_ended_while_they_load_say_nothing() -> None:
    others = [subprocess.Popen(["sh", "-c", "while :; do :; done"]) for _ in range(os.cpu_count() or 1)]
    try:  # a busy machine, on which loading takes its time
        script = [sys.executable, "-c", ENDED_WHILE_THEY_LOAD]
        ended = subprocess.run(script, capture_output=True, text=True, check=False)
    finally:
        for other in others:
            other.kill()
            other.wait()
    assert (ended.returncode, ended.stderr) == (0, "")
