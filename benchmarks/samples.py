"""How fast samples stream from a store that is larger than the memory they take: samples a second, beside the trainer.

    python benchmarks/samples.py STORE.h5 [--pairs 20000]

Repeats the pairs of the store into a large one in a temporary folder, draws filtered samples with 16 held-out points,
as configs/crossview.yaml does, and takes steps of a network of width 64 and depth 4 on some of them. Prints the memory
that the process took.
"""

from __future__ import annotations

import argparse
import itertools
import resource
import tempfile
import time
from pathlib import Path

import torch

from kornia_learnnorm import CrossViewNetwork, EightPoint, EpipolarLoss, LearnedNormalizer, Whitening
from kornia_learnnorm.data.sources import StoreSamples
from kornia_learnnorm.data.store import read_store
from kornia_learnnorm.data.writer import join_stores
from lightning_modules.datamodule import BatchLoader
from lightning_modules.task import EstimatorTask

BATCH = 1024
STEPS = 30


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("store")
    parser.add_argument("--pairs", type=int, default=20_000)
    parser.add_argument("--workers", type=int, default=0)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        large = Path(folder) / "large.h5"
        store = read_store(args.store)
        join_stores(large, itertools.repeat(store, -(-args.pairs // len(store))), {})
        print(f"store: {-(-args.pairs // len(store)) * len(store)} pairs, {large.stat().st_size / 1e6:.0f} MB")
        del store
        start = time.perf_counter()
        source = StoreSamples([str(large)], [0.8, None], num_heldout=16)
        loader = BatchLoader(source, BATCH, seed=0, shuffle=True, workers=args.workers)
        print(f"opened and counted in {time.perf_counter() - start:.1f} s: {len(loader)} batches an epoch")
        start, drawn = time.perf_counter(), 0
        for batch in itertools.islice(loader, len(loader) // 8):
            drawn += len(batch.pair)
        stream = drawn / (time.perf_counter() - start)
        print(f"streamed {stream:.0f} samples/s")
        network = CrossViewNetwork(width=64, depth=4)
        layer = EightPoint(LearnedNormalizer(Whitening(), network))
        task = EstimatorTask(layer, loss=EpipolarLoss(heldout_weight=0.5))
        start = time.perf_counter()
        for _ in range(STEPS):
            torch.autograd.grad(task.compute_loss(batch), [*network.parameters()])
        train = STEPS * len(batch.pair) / (time.perf_counter() - start)
        print(f"trained {train:.0f} samples/s: streaming is {stream / train:.1f} times as fast")
        print(f"peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3:.0f} MB")


if __name__ == "__main__":
    main()
