"""Every check of the project: lint, format, documentation, types, tests. `python -m tests`, from the checkout's top.

Arguments go to pytest. The exit status is 0 only when all passed; every check runs even if one before it failed.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

TOP = Path(__file__).parents[1]
CHECKS = {
    "lint": ["-m", "ruff", "check", "."],
    "format": ["-m", "ruff", "format", "--check", "."],
    "docs": ["-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", "build/site"],
    # a file stays with one worker, so that what its tests share is made once; they come in the order of conftest.py
    "tests": ["-m", "pytest", "--numprocesses", "auto", "--dist", "loadfile", "--no-loadscope-reorder", *sys.argv[1:]],
}
TYPES = ["-m", "pyright", "--pythonpath", sys.executable]


def main() -> int:
    # one thread a library: the tests start workers of their own, and a BLAS pool inside each only gets in their way
    environment = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "NO_MKDOCS_2_WARNING": "1", **os.environ}
    failed = []
    with tempfile.TemporaryFile() as said:
        # one process for minutes, beside the tests: they leave it a share of a core
        types = subprocess.Popen([sys.executable, *TYPES], cwd=TOP, env=environment, stdout=said, stderr=said)
        try:
            for name, command in CHECKS.items():
                print(f"== {name}", flush=True)
                began = time.monotonic()
                if subprocess.run([sys.executable, *command], cwd=TOP, env=environment, check=False).returncode:
                    failed.append(name)
                print(f"== {name}: {time.monotonic() - began:.0f} s", flush=True)
            if types.wait():
                failed.append("types")
        finally:
            types.kill()
        said.seek(0)
        print(f"== types\n{said.read().decode(errors='replace')}", flush=True)
    print(f"== failed: {', '.join(failed)}" if failed else "== all checks passed", flush=True)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
