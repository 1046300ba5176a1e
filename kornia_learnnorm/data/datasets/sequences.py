"""The sequences of KITTI and TUM that are on disk, and those of a split."""

from collections.abc import Sequence
from pathlib import Path

from kornia_learnnorm.protocol import SPLITS

MARKER = "rgb.txt"  # file that makes a folder a sequence of TUM


def split_sequences(dataset: str, split: str, root: str | Path) -> list[str]:
    """Return the names of the sequences of a split of :data:`SPLITS` that are on disk."""
    splits = SPLITS[dataset]
    if split not in splits:
        raise ValueError(f"a split of {dataset} must be one of {', '.join(splits)}, got {split!r}")
    found = sequence_folders(dataset, root)
    wanted, taken = splits[split], [name for names in splits.values() for name in names or ()]
    chosen = [name for name in found if (name not in taken if wanted is None else name in wanted)]
    if not chosen:
        expected = f"others than {', '.join(taken)}" if wanted is None else ", ".join(wanted)
        got = ", ".join(found) or "none"
        raise FileNotFoundError(f"no {split} sequence of {dataset} at {root}: expected {expected}, got {got}")
    return chosen


def sequence_folders(dataset: str, root: str | Path) -> dict[str, Path]:
    """Return the folders of a dataset's sequences by name, sorted; ``root`` may also be one sequence of TUM."""
    root = Path(root)
    if dataset == "kitti":
        parent = root / "sequences"
        if not parent.is_dir():
            raise FileNotFoundError(f"no folder {parent}, expected the sequences of KITTI in it")
        return {folder.name: folder for folder in sorted(parent.iterdir()) if folder.is_dir()}
    folders = [root] if (root / MARKER).exists() else sorted(root.iterdir())
    if not (found := {folder.resolve().name: folder for folder in folders if (folder / MARKER).exists()}):
        raise FileNotFoundError(f"no {MARKER} in {root}, nor in a folder in it")
    return found


def choose_sequences(dataset: str, root: str | Path, sequences: Sequence[str] | None) -> dict[str, Path]:
    """Return the folders of some sequences by name, in the order given; None for all."""
    if isinstance(sequences, str):
        raise TypeError(f"sequences must be a list of names, got the string {sequences!r}")
    found = sequence_folders(dataset, root)
    names = list(found if sequences is None else sequences)
    if not names or len(set(names)) < len(names):
        raise ValueError(f"sequences must be one name or more, each once, got {names}")
    if unknown := [name for name in names if name not in found]:
        raise ValueError(f"no sequence {unknown[0]!r} at {root}, there are {', '.join(found)}")
    return {name: found[name] for name in names}
