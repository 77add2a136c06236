"""Code that a result depends on: a hash over the files its modules import, and the versions of the packages they use.

Found from the imports themselves, so that no list can forget one.
"""

from __future__ import annotations

import hashlib
import platform
import re
import sys
from functools import cache
from importlib import metadata
from itertools import accumulate
from pathlib import Path

from vplog.storage.folders import regular_files

_PACKAGE = Path(__file__).parents[2]
_PUBLISHED_AS = {"cv2": "opencv-python-headless", "faiss": "faiss-cpu", "yaml": "PyYAML", "google": "protobuf"}
"""Packages whose name on PyPI is not the one they are imported by; a search for others takes half a second."""
_TYPE_CHECKING = re.compile(r"^( *)if TYPE_CHECKING:\n(?:\1 +.*\n|\n)*", re.MULTILINE)
_IMPORT = re.compile(r"^ *(?:from (\w[\w.]*) )?import ([\w.]+(?:, [\w.]+)*$|\([\w\s,]*\))", re.MULTILINE)


@cache
def code_of(*modules: str) -> dict[str, str]:
    """sha256 over the vplog files that these modules import, transitively and themselves included, as `code`; and the
    version of Python, the kind of machine, and the version of every other package that those files import.

    What is imported for type checkers alone does not count, as it does not run. A package below vplog that is entered
    on the way to one of its modules counts by its own file, not by all that it imports besides.
    """
    own = tuple(module for module in modules if module.partition(".")[0] == "vplog")
    files, packages = imported(own)
    for module in {*modules} - {*own}:  # a plug-in: all files of its package, and its version
        top = module.partition(".")[0]
        folders = [Path(place) for place in getattr(sys.modules.get(top), "__path__", ())]
        files[module] = Path(str(sys.modules[module].__file__))
        below = ((folder, name) for folder in folders for name in regular_files(folder))
        files |= {f"{top}/{name}": folder / name for folder, name in below if name.endswith(".py")}
        packages.add(top)
    digest = hashlib.sha256()
    for name in sorted(files):
        digest.update(f"{name} {hashlib.sha256(files[name].read_bytes()).hexdigest()}\n".encode())
    versions = {name: version(name) for name in sorted(packages)}
    return {"code": digest.hexdigest(), "python": platform.python_version(), "machine": platform.machine(), **versions}


def imported(modules: tuple[str, ...]) -> tuple[dict[str, Path], set[str]]:
    """Files by name of the vplog modules that these import, and the names of the packages of others."""
    files: dict[str, Path] = {}
    packages: set[str] = set()
    waiting, followed = ["vplog", *modules], set[str]()
    while waiting:
        module = waiting.pop()
        if module in followed:
            continue
        followed.add(module)
        path = _file(module, _PACKAGE)
        if path is None:
            raise ValueError(f"{module} is not a module of vplog")
        parents = accumulate(module.split(".")[:-1], "{}.{}".format)
        files |= {parent: file for parent in parents if (file := _file(parent, _PACKAGE)) is not None}
        files[module] = path
        for name in _imports(path, path.stat().st_mtime_ns):
            top = name.partition(".")[0]
            if top == "vplog":
                waiting.append(name if _file(name, _PACKAGE) is not None else name.rpartition(".")[0])
            elif top not in sys.stdlib_module_names:
                packages.add(top)
    return files, packages


@cache
def _file(module: str, package: Path) -> Path | None:
    """The file of a module or package of vplog; None where there is none of that name."""
    at = package.joinpath(*module.split(".")[1:])
    return next((file for file in (at / "__init__.py", at.with_suffix(".py")) if file.is_file()), None)


@cache
def _imports(path: Path, _changed_ns: int) -> list[str]:
    """Full names of all that a file imports when it runs, by its lines: syntax trees of all files take a second."""
    text = re.sub(" as \\w+| *#.*", "", _TYPE_CHECKING.sub("", path.read_text(encoding="utf-8")))
    found = ((module, re.findall(r"[\w.]+", names)) for module, names in _IMPORT.findall(text))
    return [f"{module}.{name}" if module else name for module, names in found for name in names]


@cache
def version(package: str) -> str:
    """Version of an installed package by its import or published name; `none` where there is none."""
    try:
        return metadata.version(_PUBLISHED_AS.get(package, package))
    except metadata.PackageNotFoundError:
        named = sorted(metadata.packages_distributions().get(package, ()))
    # an extra that is not installed matters too: another machine may decode what this one cannot
    return metadata.version(named[0]) if named else "none"
