"""What the weights of a method were trained on."""

from __future__ import annotations

import importlib
import re
from pathlib import Path

from kornia_learnnorm.evaluation.methods import base_name
from kornia_learnnorm.evaluation.tables import names_of

__all__ = ["saw", "trained_on"]

SYNTHETIC = "synthetic scenes"
UNKNOWN = "not known"
KITTI = ["kitti_00", "kitti_01", "kitti_03"]
SHIPPED = {"paper": KITTI, "crossview": KITTI, "crossview-synthetic": [SYNTHETIC]}  # as the cards of the weights say


def trained_on(method: str) -> list[str]:
    """Return the stores that the weights of a method were trained on.

    For weights of one's own these are in the configuration that ``learnnorm fit`` leaves beside them.

    Args:
        method: as for :func:`~kornia_learnnorm.evaluation.methods.find_method`.

    Returns:
        names of stores, with their pairs where not all were used; one text where it is not stores or not known; nothing
        for methods without weights.

    Example:
        >>> trained_on("crossview+LM"), trained_on("Hartley")
        (['kitti_00', 'kitti_01', 'kitti_03'], [])

    """
    name = base_name(method)
    if name in SHIPPED:
        return SHIPPED[name]
    if Path(name).suffix != ".safetensors":
        return [UNKNOWN] if ":" in name else []
    configs = sorted(Path(name).parent.glob("lightning_logs/*/config.yaml"), key=lambda path: path.stat().st_mtime)
    return _stores_of(configs[-1]) if configs else [UNKNOWN]


def _stores_of(config: Path) -> list[str]:
    """Return the names of the training stores in a configuration of ``learnnorm fit``."""
    try:
        train = importlib.import_module("yaml").safe_load(config.read_text("utf-8"))["data"]["train"]
        paths, name = train.get("init_args", {}).get("paths"), str(train.get("class_path"))
    except ImportError as error:
        raise ImportError(f"reading {config} needs PyYAML: pip install 'kornia-learnnorm[train]'") from error
    except (KeyError, TypeError, AttributeError):
        return [UNKNOWN]
    if paths:
        return names_of(paths)
    return [SYNTHETIC if name.endswith("SyntheticSamples") else UNKNOWN]


def saw(trained: list[str], store: str) -> bool:
    """Return whether image pairs of a store were among those trained on, going by their names.

    Args:
        trained: what :func:`trained_on` returns.
        store: name of a store, with ``@first:stop`` for some of its pairs.

    Example:
        >>> saw(["tum@0:9"], "tum@10:19"), saw(["tum@0:9"], "tum")
        (False, True)

    """
    name, first, stop = _parse(store)
    return any(name == other and first < end and start < stop for other, start, end in map(_parse, trained))


def _parse(store: str) -> tuple[str, float, float]:
    match = re.fullmatch(r"(.+)@(\d+):(\d+)", store)
    return (match[1], float(match[2]), float(match[3])) if match else (store, 0.0, float("inf"))
