"""Writing a store pair by pair: what was added survives a crash."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

from kornia_learnnorm.data.store import CorrespondenceStore, join_stores, read_store, write_store
from kornia_learnnorm.files import atomic_write

__all__ = ["StoreWriter", "check_target"]

OPTIONS = "options.json"  # in the folder of the parts
DIGEST = "frames"  # the option that no reader can make sense of


def check_target(path: str | Path) -> None:
    """Refuse a path where no store can be written, without touching anything.

    Args:
        path: the store to write.

    Raises:
        FileNotFoundError: if its folder does not exist.
        ValueError: if something else is there than a file, or where its parts have to wait, than a folder.

    """
    path, folder = Path(path), _folder(path)
    if not path.parent.is_dir():
        raise FileNotFoundError(f"cannot write {path}: the folder {path.parent} does not exist")
    if path.exists() and not path.is_file():
        raise ValueError(f"cannot write {path}: it is not a regular file")
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"cannot write {path}: its parts wait in {folder}, which is not a folder")


class StoreWriter:
    """Collect the pairs of a store in any order.

    Each pair waits as a store of its own in the folder ``<path>.parts``. A run that was killed finds there what it had,
    and what it was: other options are refused. :meth:`finish` joins the parts in their order and removes the folder.

    Args:
        path: the store to write, an HDF5 file.
        options: what the store depends on, of JSON's types; a part that other options made must not mix with these.
            ``frames`` is a digest: a message does not quote it.

    Attributes:
        path: the store to write.
        folder: where the parts wait.
        complete: the store is there already, made with the same options.
        skipped: the pairs that a complete store leaves out, and why; empty while it is not complete.

    Raises:
        FileNotFoundError: if the folder of the store does not exist.
        OSError: if it cannot be written.
        ValueError: if the store, or parts of it, are there but were made with other options or by other means, or
            cannot be read.
    """

    def __init__(self, path: str | Path, options: dict[str, Any]) -> None:
        self.path = Path(path)
        self.folder = _folder(self.path)
        self.options: dict[str, Any] = json.loads(json.dumps(options))
        self.skipped: dict[str, str] = {}
        check_target(self.path)
        self.complete = self.path.exists()
        if self.complete:
            self._check_complete()
        elif any(self._parts()):
            _refuse(self.folder, _read_options(self.folder / OPTIONS), self.options)
        else:
            self._begin()

    def _check_complete(self) -> None:
        provenance = read_store(self.path).provenance
        _refuse(self.path, provenance.get("options"), self.options)
        self.skipped = dict(provenance.get("skipped", {}))

    def _begin(self) -> None:
        try:
            self.folder.mkdir(exist_ok=True)
            with atomic_write(self.folder / OPTIONS) as beside:
                beside.write_text(json.dumps(self.options, indent=1), encoding="utf-8")
        except OSError as error:
            self.close()
            raise type(error)(f"cannot write {self.path}: {error.strerror or error}") from error

    def done(self) -> set[int]:
        """Return the places of the pairs that are there; parts that a power cut made unreadable are removed."""
        for part in self._parts():
            try:
                read_store(part)
            except ValueError:
                part.unlink()
        return {int(part.stem) for part in self._parts()}

    def add(self, place: int, pair: CorrespondenceStore) -> None:
        """Write a pair.

        Args:
            place: its place among the pairs of the store, from 0.
            pair: a store of one pair.

        Raises:
            ValueError: if it is not one pair, or the place is negative.
            OSError: if it cannot be written, as on a full disk.

        """
        if len(pair) != 1 or place < 0:
            raise ValueError(f"one pair and a place from 0 on are expected, got {len(pair)} pairs and place {place}")
        write_store(self.folder / f"{place:08d}.h5", pair)

    def finish(self, provenance: dict[str, Any]) -> None:
        """Write the store and remove the parts.

        Args:
            provenance: what made the store, of JSON's types; the options are added to it.

        Raises:
            ValueError: if no pair was added, or a part is no longer readable.
            OSError: if the store cannot be written; the parts stay.

        """
        join_stores(self.path, map(read_store, self._parts()), {**provenance, "options": self.options})
        shutil.rmtree(self.folder)

    def close(self) -> None:
        """Remove the folder of the parts if there is none in it, so that a run that failed early leaves nothing."""
        if not any(self._parts()):
            with suppress(OSError):  # it is gone, or holds what others put there
                (self.folder / OPTIONS).unlink(missing_ok=True)
                self.folder.rmdir()

    def _parts(self) -> Iterator[Path]:
        return iter(sorted(self.folder.glob("[0-9]*.h5")))


def _folder(path: Path) -> Path:
    return path.with_name(path.name + ".parts")


def _read_options(path: Path) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (FileNotFoundError, ValueError):
        return None


def _refuse(path: Path, had: Any, options: dict[str, Any]) -> None:
    if not isinstance(had, dict):
        raise ValueError(f"{path} is there, but not made by this command: remove it or write elsewhere")
    other = [key for key in {**had, **options} if had.get(key) != options.get(key)]
    differ = ", ".join(f"{key} was {had.get(key)!r} and is {options.get(key)!r}" for key in other if key != DIGEST)
    if differ:
        raise ValueError(f"{path} was made with other options, remove it or write elsewhere: {differ}")
    if other:
        changed = "the images, their cameras or poses, or the pairs have changed since"
        raise ValueError(f"{path} was made from other data, remove it or write elsewhere: {changed}")
