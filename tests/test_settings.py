"""Settings say in one line what does not fit."""

from __future__ import annotations

import ast
import typing
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from pydantic import Field, ValidationError

import vplog
from vplog.benchmark.recogniser_specs import read_method
from vplog.errors import SettingsError
from vplog.pipeline import Pipeline, load_pipeline, pipeline_from
from vplog.places import KINDS
from vplog.settings import Settings, load_yaml, override

if TYPE_CHECKING:
    from collections.abc import Iterator


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
    assert Outer.model_json_schema()["properties"]["name"]["description"] == "A name."


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


FOREIGN = (
    "pydantic",
    "http",
    "Input should",
    "Extra inputs",
    "union",
    "instance of",
    "type=",
    "Value error",
    "NoneType",
)
"""Words of pydantic, which no message may have."""
WRONG: tuple[Any, ...] = (
    None, True, -1, 0, 0.5, 10**40, float("nan"), float("inf"), float("-inf"), "", "many", "1.5", "nan", [], [1, "a"],
    {}, {"a": 1}, {1: 2}, {"kind": "nonsense"}, {"kind": None}, {"kind": [1]}, b"\xff", object(),
)  # fmt: skip


def places(settings: Settings, above: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """Path of every setting and group of settings."""
    for name, value in settings:
        yield (*above, name)
        if isinstance(value, Settings):
            yield from places(value, (*above, name))


def trees() -> Iterator[tuple[tuple[str, ...], dict[str, Any], Pipeline]]:
    """Path of every setting of every method, and the least that a file must say to reach it."""
    for kind in KINDS:
        made = Pipeline.read({"places": {"kind": kind}}, kind)
        yield from ((path, {"places": {"kind": kind}}, made) for path in places(made) if path[0] == "places")
    for kind in ("gnc", "pcm", "dcs", "cauchy", "geman_mcclure", "lm"):
        made = Pipeline.read({"solve": {"kind": kind}}, kind)
        yield from ((path, {"solve": {"kind": kind}}, made) for path in places(made) if path[0] == "solve")
    yield from ((path, {}, Pipeline()) for path in places(Pipeline()) if path[0] not in ("places", "solve"))


def changed(tree: dict[str, Any], path: tuple[str, ...], value: Any) -> dict[str, Any]:
    if len(path) == 1:
        return {**tree, path[0]: value}
    return {**tree, path[0]: changed(tree.get(path[0], {}), path[1:], value)}


def test_no_wrong_value_of_any_setting_is_told_in_the_words_of_pydantic() -> None:
    refused = set()
    for path, tree, _ in trees():
        for wrong in WRONG:
            try:
                Pipeline.read(changed(tree, path, wrong), "my.yaml")
            except SettingsError as error:
                said = str(error)
                refused.add(path)
                assert said.startswith("my.yaml: "), said
                assert "\n" not in said, said
                assert len(said) < 500, said
                assert not [word for word in FOREIGN if word in said], said
                assert ".".join(path) in said or path[0] in said, said
                assert any(word in said for word in (" must be ", " is no setting.", " is ", " than ")), said
    assert {path for path, *_ in trees()} == refused, "a setting that takes anything"


def test_a_mistyped_name_of_any_setting_finds_it() -> None:
    for path, tree, _ in trees():
        name = path[-1]
        if len(name) < 5:
            continue
        for typed in (name[1:], name[:2] + name[3:], name[:1] + name[2] + name[1] + name[3:]):
            if typed == name:
                continue
            with pytest.raises(SettingsError) as error:
                Pipeline.read(changed(tree, (*path[:-1], typed), 1), "my.yaml")
            said = _one_line(error)
            assert said.startswith(f"my.yaml: {'.'.join((*path[:-1], typed))} is no setting. "), said
            assert ".".join(path) in said, said


@pytest.mark.parametrize(
    ("assignment", "said"),
    [
        ("propose.per_query=0", "propose.per_query must be a whole number (at least 1), not 0."),
        ("noise.drift_per_metre=7", "noise.drift_per_metre must be a number (above 0 and at most 1), not 7."),
        ("keyframes.distance_m=far", "keyframes.distance_m must be a number (at least 0) or null, not 'far'."),
        ("library.choose=spreed", "one of random, spread, coverage, not 'spreed'. Did you mean spread?"),
        ("solve.kind=gcn", "solve.kind must be one of cauchy, dcs, geman_mcclure, gnc, lm, pcm, not 'gcn'."),
        ("per_query=3", "per_query is no setting. Did you mean propose.per_query?"),
        ("places.words=3", "places.words is no setting. It belongs to places.kind=bovf or fabmap or hybrid."),
        ("sequence.length=4", "sequence: length 4 is even"),
        ("places.box_columns=40", "places: a box of 40 x 6 is larger than the grid"),
    ],
)
def test_a_wrong_setting_says_where_what_is_allowed_and_what_is_near(assignment: str, said: str) -> None:
    with pytest.raises(SettingsError) as error:
        load_pipeline("default", ["features.max_features=400", assignment])
    message = _one_line(error)
    assert message.startswith(f"--set {assignment}: ")
    assert said in message
    with pytest.raises(SettingsError, match=r"my\.yaml: "):
        pipeline_from(override({}, assignment), "my.yaml", ["features.max_features=400"])


@pytest.mark.parametrize(
    ("method", "said"),
    [
        ("bob", "Did you mean bobb?"),
        ("bobb:refernces=3", "method bobb:refernces=3: refernces is no setting. Did you mean references?"),
        ("hybrid:bobb.rows=0", "bobb.rows must be a whole number (at least 1 and at most 255), not 0."),
        ("fabmap:seen_if_absent=0.9", "fabmap:seen_if_absent=0.9: seen_if_absent 0.9 must be below"),
    ],
)
def test_a_wrong_method_says_what_is_near(method: str, said: str) -> None:
    with pytest.raises(SettingsError) as error:
        read_method(method, Pipeline())
    assert said in _one_line(error)


def test_a_mistyped_pipeline_finds_the_shipped_one() -> None:
    with pytest.raises(SettingsError, match="Did you mean quick"):
        load_pipeline("quik")


def test_a_broken_file_says_in_which_line(tmp_path: Path) -> None:
    path = tmp_path / "p.yaml"
    path.write_text("propose:\n  per_query: 3\n  gap_s: [1, 2\n")
    with pytest.raises(SettingsError, match="line 4"):
        load_yaml(path)


def test_settings_do_not_change() -> None:
    with pytest.raises(ValidationError):
        Outer().name = "b"  # pyrefly: ignore[read-only]


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


def _kinds(settings: type[Settings]) -> Iterator[type[Settings]]:
    """A kind of settings, and all that it holds."""
    yield settings
    for field in settings.model_fields.values():
        for kind in (field.annotation, *typing.get_args(field.annotation)):
            if isinstance(kind, type) and issubclass(kind, Settings):
                yield from _kinds(kind)


def test_every_setting_is_read_somewhere() -> None:
    """One that is not would be taken without a word, and do nothing."""
    code = Path(vplog.__file__).parent
    trees = [ast.parse(path.read_text(encoding="utf-8")) for path in code.rglob("*.py")]
    read = {node.attr for tree in trees for node in ast.walk(tree) if isinstance(node, ast.Attribute)}
    kinds = {one for kind in (Pipeline, *KINDS.values()) for one in _kinds(kind)}
    assert len(kinds) > 25
    assert [f"{kind.__name__}.{name}" for kind in kinds for name in kind.model_fields if name not in read] == []
