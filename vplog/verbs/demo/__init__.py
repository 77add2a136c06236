"""A drive made on the spot: a rendered street, a car that circles a block, and the log its sensors write.

It needs no download, so `vplog demo` and the tests run on it. The same settings give the same bytes.
"""

from __future__ import annotations

from vplog.verbs.demo.record import Demo, make_drive
from vplog.verbs.demo.settings import SMALL, DemoSettings

__all__ = ["SMALL", "Demo", "DemoSettings", "make_drive"]
