"""URLs as they are stored and shown: scheme, host and path, without what may be a secret.

Links that are signed for a while and tokens of any server are in the query, and which of its keys are harmless nobody
knows for all servers. So user, password and everything behind the path are cut.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import PurePath

_SCHEME = r"[a-z][a-z0-9+.-]*:/{1,3}"
"""A URL taken for a path has one slash."""
_PASSWORD = r"[^\s/?#\"<>@:[]+:(?!\d*(?:[/?#\s]|$))"  # noqa: S105 - a pattern
"""A user and the colon before a password: not a host and its port."""
_END = r"[?#]|(?:&amp;|[;&,!\uff1f\uff03]|%(?:25)*(?:3f|23|26|3b))[^\s/=?#;&]*?(?:=|%(?:25)*3d)"
"""Where the path ends: at a query or fragment, or at `key=` behind a separator, percent-encoded and full-width ones
included."""
_URL = re.compile(
    rf"""\b({_SCHEME})(?:[^\s/?#"<>]*(?:@|%(?:25)*40)|{_PASSWORD}[^\s"<>]*@|{_PASSWORD}[^"<>]*?@|[^/?#"<>]*@)?"""
    rf"""((?:(?!{_END})[^\s"<>])*)(?:(?:{_END})(?:[^\s"<>]|["<>](?=[^\s.,:;<>)\]}}]))*)?""",
    re.IGNORECASE,
)
"""In a sentence, where a quotation mark ends it but for one within the query."""


def shown(url: str) -> str:
    """One URL, whatever characters it has, without its secrets; a path as it is."""
    found = re.match(r"[a-z][a-z0-9+.-]+:/{1,3}", url, re.IGNORECASE)
    if not found:
        return url
    place = re.sub(rf"^(?:[^/?#]*(?:@|%(?:25)*40)|{_PASSWORD}.*@)", "", url[found.end() :], flags=re.DOTALL)
    return found[0] + re.split(_END, place, maxsplit=1, flags=re.IGNORECASE)[0]


def printable(text: str) -> str:
    """A text for one line of a terminal: line ends and control characters, as file names may hold, are escaped."""
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


def without_secrets(text: str, words: Iterable[str] = ()) -> str:
    """A sentence that may name URLs, without their secrets; those among `words`, which are a command's, may have blanks
    and any other character."""
    for word in words:
        if found := re.search(_SCHEME, word, re.IGNORECASE):
            url = word[found.start() :]
            for form in (url, repr(url)[1:-1], str(PurePath(url)), " ".join(url.split())):
                text = text.replace(form, shown(form))
    return _URL.sub(r"\1\2", text)
