"""What every verb says of itself: an example that parses, options in groups; settings, completion, container image."""

from __future__ import annotations

import argparse
import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
import yaml

from vplog.cli import main
from vplog.cli.examples import EXAMPLES
from vplog.cli.parser import Parser
from vplog.pipeline import load_pipeline, pipeline_schema

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from conftest import Said

    Verb = Callable[..., Said]

PROJECT = Path(__file__).parents[2]


def verbs(parser: argparse.ArgumentParser) -> Iterator[argparse.ArgumentParser]:
    yield parser
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for one in action.choices.values():
                yield from verbs(one)


def test_every_verb_has_an_example_that_parses() -> None:
    root = main._parser()
    found = list(verbs(root))
    assert {one.prog for one in found} == set(EXAMPLES)
    for one in found:
        example = EXAMPLES[one.prog]
        assert one.prog in example
        assert f"\nexample: {example}\n" in one.format_help()
        assert len(example) < 80  # or help would wrap it
        root.parse_args(shlex.split(example)[1:])


def test_options_that_verbs_share_stand_in_groups() -> None:
    groups = {
        group.title: {option for action in group._group_actions for option in action.option_strings}
        for one in verbs(main._parser())
        if one.prog == "vplog batch"
        for group in one._action_groups
    }
    assert {"--mask", "--start"} <= groups["the log"]
    assert {"--threads"} == groups["execution"]
    assert {"--json", "--debug", "--events"} == groups["output and errors"]
    assert {"--pipeline", "--set"} == groups["settings"]
    assert {"--jobs", "--engine"} <= groups["workers"]
    assert {"--library", "--map"} <= groups["options"]


# Settings


def test_settings_have_their_sentences_as_comments(verb: Verb) -> None:
    text = verb("config", "--pipeline", "paper").out
    assert yaml.safe_load(text) == load_pipeline("paper").model_dump(mode="json")
    comments = " ".join(line.strip(" #") for line in text.splitlines() if line.strip().startswith("#"))
    schema = pipeline_schema()
    for kind in ("KeyframeSettings", "PaperBobbSettings"):
        for one in schema["$defs"][kind]["properties"].values():
            assert " ".join(one["description"].split()) in comments


def test_one_setting_is_explained(verb: Verb) -> None:
    said = verb("config", "places.references", "--set", "places.references=7", "--json").json
    assert (said["setting"], said["value"], said["default"]) == ("places.references", 7, 10)
    assert said["description"]
    text = verb("config", "places.references", "--set", "places.references=7").out
    assert text.startswith("places.references: 7\n")
    assert "default   10\n" in text
    assert "allowed   a whole number" in text
    for wrong, meant in (("places.agreemnt", "places.agreement"), ("place.agreement", "places.agreement")):
        assert f"Did you mean {meant}?" in verb("config", wrong).error
    assert "Groups: keyframes, features" in verb("config", "nothing.such").error


# Completion


def test_the_tab_key_completes(tmp_path: Path) -> None:
    pytest.importorskip("argcomplete")
    line, written = "vplog open out/run --with r", tmp_path / "words"
    words = {"_ARGCOMPLETE": "1", "_ARGCOMPLETE_IFS": " ", "_ARGCOMPLETE_STDOUT_FILENAME": str(written)}
    typed = {"COMP_LINE": line, "COMP_POINT": str(len(line)), "COMP_TYPE": "9"}
    code = "import sys; sys.argv[0] = 'vplog'; from vplog.cli.main import main; main()"
    subprocess.run([sys.executable, "-c", code], env={**os.environ, **words, **typed}, check=True)
    assert set(written.read_text().split()) == {"rerun", "report"}


def test_shells_find_the_mark_of_completion() -> None:
    assert "# PYTHON_ARGCOMPLETE_OK" in Path(main.__file__).read_text()[:1024]
    assert isinstance(main._parser(), Parser)


# The container image


def test_the_dockerfile_copies_what_is_there_and_starts_the_command() -> None:
    text = (PROJECT / "examples" / "Dockerfile").read_text()
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    words = [(kind, rest) for kind, _, rest in (line.partition(" ") for line in lines)]
    assert {kind for kind, _ in words} <= {"FROM", "COPY", "RUN", "ENV", "WORKDIR", "USER", "ENTRYPOINT", "CMD"}
    stages = [re.search(r" AS (\w+)$", rest) for kind, rest in words if kind == "FROM"]
    assert words[0][0] == "FROM"
    for rest in (rest for kind, rest in words if kind == "COPY"):
        *sources, target = rest.split()
        assert target.startswith("/")
        if sources[0].startswith("--from="):
            assert sources[0].removeprefix("--from=") in {one[1] for one in stages if one}
        else:
            assert all((PROJECT / source).exists() for source in sources)
    assert [json.loads(rest) for kind, rest in words if kind in ("ENTRYPOINT", "CMD")] == [["vplog"], ["--help"]]
    least = re.search(r'requires-python = ">=([\d.]+)"', (PROJECT / "pyproject.toml").read_text())
    assert least is not None
    assert all(f"python:{least[1]}-slim" in rest for kind, rest in words if kind == "FROM")


def _documented() -> Iterator[tuple[str, str]]:
    """Each command of vplog in the documentation, and its file."""
    for path in (PROJECT / "README.md", *sorted((PROJECT / "docs").rglob("*.md"))):
        for block in re.findall(r"^```sh\n(.*?)^```", path.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL):
            for line in block.replace("\\\n", " ").splitlines():
                if line.startswith("vplog "):
                    yield path.name, line


def test_every_command_of_the_documentation_parses() -> None:
    root, commands = main._parser(), list(_documented())
    assert len(commands) > 60
    for file, line in commands:
        words = ["7" if word in ("K", "N") else word for word in shlex.split(line, comments=True)[1:]]
        try:
            root.parse_args(words)
        except SystemExit:
            pytest.fail(f"{file}: {line}")
