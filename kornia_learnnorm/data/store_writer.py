"""Writing stores: at once, or pair by pair with the pairs on disk after a crash."""

import json
import os
import shutil
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kornia_learnnorm.data.store import FORMAT, LAYOUT, VERSION, CorrespondenceStore, read_store
from kornia_learnnorm.files import atomic_write, changed_options, check_writable, write_text
from kornia_learnnorm.optional import import_extra

OPTIONS = "options.json"  # file in the folder of the parts
DIGEST = "frames"  # option that is a hash, which messages do not quote
ROWS_PER_CHUNK = 2048  # correspondences in a chunk of HDF5
PAIRS_PER_CHUNK = 16  # pairs in a chunk of HDF5; few, since each part of an unfinished store is a file of one pair


def write_store(path: str | Path, store: CorrespondenceStore) -> None:
    """Write a store to an HDF5 file, completely or not at all, and replace an existing one; OSError if that fails."""
    join_stores(path, [store], store.provenance)


def join_stores(path: str | Path, stores: Iterable[CorrespondenceStore], provenance: dict[str, Any]) -> None:
    """Write the pairs of one or more stores, described as the first one is; one store is in memory at a time."""
    h5py = import_extra("h5py", "images", "writing stores")
    with atomic_write(path) as temporary:
        try:
            with h5py.File(temporary, "w") as file:
                for store in stores:
                    if "offsets" not in file:
                        _create(h5py, file, store)
                    _append(file["offsets"], store.offsets[1:] + file["offsets"][-1])
                    _append(file["names"], np.array(store.names, dtype=h5py.string_dtype()))
                    for name in LAYOUT:
                        _append(file[name], getattr(store, name))
                if "offsets" not in file:
                    raise ValueError(f"no pairs to write to {path}: one store or more expected, got none")
                file.attrs.update({"format": FORMAT, "version": VERSION, "provenance": json.dumps(provenance)})
        except (OSError, RuntimeError) as error:  # RuntimeError: a disk that fills while a file is closed
            number = getattr(error, "errno", None)
            raise OSError(f"cannot write {path}: {os.strerror(number) if number else error}") from error


def _create(h5py: Any, file: Any, store: CorrespondenceStore) -> None:
    file.attrs.update({key: getattr(store, key) for key in ("dataset", "pairs", "detector")})
    file.create_dataset("offsets", (1,), np.int64, maxshape=(None,), chunks=(128,))
    file.create_dataset("names", (0, 2), h5py.string_dtype(), maxshape=(None, 2), chunks=(64, 2))
    for name, (tail, dtype, axis) in LAYOUT.items():
        rows = ROWS_PER_CHUNK if axis == "M" else PAIRS_PER_CHUNK
        file.create_dataset(name, (0, *tail), dtype, maxshape=(None, *tail), chunks=(rows, *tail))


def _append(dataset: Any, rows: NDArray[Any]) -> None:
    if len(rows):
        dataset.resize(len(dataset) + len(rows), axis=0)
        dataset[-len(rows) :] = rows


def check_target(path: str | Path) -> Path:
    """Return the folder of a store's parts; FileNotFoundError or ValueError if no store can be written to the path."""
    check_writable(path)
    folder = Path(f"{Path(path)}.parts")
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"cannot write {path}: its parts are written to {folder}, which is not a folder")
    return folder


class StoreWriter:
    """Write the pairs of a store one by one, in any order.

    Each pair becomes a store of its own, a part, in the folder ``<path>.parts``, which a later run finds if this one is
    killed; :meth:`finish` joins the parts by their places. The ``options`` are all that the store depends on, values of
    JSON's types; parts, or a complete store, of other options or of another program are a ValueError.
    """

    def __init__(self, path: str | Path, options: dict[str, Any]) -> None:
        self.path = Path(path)
        self.folder = check_target(self.path)
        self.options: dict[str, Any] = json.loads(json.dumps(options))
        self.skipped: dict[str, str] = {}
        self.complete = self.path.exists()
        if self.complete:
            provenance = read_store(self.path).provenance
            _check_options(self.path, provenance.get("options"), self.options)
            self.skipped = dict(provenance.get("skipped", {}))
        elif self._parts():
            had = None
            with suppress(FileNotFoundError, ValueError):
                had = json.loads((self.folder / OPTIONS).read_text(encoding="utf-8"))
            _check_options(self.folder, had, self.options)
        else:
            try:
                self.folder.mkdir(exist_ok=True)
                write_text(self.folder / OPTIONS, json.dumps(self.options, indent=1))
            except OSError as error:
                self.close()
                raise type(error)(f"cannot write {self.path}: {error.strerror or error}") from error

    def done(self) -> set[int]:
        """Return the places of the pairs that were added, after removing unreadable parts (as a power cut leaves)."""
        for part in self._parts():
            try:
                read_store(part)
            except ValueError:
                part.unlink()
        return {int(part.stem) for part in self._parts()}

    def add(self, place: int, pair: CorrespondenceStore) -> None:
        """Write a store of one pair; ``place`` is its index in the finished store, with skipped pairs counted too."""
        if len(pair) != 1 or place < 0:
            raise ValueError(f"one pair and a place of 0 or more expected, got {len(pair)} pairs and place {place}")
        write_store(self.folder / f"{place:08d}.h5", pair)

    def finish(self, provenance: dict[str, Any]) -> None:
        """Write the store, with versions and skipped pairs as its provenance, and only then remove the parts."""
        join_stores(self.path, map(read_store, self._parts()), {**provenance, "options": self.options})
        shutil.rmtree(self.folder)

    def close(self) -> None:
        """Remove the folder of the parts if it holds no part, so that a run that failed early leaves no files."""
        if not self._parts():
            with suppress(OSError):  # the folder is gone, or holds files of others
                (self.folder / OPTIONS).unlink(missing_ok=True)
                self.folder.rmdir()

    def _parts(self) -> list[Path]:
        return sorted(self.folder.glob("[0-9]*.h5"))


def _check_options(path: Path, had: Any, options: dict[str, Any]) -> None:
    if not isinstance(had, dict):
        raise ValueError(f"{path} exists, but was not made by this command: remove it or write elsewhere")
    if differ := changed_options({**had, DIGEST: None}, {**options, DIGEST: None}):
        raise ValueError(f"{path} was made with other options, remove it or write elsewhere: {differ}")
    if had != options:
        changed = "the images, their cameras, their poses or the pairs have changed since"
        raise ValueError(f"{path} was made from other data, remove it or write elsewhere: {changed}")
