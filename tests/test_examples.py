"""The scripts in examples/, cut short: they run, what they train gets better."""

from __future__ import annotations

import importlib
from pathlib import Path

import pytest
import torch
from kornia.feature import DISK, LightGlue

import kornia_learnnorm as kln

EXAMPLES = Path(__file__).parents[1] / "examples"


@pytest.fixture
def example(monkeypatch):
    """Import an example as when it is run: its folder is on the path."""
    monkeypatch.syspath_prepend(EXAMPLES)
    return importlib.import_module


@pytest.fixture
def synthetic(monkeypatch):
    monkeypatch.delenv("LEARNNORM_DATA", raising=False)


@pytest.mark.parametrize(
    ("name", "steps", "points", "gain"), [("predict_weights", 64, 128, 0.3), ("guided_sampling", 32, 128, 0.5)]
)
def test_learns_from_synthetic_pairs(name, steps, points, gain, example, synthetic):
    before, after = example(name).main(["--steps", str(steps), "--points", str(points)])
    assert after < gain * before


def test_runs_on_real_pairs(example, real_data):
    before, after = example("predict_weights").main(["--steps", "2", "--points", "64", "--pairs", "2"])
    assert 0 < min(before, after) <= max(before, after) < 10


def test_kornia_ransac_example(example, synthetic):
    results = example("kornia_ransac").main(["--samples", "100", "--pairs", "2"])
    assert len(results) == 7
    assert all(f1 > 50 and error < 3 for f1, error in results.values())


def test_lightglue_learns_through_the_layer_and_the_learned_one_needs_no_scores(example, synthetic):
    before, after = example("match_and_estimate").main(["--steps", "25"])
    assert after < 0.9 * before
    before, _ = example("match_and_estimate").main(["--layer", "learned", "--steps", "1"])
    assert before < 1


def test_images_are_matched_with_gradients(example, tmp_path):
    cv2 = pytest.importorskip("cv2")
    module = example("match_and_estimate")
    torch.manual_seed(0)
    images = tmp_path / "image1.png", tmp_path / "image2.png"
    for path in images:
        cv2.imwrite(str(path), torch.randint(256, (64, 80), dtype=torch.uint8).numpy())
    lightglue = LightGlue(None, input_dim=128, n_layers=1, flash=False, **module.EVERY_MATCH)
    distance, norm = module.match_images(DISK().eval(), lightglue, kln.EightPoint(), images)
    assert distance > 0
    assert norm > 0


def test_one_line_changes_nothing_but_the_solver(example):
    errors = example("one_line").main(["--scenes", "300"])
    kornia, same, whitening, learned = errors.values()
    assert same == pytest.approx(kornia, rel=1e-3)
    assert learned < whitening < kornia
