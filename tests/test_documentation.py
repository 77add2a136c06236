"""What README and documentation show works with what they tell the user to install, and with no more."""

from __future__ import annotations

import ast
import re
import shlex
import shutil
import sys
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import pytest
import yaml
from packaging.requirements import Requirement

import vplog
from tests.plain_install import TOP, read_project, requirements_in, run_in, run_scripts
from vplog.maps.snapshots import write_delta

if TYPE_CHECKING:
    from collections.abc import Callable

    from vplog.verbs.demo.record import Demo

PROJECT = read_project(TOP)
PAGES = [TOP / "README.md", *sorted((TOP / "docs").rglob("*.md"))]
FIRST_PAGES = [TOP / "README.md", TOP / "docs" / "index.md", TOP / "docs" / "tutorial.md"]
NOT_INSTALLED = {"apache-airflow", "dagster", "dagster-webserver", "jupyterlab"}
"""Programs that run an example, which the tests do without."""


def blocks(page: Path, language: str = r"\w+") -> list[tuple[str, str]]:
    """Return language and text of the code blocks of a page."""
    text = page.read_text(encoding="utf-8")
    return re.findall(rf"^```({language})\n(.*?)^```", text, re.MULTILINE | re.DOTALL)


# Commands to install


def wrong(requirement: str) -> bool:
    """Whether a requirement is neither a path in the checkout nor a library that the tests know."""
    path, _, extras = requirement.partition("[")
    if path.startswith("."):
        known = PROJECT["optional-dependencies"] if path == "." else {}
        return not (TOP / path / "pyproject.toml").is_file() or not {*re.findall(r"[\w-]+", extras)} <= {*known}
    groups = [PROJECT["dependencies"], *PROJECT["optional-dependencies"].values()]
    libraries = {Requirement(text).name for group in groups for text in group}
    return not path.startswith("/") and requirement not in libraries | NOT_INSTALLED


def test_the_distribution_has_a_name_of_its_own() -> None:
    """The name `vplog` belongs to another project on PyPI."""
    assert PROJECT["name"] == "vplog-slam"


@pytest.mark.parametrize(
    ("text", "is_wrong"),
    [
        ("`pip install 'vplog[rerun]'`", True),
        ("pip install -U vplog-slam", True),
        ("pip3 install '.[rerum]'", True),
        ("pip install ./examples/nothing", True),
        ("Install it: pip install rerun-sdk", False),
        ("pip install -e '.[test]' && vplog demo", False),
        ("from one `pip install`.", False),
    ],
)
def test_wrong_commands_are_recognised(text: str, is_wrong: bool) -> None:
    assert any(map(wrong, requirements_in(text))) == is_wrong


def test_every_pip_install_names_a_library_or_the_checkout() -> None:
    """In the package, the documentation and the examples."""
    folders = [TOP / name for name in ("vplog", "docs", "examples", ".ci")]
    files = [path for folder in folders for path in folder.rglob("*") if path.is_file() and path.suffix != ".pyc"]
    texts = {path: path.read_text(encoding="utf-8", errors="replace") for path in [*files, *TOP.glob("*.md")]}
    del texts[TOP / "CHANGELOG.md"]
    found = {path: requirements_in(text) for path, text in texts.items()}
    assert sum(map(len, found.values())) > 20
    assert [(path, text) for path, requirements in found.items() for text in requirements if wrong(text)] == []
    assert [path for path, text in texts.items() if re.search(r"\bvplog\[", text)] == []
    for path in TOP.glob("examples/*/pyproject.toml"):
        assert [text for text in read_project(path.parent)["dependencies"] if wrong(text)] == []


@pytest.mark.parametrize("page", FIRST_PAGES, ids=lambda page: page.stem)
def test_a_first_page_begins_with_the_commands_to_install(page: Path) -> None:
    [(_, first), *_] = blocks(page)
    assert first.startswith("python3 -m venv .venv")
    assert requirements_in(first) == ["."]


# Code to copy


def test_an_environment_has_what_is_installed_and_no_more(environment: Callable[..., Path], tmp_path: Path) -> None:
    """Otherwise the tests below could not fail."""
    imports = "from importlib.util import find_spec; print([bool(find_spec(name)) for name in ('vplog', 'pandas')])"
    for requirements, expected in (((), "[True, False]\n"), (("pandas",), "[True, True]\n")):
        assert run_in(environment(*requirements), "python", "-c", imports, folder=tmp_path) == expected
    with pytest.raises(AssertionError, match="No module named 'pandas'"):
        code = "import pyarrow; pyarrow.table({'a': [1]}).to_pandas()"
        run_in(environment(), "python", "-c", code, folder=tmp_path)


def test_the_package_imports_only_what_it_installs(environment: Callable[..., Path], tmp_path: Path) -> None:
    """Extras included, in every file and function."""
    trees = [ast.parse(path.read_bytes()) for path in (TOP / "vplog").rglob("*.py")]
    nodes = [node for tree in trees for node in ast.walk(tree)]
    names = {alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}
    names |= {node.module or "" for node in nodes if isinstance(node, ast.ImportFrom)}
    tops = sorted({name.partition(".")[0] for name in names} - sys.stdlib_module_names)
    extras = ",".join(PROJECT["optional-dependencies"].keys() - {"test"})
    code = f"from importlib.util import find_spec; print([name for name in {tops} if not find_spec(name)])"
    assert run_in(environment(f".[{extras}]"), "python", "-c", code, folder=tmp_path) == "[]\n"


@pytest.fixture(scope="session")
def inputs(drive: Demo, halves: Path, made_once: Callable[..., Path]) -> Path:
    """The files that Python code of the documentation opens, by the names that it gives them."""

    def fill(folder: Path) -> None:
        (folder / "drive.mcap").symlink_to(drive.log)
        (folder / "truth.tum").symlink_to(drive.truth)
        shutil.copytree(halves, folder / "maps" / "city")
        write_delta(folder / "maps" / "city")
        log = vplog.open_log(drive.log)
        [frame] = log.frames(log.stamps()[7:8])
        cv2.imwrite(str(folder / "photo.jpg"), frame.decode().image)
        camera = log.camera()
        assert camera.matrix is not None
        lens = {
            "camera_model": "pinhole", "intrinsics": camera.matrix[[0, 1, 0, 1], [0, 1, 2, 2]].tolist(),
            "resolution": [camera.width, camera.height], "distortion_model": "radtan", "distortion_coeffs": [0.0] * 4,
        }  # fmt: skip
        (folder / "phone.yaml").write_text(yaml.safe_dump({"cam0": lens}))

    return made_once("inputs", fill)


OTHER_PAGES = [page for page in PAGES if page.name != "tutorial.md"]


def test_python_code_runs(inputs: Path, environment: Callable[..., Path], tmp_path: Path) -> None:
    """Each page alone, and the docstring of the package."""
    pages = {page.name: "\n".join(code for _, code in blocks(page, "python")) for page in OTHER_PAGES}
    pages["vplog.py"] = textwrap.dedent("\n".join(re.findall(r"^ {4}.*", vplog.__doc__ or "", re.MULTILINE)))
    pages_of: dict[tuple[str, ...], list[list[Path]]] = {}
    for name, code in pages.items():
        (path := tmp_path / name).write_text(code)
        pages_of.setdefault(tuple(requirements_in(code)), []).append([path])
    assert pages_of.keys() == {(), ("duckdb", "deltalake")}
    for requirements, commands in pages_of.items():
        run_scripts(environment(*requirements), commands, inputs)


def test_the_tutorial_runs(drive: Demo, environment: Callable[..., Path], tmp_path: Path) -> None:
    """On the small drive instead of the demo's, which has tests of its own."""
    tutorial = blocks(TOP / "docs" / "tutorial.md")
    installed = environment(*(requirement for _, text in tutorial for requirement in requirements_in(text)))
    commands: list[list[object]] = []
    for language, text in tutorial:
        if language == "python":
            (path := tmp_path / "block.py").write_text(text)
            commands.append([path])
        else:
            lines = [shlex.split(line) for line in text.splitlines()]
            programs = [line for line in lines if line[0] in ("vplog", "evo_ape") and line[1] != "demo"]
            commands += [[installed / "bin" / program, *arguments] for program, *arguments in programs]
    (folder := tmp_path / "out" / "demo" / "drive").mkdir(parents=True)
    (folder / "drive.mcap").symlink_to(drive.log)
    (folder / "truth.tum").symlink_to(drive.truth)
    out = run_scripts(installed, commands, tmp_path)
    assert "accepted" in out
    assert "rmse" in out
    assert (tmp_path / "places.parquet").is_file()


def test_other_shell_commands_are_of_vplog_or_of_every_system() -> None:
    """The options of vplog's commands are tested in tests/cli/test_help.py."""
    lines = [line for page in OTHER_PAGES for _, text in blocks(page, "sh") for line in text.splitlines()]
    programs = {line.split()[0] for line in lines if not line.startswith(" ")}
    assert programs <= {"vplog", "pip", "python3", ".", "curl"}
