"""Training on two processes gives what one gives; what is wrong with the samples of one stops none of them."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file
from train_processes import run

CASES = ["plain", "pairs", "filtered", "spoiled", "resumed"]
SCRIPT = Path(__file__).parents[1] / "train_processes.py"


def results(folder, rank=0):
    return json.loads((folder / f"results-{rank}.json").read_text())


def weights(folder, rank=0):
    return load_file(folder / f"weights-{rank}.safetensors")


def same(folder, other, rank=0):
    """The weights and results of two runs are the same up to rounding."""
    torch.testing.assert_close(weights(folder, rank), weights(other), rtol=0, atol=1e-9)
    expected, got = results(other), results(folder, rank)
    assert len(got) == len(expected) == 8
    for name in got.keys() - {"samples"}:
        assert got[name] == pytest.approx(expected[name], rel=1e-6, nan_ok=True), name


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    folder = tmp_path_factory.mktemp("alone")
    for case in ("plain", "pairs", "filtered"):
        run(case, 1, folder)
    with (
        pytest.warns(UserWarning, match="a step was skipped: no samples"),
        pytest.warns(UserWarning, match="a step was skipped: non-finite gradient"),
    ):
        run("spoiled", 1, folder)
    return folder


@pytest.mark.skipif(sys.platform == "win32", reason="the test starts its processes as on Unix")
def test_two_processes_give_what_one_gives(alone, tmp_path):
    """All cases in one test, since two processes take long to start."""
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--local-addr=127.0.0.1"]
    command += ["--nproc-per-node=2", str(SCRIPT), "2", str(tmp_path), *CASES]
    done = subprocess.run(command, env=os.environ | {"OMP_NUM_THREADS": "1"}, capture_output=True, timeout=220)
    assert done.returncode == 0, done.stderr.decode()
    for case in CASES[:-1]:
        samples = [results(tmp_path / case, rank)["samples"] for rank in (0, 1)]
        assert samples[0] != samples[1]
        assert [a + b for a, b in zip(*samples, strict=True)] == results(alone / case)["samples"]
        for rank in (0, 1):
            same(tmp_path / case, alone / case, rank)
        expected, got = (load_file(folder / case / "predictions.safetensors") for folder in (alone, tmp_path))
        assert torch.equal(got.pop("pair"), expected.pop("pair"))
        torch.testing.assert_close(got, expected, rtol=1e-6, atol=1e-7)
    # cut at the third of six steps, after the second checkpoint
    torch.testing.assert_close(weights(tmp_path / "resumed", 1), weights(tmp_path / "plain"), rtol=0, atol=0)
    assert results(tmp_path / "resumed")["train/loss"] == results(tmp_path / "plain")["train/loss"][2:]


def test_what_is_left_out_is_counted(alone):
    got = results(alone / "spoiled")
    assert got["train/left_out"] == [0, 7, 1, 15, 0, 0]  # of fifteen
    assert got["train/skipped"] == [0, 0, 0, 1, 1, 0]
    assert got["train/loss"][3] == 0
    assert got["val/left_out"] == 7 + 1 + 15
    assert results(alone / "filtered")["samples"] == [20, 20, 1, 1, 20, 20]  # every announced batch comes
    for folder in alone.iterdir():
        assert all(tensor.isfinite().all() for tensor in weights(folder).values())
