"""The program from Python: what it offers, from a script, a notebook and a worker process, by path and by URL."""

from __future__ import annotations

import inspect
import json
import multiprocessing
import pickle
import pydoc
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa
import pytest

import vplog
from tests.batch.test_batch import QUICK, TINY
from vplog import errors
from vplog.demo import make_drive
from vplog.demo.settings import DemoSettings
from vplog.results import tables

if TYPE_CHECKING:
    from tests.conftest import Said
    from vplog.demo.record import Drive

TOP = Path(vplog.__file__).parents[1]
EXAMPLES = TOP / "examples"


def python(code: str, *arguments: object, folder: Path) -> str:
    """What a program says on stdout that is given as text, so that its main module has no file."""
    command = [sys.executable, "-c", code, *map(str, arguments)]
    return _run(command, folder)


def script(path: Path, *arguments: object, folder: Path) -> str:
    return _run([sys.executable, str(path), *map(str, arguments)], folder)


def _run(command: list[str], folder: Path) -> str:
    done = subprocess.run(
        command, capture_output=True, text=True, check=False, cwd=folder, env={"PYTHONPATH": str(TOP), "HOME": "/tmp"}
    )
    assert done.returncode == 0, done.stderr
    return done.stdout
