"""Predictions of methods on stores, computed once and kept in a folder: a run.

Its ``run.json`` says what it was computed from. Each store has a folder with the motion of its pairs and the protocols,
in each of which are the samples and a file per method: NumPy archives of arrays in the order of the samples. A file
that exists is read, to know that it is whole, and not computed again; a run of other options is refused. A method that
fails is left out of the run, all others go on.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch

from kornia_learnnorm.data.residual_filter import plain_residual
from kornia_learnnorm.data.sets import MatchSets
from kornia_learnnorm.data.store import CorrespondenceStore, read_store
from kornia_learnnorm.evaluation.methods import Method, base_name, find_method, identify_method, short_names
from kornia_learnnorm.evaluation.runs.example import random_pair, sweep
from kornia_learnnorm.evaluation.runs.pairs import pair_motions
from kornia_learnnorm.evaluation.runs.predict import SampleOptions, predict
from kornia_learnnorm.evaluation.runs.run import (
    EXAMPLE,
    PAIRS,
    SAMPLES,
    SWEEP,
    Run,
    is_swept,
    method_path,
    pairs_path,
    prediction_keys,
    read_run,
    samples_path,
    sweep_path,
)
from kornia_learnnorm.evaluation.runs.store import (
    Arrays,
    begin_section,
    leave_out,
    read_arrays,
    read_section,
    run_folder,
    write_arrays,
)
from kornia_learnnorm.optional import import_extra
from kornia_learnnorm.protocol import PROTOCOLS

__all__ = ["record_run", "temporary_run"]


def temporary_run(
    stores: Mapping[str, str],
    methods: Sequence[str],
    options: SampleOptions | None = None,
    protocols: Sequence[str] = tuple(PROTOCOLS),
) -> Run:
    """Return a run that is not kept, without shares of inliers and errors by the number of correspondences.

    Args:
        stores: paths of the stores by the names that tables give them.
        methods: names for :func:`~kornia_learnnorm.evaluation.methods.find_method`.
        options: how the samples are drawn.
        protocols: ``filtered``, ``unfiltered`` or both.

    Raises:
        ValueError: if a store or a method is wrong, or a method fails.
        OSError: if a file is missing.

    """
    with TemporaryDirectory(prefix="learnnorm-") as folder:
        record_run(folder, stores, methods, options, protocols, complete=False)
        return read_run(folder, complete=False)


def record_run(
    folder: str | Path,
    stores: Mapping[str, str],
    methods: Sequence[str],
    options: SampleOptions | None = None,
    protocols: Sequence[str] = tuple(PROTOCOLS),
    complete: bool = True,
    command: str = "",
) -> str:
    """Compute what a run does not have yet, with a progress bar.

    Args:
        folder: the run, made if missing.
        stores: paths of the stores by the names that tables give them.
        methods: names for :func:`~kornia_learnnorm.evaluation.methods.find_method`.
        options: how the samples are drawn.
        protocols: ``filtered``, ``unfiltered`` or both.
        complete: compute everything that a report shows: also the shares of inliers, F1 and, for one pair, the errors
            by the number of correspondences.
        command: the command line that asks for it, for the report.

    Returns:
        why there is no example of a pair; empty where there is one or none was wanted.

    Raises:
        ValueError: if the folder holds a run of other options, a store or a method is wrong, a file is damaged, or, at
            the end, if a method has failed.
        OSError: if a file is missing or cannot be written, or another process writes this run.

    """
    options = SampleOptions() if options is None else options
    folder, names = Path(folder), short_names(methods)
    found = {names[name]: find_method(name) for name in methods}
    recorder = _Recorder(folder, found, {name: read_store(path) for name, path in stores.items()}, options, complete)
    about = {
        **vars(options),
        "methods": {names[name]: identify_method(name) for name in methods},
        "trained_on": {name: list(method.trained_on) for name, method in found.items()},
    }
    with run_folder(folder):
        before = (read_section(folder, "evaluate") or {}).get("methods", {})
        begin_section(folder, "evaluate", recorder.stores, about, command=command)
        recorder.record_stores(protocols)
        no_example = recorder.record_sizes() if complete else ""
        recorder.forget(recorder.failed.keys() - before.keys())
    if failed := recorder.failed:
        # A normaliser of the user's own is named in its message already.
        texts = [text if text.startswith(base_name(name)) else f"{name}: {text}" for name, text in failed.items()]
        raise ValueError("; ".join(texts) + (f". All others are in {folder}" if complete else ""))
    return no_example


@dataclass
class _Recorder:
    """What computes the missing files of a run; ``failed`` says why methods failed, by name."""

    folder: Path
    methods: dict[str, Method]
    stores: dict[str, CorrespondenceStore]
    options: SampleOptions
    complete: bool
    failed: dict[str, str] = field(default_factory=dict)

    def record_stores(self, protocols: Sequence[str]) -> None:
        """Compute the missing motions, samples and predictions of all stores."""
        tqdm = import_extra("tqdm", "images", "the progress bar of an evaluation").tqdm
        steps, keys = len(self.stores) * len(protocols) * len(self.methods), prediction_keys(self.complete)
        with tqdm(total=steps, unit="step", disable=None) as bar:
            for name, store in self.stores.items():
                bar.set_postfix_str(name)
                _once(pairs_path(self.folder, name), partial(pair_motions, store), PAIRS, len(store))
                for protocol in protocols:
                    samples = self._samples(name, protocol)
                    for label, method in self.methods.items():
                        compute = partial(predict, method, samples, store, PROTOCOLS[protocol], self.complete)
                        path = method_path(self.folder, name, protocol, label)
                        self._attempt(label, path, compute, keys, len(samples.pair))
                        bar.update()

    def _samples(self, store: str, protocol: str) -> MatchSets:
        """Return the samples within the limit on the residual; write all that were drawn."""
        drawn, limit = self.options.draw(self.stores[store], PROTOCOLS[protocol]), self.options.max_residual

        def describe() -> Arrays:
            residual = plain_residual(drawn.points1, drawn.points2).numpy()
            if not (residual < limit).any():
                few = f"none of {len(residual)} samples has an un-normalised residual below {limit:g} px"
                raise ValueError(f"{store}, {protocol}: {few}")
            return {"pair": drawn.pair.numpy(), "plain_residual": residual}

        path = samples_path(self.folder, store, protocol)
        found = _once(path, describe, SAMPLES, len(drawn.pair))
        if not np.array_equal(found["pair"], drawn.pair.numpy()):
            raise ValueError(f"{path.parent} is of other samples than the run's seed draws of the store, remove it")
        return drawn.select(torch.from_numpy(found["plain_residual"] < limit))

    def record_sizes(self) -> str:
        """Compute the missing example and its errors by the number of correspondences, or return why there is none."""
        path = self.folder / "example.npz"
        if not path.is_file():
            try:
                write_arrays(path, random_pair(self.stores, self.options.seed))
            except ValueError as error:
                return str(error)
        example = read_arrays(path, EXAMPLE)
        for name, method in self.methods.items():
            if is_swept(name):
                compute = partial(sweep, method, example, self.options.seed)
                self._attempt(name, sweep_path(self.folder, name), compute, SWEEP)
        return ""

    def _attempt(
        self, name: str, path: Path, compute: Callable[[], Arrays], keys: Sequence[str], rows: int | None = None
    ) -> None:
        """Write a method's file unless it exists or the method has failed; note if it fails now."""
        if path.is_file():
            read_arrays(path, keys, rows)
        elif name not in self.failed:
            try:
                write_arrays(path, compute())
            except ValueError as error:
                self.failed[name] = str(error)

    def forget(self, methods: Collection[str]) -> None:
        """Remove methods from the run, with their files: their code will be another when they come again."""
        leave_out(self.folder, "evaluate", methods)
        for name in methods:
            cells = [method_path(self.folder, store, protocol, name) for store in self.stores for protocol in PROTOCOLS]
            for path in (*cells, sweep_path(self.folder, name)):
                path.unlink(missing_ok=True)


def _once(path: Path, compute: Callable[[], Arrays], keys: Sequence[str], rows: int | None = None) -> Arrays:
    """Return the arrays of a file, after computing and writing them if it does not exist."""
    if not path.is_file():
        write_arrays(path, compute())
    return read_arrays(path, keys, rows)
