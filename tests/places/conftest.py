"""One small library for all tests of the folder."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tests.places.pictures import SMALL, reference
from vplog.execution.execution import Execution

if TYPE_CHECKING:
    from vplog.data import Reference
    from vplog.places.bobb_paper import PaperBobbState


@pytest.fixture(scope="session")
def references() -> list[Reference]:
    return [reference(seed) for seed in range(12)]


@pytest.fixture(scope="session")
def state(references: list[Reference]) -> PaperBobbState:
    return SMALL.learn(references, Execution(2))
