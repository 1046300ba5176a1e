"""Predictions of methods on stores, computed once and kept in a folder: what ``learnnorm evaluate`` makes.

Each store has a folder with, for each protocol, the samples and a file per method.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from torch import Tensor

from kornia_learnnorm.data.sets import MatchSets, plain_residual
from kornia_learnnorm.data.store import CorrespondenceStore, read_store
from kornia_learnnorm.evaluation.methods import Method, find_method, identify_method, short_names
from kornia_learnnorm.evaluation.runs import results_store
from kornia_learnnorm.evaluation.runs.predict import AGREEMENT, ERRORS, SampleOptions, predict
from kornia_learnnorm.evaluation.runs.results_store import About, Job, Stores, file_name, read_arrays
from kornia_learnnorm.protocol import PROTOCOLS

SAMPLES = ("pair", "plain_residual")  # arrays in the file of samples
KEYS = (ERRORS, (*ERRORS, *AGREEMENT))  # arrays in the file of a method's predictions, without and with agreement


@dataclass(frozen=True)
class RunCell:
    """The predictions of all methods on the samples of one store and protocol."""

    store: str  # its name
    protocol: str  # filtered or unfiltered
    pair: Tensor  # image pair of each sample, (S,) int64
    drawn: int  # number of samples before the filter on the un-normalised residual
    predictions: dict[str, dict[str, Tensor]]  # arrays (S, ...) by method and quantity, float64

    @property
    def title(self) -> str:
        """Store and protocol."""
        return f"{self.store}, {self.protocol}"


@dataclass(frozen=True)
class Run:
    """A run of predictions."""

    about: About  # what the run was computed from, its section of run.json
    cells: list[RunCell]
    missing: list[str] = field(default_factory=list)  # what has not been computed yet


def temporary_run(stores: Mapping[str, str], methods: Sequence[str], options: SampleOptions | None = None) -> Run:
    """Return a run that is not kept, without shares of inliers."""
    with TemporaryDirectory(prefix="learnnorm-") as folder:
        record_run(folder, stores, methods, options, complete=False)
        return read_run(folder, complete=False)


def record_run(
    folder: str | Path,
    stores: Mapping[str, str],
    methods: Sequence[str],
    options: SampleOptions | None = None,
    complete: bool = True,
    command: str = "",
) -> None:
    """Compute what a run does not have yet.

    ``stores`` are paths by the names that tables give them, ``methods`` names for ``find_method``. A run that
    is ``complete`` has all that a report shows: also the shares of inliers and F1. ``command`` is the command line that
    asks for it, for the report.

    A ValueError tells that the folder holds a run of other options, a store or a method is wrong, a file is damaged,
    or, at the end, that a method has failed; an OSError that a file is missing or cannot be written, or that another
    process writes this run.
    """
    options = SampleOptions() if options is None else options
    folder, names = Path(folder), short_names(methods)
    found = {names[name]: find_method(name) for name in methods}
    read = {name: read_store(path) for name, path in stores.items()}
    about = {
        **vars(options),
        "methods": {names[name]: identify_method(name) for name in methods},
        "trained_on": {name: list(method.trained_on) for name, method in found.items()},
    }
    with results_store.run_folder(folder):
        before = results_store.begin_section(folder, "evaluate", read, about, command=command)
        jobs = _jobs(folder, read, found, options, complete)
        total = len(read) * len(PROTOCOLS) * len(found)
        failed = results_store.record(folder, "evaluate", jobs, total, before.get("methods", ()))
    if failed:
        raise ValueError(failed + (f". All others are in {folder}" if complete else ""))


def _jobs(
    folder: Path, stores: Stores, methods: Mapping[str, Method], options: SampleOptions, complete: bool
) -> Iterator[Job]:
    """Make the files of the stores' samples, and give those of the methods to make."""
    keys = KEYS[complete]
    for name, store in stores.items():
        for protocol, max_ratio in PROTOCOLS.items():
            place = f"{name}, {protocol}"
            samples = _samples(_path(folder, name, protocol, "samples"), place, options, store, max_ratio)
            for label, method in methods.items():
                compute = partial(predict, method, samples, store, max_ratio, complete)
                yield Job(label, _path(folder, name, protocol, label), compute, keys, len(samples.pair))


def _path(folder: Path, *names: str) -> Path:
    """Return a file of a run."""
    *parents, last = map(file_name, names)
    return folder.joinpath(*parents, f"{last}.npz")


def _samples(
    path: Path, place: str, options: SampleOptions, store: CorrespondenceStore, max_ratio: float | None
) -> MatchSets:
    """Return the samples within the limit on the residual; write all that were drawn."""
    drawn, limit = options.draw(store, max_ratio), options.max_residual
    if not path.is_file():
        residual = plain_residual(drawn.points1, drawn.points2).numpy()
        if not (residual < limit).any():
            few = f"none of {len(residual)} samples has an un-normalised residual below {limit:g} px"
            raise ValueError(f"{place}: {few}")
        results_store.write_arrays(path, {"pair": drawn.pair.numpy(), "plain_residual": residual})
    found = read_arrays(path, SAMPLES, len(drawn.pair))
    if not np.array_equal(found["pair"], drawn.pair.numpy()):
        raise ValueError(f"{path.parent} is of other samples than the run's seed draws of the store, remove it")
    return drawn.select(torch.from_numpy(found["plain_residual"] < limit))


def read_run(folder: str | Path, complete: bool = True) -> Run:
    """Read what there is of a run; raise FileNotFoundError for a folder without one, ValueError if it is damaged."""
    folder = Path(folder)
    about, missing = results_store.read_section(folder, "evaluate"), list[str]()
    if about is None:
        raise FileNotFoundError(f"no run at {folder}: learnnorm evaluate STORE --out {folder} makes one")
    cells = []
    for store in about["stores"]:
        for protocol in PROTOCOLS:
            absent = ["all methods"]
            if _path(folder, store, protocol, "samples").is_file():
                cells.append(_read_cell(folder, about, store, protocol, complete))
                absent = [name for name in about["methods"] if name not in cells[-1].predictions]
            missing += [f"{name} on {store}, {protocol}" for name in absent]
    return Run(about, cells, missing)


def _read_cell(folder: Path, about: dict[str, Any], store: str, protocol: str, complete: bool) -> RunCell:
    samples = read_arrays(_path(folder, store, protocol, "samples"), SAMPLES)
    kept = torch.from_numpy(samples["plain_residual"] < about["max_residual"])
    pair = torch.from_numpy(samples["pair"])[kept]
    paths = {name: _path(folder, store, protocol, name) for name in about["methods"]}
    predictions = {
        name: {key: torch.from_numpy(value) for key, value in read_arrays(path, KEYS[complete], len(pair)).items()}
        for name, path in paths.items()
        if path.is_file()
    }
    return RunCell(store, protocol, pair, len(kept), predictions)
