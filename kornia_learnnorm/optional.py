"""Optional packages, which come with the extras of this package, and modules of the user."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

__all__ = ["import_extra", "working_folder_importable"]


def import_extra(module: str, extra: str, purpose: str) -> Any:
    """Import a module of a package that the core does not need.

    Args:
        module: name of the module.
        extra: the extra of this package that installs it.
        purpose: what needs it, the start of the message.

    Returns:
        the module.

    Raises:
        ImportError: if it is not installed; the message names the extra and how to install it.

    Example:
        >>> import_extra("no_such_module", "images", "reading images")
        Traceback (most recent call last):
        ImportError: reading images needs no_such_module: run pip install '.[images]' in a checkout of kornia_learnnorm

    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ImportError(
            f"{purpose} needs {module}: run pip install '.[{extra}]' in a checkout of kornia_learnnorm"
        ) from error


@contextmanager
def working_folder_importable() -> Iterator[None]:
    """Look for modules in the working folder too, last, while the block runs."""
    before = [*sys.path]
    try:
        sys.path.append(str(Path.cwd()))
        yield
    finally:
        sys.path[:] = before
