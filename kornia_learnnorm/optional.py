"""Optional packages, which come with the extras of this package, and modules of the user."""

import importlib
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any


def import_extra(module: str, extra: str, purpose: str) -> Any:
    """Return a module of a package that the core does not need; without it, say which extra brings it and for what."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        advice = f"run pip install 'kornia-learnnorm[{extra}]', in a checkout pip install '.[{extra}]'"
        raise ImportError(f"{purpose} needs {error.name or module}: {advice}") from error


@contextmanager
def working_folder_importable() -> Iterator[None]:
    """Look for modules in the working folder too, last, while the block runs."""
    before = [*sys.path]
    try:
        sys.path.append(str(Path.cwd()))
        yield
    finally:
        sys.path[:] = before
