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
    error = capsys.readouterr().err
    assert error.startswith("learnnorm fit: error: the environment variable LEARNNORM_DATA, named in ")
    assert error.count("\n") == 1


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A run of a few steps, and the options that it was made with."""
    folder = tmp_path_factory.mktemp("run")
    config = next(path for path in CONFIGS if path.stem == "crossview-synthetic")
    numbers = [f"--data.{stage}.init_args.number=100" for stage in ("train", "val", "test")]
    options = ["--config", str(config), *SMALL, *numbers, f"--trainer.default_root_dir={folder}"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sys.argv", ["learnnorm"])
        assert main(["fit", *options]) == 0
    return folder, options


@pytest.mark.parametrize("command", ["validate", "test", "predict"])
def test_a_checkpoint_is_needed(trained, command, capsys):
    assert main([command, *trained[1]]) == 2
    assert "give the checkpoint by --ckpt_path" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("file", "message"),
    [
        ("weights.safetensors", "is not a checkpoint of a training run"),
        ("text.ckpt", "is not a checkpoint of a training run"),
        ("none.ckpt", "no checkpoint at"),
    ],
)
@pytest.mark.parametrize("command", ["fit", "test"])
def test_wrong_checkpoints(trained, command, file, message, capsys):
    folder, options = trained
    (folder / "text.ckpt").write_text("not a checkpoint")
    assert main([command, *options, f"--ckpt_path={folder / file}"]) == 2
    assert message in capsys.readouterr().err


def test_checkpoint_of_another_network(trained, capsys):
    folder, options = trained
    other = "--model.normalizer.init_args.network.init_args.width=32"
    assert main(["test", *options, other, f"--ckpt_path={folder / 'checkpoints/last.ckpt'}"]) == 2
    assert "holds another network than the one configured" in capsys.readouterr().err


def test_interrupted(monkeypatch, capsys):
    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("kornia_learnnorm.evaluation.evaluate.run", interrupt)
    assert main(["evaluate", "store.h5"]) == 130
    assert capsys.readouterr().err == "interrupted\n"


def test_stores_and_weights_are_checked_first(tmp_path, capsys):
    write_store(tmp_path / "s.h5", synthetic_store(pairs=1, points=40))
    assert main(["evaluate", str(tmp_path / "s.h5"), str(tmp_path / "missing.h5")]) == 2
    assert main(["evaluate", str(tmp_path / "s.h5"), "--weights", str(tmp_path / "s.h5")]) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert "no store at" in printed.err
    assert "not a .safetensors file by its name" in printed.err


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
