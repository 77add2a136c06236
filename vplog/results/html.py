"""HTML pages from the Jinja templates beside this module: every value is escaped, style and script are inline."""

from __future__ import annotations

import base64
import hashlib
import json
import math
from functools import cache, partial
from importlib.resources import files
from typing import TYPE_CHECKING, Any

from vplog.storage.image_file import image_size

if TYPE_CHECKING:
    from jinja2 import Environment
    from markupsafe import Markup


def render(template: str, **values: Any) -> str:
    """The page that a template of `templates/` gives for these values."""
    return _environment().get_template(template).render(values)


@cache
def _environment() -> Environment:
    from jinja2 import ChainableUndefined, Environment, PackageLoader  # only a verb that writes a page pays for it

    environment = Environment(
        loader=PackageLoader("vplog.results"),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        undefined=ChainableUndefined,  # a run.json of another version may lack any field
    )
    indented = partial(json.dumps, indent=1, ensure_ascii=False)
    environment.filters |= {"inline": _inline, "hashed": _hashed}
    environment.filters |= {"figure": figure, "data_url": data_url, "mapping": mapping, "indented": indented}
    environment.filters["image_size"] = image_size
    environment.policies["json.dumps_kwargs"] = {"separators": (",", ":"), "allow_nan": False}
    return environment


@cache
def _inline(name: str) -> Markup:
    """A style or script of ours as it stands between its tags."""
    from markupsafe import Markup  # of Jinja

    return Markup(files("vplog.results").joinpath("templates", name).read_text(encoding="utf-8"))  # noqa: S704


def _hashed(name: str) -> str:
    """The source expression by which a Content-Security-Policy allows this inline text, and no other."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(_inline(name).encode()).digest()).decode()}'"


def figure(value: Any, digits: int = 1) -> str:
    """A number for reading, with thin spaces in long ones; `-` where it is not known."""
    if not isinstance(value, int | float) or not math.isfinite(value):
        return "-"
    return f"{value:,.{0 if isinstance(value, int) else digits}f}".replace(",", "\u202f")


def data_url(data: bytes) -> str:
    """A JPEG as an address that holds it."""
    return f"data:image/jpeg;base64,{base64.b64encode(data).decode()}"


def mapping(value: Any) -> dict[str, Any]:
    """The value where it is an object of JSON, else an empty one."""
    return value if isinstance(value, dict) else {}
