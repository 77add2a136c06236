from __future__ import annotations

import json
from pathlib import Path

import pytest

from vplog.errors import ResultError, SettingsError
from vplog.pipeline import pipeline_schema
from vplog.results import messages
from vplog.results.contracts import table_schemas, write_schemas
from vplog.storage.parquet_limits import TABLE_VERSION

SCHEMAS = Path(__file__).parents[2] / "schemas"


def test_contracts_in_the_repository_are_those_of_the_code(tmp_path: Path) -> None:
    written = write_schemas(tmp_path, pipeline_schema())
    assert {path.name for path in written} == {path.name for path in SCHEMAS.iterdir()}
    for path in written:
        assert (SCHEMAS / path.name).read_text() == path.read_text(), f"run `vplog schemas`: {path.name} has changed"


def test_every_column_has_a_description_and_every_number_a_unit(tmp_path: Path) -> None:
    write_schemas(tmp_path, pipeline_schema())
    for name, schema in table_schemas().items():
        columns = json.loads((tmp_path / f"{name}.json").read_text())["columns"]
        assert [column["name"] for column in columns] == schema.names
        for column in columns:
            assert column["description"]
            assert column["unit"] or column["type"] in ("string", "any"), column["name"]


def test_proto_text_and_message_class_agree() -> None:
    """Each field of the class is one line of the text, under the same number and type."""
    text = messages.loop_closure_proto()
    fields = messages.loop_closure_class().DESCRIPTOR.fields
    assert len(fields) == text.count(" = ") - 1  # `syntax = ` is the one that is no field
    for field in fields:
        kind = (
            field.message_type.full_name
            if field.message_type
            else {1: "double", 2: "float", 5: "int32", 13: "uint32"}.get(field.type, "string")
        )
        repeated = "repeated " if field.is_repeated else ""
        assert f"\n  {repeated}{kind} {field.name} = {field.number};\n" in text


def test_columns_change_only_with_the_version() -> None:
    """Those of the version that the tables have stay as they were written down when it began; new ones may be null.

    Where this fails, raise TABLE_VERSION and write down the columns of the new one, or let the new column be nullable.
    """
    frozen = json.loads((Path(__file__).parent / f"tables_version_{TABLE_VERSION}.json").read_text())
    now = {}
    for name in table_schemas():
        contract = json.loads((SCHEMAS / f"{name}.json").read_text())
        assert contract["version"] == TABLE_VERSION
        now[name] = {column["name"]: [column["type"], column["nullable"]] for column in contract["columns"]}
    for name, columns in frozen.items():
        kept = {column: now[name].get(column) for column in columns}
        assert kept == columns, f"{name}: a column was removed or changed"
        added = {column: about for column, about in now[name].items() if column not in columns}
        assert all(nullable for _, nullable in added.values()), f"{name}: a column was added that may not be null"


@pytest.mark.parametrize("name", ["map.json", "pipeline.schema.json", "vplog.LoopClosure.proto"])
def test_what_is_no_schema_is_not_replaced(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text('{"format": 1}')
    with pytest.raises(ResultError, match="is no schema, and is not replaced"):
        write_schemas(tmp_path, pipeline_schema())
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {name: '{"format": 1}'}


def test_a_folder_of_other_things_gets_no_schemas(tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_bytes(b"a log is hashed with all that is in its folder")
    with pytest.raises(SettingsError, match="a folder with other things in it, not schemas"):
        write_schemas(tmp_path, pipeline_schema())
    assert [path.name for path in tmp_path.iterdir()] == ["a.mcap"]
