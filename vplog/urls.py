"""URLs as they are stored and shown: without what may be a secret.

Links that are signed for a while (AWS Signature, Google's, Azure SAS) and tokens of any server are in the query, and
which of its keys are harmless nobody knows for all servers. So user, password, query and fragment are cut: what is left
tells which file it is, and who needs to open it again is given the URL again.
"""

from __future__ import annotations

import re

_URL = re.compile(r"""\b([a-z][a-z0-9+.-]*:/{1,3})([^\s/?#"<>]*@)?([^\s?#"<>]*)([?#][^\s"<>]*)?""", re.IGNORECASE)
"""Scheme, user and password, host and path, query and fragment. A URL that was taken for a path has one slash."""


def shown(url: str) -> str:
    """One URL, whatever characters it has, without its secrets; a path as it is."""
    return without_secrets(re.split("[?#]", url, maxsplit=1)[0]) if "://" in url else url


def without_secrets(text: str) -> str:
    """A sentence that may name URLs, without their secrets."""
    return _URL.sub(lambda found: found[1] + found[3], text)
