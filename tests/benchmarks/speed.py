"""CPU seconds of `vplog optimize` on public graphs, beside GTSAM's GNC and Levenberg-Marquardt in the same run.

Whole processes are measured, start and files included, with caches that one run before has filled.
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

from tests.benchmarks.graphs import folder
from tests.benchmarks.measure import Figure

if TYPE_CHECKING:
    from collections.abc import Iterator

NAMES = ("intel", "CSAIL", "M3500", "M3500b", "torus3D", "sphere2500", "B25b_0.500", "kitti_06")
GTSAM = Path(__file__).with_name("gtsam_solve.py")
MOST = {"gnc": 3.0, "lm": 8.0}
"""Times the CPU seconds of GTSAM's method that `optimize` may take."""


def speed(names: tuple[str, ...] = NAMES) -> Iterator[Figure]:
    """Yield the CPU seconds of `optimize` as a multiple of those of each method of GTSAM."""
    files = {file.stem: file for file in folder().rglob("*.g2o")}
    for name in names:
        if name not in files:
            continue
        file = files[name]
        with tempfile.TemporaryDirectory() as out:
            outputs = [str(Path(out) / name) for name in ("first.g2o", "second.g2o")]
            ours = [sys.executable, "-m", "vplog", "optimize", str(file), "-o"]
            _, own = (_cpu_seconds([*ours, output]) for output in outputs)
        for method, most in MOST.items():
            _, theirs = (_cpu_seconds([sys.executable, str(GTSAM), method, str(file)]) for _ in outputs)
            ratio = own / theirs
            yield Figure(f"{name}: times GTSAM's {method}", ratio, most, True, {"cpu_s": own, "gtsam_cpu_s": theirs})


def _cpu_seconds(command: list[str]) -> float:
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)  # it would compile every module again in each process
    subprocess.run(command, check=True, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
