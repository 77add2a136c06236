"""Records hold what they were written with, or say that they do not."""

from __future__ import annotations

import json
import random
from typing import TYPE_CHECKING, Any

import pytest

from tests.results.example import make_run
from tests.run.test_run_folder import written
from vplog.errors import ResultError
from vplog.logs import TopicChoice
from vplog.pipeline import Pipeline
from vplog.results.run_record import read_finished_run, read_run_json, write_run_json
from vplog.results.tables import TableMetadata, write_closures, write_keyframes
from vplog.run.provenance import OWN_LIBRARY, head
from vplog.run.run_folder import staged_run
from vplog.verbs.resume import resume_request

if TYPE_CHECKING:
    from pathlib import Path


def write_run(folder: Path, **changed: Any) -> dict[str, Any]:
    """A finished run with the tables that `explain` needs, and its record."""
    known, about = make_run(3), TableMetadata({}, "")
    write_keyframes(folder / "keyframes.parquet", known.keyframes, known.solution.world_from_body, about)
    write_closures(folder / "closures.parquet", known.closures, known.keyframes, about)
    log = written(folder / "a.mcap", b"a log")
    account = {**head(Pipeline(), log, 1, TopicChoice()), "finished": True, "library": {"from": OWN_LIBRARY}}
    account |= {"solution": {"reason": "It converged."}, **changed}
    write_run_json(folder / "run.json", account)
    return account


def test_no_flipped_bit_of_a_run_json_is_believed(tmp_path: Path) -> None:
    known, chance, path = write_run(tmp_path), random.Random(7), tmp_path / "run.json"
    data, refused = path.read_bytes(), 0
    for _ in range(200):
        flipped = bytearray(data)
        flipped[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
        path.write_bytes(flipped)
        try:
            found = read_run_json(path)
        except ResultError as error:
            assert str(path) in str(error)
            refused += 1
        else:  # a flip in the name of the checksum leaves a field that nobody reads
            assert {**found, **known} == found
    assert refused > 190


@pytest.mark.parametrize("number", ["1" + 400 * "0", "-9223372036854775809", "1e400", "Infinity", "NaN"])
def test_a_number_that_no_field_can_hold_is_damage(number: str, tmp_path: Path) -> None:
    path = tmp_path / "run.json"
    path.write_text(f'{{"finished": true, "log": "a", "solution": {{"pieces": {number}}}}}')
    with pytest.raises(ResultError, match="damaged") as error:
        read_run_json(path)
    assert "\n" not in str(error.value)


def test_a_record_without_a_checksum_is_read(tmp_path: Path) -> None:
    """An older vplog wrote it, or an editor."""
    write_run_json(tmp_path / "run.json", {"finished": True, "log": "a"})
    text = json.loads((tmp_path / "run.json").read_text())
    del text["record_sha256"]
    (tmp_path / "run.json").write_text(json.dumps(text))
    assert read_finished_run(tmp_path) == {"finished": True, "log": "a"}


def test_the_request_of_an_unfinished_run_has_a_checksum(tmp_path: Path) -> None:
    out, log = tmp_path / "out", written(tmp_path / "a.mcap", b"a log")
    with pytest.raises(KeyboardInterrupt), staged_run(out, head(Pipeline(), log, 1), [log]):
        (out / ".cache" / "extract-0.stage").write_text("a result")
        raise KeyboardInterrupt
    request = out / ".cache" / "run.json"
    request.write_text(request.read_text().replace('"rotation_deg": 10.0', '"rotation_deg": 11.0'))
    with pytest.raises(ResultError, match="checksum"):
        resume_request(out)
