"""Learn weights of correspondences through the weighted eight-point algorithm.

A network gives each correspondence a weight, the estimator is a layer, and the loss is the error of its result.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from pair_data import Pairs, SetNetwork, load_pairs, parse

import kornia_learnnorm as kln


def estimate(pairs: Pairs, network: SetNetwork, layer: kln.EightPoint) -> torch.Tensor:
    """Return fundamental matrices (P, 3, 3)."""
    return layer(pairs.points1, pairs.points2, network(pairs).softmax(-1))


def main(args: Sequence[str] | None = None) -> tuple[float, float]:
    """Train, and return the held-out error in pixels before and after."""
    options = parse(__doc__, args, steps=400)
    torch.manual_seed(0)
    training, held_out = load_pairs()
    generator, network, layer = torch.Generator().manual_seed(0), SetNetwork(), kln.EightPoint(kln.Whitening())
    optimizer = torch.optim.Adam(network.parameters(), 2e-3)
    with torch.no_grad():
        before = held_out.error(estimate(held_out, network, layer)).median().item()
    for step in range(1, options.steps + 1):
        batch = training.draw(options.pairs, options.points, generator)
        loss = batch.error(estimate(batch, network, layer), bound=100.0).mean()
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
        if step == 1 or step % max(1, options.steps // 8) == 0:
            print(f"step {step:4d}: loss {loss.item():.3f} px")
    with torch.no_grad():
        after = held_out.error(estimate(held_out, network, layer)).median().item()
    print(f"held-out pairs, median error: {before:.3f} px with equal weights, {after:.3f} px with learned ones")
    return before, after


if __name__ == "__main__":
    main()
