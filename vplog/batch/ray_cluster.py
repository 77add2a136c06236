"""A connection to a Ray cluster: one of this machine for the time of a block, or one that is there."""

from __future__ import annotations

import os
import secrets
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import Future, InvalidStateError
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from vplog.errors import SettingsError
from vplog.storage.scratch import scratch

_CONNECT_TIMEOUT_S = 5.0
"""Time after which a machine that does not take a connection counts as unreachable: TCP has then tried three times."""
_ANSWER_TIMEOUT_S = 30.0
"""Limit of the health check of a cluster. Ray's own tools wait for minutes; a loaded head needs seconds."""
_LOST_S = 30.0
"""Time after which a head that takes no connections counts as lost. Ray ends this process after twice that."""
_RAY_WAITS = "RAY_gcs_rpc_server_reconnect_timeout_s"
"""Environment variable: for how long Ray waits, as for a head that starts again by itself."""
_ENVIRONMENT = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
"""Environment of workers, as cli.py has it for the batch: another number of BLAS threads could give other last bits."""
_QUIET = {"RAY_USAGE_STATS_ENABLED": "0", "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0"}
"""Defaults of the environment: no usage reports to Ray's makers, and no deprecation warning."""
_TOKEN = secrets.token_hex(32)
"""Authentication of our own clusters where the user has no token: Ray would write one to ~/.ray. Ray uses the first of
a process throughout, so all clusters of this process share it."""
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


class ClusterHead:
    """The head of a cluster: whether it is there, and the futures that fail along with it."""

    def __init__(self, address: str) -> None:
        self._address, self._futures, self.is_lost = address, set[Future[Any]](), False

    def future(self) -> Future[Any]:
        """A new future, which fails with SettingsError where the head is lost."""
        future: Future[Any] = Future()
        future.set_running_or_notify_cancel()
        self._futures.add(future)
        future.add_done_callback(self._futures.discard)
        return future

    def check(self) -> None:
        """Raises SettingsError where it is lost."""
        if self.is_lost:
            raise self._error()

    def watch(self, ended: threading.Event) -> None:
        """Probe the head until `ended`. One that was never reached this way does not count as lost."""
        last_contact, place = float("inf"), self._address.rpartition(":")
        wait = os.environ.get(_RAY_WAITS, "")
        patience_s = max(_LOST_S, int(wait) / 2 if wait.isdecimal() else 0)
        while not ended.wait(_LOST_S / 10):
            with suppress(OSError, ValueError):
                socket.create_connection((place[0].strip("[]"), int(place[2])), _CONNECT_TIMEOUT_S).close()
                last_contact = time.monotonic()
            self.is_lost = self.is_lost or time.monotonic() - last_contact > patience_s
            for future in list(self._futures) if self.is_lost else ():
                with suppress(InvalidStateError):  # it has just ended
                    future.set_exception(self._error())

    def _error(self) -> SettingsError:
        return SettingsError(
            f"The Ray cluster at {self._address} has lost its head node. The map keeps what it has. Start the "
            "cluster and run again."
        )


@contextmanager
def watched_head(ray: Any) -> Iterator[ClusterHead]:
    """The head of the cluster that this process is connected to."""
    head, ended = ClusterHead(ray.get_runtime_context().gcs_address), threading.Event()
    watch = threading.Thread(target=head.watch, args=(ended,), daemon=True)
    watch.start()
    try:
        yield head
    finally:
        ended.set()
        watch.join()


def _imported() -> Any:
    for name, value in _QUIET.items():  # before it is loaded, which is when it looks
        os.environ.setdefault(name, value)
    try:
        import ray
    except ImportError:
        raise SettingsError("--engine ray needs Ray. Install it: pip install ray") from None
    return ray


def _start(ray: Any, folder: Path, threads: int) -> None:
    """A cluster of this machine alone. Its files and those of its workers go with the folder."""
    before = dict(os.environ)
    os.environ.update({"TMPDIR": str(folder), **_ENVIRONMENT})
    tokens = "RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH"
    if not (any(map(os.environ.get, tokens)) or Path("~/.ray/auth_token").expanduser().is_file()):  # Ray makes none
        os.environ["RAY_AUTH_TOKEN"] = _TOKEN
    place = str(folder) if len(str(folder)) <= _LONGEST_PLACE else _OTHER_PLACE
    try:
        _connect(ray, "local", num_cpus=threads, num_gpus=0, include_dashboard=False, _temp_dir=place)
    finally:
        os.environ.clear()
        os.environ.update(before)


def _check_answers(address: str) -> None:
    """Raises SettingsError where no cluster answers: Ray would wait for minutes, and then end this process."""
    if address == "auto":
        return
    host, _, port = address.rpartition(":")
    if not host or not port.isdigit() or "//" in host:
        raise SettingsError(
            f"--address {address} is not a HOST:PORT of a Ray cluster. Give what `ray start --head` prints, or auto."
        )
    command = [sys.executable, "-m", "ray.scripts.scripts", "health-check", "--skip-version-check"]
    try:
        socket.create_connection((host, int(port)), _CONNECT_TIMEOUT_S).close()
        health = [*command, "--address", address]
        done = subprocess.run(health, capture_output=True, timeout=_ANSWER_TIMEOUT_S, check=False)  # noqa: S603
        if b"authentication token" in done.stderr.lower():
            raise SettingsError(
                f"The Ray cluster at {address} wants its token. Set RAY_AUTH_MODE=token, and RAY_AUTH_TOKEN to it, or "
                "have it in ~/.ray/auth_token or in the file of RAY_AUTH_TOKEN_PATH."
            )
        answers = done.returncode != 1
    except (OSError, OverflowError, subprocess.TimeoutExpired):
        answers = False
    if not answers:
        raise SettingsError(f"No Ray cluster answers at {address}. Start one: ray start --head --port {port}")


def _connect(ray: Any, address: str, **more: Any) -> None:
    ends = signal.getsignal(signal.SIGTERM)
    try:
        ray.init(address=address, log_to_driver=False, logging_level="ERROR", **more)
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # of many kinds, by what is wrong and by version; the end of this process is one
        what = "start a Ray cluster here" if address == "local" else f"join the Ray cluster at {address}"
        if getattr(error, "code", None) == signal.SIGTERM and callable(ends):
            ends(signal.SIGTERM, None)  # Ray's own handler was called in place of ours
        text = " ".join(str(error).split())[:400] or type(error).__name__
        raise SettingsError(f"Cannot {what}: {text}") from None
    finally:
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, ends)
