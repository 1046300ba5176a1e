"""Learn where RANSAC should sample, by the loss that is expected of a softly chosen hypothesis.

A network gives each correspondence a logit; minimal samples are drawn with them, solved and scored. In the end RANSAC
draws with them too, a few samples without refinement, so that the sampling and the normalisation show.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from pair_data import Pairs, SetNetwork, load_pairs, parse

import kornia_learnnorm as kln
from kornia_learnnorm.metrics.inliers import f1_score
from kornia_learnnorm.ransac.soft import SoftChoice, expected_loss, sample_minimal_sets


def choose(pairs: Pairs, logits: torch.Tensor, generator: torch.Generator, count: int = 32) -> SoftChoice:
    """Draw hypotheses and return what is expected of the chosen one."""
    samples, log_probs = sample_minimal_sets(logits, count, generator)
    return expected_loss(
        pairs.points1, pairs.points2, samples, pairs.error, log_probs, kln.Whitening(), threshold=1.0, scale=0.3
    )


def ransac_f1(pairs: Pairs, logits: torch.Tensor, normalizer: torch.nn.Module) -> float:
    """Return the mean F1 at 1 px in percent of the best of 64 minimal samples that are drawn with the logits."""
    ransac = kln.RANSAC(normalizer, max_samples=64, confidence=1, refine=False, seed=0)
    rows = zip(pairs.points1, pairs.points2, (logits / 2).softmax(-1), strict=True)  # RANSAC squares them
    F_mat = torch.stack([ransac(*row)[0] for row in rows])
    return 100 * f1_score(pairs.points1, pairs.points2, F_mat, pairs.F_mat, threshold=1.0).nanmean().item()


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
        logits = network(held_out)
    print(f"held-out pairs, error of 32 samples: {before:.3f} px drawn uniformly, {after:.3f} px where learned")
    for normalizer in (kln.Hartley(), kln.Whitening(), kln.LearnedNormalizer.from_pretrained()):
        uniform, learned = (ransac_f1(held_out, values, normalizer) for values in (torch.zeros_like(logits), logits))
        name = type(normalizer).__name__
        print(f"RANSAC, 64 samples, {name}: F1 {uniform:.2f} % drawn uniformly, {learned:.2f} % where learned")
    return before, after


if __name__ == "__main__":
    main()
