"""Every check of the project: lint, format, documentation, types, tests. `python -m tests`, from the checkout's top.

`--fast` leaves out types, documentation and the tests marked slow. Other arguments go to pytest. The exit status is 0
only when all passed; every check runs even if one before it failed.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator

TOP = Path(__file__).parents[1]
LINT = {"lint": ["-m", "ruff", "check", "."], "format": ["-m", "ruff", "format", "--check", "."]}
DOCS = {"docs": ["-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", "build/site"]}
# a file stays with one worker, so that what its tests share is made once; they come in the order of conftest.py
TESTS = ["-m", "pytest", "--numprocesses", "auto", "--dist", "loadfile", "--no-loadscope-reorder"]
TYPES = ["-m", "pyrefly", "check", "--python-interpreter-path", sys.executable]


def main(arguments: list[str]) -> int:
    if "--fast" in arguments:
        arguments.remove("--fast")
        failed = failing({**LINT, "tests": [*TESTS, "-m", "not slow and not benchmark", *arguments]})
    else:
        with in_background("types", TYPES) as types:
            failed = failing({**LINT, **DOCS, "tests": [*TESTS, *arguments]})
        failed += types
    print(f"== failed: {', '.join(failed)}" if failed else "== all checks passed", flush=True)
    return 1 if failed else 0


def failing(checks: dict[str, list[str]]) -> list[str]:
    """Names of the checks that fail; all are run."""
    failed = []
    for name, command in checks.items():
        print(f"== {name}", flush=True)
        began = time.monotonic()
        if subprocess.run([sys.executable, *command], cwd=TOP, env=environment(), check=False).returncode:
            failed.append(name)
        print(f"== {name}: {time.monotonic() - began:.0f} s", flush=True)
    return failed


@contextmanager
def in_background(name: str, command: list[str]) -> Iterator[list[str]]:
    """Run a check of one process for minutes beside the block; its name is in the list afterwards if it fails."""
    failed: list[str] = []
    with tempfile.TemporaryFile() as output:
        process = subprocess.Popen(
            [sys.executable, *command], cwd=TOP, env=environment(), stdout=output, stderr=subprocess.STDOUT
        )
        try:
            yield failed
            if process.wait():
                failed.append(name)
        finally:
            process.kill()
        output.seek(0)
        print(f"== {name}\n{output.read().decode(errors='replace')}", flush=True)


def environment() -> dict[str, str]:
    """One thread a library: the tests start workers of their own, and a BLAS pool inside each gets in their way. And
    all that is compiled is kept: a hundred processes of the tests load the package."""
    inherited = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    return {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "NO_MKDOCS_2_WARNING": "1", **inherited}


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
