"""URLs as they are stored and shown: without what may be a secret.

Links that are signed for a while (AWS Signature, Google's, Azure SAS) and tokens of any server are in the query, and
which of its keys are harmless nobody knows for all servers. So user, password, query and fragment are cut: what is left
tells which file it is, and who needs to open it again is given the URL again.
"""

from __future__ import annotations

import re

_USER = r"""\b([a-z][a-z0-9+.-]*:/{1,3})(?:[^\s/?#"<>]*@|[^\s/?#"<>@:[]+:(?!\d*[/?#])[^\s"<>]*@)?"""
"""Scheme; user and password, which may have any character but blanks. A URL taken for a path has one slash."""
_QUERY = r"[?#]|;[\w.-]+="
"""Where a query, a fragment or the parameters of a path (`;jsessionid=`) begin."""
_URL = re.compile(
    rf"""{_USER}((?:(?!{_QUERY})[^\s"<>])*)(?:(?:{_QUERY})(?:[^\s"<>]|["<>](?=[^\s.,:;<>)\]}}]))*)?""", re.IGNORECASE
)
"""In a sentence, where a quotation mark ends it but for one within the query."""


def shown(url: str) -> str:
    """One URL, whatever characters it has, without its secrets; a path as it is."""
    if not re.match(r"[a-z][a-z0-9+.-]+:/", url, re.IGNORECASE):
        return url
    return re.split(_QUERY, re.sub(_USER, r"\1", url, count=1, flags=re.IGNORECASE), maxsplit=1)[0]


def without_secrets(text: str) -> str:
    """A sentence that may name URLs, without their secrets."""
    return _URL.sub(r"\1\2", text)
