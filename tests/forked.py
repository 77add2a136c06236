"""Programs in processes of their own that have the package loaded: forks of a server, as those of a batch are.

A new interpreter loads modules for three CPU seconds. What its own start and end do is tested with `subprocess`.
"""

from __future__ import annotations

import os
import signal
import sys
import tempfile
import time
from pathlib import Path

from vplog.execution.process_pool import Process

VPLOG = "from vplog.cli import main; main.main()"


class Forked:
    """`python -c CODE ARGUMENTS...` with the environment and working folder of the test."""

    def __init__(self, code: str, *arguments: object) -> None:
        self._said = tempfile.TemporaryDirectory()
        given = (code, [*map(str, arguments)], dict(os.environ), Path(self._said.name))
        self._process = Process(target=_run, args=given)
        self._process.start()

    def poll(self) -> int | None:
        """Its exit status, negative where a signal ended it; None while it runs."""
        return self._process.exitcode

    def send(self, number: signal.Signals) -> None:
        os.kill(self._process.pid or 0, number)

    def ended(self) -> tuple[int, str, str]:
        """Its exit status, and what it said on stdout and stderr, once it has ended."""
        self._process.join(600)
        assert self._process.exitcode is not None, "it runs for ten minutes"
        out, err = (Path(self._said.name, name).read_text(encoding="utf-8") for name in ("out", "err"))
        return self._process.exitcode, out, err


def _run(code: str, arguments: list[str], environment: dict[str, str], said: Path) -> None:
    os.environ.clear()
    os.environ.update(environment)
    for number, name in ((1, "out"), (2, "err")):
        file = os.open(said / name, os.O_WRONLY | os.O_CREAT)
        os.dup2(file, number)
        os.close(file)
    signal.pthread_sigmask(signal.SIG_SETMASK, ())
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell that starts tests in the background ignores it
    time.tzset()
    sys.argv = ["-c", *arguments]
    exec(code, {"__name__": "__main__"})  # noqa: S102 (it is of a test)
