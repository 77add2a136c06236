"""Templates of pages: the wheel ships them, every value is escaped, and only a page loads Jinja."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from vplog.results.html import _environment, figure

ROOT = Path(__file__).parents[2]
TEMPLATES = sorted(path.name for path in (ROOT / "vplog" / "results" / "templates").iterdir())


def test_the_wheel_ships_every_template() -> None:
    from hatchling.builders.wheel import WheelBuilder

    shipped = {file.distribution_path for file in WheelBuilder(str(ROOT)).recurse_included_files()}
    assert {f"vplog/results/templates/{name}" for name in TEMPLATES} <= shipped
    for folder in ("pipelines", "schemas"):
        assert {f"vplog/{folder}/{path.name}" for path in (ROOT / folder).iterdir()} <= shipped
    assert set(_environment().list_templates()) == set(TEMPLATES)


@pytest.mark.parametrize("name", TEMPLATES)
def test_every_template_compiles_and_fetches_nothing(name: str) -> None:
    assert _environment().get_template(name)
    text = (ROOT / "vplog" / "results" / "templates" / name).read_text(encoding="utf-8")
    text = text.removeprefix("/*! https://github.com/leeoniya/uPlot (v1.6.32) */")
    assert not {word for word in ("://", "@import", "url(", "|safe", "autoescape") if word in text}


def test_macros_escape_their_values() -> None:
    template = _environment().from_string(
        '{% from "parts.html" import legend, picture, table %}'
        "{{ table([x], [[x]]) }}{{ legend([(x, x)]) }}{{ picture(jpeg, x) }}"
    )
    text = template.render(x='"><script>', jpeg=b"")
    assert "<script" not in text
    assert text.count("&#34;&gt;&lt;script&gt;") == 5


def test_numbers_are_for_reading() -> None:
    assert [figure(value) for value in (1234567, 1234.56, float("nan"), None, "x")] == [
        "1\u202f234\u202f567", "1\u202f234.6", "-", "-", "-"
    ]  # fmt: skip


def test_jinja_is_loaded_when_a_page_is_written() -> None:
    code = "import sys, vplog.verbs.info, vplog.run.report; print('jinja2' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"
