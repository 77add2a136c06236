"""Reference pages that are made from the code itself: settings, files, verbs, the Python API."""

from __future__ import annotations

import inspect
import json
import re
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mkdocs.structure.files import File

import vplog

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files

SCHEMAS = Path(__file__).parents[1] / "schemas"


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the generated pages; mkdocs calls this before it renders."""
    pages = {"settings": settings_page(), "files": files_page(), "verbs": verbs_page(), "python": python_page()}
    for name, text in pages.items():
        files.append(File.generated(config, f"reference/{name}.md", content=text))
    return files


def settings_page() -> str:
    """Every setting of a pipeline: name, type, default and what it does, from schemas/pipeline.schema.json."""
    schema = _read("pipeline.schema.json")
    kinds = schema["$defs"]
    lines = [
        "# Settings",
        "",
        "Every setting of a pipeline file. `--set a.b=c` changes one, `vplog config` prints all of them as YAML.",
    ]
    for name, part in schema["properties"].items():
        lines += ["", f"## {name}", "", _cell(part.get("description", ""))]
        for kind in _references(part):
            lines += ["", f"### {kinds[kind].get('title', kind)}", "", _cell(kinds[kind].get("description", "")), ""]
            lines += ["| setting | default | |", "|---|---|---|"]
            lines += [_setting(key, one) for key, one in kinds[kind].get("properties", {}).items()]
    return "\n".join(lines) + "\n"


def files_page() -> str:
    """Columns of every Parquet table, from the schemas."""
    lines = [
        "# Files and columns",
        "",
        "Column names, types and units of every table. The MCAP channels are in `schemas/result.mcap.json`.",
    ]
    for path in sorted(SCHEMAS.glob("*.json")):
        columns = _read(path.name).get("columns")
        if columns is None:
            continue
        lines += ["", f"## {path.stem}.parquet", "", "| column | type | |", "|---|---|---|"]
        lines += [f"| `{one['name']}` | `{one['type']}` | {_cell(one.get('description', ''))} |" for one in columns]
    return "\n".join(lines) + "\n"


def verbs_page() -> str:
    """The help of every verb, as the command line prints it."""
    overview = _help()
    lines = ["# Verbs", "", "```text", overview, "```"]
    for verb in re.findall(r"^ {4}(\w+)\b", overview, re.MULTILINE):
        lines += ["", f"## vplog {verb}", "", "```text", _help(verb), "```"]
    return "\n".join(lines) + "\n"


def python_page() -> str:
    """Functions, classes and errors of `import vplog`, from their docstrings."""
    names = {name: getattr(vplog, name) for name in vplog.__all__}
    functions = [name for name, one in names.items() if inspect.isfunction(one)]
    classes = [name for name in names if inspect.isclass(names[name]) and not name.endswith("Error")]
    lines = ["# Python", "", *_documented(vplog)]
    for name in ("run", *(name for name in functions if name != "run")):
        lines += ["", f"## vplog.{name}", "", "```python", f"vplog.{name}{_signature(names[name])}", "```"]
        lines += ["", *_documented(names[name])]
    for name in classes:
        lines += ["", f"## {name}", "", *_documented(names[name])]
        for member, one in vars(names[name]).items():
            if not member.startswith("_") and inspect.getdoc(one) and not isinstance(one, str):
                signature = _signature(one) if inspect.isfunction(one) else ""
                lines += ["", f"### {name}.{member}{signature}", "", *_documented(one)]
    errors = [name for name in names if name.endswith("Error")]
    lines += ["", "## Errors", "", "All are a `VplogError`.", "", "| error | |", "|---|---|"]
    lines += [f"| `{name}` | {_cell(inspect.getdoc(names[name]) or '')} |" for name in errors]
    return "\n".join(lines) + "\n"


def _signature(function: Any) -> str:
    """Names and defaults, without types."""
    signature, empty = inspect.signature(function), inspect.Parameter.empty
    known = [one.replace(annotation=empty) for one in signature.parameters.values() if one.name != "self"]
    text = str(signature.replace(parameters=known, return_annotation=empty))
    return re.sub(r"<function (\S+) at \w+>", lambda found: "None" if "lambda" in found[1] else found[1], text)


def _documented(one: Any) -> list[str]:
    """A docstring, its parameters as a list."""
    parameters = inspect.signature(one).parameters if inspect.isfunction(one) else {}

    def item(found: re.Match[str]) -> str:
        return f"- `{found[1]}`: " if set(found[1].split(", ")) <= set(parameters) else found[0]

    return re.sub(r"(?m)^(\w+(?:, \w+)*): (?=\S)", item, inspect.getdoc(one) or "").splitlines()


def _help(*verb: str) -> str:
    command = [sys.executable, "-m", "vplog", *verb, "--help"]
    return subprocess.run(command, capture_output=True, text=True, check=True, cwd=SCHEMAS.parent).stdout.rstrip()


def _read(name: str) -> dict[str, Any]:
    return json.loads((SCHEMAS / name).read_text(encoding="utf-8"))


def _references(part: dict[str, Any]) -> list[str]:
    """Names of the definitions that a setting may be."""
    found = [one["$ref"] for one in (part, *part.get("oneOf", []), *part.get("anyOf", [])) if "$ref" in one]
    return [name.rpartition("/")[2] for name in found]


def _setting(name: str, about: dict[str, Any]) -> str:
    default = json.dumps(about.get("default", about.get("const", "")))
    return f"| `{name}` | `{default}` | {_cell(about.get('description', ''))} |"


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")
