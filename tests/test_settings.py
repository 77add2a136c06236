"""Settings say in one line what does not fit."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest
from pydantic import Field, ValidationError

from vplog.errors import SettingsError
from vplog.settings import Settings, load_yaml, override

if TYPE_CHECKING:
    from pathlib import Path


class Inner(Settings):
    count: int = Field(default=3, ge=1)
    """How many."""
    share: float = 0.5
    """How much."""


class Outer(Settings):
    inner: Inner = Inner()
    """The group."""
    name: str = "a"
    """A name."""


def _one_line(error: pytest.ExceptionInfo[SettingsError]) -> str:
    message = str(error.value)
    assert "\n" not in message
    assert len(message) < 500
    return message


def test_what_is_not_said_is_the_default() -> None:
    assert Outer.read({}, "file") == Outer()
    assert Outer.read({"inner": {"count": 7}}, "file") == Outer(inner=Inner(count=7))
    assert Outer.model_fields["name"].description == "A name."


@pytest.mark.parametrize(
    ("tree", "where"),
    [
        ({"outer": 1}, "outer"),
        ({"inner": {"cuont": 1}}, "inner.cuont"),
        ({"inner": {"count": "many"}}, "inner.count"),
        ({"inner": {"count": 1.5}}, "inner.count"),
        ({"inner": {"count": 0}}, "inner.count"),
        ({"inner": {"share": float("nan")}}, "inner.share"),
        ({"inner": {"share": float("inf")}}, "inner.share"),
        ({"inner": [1]}, "inner"),
        ({"inner": None}, "inner"),
        ({"name": {"a": 1}}, "name"),
        ({1: 2}, "1"),
    ],
)
def test_what_does_not_fit_is_named(tree: dict[str, Any], where: str) -> None:
    with pytest.raises(SettingsError) as error:
        Outer.read(tree, "my.yaml")
    assert _one_line(error).startswith(f"my.yaml: {where}")


def test_settings_do_not_change() -> None:
    with pytest.raises(ValidationError):
        Outer().name = "b"  # pyright: ignore[reportAttributeAccessIssue]


def test_a_file_is_read(tmp_path: Path) -> None:
    path = tmp_path / "p.yaml"
    path.write_text("inner:\n  count: 4\nname: Straße\n", encoding="utf-8")
    assert Outer.read(load_yaml(path), "p") == Outer(inner=Inner(count=4), name="Straße")
    path.write_text("# nothing but defaults\n")
    assert load_yaml(path) == {}


@pytest.mark.parametrize(
    "text",
    [
        "- a\n- b\n",
        "just words",
        "3",
        "a: [1, 2",
        "a: b: c",
        "\ta: 1",
        "a: !!python/object/apply:os.getcwd []",
        "when: 2024-13-45",
        "long: " + "9" * 5000,
        "[" * 1500,
        "? [a]\n: 1",
        "\x00",
    ],
)
def test_files_that_are_no_mapping(tmp_path: Path, text: str) -> None:
    path = tmp_path / "p.yaml"
    path.write_text(text)
    with pytest.raises(SettingsError) as error:
        load_yaml(path)
    assert str(path) in _one_line(error)


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    (tmp_path / "latin.yaml").write_bytes("name: Straße".encode("latin-1"))
    (tmp_path / "large.yaml").write_text("# " + "x" * 1_000_000)
    for name, why in (("latin.yaml", "Cannot read"), ("large.yaml", "larger than 1 MB"), ("no.yaml", "Cannot read")):
        with pytest.raises(SettingsError, match=why) as error:
            load_yaml(tmp_path / name)
        _one_line(error)
    with pytest.raises(SettingsError, match="Cannot read"):
        load_yaml(tmp_path)


def test_a_small_file_that_unfolds_without_end_is_refused(tmp_path: Path) -> None:
    """Aliases of aliases are 10^30 words when printed."""
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 10)}]" for n in range(1, 30)]
    path = tmp_path / "p.yaml"
    path.write_text("\n".join([*lines, "name: *a29"]))
    tree = load_yaml(path)
    with pytest.raises(SettingsError) as error:
        Outer.read({"name": tree["name"]}, "p.yaml")
    _one_line(error)


def test_override_sets_one_value_in_a_copy() -> None:
    tree = {"inner": {"count": 1, "share": 0.1}, "name": "x"}
    assert override(tree, "inner.count=5") == {"inner": {"count": 5, "share": 0.1}, "name": "x"}
    assert tree["inner"] == {"count": 1, "share": 0.1}
    assert override({}, "a.b.c=[1, 2.5]") == {"a": {"b": {"c": [1, 2.5]}}}
    assert override({"a": None}, "a.b=null") == {"a": {"b": None}}
    assert override({}, "name=a=b") == {"name": "a=b"}
    assert override({}, "name=") == {"name": None}


@pytest.mark.parametrize(
    "assignment",
    ["", "a", "=1", "a..b=1", ".a=1", "a.=1", "a=[1", "a=2024-13-45", "a=" + "9" * 5000, "a=" + "[" * 1500],
)
def test_overrides_that_say_nothing(assignment: str) -> None:
    with pytest.raises(SettingsError) as error:
        override({}, assignment)
    assert str(error.value).startswith("--set")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("value", [3, 0, "", False, "text", [], [1]])
def test_a_value_is_no_group(value: object) -> None:
    with pytest.raises(SettingsError, match="is a value, not a group"):
        override({"a": value}, "a.b=1")
