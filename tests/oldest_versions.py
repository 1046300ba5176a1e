"""Print the requirements of the core, except torch, at the lower bounds of pyproject.toml."""

import tomllib
from pathlib import Path


def oldest(requirements):
    """Requirements such as ``numpy>=1.26`` as pins of the oldest version, without torch, which make installs itself."""
    return [requirement.replace(">=", "==") for requirement in requirements if not requirement.startswith("torch>=")]


if __name__ == "__main__":
    project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    print("\n".join(oldest(project["dependencies"])))
