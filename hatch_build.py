"""Hook of the build: the README in the metadata, its links absolute once `[project.urls]` has the Repository.

An index of packages shows the README without the files beside it.
"""

import re
from pathlib import Path
from typing import Any

from hatchling.metadata.plugin.interface import MetadataHookInterface

RELATIVE = re.compile(r"(?<=\]\()(?![a-z]+:|#)([^)\s]+)|(?<=src=\")(?![a-z]+:)([^\"]+)")  # [text](TARGET), src="TARGET"
PICTURES = (".jpg", ".png", ".svg")


def absolute(readme: str, repository: str) -> str:
    """Return a README whose links lead to the files of a repository on GitHub, and whose pictures are read there."""

    def target(link: re.Match[str]) -> str:
        path = link[1] or link[2]
        return f"{repository}/{'raw' if path.endswith(PICTURES) else 'blob'}/main/{path}"

    return RELATIVE.sub(target, readme)


class Readme(MetadataHookInterface):
    """Gives the metadata the README."""

    def update(self, metadata: dict[str, Any]) -> None:
        """Add it; `metadata` is the table `[project]`."""
        text = Path(self.root, "README.md").read_text(encoding="utf-8")
        if repository := metadata.get("urls", {}).get("Repository"):
            text = absolute(text, repository.rstrip("/"))
        metadata["readme"] = {"content-type": "text/markdown", "text": text}
