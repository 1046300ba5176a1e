"""``run.json``: what a run of predictions is of."""

from __future__ import annotations

import importlib.metadata
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from kornia_learnnorm.files import atomic_write

__all__ = ["begin_run", "leave_out", "read_about", "read_object"]

FORMAT = 2  # of what a run keeps; others are refused
JOINED = ("stores", "methods", "trained_on")
PACKAGES = ("kornia_learnnorm", "torch", "kornia")

About = dict[str, Any]


def read_about(folder: Path) -> About:
    """Return what a run is of.

    Args:
        folder: the run.

    Returns:
        ``stores`` and ``methods``, what each is by its name; ``trained_on``, names by method; ``seed``,
        ``max_samples``, ``versions`` by package, and ``format``.

    Raises:
        FileNotFoundError: if the folder has no run.
        ValueError: if another version of the package made it, or the file is damaged.

    """
    path = folder / "run.json"
    if not path.is_file():
        raise FileNotFoundError(f"no run at {folder}: learnnorm evaluate STORE --out {folder} makes one")
    about = read_object(path)
    if about.get("format") != FORMAT:
        raise ValueError(
            f"{folder} is a run of format {about.get('format')}, expected {FORMAT}: another version of the package made"
            " it, learnnorm evaluate STORE --out ELSEWHERE makes it anew"
        )
    wrong = [key for key in (*JOINED, "versions") if not isinstance(about.get(key), dict)]
    wrong += [key for key in ("seed", "max_samples") if key not in about]
    if wrong or about["methods"].keys() != about["trained_on"].keys():
        raise ValueError(f"{path} is damaged: {', '.join(wrong or ['methods and trained_on'])} not as they should be")
    return about


def read_object(path: Path) -> About:
    """Return the object of a JSON file.

    Args:
        path: the file.

    Raises:
        ValueError: if the file is damaged.

    """
    try:
        about = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{path} is damaged, it is not JSON: {error}") from error
    if not isinstance(about, dict):
        raise ValueError(f"{path} is damaged: expected an object of JSON, got {type(about).__name__}")
    return about


def begin_run(folder: Path, joined: dict[str, dict[str, Any]], seed: int, max_samples: int | None) -> list[str]:
    """Write what a run is of, or refuse a folder of another one; further stores and methods may join it.

    Args:
        folder: the run, made if missing.
        joined: what each store and method is, and what the methods were trained on.
        seed: seed of the shuffles.
        max_samples: at most so many samples of each store and protocol; None for all.

    Returns:
        the methods that were not there before.

    Raises:
        ValueError: if the folder holds a run of other options.
        OSError: if it cannot be written.

    """
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"{folder} is a file: expected a folder for the run, or a new name")
    versions = {name: importlib.metadata.version(name) for name in PACKAGES}
    about: About = {"format": FORMAT, **joined, "seed": seed, "max_samples": max_samples, "versions": versions}
    new = list(joined["methods"])
    if (folder / "run.json").is_file():
        had = read_about(folder)
        new = [name for name in new if name not in had["methods"]]
        differ = [
            f"{key} {had[key]!r}, now {about[key]!r}" for key in ("seed", "max_samples") if had[key] != about[key]
        ]
        for key in (*JOINED, "versions"):
            differ += [
                f"{name} {old!r}, now {about[key][name]!r}"
                for name, old in had[key].items()
                if about[key].get(name, old) != old
            ]
            about[key] = {**had[key], **about[key]}
        if differ:
            raise ValueError(f"{folder} is a run of other options, remove it or write elsewhere: {'; '.join(differ)}")
    folder.mkdir(parents=True, exist_ok=True)
    _write(folder, about)
    return new


def leave_out(folder: Path, methods: Sequence[str]) -> None:
    """Take methods out of what a run is of; their files are the caller's.

    Args:
        folder: the run.
        methods: their names.

    """
    about = read_about(folder)
    for key in ("methods", "trained_on"):
        about[key] = {name: value for name, value in about[key].items() if name not in methods}
    _write(folder, about)


def _write(folder: Path, about: About) -> None:
    with atomic_write(folder / "run.json") as beside:
        beside.write_text(json.dumps(about, indent=1), encoding="utf-8")
