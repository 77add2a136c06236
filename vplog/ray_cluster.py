"""A connection to a Ray cluster: one of this machine for the time of a block, or one that is there."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from vplog.errors import SettingsError
from vplog.scratch import scratch

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

_CONNECT_S = 5.0
"""Until a machine that does not take a connection counts as away: TCP has then tried three times."""
_ANSWER_S = 30.0
"""Until a cluster that says nothing counts as none. Ray's own tools wait for minutes; a loaded head needs seconds."""
_ENVIRONMENT = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
"""Of workers, as cli.py has it for the batch itself: another number of BLAS threads could give other last bits."""
_QUIET = {"RAY_USAGE_STATS_ENABLED": "0", "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0"}
"""Ray reports nothing to its makers, and warns of no change to come, unless the user's environment says otherwise."""
_LONGEST_PLACE = 40
"""Characters of a folder that Ray can put its sockets into: their names add up to 66, and the system takes 107."""
_OTHER_PLACE = "/tmp/ray"  # noqa: S108
"""Ray's own, where the folder's name is longer; its files then stay."""


@contextmanager
def connected(address: str | None, threads: int) -> Iterator[Any]:
    """The module `ray` while it is connected to the cluster at `address`, or to one of this machine with so many cores.

    Without an address a connection that this process has already is used. Raises SettingsError with one line.
    """
    ray = _imported()
    if address is None and ray.is_initialized():
        yield ray
        return
    with scratch("ray") as folder:
        try:
            if address is None:
                _start(ray, folder, threads)
            else:
                _check_answers(address)
                _connect(ray, address, runtime_env={"env_vars": _ENVIRONMENT})
            yield ray
        finally:
            ray.shutdown()


def _imported() -> Any:
    for name, value in _QUIET.items():  # before it is loaded, which is when it looks
        os.environ.setdefault(name, value)
    try:
        import ray
        import ray._private.worker as session
    except ImportError:
        raise SettingsError("--engine ray needs Ray. Install it: pip install 'vplog[ray]'") from None
    setattr(session, "_worker_logs_enabled", False)  # noqa: B010 (what machines say would go to our stdout; futures tell)
    return ray


def _start(ray: Any, folder: Path, threads: int) -> None:
    """A cluster of this machine alone. Its files and those of its workers go with the folder."""
    before = dict(os.environ)
    os.environ.update({"TMPDIR": str(folder), **_ENVIRONMENT})
    place = str(folder) if len(str(folder)) <= _LONGEST_PLACE else _OTHER_PLACE
    try:
        _connect(ray, "local", num_cpus=threads, num_gpus=0, include_dashboard=False, _temp_dir=place)
    finally:
        os.environ.clear()
        os.environ.update(before)


def _check_answers(address: str) -> None:
    """Ray by itself would wait for minutes, and then end this process. Raises SettingsError."""
    if address == "auto":
        return
    host, _, port = address.rpartition(":")
    if not host or not port.isdigit() or "//" in host:
        raise SettingsError(
            f"--address {address} is no HOST:PORT of a Ray cluster. Take what `ray start --head` says, or auto."
        )
    command = [sys.executable, "-m", "ray.scripts.scripts", "health-check", "--skip-version-check"]
    try:
        socket.create_connection((host, int(port)), _CONNECT_S).close()
        done = subprocess.run([*command, "--address", address], capture_output=True, timeout=_ANSWER_S, check=False)  # noqa: S603
        answers = done.returncode != 1
    except (OSError, OverflowError, subprocess.TimeoutExpired):
        answers = False
    if not answers:
        raise SettingsError(f"No Ray cluster answers at {address}. Start one: ray start --head --port {port}")


def _connect(ray: Any, address: str, **more: Any) -> None:
    try:
        ray.init(address=address, log_to_driver=False, logging_level="ERROR", **more)
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # of many kinds, by what is wrong and by version; the end of this process is one
        what = "start a Ray cluster here" if address == "local" else f"join the Ray cluster at {address}"
        text = " ".join(str(error).split())[:400] or type(error).__name__
        raise SettingsError(f"Cannot {what}: {text}") from None
