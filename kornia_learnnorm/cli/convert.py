"""Convert stores of correspondences to and from the files of hloc: ``learnnorm convert``."""

from __future__ import annotations

import argparse
from pathlib import Path

from kornia_learnnorm.data.formats.hloc import export_hloc, import_hloc
from kornia_learnnorm.data.store import read_store
from kornia_learnnorm.data.writer import write_store

__all__ = ["EXAMPLES", "add_arguments", "run"]

EXAMPLES = """\
learnnorm convert FOLDER store.h5 --from hloc
learnnorm convert store.h5 FOLDER --to hloc"""

FEATURES = "features.h5"  # file of keypoints in the folder
MATCHES = "matches.h5"  # file of matches in the folder


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``learnnorm convert`` to a parser."""
    parser.add_argument("source", metavar="SOURCE", help="folder to read with --from, store (.h5) with --to")
    parser.add_argument(
        "target", metavar="TARGET", type=Path, help="store (.h5) to write with --from, folder with --to"
    )
    direction = parser.add_mutually_exclusive_group(required=True)
    text = f"format of the folder: hloc, with {FEATURES} and {MATCHES}"
    direction.add_argument("--from", dest="source_format", choices=["hloc"], help=text)
    direction.add_argument("--to", dest="target_format", choices=["hloc"], help=text)


def run(args: argparse.Namespace) -> int:
    """Write a store, or a folder of hloc's files; an existing file is not overwritten."""
    result = _import(Path(args.source), args.target) if args.source_format else _export(args.source, args.target)
    print(f"wrote {args.target}: {result}")
    return 0


def _import(folder: Path, path: Path) -> str:
    _refuse_existing(path)
    store = import_hloc(folder / FEATURES, folder / MATCHES)
    write_store(path, store)
    ratios = "" if store.ratio.any() else "; all ratios are 0, which passes every ratio test"
    return f"{len(store)} pairs without ground truth, {len(store.ratio)} matches{ratios}"


def _export(path: str, folder: Path) -> str:
    store = read_store(path)
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"cannot export to {folder}: it is a file, expected a folder")
    for name in (FEATURES, MATCHES):
        _refuse_existing(folder / name)
    folder.mkdir(parents=True, exist_ok=True)
    left_out = export_hloc(store, folder / FEATURES, folder / MATCHES)
    why = f"; matches of a keypoint that has a better one: {left_out}" if left_out else ""
    return f"{len(store)} pairs, {len(store.ratio) - left_out} matches, {left_out} left out{why}"


def _refuse_existing(path: Path) -> None:
    if path.exists():
        raise ValueError(f"cannot write {path}: it exists already, remove it or write elsewhere")
