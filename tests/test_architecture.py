"""Imports point one way, two folders talk to gtsam, one file talks to the user, and start-up is light."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

import vplog
from vplog.pipeline import STAGES, Pipeline, load_pipeline, pipeline_folder
from vplog.settings import load_yaml

if TYPE_CHECKING:
    from collections.abc import Iterator

PACKAGE = Path(vplog.__file__).parent
LAYERS = (
    {"errors", "data", "version"},
    {"settings", "execution", "storage"},
    {"stages", "geometry"},
    {"features", "logs", "graph", "results", "evaluate"},
    {"refinement"},
    {"joint"},
    {"places", "loops"},
    {"odometry"},
    {"run", "testing"},
    {"pipeline"},
    {"maps", "benchmark", "verbs"},
    {"batch"},
    {"api"},
    {"cli"},
    {"__main__"},
)
"""From what depends on nothing to what depends on all. A part sees the layers above its own line, and itself."""
LEVEL = {part: level for level, parts in enumerate(LAYERS) for part in parts}
FILES = sorted(PACKAGE.rglob("*.py"))
HEAVY = (
    "cv2", "faiss", "gtsam", "jinja2", "matplotlib", "mcap", "numba", "numpy", "obstore", "pyarrow", "pydantic", "rich",
    "rosbags",
)  # fmt: skip


def name_of(file: Path) -> str:
    return file.relative_to(PACKAGE).as_posix()


def part_of(file: Path) -> str:
    """The file or folder right below the package; the package's own __init__ is part of none."""
    return file.relative_to(PACKAGE).parts[0].removesuffix(".py")


def module_of(file: Path) -> str:
    """Its full name; that of a package for its __init__."""
    return ".".join(("vplog", *file.relative_to(PACKAGE).with_suffix("").parts)).removesuffix(".__init__")


@cache
def imports(file: Path) -> list[str]:
    """Full names of all that a file imports, wherever in it and for whatever purpose."""
    found = []
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{name_of(file)}: imports are absolute"
            found += [f"{node.module}.{alias.name}" for alias in node.names]
    return found


def nodes(file: Path, words: str) -> Iterator[ast.AST]:
    """All nodes of a file that has some of the words (a pattern) in its text; else there is nothing to find."""
    text = file.read_text(encoding="utf-8")
    yield from ast.walk(ast.parse(text)) if re.search(words, text) else ()


def parts_used(file: Path) -> set[str]:
    """The parts of the package that a file imports."""
    return {name.split(".")[1] for name in imports(file) if name.startswith("vplog.")}


def test_imports_point_one_way() -> None:
    """A part imports itself and what stands above its line; the package itself names the API for type checkers."""
    wrong = []
    for file in FILES:
        part, used = part_of(file), parts_used(file)
        assert part == "__init__" or part in LEVEL, f"{part} has no place in the order of the parts"
        if part == "__init__":
            wrong += [f"vplog imports {other}" for other in used - {"api", "errors", "version"}]
            continue
        own = LEVEL[part]
        wrong += [f"{name_of(file)} imports {other}" for other in used if other != part and LEVEL[other] >= own]
    assert not wrong


def test_no_file_imports_itself_by_way_of_others() -> None:
    """Imports inside functions and for types alone count, too."""
    names = {module_of(file): file for file in FILES}
    edges = {
        name: {
            used if used in names else used.rpartition(".")[0] for used in imports(file) if used.startswith("vplog.")
        }
        for name, file in names.items()
    }
    try:
        TopologicalSorter(edges).prepare()
    except CycleError as error:
        pytest.fail(" -> ".join(error.args[1]))


def test_no_stage_asks_for_a_certain_recogniser() -> None:
    """What a state can do is a protocol of stages.py."""
    asked = []
    for file in FILES:
        for node in nodes(file, "(Bobb|Hybrid)State"):
            if isinstance(node, ast.Call) and ast.unparse(node.func) == "isinstance" and part_of(file) != "places":
                kinds = {name.id for name in ast.walk(node.args[1]) if isinstance(name, ast.Name)}
                asked += [f"{name_of(file)}:{node.lineno}" for kind in kinds if re.search("(Bobb|Hybrid)State", kind)]
    assert not asked


def test_the_check_sees_imports() -> None:
    assert "loops" in parts_used(PACKAGE / "pipeline.py")
    assert "pipeline" in parts_used(PACKAGE / "cli/main.py")


def test_run_reads_like_the_algorithm() -> None:
    """A screen of steps: no lambda, no record, no name of a step as text."""
    tree = ast.parse((PACKAGE / "pipeline.py").read_text(encoding="utf-8"))
    [run] = [one for one in tree.body if isinstance(one, ast.FunctionDef) and one.name == "run"]
    assert run.end_lineno is not None
    assert run.end_lineno - run.lineno < 60
    parts = list(ast.walk(run))
    assert not [part for part in parts if isinstance(part, ast.Lambda | ast.Dict)]
    assert not {part.value for part in parts if isinstance(part, ast.Constant)}.intersection(STAGES)


def test_a_run_reads_no_result_back() -> None:
    """What it writes goes to its report as values; files are read where the run is one of before."""
    for name in ("pipeline.py", "run/outputs.py", "maps/joining/joint_run.py"):
        text = (PACKAGE / name).read_text(encoding="utf-8")
        assert not re.findall(r"mcap_read|tables\.read_|read_bytes|places\.load|gather\(", text), name


def test_only_the_graph_and_odometry_use_gtsam() -> None:
    users = {part_of(file) for file in FILES if any(name.split(".")[0] == "gtsam" for name in imports(file))}
    assert users == {"graph", "odometry"}


def speech(file: Path) -> list[str]:
    """Calls that print or exit."""
    found = []
    for node in nodes(file, "print|exit|quit|stdout|stderr|SystemExit"):
        if isinstance(node, ast.Call):
            name = ast.unparse(node.func)
            streams = ("sys.stdout.", "sys.stderr.")
            if name in {"print", "exit", "quit", "sys.exit", "os._exit"} or name.startswith(streams):
                found.append(f"{name_of(file)}:{node.lineno} {name}")
        elif isinstance(node, ast.Name) and node.id == "SystemExit":
            found.append(f"{name_of(file)}:{node.lineno} SystemExit")
    return found


def test_only_the_command_line_prints_and_exits() -> None:
    spoken = {name_of(file) for file in FILES if speech(file)}
    assert spoken == {"cli/main.py", "cli/printing.py", "cli/progress.py", "cli/results.py"}


def test_nothing_is_left_to_do() -> None:
    marks = re.compile(r"\b(?:TODO|FIXME|XXX|HACK|NotImplemented(?:Error)?)\b")
    assert not [name_of(file) for file in FILES if marks.search(file.read_text(encoding="utf-8"))]


def test_the_command_line_starts_light() -> None:
    code = "import sys, vplog.cli.main; print(*sorted({name.partition('.')[0] for name in sys.modules}))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = set(done.stdout.split())
    assert "vplog" in loaded
    assert not loaded.intersection(HEAVY)


@pytest.mark.parametrize("file", sorted(pipeline_folder().glob("*.yaml")), ids=lambda file: file.stem)
def test_shipped_pipelines_load(file: Path) -> None:
    """By name and by path, through the same checks as a user's own file."""
    assert load_pipeline(file.stem) == load_pipeline(str(file)) == Pipeline.read(load_yaml(file), file.name)


def test_the_default_pipeline_is_the_defaults_in_code() -> None:
    assert load_pipeline("default") == Pipeline()
