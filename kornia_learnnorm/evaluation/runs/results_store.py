"""The results of a run, kept in a folder: NumPy archives, each computed once, and ``run.json``.

The latter says what the run was computed from, in a section for ``evaluate`` and one for ``robust``.
"""

import importlib.metadata
import json
import re
import zipfile
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import datetime
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kornia_learnnorm.data.store import CorrespondenceStore
from kornia_learnnorm.files import atomic_write, changed_options, exclusive, explained, write_text
from kornia_learnnorm.optional import import_extra

FORMAT = 4  # of the folder; runs of another format are refused
# Parts of a section that may grow: what each is, by its name. Those between stores and versions are of its methods.
JOINED = {"evaluate": ("stores", "methods", "trained_on", "versions"), "robust": ("stores", "estimators", "versions")}
# Parts that must stay as they are.
OPTIONS = {
    "evaluate": ("size", "seed", "max_samples", "max_residual"),
    "robust": ("pairs", "seeds", "slow_seeds", "seed", "threads"),
}
# Where the files of methods are.
PLACES = {"evaluate": "*/*", "robust": "robust/*/*/*"}
MAX_NAME = 80  # letters of a name in that of a file

About = dict[str, Any]
Arrays = dict[str, NDArray[Any]]
Names = Sequence[str]
Paths = Mapping[str, str]  # of stores, by their names in tables
Stores = Mapping[str, CorrespondenceStore]  # by their names in tables
Job = tuple[str, Path, Callable[[], Arrays]]  # a method, the file that it makes, and how


def record(
    folder: Path, section: str, stores: Stores, about: About, jobs: Iterable[Job], total: int, redo: Names, command: str
) -> str:
    """Do the jobs, at most ``total``, whose files are missing, or refuse a folder of other options.

    ``about`` has the options and, by the names in ``JOINED``, what each method or estimator is, None for one whose
    package is not installed. Stores and methods may join; results and descriptions of ``redo`` are replaced. Returns
    why methods failed, empty if none has; they leave the run unless it had them before.
    """
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"{folder} is a file: expected a folder for the run, or a new name")
    folder.mkdir(parents=True, exist_ok=True)
    tqdm = import_extra("tqdm", "images", "the progress bar of an evaluation").tqdm
    failed: dict[str, str] = {}
    with exclusive(folder):
        before, about = _begin(folder, section, stores, about, redo, command)
        _forget(folder, section, redo)
        with tqdm(jobs, total=total, unit="file", disable=None) as bar:
            for method, path, compute in bar:
                bar.set_postfix_str(f"{method}: {path.parent.relative_to(folder)}")
                if not path.is_file() and method not in failed:
                    try:
                        write_arrays(path, compute())
                    except ValueError as error:
                        failed[method] = str(error)
        forgotten = failed.keys() - (before.get(JOINED[section][1], {}).keys() - {*redo})
        for key in JOINED[section][1:-1]:
            about[key] = {name: value for name, value in about[key].items() if name not in forgotten}
        _write(folder, section, about)
        _forget(folder, section, forgotten)
    # A normaliser of the user's own is named in its message already.
    named = {text if text.startswith(name.partition("+")[0]) else f"{name}: {text}" for name, text in failed.items()}
    return "; ".join(sorted(named))


def _forget(folder: Path, section: str, names: Iterable[str]) -> None:
    for name in names:
        for path in folder.glob(f"{PLACES[section]}/{file_name(name)}.npz"):
            path.unlink()


def read_section(folder: Path, section: str) -> About | None:
    """Return what a section, ``evaluate`` or ``robust``, says of a run; None if it has none."""
    about = _read(folder).get(section)
    if about is None:
        return None
    if not isinstance(about, dict):
        raise ValueError(f"{folder / 'run.json'} is damaged: {section} must be an object, got {about!r}")
    about.setdefault("commands", {})  # runs of older versions have none
    wrong = [key for key in (*JOINED[section], "commands") if not isinstance(about.get(key), dict)]
    wrong += [key for key in OPTIONS[section] if key not in about]
    if wrong:
        raise ValueError(f"{folder / 'run.json'} is damaged: {', '.join(wrong)} missing or not an object")
    return about


def _begin(folder: Path, section: str, stores: Stores, about: About, redo: Names, command: str) -> tuple[About, About]:
    """Write what a run is computed from, or refuse a folder of other options; return the section before and now."""
    about = about | {
        "stores": {
            name: f"{store.dataset or 'no description'}, {len(store)} pairs, {store.offsets[-1]} matches"
            for name, store in stores.items()
        },
        "versions": {name: importlib.metadata.version(name) for name in ("kornia_learnnorm", "torch", "kornia")},
    }
    before = read_section(folder, section) or {}
    joined, had = JOINED[section], before or about
    parts = [tuple({key: part[key] for key in OPTIONS[section]} for part in (had, about))]
    for key in joined:  # a package that is or was not installed is no change
        both = [n for n in about[key] if n not in redo and None not in (had[key].get(n), about[key][n])]
        parts.append(tuple({name: part[key][name] for name in both} for part in (had, about)))
    if differ := "; ".join(filter(None, (changed_options(*part) for part in parts))):
        raise ValueError(f"{folder} is a run of other options, remove it or write elsewhere: {differ}")
    dates = {command: datetime.now().astimezone().date().isoformat()} if command else {}
    about["commands"] = {**had.get("commands", {}), **dates}
    for key in joined:  # what is not installed now stays as it was
        about[key] = had[key] | {name: v for name, v in about[key].items() if v is not None or name not in had[key]}
    _write(folder, section, about)
    return before, about


def _read(folder: Path) -> dict[str, Any]:
    path = folder / "run.json"
    if not path.is_file():
        return {}
    with explained(f"{path} is damaged, it is not JSON", ValueError):
        found = json.loads(path.read_text(encoding="utf-8"))
    sections: dict[str, Any] = found if isinstance(found, dict) else {}
    if (number := sections.pop("format", None)) != FORMAT:
        advice = "another version of the package made it, remove it or give another folder to --out"
        raise ValueError(f"{folder} is a run of format {number}, expected {FORMAT}: {advice}")
    return sections


def _write(folder: Path, section: str, about: About) -> None:
    write_text(folder / "run.json", json.dumps({"format": FORMAT, **_read(folder), section: about}, indent=1))


def file_name(name: str) -> str:
    """Return the name of the file or folder of a store or method; one with odd letters gets a part of its hash."""
    safe = re.sub(r"[^A-Za-z0-9+_.-]", "_", name)[:MAX_NAME].strip(".")
    return safe if safe and safe == name else f"{safe}-{sha256(name.encode()).hexdigest()[:8]}"


def array_path(folder: Path, *names: str) -> Path:
    """Return the file of arrays that belongs to a store, its protocol and a method, by their names in tables."""
    *parents, last = map(file_name, names)
    return folder.joinpath(*parents, f"{last}.npz")


def write_arrays(path: Path, arrays: Mapping[str, Any]) -> None:
    """Write arrays to a compressed ``.npz`` file, whole or not at all; make its folder if missing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as temporary:
        np.savez_compressed(temporary, **arrays)


def read_arrays(path: Path, keys: Sequence[str] = (), rows: int | None = None) -> dict[str, Tensor]:
    """Return the arrays of a file; raise ValueError if it is damaged, lacks ``keys`` or these have not ``rows``."""
    errors = OSError, ValueError, EOFError, KeyError, TypeError, zipfile.BadZipFile, zlib.error
    with explained(f"{path} is damaged, remove it", *errors), path.open("rb") as file, np.load(file) as data:
        found = {key: torch.from_numpy(value) for key, value in data.items()}
    if lacks := [key for key in keys if key not in found]:
        raise ValueError(f"{path} is damaged, remove it: expected arrays {', '.join(lacks)}, got {', '.join(found)}")
    for key in keys:
        if rows is not None and found[key].shape[:1] != (rows,):
            got = f"{key} has shape {tuple(found[key].shape)}"
            raise ValueError(f"{path} is of other samples, remove it: expected {rows} rows, {got}")
    return found
