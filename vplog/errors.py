"""The error tree. Every message says what happened, where, and what to do next; only cli.py prints and exits."""


class VplogError(Exception):
    """A known failure that a user can act on: one line, no traceback."""


class LogError(VplogError):
    """A log cannot be read, or holds nothing usable."""


class SettingsError(VplogError):
    """A pipeline file, a setting or an option does not fit."""


class LibraryError(VplogError):
    """A reference library is missing, damaged, or made with other settings."""


class GraphError(VplogError):
    """A pose graph cannot be built or solved as asked."""


class TruthError(VplogError):
    """Ground truth is missing, unreadable, or does not cover the drive."""


class ResultError(VplogError):
    """A run folder cannot be written or read back."""


class NewerError(ResultError):
    """A file was written by a newer vplog in a way that this one does not read."""


def was_interrupted(error: BaseException | None) -> bool:
    """Whether Ctrl-C is behind an error: compiled code and imports that it stops raise others in its place."""
    seen: set[int] = set()
    while error is not None and id(error) not in seen:
        if isinstance(error, KeyboardInterrupt):
            return True
        seen.add(id(error))
        error = error.__cause__ or error.__context__
    return False
