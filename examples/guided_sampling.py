"""Learn where RANSAC should sample, by the loss that is expected of a softly chosen hypothesis.

A network gives each correspondence a logit; minimal samples are drawn with them, solved and scored.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from pairs import Pairs, SetNetwork, load_pairs, parse

import kornia_learnnorm as kln
from kornia_learnnorm.soft import SoftChoice, expected_loss, sample_minimal_sets


def choose(pairs: Pairs, logits: torch.Tensor, generator: torch.Generator, count: int = 32) -> SoftChoice:
    """Draw hypotheses and return what is expected of the chosen one."""
    samples, log_probs = sample_minimal_sets(logits, count, generator)
    return expected_loss(
        pairs.points1, pairs.points2, samples, pairs.error, log_probs, kln.Whitening(), threshold=1.0, scale=0.3
    )


def main(args: Sequence[str] | None = None) -> tuple[float, float]:
    """Train, and return the expected held-out error in pixels before and after."""
    options = parse(__doc__, args, steps=200)
    torch.manual_seed(0)
    training, held_out = load_pairs()
    generator, network = torch.Generator().manual_seed(0), SetNetwork()
    optimizer = torch.optim.Adam(network.parameters(), 2e-3)
    with torch.no_grad():
        before = choose(held_out, network(held_out), torch.Generator().manual_seed(1)).loss.mean().item()
    for step in range(1, options.steps + 1):
        batch = training.draw(options.pairs, options.points, generator)
        loss = choose(batch, network(batch), generator).loss.mean()
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
        if step == 1 or step % max(1, options.steps // 8) == 0:
            print(f"step {step:4d}: loss {loss.item():.3f} px")
    with torch.no_grad():
        after = choose(held_out, network(held_out), torch.Generator().manual_seed(1)).loss.mean().item()
    print(f"held-out pairs, error of 32 samples: {before:.3f} px drawn uniformly, {after:.3f} px where learned")
    return before, after


if __name__ == "__main__":
    main()
