"""What importing the core loads, and what it offers."""

from __future__ import annotations

import importlib
import subprocess
import sys

import pytest

import kornia_learnnorm

HEAVY = ["pytorch_lightning", "lightning", "cv2", "h5py", "matplotlib", "jsonargparse", "torchmetrics", "rich"]
CORE = [
    "correspondences",
    "epipolar_cost",
    "estimators",
    "files",
    "learned",
    "linear",
    "losses",
    "matches",
    "metrics",
    "networks",
    "normalizers",
    "objectives",
    "optimal_rank2",
    "pair_metrics",
    "pose_accuracy",
    "pose_metrics",
    "rank2_manifold",
    "ransac",
    "refine",
    "residuals",
    "reweighting",
    "sampling",
    "scoring",
    "soft",
    "solver",
    "transforms",
]


def loaded_after(statement: str) -> list[str]:
    """Names of the heavy packages that a fresh interpreter holds after the statement."""
    code = f"{statement}\nimport sys\nprint(*[name for name in {HEAVY} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return done.stdout.split()


def test_importing_the_core_loads_nothing_heavy():
    modules = ", ".join(f"kornia_learnnorm.{name}" for name in CORE)
    assert loaded_after(f"import kornia_learnnorm, {modules}") == []


def test_the_check_can_fail():
    pytest.importorskip("h5py")
    assert "h5py" in loaded_after("import h5py")


def test_everything_offered_exists():
    assert sorted(kornia_learnnorm.__all__) == sorted(set(kornia_learnnorm.__all__))
    for name in kornia_learnnorm.__all__:
        assert getattr(kornia_learnnorm, name).__doc__
    assert kornia_learnnorm.__version__


@pytest.mark.parametrize("name", CORE)
def test_modules_offer_what_they_say(name):
    module = importlib.import_module(f"kornia_learnnorm.{name}")
    assert module.__doc__
    for offered in module.__all__:
        assert getattr(module, offered).__doc__
        assert getattr(module, offered).__module__ == module.__name__
