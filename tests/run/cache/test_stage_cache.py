"""The identity of a log in the stage cache."""

from __future__ import annotations

import os
import random
import time
from typing import TYPE_CHECKING

import pytest

from vplog.errors import LogError
from vplog.run.cache.stage_cache import StageCache, inputs_of, key_of

if TYPE_CHECKING:
    from pathlib import Path


def test_no_flipped_bit_of_a_logs_identity_is_believed(tmp_path: Path) -> None:
    """The log has the name it had in the cache, or another that nothing is kept by."""
    file, cache, chance = tmp_path / "a.mcap", tmp_path / "cache", random.Random(5)
    file.write_bytes(b"a log")
    with StageCache(cache, file) as stages:
        stages.store("extract-000000", "0" * 64, [], b"")
        stages.finish(["extract-000000.stage"])
    os.utime(file, ns=(0, 0))
    known, sound = inputs_of(file, cache), (cache / "inputs.json").read_bytes()
    assert known.token != key_of(known.signature)
    for _ in range(200):
        flipped = bytearray(sound)
        flipped[chance.randrange(len(sound))] ^= 1 << chance.randrange(8)
        (cache / "inputs.json").write_bytes(flipped)
        found = inputs_of(file, cache)
        assert found.token in (known.token, key_of(known.signature))
        assert found.signature == known.signature


def test_a_run_that_has_failed_does_not_read_its_log_to_the_end(tmp_path: Path) -> None:
    """A sparse file of 20 GB takes ten seconds to hash; a log may have hundreds."""
    log = tmp_path / "drive.bag"
    with log.open("wb") as stream:
        stream.truncate(20 * 10**9)
    began = time.process_time()
    with pytest.raises(LogError), StageCache(tmp_path / "cache", log):
        raise LogError("no odometry")
    assert time.process_time() - began < 2.0
