"""The README as an index of packages shows it: there, links into the repository lead nowhere.

Where `pyproject.toml` names the repository's home (`project.urls.Source`), they lead to it; where
none is named, their words stand without them. Run by hatchling whenever it builds.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from hatchling.metadata.plugin.interface import MetadataHookInterface

# An image, or a link, to a file of the repository.
INSIDE = re.compile(r"(?P<image>!?)\[(?P<words>[^\]]*)\]\((?!https?:|#)(?P<path>[^)]+)\)")


def as_on_an_index(text: str, home: str | None) -> str:
    """README with links that hold elsewhere."""

    def elsewhere(found: re.Match[str]) -> str:
        if home is not None:
            kind = "raw" if found["image"] else "blob"
            return f"{found['image']}[{found['words']}]({home}/{kind}/HEAD/{found['path']})"
        return "" if found["image"] else found["words"]

    return re.sub(r"\n{3,}", "\n\n", INSIDE.sub(elsewhere, text))


class CustomMetadataHook(MetadataHookInterface):
    """What hatchling calls."""

    def update(self, metadata: dict[str, Any]) -> None:
        """Put the README into the metadata."""
        text = (Path(self.root) / "README.md").read_text("utf-8")
        home = metadata.get("urls", {}).get("Source")
        readme = as_on_an_index(text, home and home.rstrip("/"))
        metadata["readme"] = {"content-type": "text/markdown", "text": readme}
