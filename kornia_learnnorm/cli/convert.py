"""Convert stores of correspondences to and from the formats of others: ``learnnorm convert``."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import numpy as np

from kornia_learnnorm.data.formats.hloc import export_hloc, import_hloc
from kornia_learnnorm.data.formats.interchange import new_folder
from kornia_learnnorm.data.formats.kitti_flow import export_kitti_flow, import_kitti_flow
from kornia_learnnorm.data.formats.ngransac import export_ngransac, import_ngransac
from kornia_learnnorm.data.store import CorrespondenceStore, read_store, write_store

__all__ = ["add_arguments", "run"]

_FEATURES, _MATCHES = "features.h5", "matches.h5"


def _import_hloc(folder: Path) -> CorrespondenceStore:
    return import_hloc(folder / _FEATURES, folder / _MATCHES)


def _export_hloc(store: CorrespondenceStore, folder: Path) -> dict[str, int]:
    folder = new_folder(folder, _FEATURES)
    return export_hloc(store, folder / _FEATURES, folder / _MATCHES)


IMPORTS: dict[str, Callable[[Path], CorrespondenceStore]] = {
    "kitti-flow": import_kitti_flow,
    "ngransac": import_ngransac,
    "hloc": _import_hloc,
}
EXPORTS: dict[str, Callable[[CorrespondenceStore, Path], dict[str, int]]] = {
    "kitti-flow": export_kitti_flow,
    "ngransac": export_ngransac,
    "hloc": _export_hloc,
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``learnnorm convert`` to a parser."""
    parser.add_argument("source", metavar="SOURCE", help="folder to read with --from, store (.h5) with --to")
    parser.add_argument(
        "target", metavar="TARGET", type=Path, help="store (.h5) to write with --from, folder with --to"
    )
    direction = parser.add_mutually_exclusive_group(required=True)
    text = "format of the folder: %(choices)s; hloc's holds features.h5 and matches.h5"
    direction.add_argument("--from", dest="source_format", metavar="FORMAT", choices=list(IMPORTS), help=text)
    direction.add_argument("--to", dest="target_format", metavar="FORMAT", choices=list(EXPORTS), help=text)


def run(args: argparse.Namespace) -> int:
    """Run ``learnnorm convert``: write a store, or a folder in the format of others.

    Raises:
        FileNotFoundError: if the source is missing.
        ValueError: if it is not what it should be, or the target is there already or cannot hold it.
        OSError: if the target cannot be written.

    """
    print(f"wrote {args.target}: {_import(args) if args.source_format else _export(args)}")
    return 0


def _import(args: argparse.Namespace) -> str:
    if args.target.exists():
        raise ValueError(f"cannot write {args.target}: it is there already, remove it or write elsewhere")
    store = IMPORTS[args.source_format](Path(args.source))
    write_store(args.target, store)
    known = int(np.isfinite(store.F).all((1, 2)).sum())
    ratios = "" if store.ratio.any() else f"; there are no ratios in {args.source}: all are 0 and pass every ratio test"
    return f"{len(store)} pairs, {known} with ground truth, {len(store.ratio)} matches{ratios}"


def _export(args: argparse.Namespace) -> str:
    store = read_store(args.source)
    notes = EXPORTS[args.target_format](store, args.target)
    left = sum(count for what, count in notes.items() if what.startswith("matches"))
    why = "".join(f"; {what}: {count}" for what, count in notes.items())
    return f"{len(store)} pairs, {len(store.ratio) - left} matches, {left} left out{why}"
