"""The code that a result depends on is found from imports."""

from __future__ import annotations

import ast
import shutil
import subprocess
import sys
from collections import Counter
from typing import TYPE_CHECKING

from vplog.run.cache import code_hash

if TYPE_CHECKING:
    from pathlib import Path

    import pytest

    from vplog.verbs.demo.record import Demo

EXTRACTION = ("vplog.run.feature_extraction", "vplog.features.sift")
COUNTS = ("logs/messages/h264.py", "features/sift.py", "features/stereo_depth.py", "features/__init__.py")
OTHERS = ("graph/gnc.py", "run/report.py", "pipeline.py", "loops/verify.py", "places/bobb.py", "run/provenance.py")


def test_code_counts_where_it_is_imported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    copy = tmp_path / "vplog"
    shutil.copytree(code_hash._PACKAGE, copy, ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(code_hash, "_PACKAGE", copy)

    def hashed(*changed: str) -> str:
        for file in changed:
            with (copy / file).open("a") as stream:
                stream.write("\n# changed\n")
        return code_hash.code_of.__wrapped__(*EXTRACTION)["code"]

    before = hashed()
    assert hashed(*OTHERS) == before
    found = [hashed(file) for file in COUNTS]
    assert len({before, *found}) == len(COUNTS) + 1


def test_all_code_that_a_part_runs_counts(tiny: Demo) -> None:
    """What of the package a process has loaded after computing a part is among the files that its key is made of."""
    code = f"""
import sys
from dataclasses import fields, replace
from pathlib import Path
from vplog.run.keyframes import KeyframeSettings
from vplog.features.sift import SiftSettings
from vplog.features.stereo_depth import StereoSettings
from vplog.results.previews import PictureSettings
from types import SimpleNamespace
from vplog.run import feature_extraction
from vplog.run.feature_extraction import compute_part, parts_of
feature_extraction.PART_KEYFRAMES = 1
asked = SimpleNamespace(keyframes=KeyframeSettings(), features=SiftSettings(max_features=10), stereo=StereoSettings(),
                        pictures=PictureSettings())
compute_part(parts_of(Path({str(tiny.log)!r}), asked)[0])
print(*[name for name in sys.modules if name.split(".")[0] == "vplog"])
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded, (files, packages) = set(done.stdout.split()), code_hash.imported(EXTRACTION)
    assert {"vplog.run.feature_extraction", "vplog.logs.recorded_log", "vplog.logs.formats.mcap_file"} <= loaded
    assert loaded <= files.keys()
    assert {"cv2", "numpy", "mcap"} <= packages
    assert "gtsam" not in packages


def test_every_import_of_the_package_is_found() -> None:
    """By its syntax tree; an example in a docstring, which counts too, names the package itself."""
    for file in code_hash._PACKAGE.rglob("*.py"):
        found = Counter(code_hash._imports(file, file.stat().st_mtime_ns))
        tree = ast.parse(file.read_text(encoding="utf-8"))
        for block in ast.walk(tree):
            if isinstance(block, ast.If) and ast.unparse(block.test) == "TYPE_CHECKING":
                block.body = []
        nodes = list(ast.walk(tree))
        expected = Counter(
            f"{node.module}.{alias.name}" for node in nodes if isinstance(node, ast.ImportFrom) for alias in node.names
        ) + Counter(alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names)
        assert expected <= found, file
        assert all(name.startswith("vplog") for name in found - expected), file
