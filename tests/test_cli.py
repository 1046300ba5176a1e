"""The command line, on files that the tests write."""

from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

import kornia_learnnorm as kln
from kornia_learnnorm.data.store import write_store
from kornia_learnnorm.data.synthesize import synthetic_store
from lightning_modules.cli import main

CONFIGS = sorted((Path(__file__).parent.parent / "configs").glob("*.yaml"))
SMALL = ["--trainer.max_steps=3", "--trainer.enable_progress_bar=false", "--data.batch_size=16"]


@pytest.fixture(autouse=True)
def program(monkeypatch):
    """LightningCLI warns about arguments from Python while pytest's own are on the command line."""
    monkeypatch.setattr("sys.argv", ["learnnorm"])


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """A folder like LEARNNORM_DATA's, with small synthetic stores under the names that the configs use."""
    folder = tmp_path_factory.mktemp("data")
    (folder / "correspondences").mkdir()
    for seed, name in enumerate(("kitti_00", "kitti_01", "kitti_03", "kitti_06")):
        write_store(folder / f"correspondences/{name}.h5", synthetic_store(pairs=2, points=120, seed=seed))
    return folder


@pytest.mark.parametrize("config", CONFIGS, ids=lambda path: path.stem)
def test_every_config_runs(config, data, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("LEARNNORM_DATA", str(data))
    small = [*SMALL, f"--trainer.default_root_dir={tmp_path}"]
    if "synthetic" in config.stem:
        small += ["--data.train.init_args.number=200", "--data.test.init_args.number=50"]
    small += ["--data.val.init_args.number=50"]
    assert main(["fit", "--config", str(config), *small]) == 0
    normalizer = kln.LearnedNormalizer.from_pretrained(tmp_path / "weights.safetensors")
    T1, _ = normalizer(torch.rand(1, 8, 2), torch.rand(1, 8, 2))
    assert torch.isfinite(T1).all()
    checkpoint = f"--ckpt_path={tmp_path / 'checkpoints/last.ckpt'}"
    for command in ("validate", "test", "predict"):
        assert main([command, "--config", str(config), *small, checkpoint]) == 0
    assert "better_than_hartley" in capsys.readouterr().out
    assert set(load_file(tmp_path / "predictions.safetensors")) == {"F_mat", "T1", "T2", "pair", "residual"}


def test_unset_variable(tmp_path, monkeypatch, capsys):
    monkeypatch.delenv("LEARNNORM_DATA", raising=False)
    config = next(path for path in CONFIGS if path.stem == "crossview")
    code = main(["fit", "--config", str(config), *SMALL, f"--trainer.default_root_dir={tmp_path}"])
    assert code == 2
    assert "environment variable LEARNNORM_DATA" in capsys.readouterr().err


def test_synthesize_evaluate_estimate(tmp_path, capsys):
    assert main(["synthesize", str(tmp_path), "--pairs", "2", "--points", "80"]) == 0
    assert main(["evaluate", str(tmp_path / "synthetic.h5"), "--weights", "crossview"]) == 0
    out = capsys.readouterr().out
    for row in ("none", "Hartley", "whitening", "reweighted whitening", "learned: crossview"):
        assert f"| {row}" in out
    assert "matches with ratio below 0.8" in out
    assert "unfiltered matches" in out
    pair = [str(tmp_path / "image1.png"), str(tmp_path / "image2.png")]
    assert main(["estimate", *pair, "--out", str(tmp_path / "pair.png"), "--json", str(tmp_path / "F.json")]) == 0
    assert (tmp_path / "pair.png").stat().st_size > 10_000
    assert "inliers" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["evaluate", "none.h5"], "no store at none.h5"),
        (["evaluate", __file__], "not a readable HDF5 file"),
        (["estimate", "none1.png", "none2.png"], "none1.png"),
        (["synthesize", "folder", "--pairs", "0"], "0"),
    ],
)
def test_errors_are_one_line_and_exit_code_2(arguments, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"learnnorm {arguments[0]}: error: ")
    assert error.count("\n") == 1
    assert message in error
    assert list(tmp_path.iterdir()) == []


def test_unknown_weights(tmp_path, capsys):
    write_store(tmp_path / "s.h5", synthetic_store(pairs=1, points=40))
    assert main(["evaluate", str(tmp_path / "s.h5"), "--weights", "nothing"]) == 2
    assert "no weights 'nothing'" in capsys.readouterr().err


@pytest.mark.parametrize("arguments", [[], ["unknown"], ["evaluate"], ["fit", "--nonsense"]])
def test_bad_usage_exits_with_2(arguments, capsys):
    with pytest.raises(SystemExit) as caught:
        main(arguments)
    assert caught.value.code == 2
    assert "usage" in capsys.readouterr().err.lower()
