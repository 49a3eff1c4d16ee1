"""What pages share: the template, figures inside the file, versions."""

from __future__ import annotations

import platform
import re
from base64 import b64encode
from collections.abc import Iterable, Iterator
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, NamedTuple

import evofsm
from evofsm.extras import needs

with needs("jinja2", "plot", "writing the page"):
    from jinja2 import Environment, PackageLoader, StrictUndefined

_PACKAGES = ("numpy", "numba", "matplotlib")


class Setting(NamedTuple):
    """A line of a page's list of settings."""

    name: str
    value: str


def write_html(page: Path, **values: Any) -> Path:
    """Fill the template in with values and the date; all of them are text, never markup."""
    environment = Environment(
        loader=PackageLoader("studies.old"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"minus": _with_minus_signs, "inline": _inline}
    text = environment.get_template("page.html.j2").render(
        date=datetime.now(UTC).date().isoformat(), version=evofsm.__version__, **values
    )
    page.parent.mkdir(parents=True, exist_ok=True)
    page.write_text(text, encoding="utf-8")
    return page


def _with_minus_signs(text: str) -> str:
    """Hyphens before numbers as minus signs; those within words stay."""
    return re.sub(r"(?<![\w.])-(?=[\d.])", "−", text)


def _inline(path: Path) -> str:
    """An SVG file as the address of an image that holds it."""
    return f"data:image/svg+xml;base64,{b64encode(path.read_bytes()).decode('ascii')}"


def versions(more: Iterable[str] = ()) -> Iterator[Setting]:
    """What the numbers were computed with: the usual packages, and more."""
    yield Setting("evofsm", evofsm.__version__)
    yield Setting("Python", platform.python_version())
    for name in (*_PACKAGES, *more):
        yield Setting("SUMO (libsumo)" if name == "libsumo" else name, _version_of(name))
    yield Setting("system", f"{platform.system()} on {platform.machine()}")


def _version_of(package: str) -> str:
    """A package may be on the path without having been installed by pip."""
    try:
        return version(package)
    except PackageNotFoundError:
        return "unknown"
