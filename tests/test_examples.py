"""The scripts in examples/, cut short: they run, and what they train gets better."""

from __future__ import annotations

import importlib
import os
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[1] / "examples"


def run(name: str, monkeypatch, *args: str) -> tuple[float, float]:
    monkeypatch.syspath_prepend(EXAMPLES)
    for module in ("pairs", name):
        monkeypatch.delitem(sys.modules, module, raising=False)
    try:
        return importlib.import_module(name).main(args)
    finally:
        sys.modules.pop("pairs", None)
        sys.modules.pop(name, None)


@pytest.mark.parametrize(
    ("name", "steps", "points", "gain"), [("predict_weights", 64, 128, 0.3), ("guided_sampling", 32, 128, 0.5)]
)
def test_learns_from_synthetic_pairs(name, steps, points, gain, monkeypatch, capsys):
    monkeypatch.delenv("LEARNNORM_DATA", raising=False)
    before, after = run(name, monkeypatch, "--steps", str(steps), "--points", str(points))
    assert after < gain * before
    printed = capsys.readouterr().out
    assert f"step {steps:4d}: loss " in printed
    assert f"{after:.3f} px" in printed


@pytest.mark.parametrize("name", ["predict_weights", "guided_sampling"])
def test_runs_on_real_pairs(name, monkeypatch):
    pytest.importorskip("h5py")
    if not os.environ.get("LEARNNORM_DATA"):
        pytest.skip("LEARNNORM_DATA does not name a folder of real correspondences")
    before, after = run(name, monkeypatch, "--steps", "2", "--points", "64", "--pairs", "2")
    assert 0 < before < 10
    assert 0 < after < 10
