"""Predictions of methods on stores, computed once and kept: ``learnnorm evaluate STORE ... --out RUN``.

A run is a folder. ``run.json`` says what it is of. Each store has a folder with its pairs and the protocols, in each of
which are the samples and a file per method: NumPy archives of arrays in the order of the samples. What is there
already is read, to know that it is whole, and not computed again; a run of other options is refused. A method that
fails is left out of the run, all others go on.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from kornia_learnnorm.data.samples import RATIO
from kornia_learnnorm.data.store import CorrespondenceStore, read_store
from kornia_learnnorm.evaluation.methods import Method, base_name, find_method, identify_method, short_names
from kornia_learnnorm.evaluation.runs.example import random_pair, sweep
from kornia_learnnorm.evaluation.runs.manifest import begin_run, leave_out
from kornia_learnnorm.evaluation.runs.motion import pair_motions
from kornia_learnnorm.evaluation.runs.predict import describe, draw, predict
from kornia_learnnorm.evaluation.runs.run import (
    EXAMPLE,
    PAIRS,
    PREDICTIONS,
    SAMPLES,
    SWEEP,
    file_name,
    is_swept,
    method_files,
    read_arrays,
    within_limit,
)
from kornia_learnnorm.evaluation.runs.trained import trained_on
from kornia_learnnorm.files import atomic_write

__all__ = ["PROTOCOLS", "record_run"]

PROTOCOLS: dict[str, float | None] = {"filtered": RATIO, "unfiltered": None}

Arrays = dict[str, NDArray[Any]]
Methods = dict[str, Method]
Failed = dict[str, str]


def record_run(
    folder: str | Path, stores: Mapping[str, str], methods: list[str], seed: int = 0, max_samples: int | None = None
) -> str:
    """Compute what is not there yet of a run, with a progress bar.

    Args:
        folder: the run, made if missing.
        stores: paths of the stores by the names that tables give them.
        methods: names for :func:`~kornia_learnnorm.evaluation.methods.find_method`.
        seed: seed of the shuffles.
        max_samples: at most so many samples of each store and protocol, drawn at random; None for all.

    Returns:
        why there is no example of a pair; empty where there is one.

    Raises:
        ValueError: if the folder holds a run of other options, a store or a method is wrong, what is there is damaged,
            or, at the end, if a method has failed.
        OSError: if a file is missing or cannot be written.

    """
    folder, names = Path(folder), short_names(methods)
    found = {names[name]: find_method(name) for name in methods}
    read = {name: read_store(path) for name, path in stores.items()}
    joined: dict[str, dict[str, Any]] = {
        "stores": {name: f"{s.dataset}, {len(s)} pairs, {s.offsets[-1]} matches" for name, s in read.items()},
        "methods": {names[name]: identify_method(name) for name in methods},
        "trained_on": {names[name]: trained_on(name) for name in methods},
    }
    new, failed = begin_run(folder, joined, seed, max_samples), Failed()
    with tqdm(total=len(read) * (2 * len(found) + 2), unit="step", disable=None) as bar:
        for name, store in read.items():
            bar.set_postfix_str(name)
            _record_store(folder / name, store, found, failed, seed, max_samples, bar)
    about_example = _record_sizes(folder, read, found, failed, seed)
    if failed:
        _forget(folder, read, [name for name in failed if name in new])
        # Own code says its name, since it fails elsewhere too.
        texts = [text if text.startswith(base_name(name)) else f"{name}: {text}" for name, text in failed.items()]
        raise ValueError(f"{'; '.join(texts)}. All others are in {folder}")
    return about_example


def _record_store(
    folder: Path,
    store: CorrespondenceStore,
    methods: Methods,
    failed: Failed,
    seed: int,
    max_samples: int | None,
    bar: tqdm,
) -> None:
    """Compute what is not there yet of a store's pairs, samples and predictions."""
    _once(folder / "pairs.npz", partial(pair_motions, store), PAIRS, len(store))
    for protocol, ratio in PROTOCOLS.items():
        place = folder / protocol
        drawn = draw(store, ratio, seed, max_samples)
        _once(place / "samples.npz", partial(describe, drawn, place), SAMPLES, len(drawn.pair))
        if not np.array_equal(read_arrays(place / "samples.npz")["pair"], drawn.pair.numpy()):
            raise ValueError(f"{place} is of other samples than the run's seed draws of the store, remove it")
        samples = drawn.select(within_limit(place))
        bar.update()
        for name, method in methods.items():
            path, compute = place / f"{file_name(name)}.npz", partial(predict, method, samples, store, ratio)
            _attempt(name, failed, path, compute, PREDICTIONS, len(samples.pair))
            bar.update()


def _record_sizes(
    folder: Path, stores: Mapping[str, CorrespondenceStore], methods: Methods, failed: Failed, seed: int
) -> str:
    """Compute what is not there yet of the example and its errors, or return why there is no example."""
    path = folder / "example.npz"
    if not path.is_file():
        try:
            example = random_pair(stores, seed)
        except ValueError as error:
            return str(error)
        _write(path, example)
    example = read_arrays(path, EXAMPLE)
    for name, method in methods.items():
        if is_swept(name):
            compute = partial(sweep, method, example, seed)
            _attempt(name, failed, folder / "sizes" / f"{file_name(name)}.npz", compute, SWEEP)
    return ""


def _once(path: Path, compute: Callable[[], Arrays], keys: Sequence[str], rows: int | None = None) -> None:
    """Write the arrays that ``compute`` returns, unless the file is there: then see that it holds such arrays."""
    if path.is_file():
        read_arrays(path, keys, rows)
    else:
        _write(path, compute())


def _attempt(
    name: str, failed: Failed, path: Path, compute: Callable[[], Arrays], keys: Sequence[str], rows: int | None = None
) -> None:
    """Do the same for a method that has not failed, and note if it does."""
    if path.is_file():
        read_arrays(path, keys, rows)
    elif name not in failed:
        try:
            arrays = compute()
        except ValueError as error:
            failed[name] = str(error)
        else:
            _write(path, arrays)


def _write(path: Path, arrays: dict[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as beside:
        np.savez_compressed(beside, **arrays)


def _forget(folder: Path, stores: Iterable[str], methods: list[str]) -> None:
    """Take methods out of a run, with their files: they will not be the same when they come again."""
    leave_out(folder, methods)
    for name in methods:
        for path in method_files(folder, stores, name):
            path.unlink(missing_ok=True)
