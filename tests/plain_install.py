"""Virtual environments that contain what a `pip install` command installs, and nothing else.

They take a second and no download: they link to packages of the environment that runs the tests.
"""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
import tomllib
import venv
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import vplog

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

TOP = Path(vplog.__file__).parents[1]
_SCRIPTS = """
import json, runpy, sys
for sys.argv in json.loads(sys.argv[1]):
    try:
        runpy.run_path(sys.argv[0], run_name="__main__")
    except SystemExit as end:
        if end.code:
            raise
"""


def requirements_in(text: str) -> list[str]:
    """Return what the `pip install` commands of a text install: names and paths, without options.

    A command ends with its line, code span, string or bracket. The mere mention of `pip install` has no requirement.
    """
    commands = re.findall(r"pip3? install\b([^\n`\"#&;|)]*)(`?)", text)
    if unreadable := [command for command, end in commands if not command.strip() and not end]:
        raise ValueError(f"a `pip install` without arguments in its line: {unreadable}")
    words = [word for command, _ in commands for word in shlex.split(command)]
    return [word for word in words if not word.startswith("-")]


def make_environment(folder: Path, *requirements: str) -> None:
    """Make a virtual environment in `folder` with these requirements and all that they depend on.

    A requirement is a distribution, or a path from the checkout's top that begins with a dot and may have extras:
    `.[onnx]`. Raises PackageNotFoundError if a distribution is not installed here.
    """
    venv.create(folder, symlinks=True)
    [site] = folder.glob("lib/python*/site-packages")
    names = [text for text in requirements if not text.startswith(".")]
    scripts: dict[str, str] = {}
    for path, _, extras in (text.partition("[") for text in requirements if text.startswith(".")):
        project = read_project(TOP / path)
        with (site / "checkouts.pth").open("a") as file:
            file.write(f"{TOP / path}\n")
        names += project["dependencies"]
        names += [name for extra in re.findall(r"[\w-]+", extras) for name in project["optional-dependencies"][extra]]
        scripts |= project.get("scripts", {})
    for distribution in with_dependencies(names):
        for top in {file.parts[0] for file in distribution.files or ()} - {"..", "__pycache__"}:
            (site / top).symlink_to(Path(str(distribution.locate_file(top))))
        scripts |= {one.name: one.value for one in distribution.entry_points.select(group="console_scripts")}
    for name, target in scripts.items():
        module, function = target.split(":")
        script = folder / "bin" / name
        script.write_text(f"#!{folder}/bin/python\nimport {module}, sys\nsys.exit({module}.{function}())\n")
        script.chmod(0o755)


def read_project(folder: Path) -> dict[str, Any]:
    """Return the table `project` of a folder's pyproject.toml."""
    return tomllib.loads((folder / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def with_dependencies(requirements: Iterable[str]) -> list[metadata.Distribution]:
    """Return the installed distributions that these requirements name, and all that they depend on."""
    found: dict[tuple[str, str], metadata.Distribution] = {}
    waiting = [(Requirement(text), "") for text in requirements]
    while waiting:
        requirement, extra = waiting.pop()
        if requirement.marker is None or requirement.marker.evaluate({"extra": extra}):
            name = canonicalize_name(requirement.name)
            for wanted in {"", *requirement.extras} - {extra for at, extra in found if at == name}:
                found[name, wanted] = metadata.distribution(name)
                waiting += [(Requirement(text), wanted) for text in found[name, wanted].requires or ()]
    return list({name: distribution for (name, _), distribution in found.items()}.values())


def run_in(environment: Path, *command: object, folder: Path) -> str:
    """Return what a command prints on stdout, run in `folder` with the environment's programs. It must succeed."""
    inherited = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    variables = {**inherited, "PATH": f"{environment}/bin:{os.environ['PATH']}", "MPLBACKEND": "Agg"}
    words = [*map(str, command)]
    done = subprocess.run(words, capture_output=True, text=True, check=False, cwd=folder, env=variables)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def run_scripts(environment: Path, commands: Iterable[Sequence[object]], folder: Path) -> str:
    """Return what Python scripts, each with its arguments, print on stdout, like `run_in`.

    They run one after another in one process, because loading the package takes 3 CPU seconds.
    """
    words = json.dumps([[*map(str, command)] for command in commands])
    return run_in(environment, "python", "-c", _SCRIPTS, words, folder=folder)
