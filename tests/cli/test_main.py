"""The command line, on files that the tests write."""

import contextlib
import errno
import io
import json
import os
import re
import shlex
import signal
import socket
import subprocess
import sys
from pathlib import Path
from unittest.mock import Mock

import pytest
import torch
import train_processes
import yaml
from safetensors.torch import load_file

import kornia_learnnorm as kln
from kornia_learnnorm.cli import synthesize
from kornia_learnnorm.cli.main import TOOLS, TRAINING, main, make_parser
from kornia_learnnorm.data.store import read_store
from kornia_learnnorm.data.store_writer import write_store
from kornia_learnnorm.data.synthetic.render import render_pair
from kornia_learnnorm.data.synthetic.scenes import synthetic_store
from lightning_modules.config_files import find_config

pytestmark = pytest.mark.usefixtures("program")

FOLDER = Path(__file__).parents[2] / "configs"
OF_SETS = ("crossview-sets", "refiner", *(path.stem for path in sorted(FOLDER.glob("robust*.yaml"))))
SMALL = ["--trainer.max_steps=3", "--trainer.enable_progress_bar=false", "--data.batch_size=16"]
SMALL += ["--trainer.num_sanity_val_steps=0"]
NETWORK = "model.estimator.init_args.normalizer.init_args.network.init_args"
BASES = ("base", "paper-base", "reduction-log")  # what is no overlay of ablations/base


def runs(pattern, *bases, prefix="", but=BASES):
    """Lists of configurations that are given together, by the name of the last; each changes those before it."""
    paths = [path for path in sorted(FOLDER.glob(f"{pattern}.yaml")) if path.stem not in but]
    return {prefix + path.stem: [*(FOLDER / f"{base}.yaml" for base in bases), path] for path in paths}


PAPER_BASE = ("paper-short", "ablations/paper-base")
ABLATIONS = runs("ablations/*", "ablations/base")
ABLATIONS |= runs("ablations/loss-[as]*", *PAPER_BASE, prefix="paper-")
ABLATIONS |= runs("ablations/reduction-log", *PAPER_BASE, prefix="paper-", but=())
SHORTER = {}  # ablations of longer trainings
for part, whole in {"layer": "robust", "size": "robust-synthetic", "pose": "robust-pose", "refiner": "refiner"}.items():
    SHORTER |= runs(f"ablations/{part}/*", whole, f"ablations/{part}/base", prefix=f"{part}-")
TABLE1 = runs("table1/*", "crossview") | runs("table1/paper*", "paper-short")
RUNS = runs("*", but=(*OF_SETS, "own")) | runs("ablations/base", but=()) | ABLATIONS | TABLE1
TRAINED = ("crossview", "paper", "transform-paper")
STORES = ("kitti_00", "kitti_01", "kitti_03", "kitti_06", "tum_fr3_office")


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """A folder like LEARNNORM_DATA's, with small synthetic stores under the names that the configs use."""
    folder = tmp_path_factory.mktemp("data")
    (folder / "correspondences").mkdir()
    for seed, name in enumerate(STORES):
        pairs = 3 if name.startswith("tum") else 2  # of each of three scenes
        write_store(folder / f"correspondences/{name}.h5", synthetic_store(pairs, points=120, seed=seed))
    return folder


@pytest.mark.parametrize("name", RUNS)
def test_every_config_runs(name, data, tmp_path, monkeypatch, capsys, refused):
    """One of each transform trains; of the others, task, data and trainer are made."""
    monkeypatch.setenv("LEARNNORM_DATA", str(data))
    options = [word for config in RUNS[name] for word in ("--config", str(config))]
    options += [*SMALL, f"--trainer.default_root_dir={tmp_path}", "--data.val.init_args.number=50"]
    if RUNS[name][0].stem.startswith("paper"):
        options += [f"--{NETWORK}.width=8", f"--{NETWORK}.depth=2"]
    if name not in TRAINED:
        refused(["fit", *options, "--trainer.max_steps=0"], "trainer.max_steps is 0")  # the last that is checked
        return
    assert main(["fit", *options]) == 0
    normalizer, points = kln.LearnedNormalizer.from_pretrained(tmp_path / "weights.safetensors"), torch.rand(2, 5, 8, 2)
    assert normalizer.trained_on
    assert {store.partition("@")[0] for store in normalizer.trained_on} <= {*STORES}
    for T, base in zip(normalizer(*points), normalizer.base(*points), strict=True):  # moved off the base's
        assert T.isfinite().all()
        assert not T.isclose(base, rtol=1e-6).all()
    if name == "crossview":
        options += [f"--ckpt_path={tmp_path / 'checkpoints/last.ckpt'}"]
        assert [main([command, *options]) for command in ("test", "predict")] == [0, 0]
        assert "better_than_hartley" in capsys.readouterr().out
        assert set(load_file(tmp_path / "predictions.safetensors")) == {"F_mat", "T1", "T2", "pair", "residual"}


@pytest.mark.parametrize("name", OF_SETS)
def test_every_config_of_an_estimator_runs(name, request, tmp_path, monkeypatch, capsys, refused):
    config = ["--config", str(FOLDER / f"{name}.yaml")]
    config += ["--trainer.enable_progress_bar=false", f"--trainer.default_root_dir={tmp_path}"]
    if not name.endswith("synthetic"):
        monkeypatch.setenv("LEARNNORM_DATA", str(request.getfixturevalue("real_data")))
        refused(["fit", *config, "--trainer.max_steps=0"], "trainer.max_steps is 0")
        return
    for stage in ("train", "val"):
        config += [f"--data.{stage}.init_args.correspondences=128", f"--data.{stage}.init_args.batches=2"]
    assert main(["fit", *config, "--trainer.max_steps=2"]) == 0
    kind = kln.LearnedRelativePose if "pose" in name else kln.LearnedEightPoint
    layer = kind.from_pretrained(tmp_path / "weights.safetensors")
    assert layer.trained_on == ("synthetic scenes",)
    assert all(bool(value.any()) for key, value in layer.state_dict().items() if "logit.weight" in key)
    checkpoint = f"--ckpt_path={tmp_path / 'checkpoints/last.ckpt'}"
    assert main(["validate", *config, checkpoint]) == 0
    assert "val/median" in capsys.readouterr().out
    refused(["test", *config, checkpoint], "data.test is not set")


def settings(node, name=""):
    """Names of the settings of a configuration; a part of another class counts as one, whatever its arguments."""
    if not isinstance(node, dict) or "class_path" in node:
        return {name} - {"trainer.default_root_dir"}
    return set().union(*(settings(value, f"{name}.{key}".strip(".")) for key, value in node.items()))


# The transform of the paper needs three parameters, a source leaves its share.
TWO = {"transform-paper", "layer-hartley-optimal", "pose-synthetic", "refiner-xfeat"}
TWO |= {f"layer-without-{source}" for source in ("kitti", "photos", "synthetic")}


@pytest.mark.parametrize("name", ABLATIONS | SHORTER)
def test_an_ablation_changes_one_thing(name):
    changed = settings(yaml.safe_load((ABLATIONS | SHORTER)[name][-1].read_text()))
    assert len(changed) == 1 + (name in TWO), changed


def test_missing_and_wrong_checkpoints(trained, monkeypatch, refused):
    monkeypatch.chdir(trained[0])
    for commands, options, message in [
        ("validate predict", [], "give the checkpoint by --ckpt_path"),
        ("fit", ["--ckpt_path=weights.safetensors"], "weights.safetensors is not a checkpoint of a training run"),
        ("test", ["--ckpt_path=none.ckpt"], "no checkpoint at none.ckpt"),
        ("test", ["--ckpt_path=checkpoints/last.ckpt", f"--{NETWORK}.width=32"], "holds another network than the one"),
    ]:
        for command in commands.split():
            refused([command, *trained[1], *options], message)


# The console script in a process where importing torch is interrupted.
INTERRUPTED_IMPORT = """import sys

class Interrupting:
    def find_spec(self, name, path=None, target=None):
        if name == "torch" and "numpy" in sys.modules:  # which swallows interrupts when torch imports it
            raise KeyboardInterrupt

sys.meta_path.insert(0, Interrupting())
import kornia_learnnorm_command
sys.exit(kornia_learnnorm_command.main())
"""


def test_interrupted_while_importing(tmp_path):
    environment = {**os.environ, "PYTHONPATH": str(FOLDER.parent)}
    command = [sys.executable, "-c", INTERRUPTED_IMPORT]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "interrupted\n")


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_knows_options_and_names(shell, capsys):
    pytest.importorskip("shtab", reason="shtab is not installed")
    assert main(["completion", shell]) == 0
    printed = capsys.readouterr().out
    assert all(word in printed for word in (*TOOLS, "fit", "max-samples", "kitti", "crossview-synthetic"))


def test_output_whose_reader_has_ended_is_no_error(monkeypatch, capsys):
    read, write = os.pipe()
    os.close(read)
    with os.fdopen(write, "w") as stream:  # closing it writes what is left in the buffer
        monkeypatch.setattr("sys.stdout", stream)
        assert main(["config", "crossview"]) == 141
    assert capsys.readouterr().err == ""


def test_synthesize(tmp_path, monkeypatch, refused):
    monkeypatch.setattr(synthesize, "render_pair", lambda seed: render_pair(seed, 96, 72))
    assert main(["synthesize", str(tmp_path), "--pairs", "2", "--points", "80"]) == 0
    assert len(read_store(tmp_path / "synthetic.h5")) == 6
    assert {path.name for path in tmp_path.glob("[gi]*")} == {"ground_truth.json", "image1.png", "image2.png"}
    refused(["synthesize", tmp_path / "image1.png"], "image1.png is a file: expected a folder")


FIT = ["fit", "--config", "crossview-synthetic"]
WITH_BAD = [*FIT, "--config", "bad.yaml"]
DATA = "data: {{{}: {{class_path: kornia_learnnorm.data.training_samples.StoreSamples, init_args: {}}}}}"


@pytest.mark.parametrize(
    ("arguments", "bad", "message"),
    [
        (["fit", "--config", "crossview", *SMALL], "", "the environment variable LEARNNORM_DATA, named in "),
        (["estimate", "none1.png", "none2.png"], "", "none1.png"),
        (["estimate", "a.png", "b.png", f"--seed={2**63}"], "", f"seed must lie in [0, 2^63), got {2**63}"),
        *((["demo", f"--port={n}"], "", f"from 1 to 65535 expected, got {n}") for n in (0, -1, 65536)),
        (["demo", "--matcher", "lightglue"], "", "keynet, got sift"),
        (["fit"], "", "give one by --config, a file or one of crossview, "),
        (["validate"], "", "for example learnnorm validate --config crossview-synthetic --ckpt_path "),
        (["fit", "crossview"], "", "'crossview'; a configuration is given by --config crossview"),
        *(
            ([*FIT, f"--trainer.{option}"], "", f"trainer.{option.partition('=')[0]} is 0")
            for option in ("max_epochs=0", "limit_train_batches=0", "limit_train_batches=0.0", "max_time=00:00:00:00")
        ),
        ([*FIT, "--nonsense"], "", "--nonsense; learnnorm fit --help-all lists the options"),
        ([*FIT, "--trainer.default_root_dir", "bad.yaml"], "", "bad.yaml is a file: expected a folder for the run"),
        (WITH_BAD, "model: {nomalizer: 3}", "model.nomalizer"),
        *((WITH_BAD, bad, "") for bad in ("", "- 1")),
        (WITH_BAD, "\xff\xfe", "bad.yaml is not a configuration: "),
        ([*FIT, "--config", "own.yaml"], "", "no configuration own.yaml: expected a file, or one of crossview, "),
        (WITH_BAD, "a: [1", "bad.yaml is not a configuration: "),
        (WITH_BAD, DATA.format("train", "{paths: [none.h5]}"), "no store at none.h5\n"),
    ],
)
def test_errors_are_one_line_and_exit_code_2(arguments, bad, message, tmp_path, monkeypatch, refused, recwarn):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["learnnorm", *arguments])
    monkeypatch.delenv("LEARNNORM_DATA", raising=False)
    Path("bad.yaml").write_bytes(bad.encode("latin-1"))
    refused(arguments, message)
    assert [path.name for path in tmp_path.iterdir()] == ["bad.yaml"]
    assert not [w for w in recwarn if "LightningCLI" in str(w.message)]


def test_a_port_in_use(refused):
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        refused(["demo", "--no-browser", f"--port={port}"], f"--port {port}: cannot listen there")


@pytest.mark.parametrize(
    ("command", "blocked", "extra"),
    [
        ("evaluate s.h5", "h5py", "images"),
        ("fit", "lightning_modules.training_command", "train"),
        ("completion bash", "shtab", "completion"),
        ("export paper --format onnx --out a.onnx", "onnx", "onnx"),
        ("export-colmap . --out a.db", "pycolmap", "colmap"),
        *(("demo --no-browser", package, "demo") for package in ("gradio", "cv2", "PIL")),
    ],
)
def test_a_missing_package_is_one_line(command, blocked, extra, tmp_path, monkeypatch, refused):
    monkeypatch.chdir(tmp_path)
    write_store("s.h5", synthetic_store(pairs=1, points=40))
    monkeypatch.setitem(sys.modules, blocked, None)
    refused(command.split(), f"needs {blocked}: run pip install 'kornia-learnnorm[{extra}]'")


def test_json_of_a_checkpoint_has_its_metrics(trained, tmp_path, capsys, refused):
    folder, options = trained
    last, path = folder / "checkpoints/last.ckpt", tmp_path / "metrics.json"
    words = ["validate", *options, "--ckpt_path", str(last)]
    assert main([*words, "--json", str(path)]) == 0
    out, found = capsys.readouterr().out, json.loads(path.read_text())
    assert found["command"] == shlex.join(["learnnorm", *words, "--json", str(path)])
    (table,) = found["tables"]
    names = {f"val/{name}" for name in ("log_sed", "better_than_hartley", "better_than_whitening", "left_out")}
    assert {row["metric"] for row in table["rows"]} == names
    assert all(row["metric"] in out and str(row["value"]) in out for row in table["rows"])
    assert main([*words, "--json=-"]) == 0
    assert json.loads(capsys.readouterr().out)["tables"] == found["tables"]
    refused([*words, "--json", last], f"--json {last}: expected a new file or -")


def test_a_training_says_where_it_runs_and_how_long(tmp_path, caplog, capsys):
    options = ["--data.batch_size=16", "--trainer.max_steps=13", "--trainer.accelerator=cpu"]
    options += [f"--data.{stage}.init_args.number=64" for stage in ("train", "val")]
    options += [f"--{NETWORK}.width=8", f"--{NETWORK}.depth=1"]
    with caplog.at_level("INFO"):
        assert main(["fit", "--config=crossview-synthetic", *options, f"--trainer.default_root_dir={tmp_path}"]) == 0
    assert f"device cpu, 13 steps; results in {tmp_path}" in caplog.messages
    printed = capsys.readouterr().out
    assert " 4/4 " in printed  # of an epoch, in Lightning's bar
    assert re.search(r"\n(not )?better than at the start: val/log_sed \S+, at the start \S+\n$", printed)
    assert "better_than" not in printed  # nearly 1 from the first steps on
    assert [text for text in caplog.messages if re.fullmatch(r"about \d+ s for the remaining 2 steps, .*", text)]
    assert [text for text in caplog.messages if re.fullmatch(r"13 steps in \d+ s", text)]
    assert [text for text in caplog.messages if re.search("available|Tip|Seed", text)] == []  # Lightning's own


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_an_interrupted_training_exits_as_interrupted(number, code, tmp_path, monkeypatch, capsys, caplog):
    monkeypatch.chdir(tmp_path)
    interrupt = train_processes.Interrupt(1, number=number)
    monkeypatch.setattr("lightning_modules.callbacks.ExportWeights.on_after_backward", interrupt.on_after_backward)
    with pytest.raises(SystemExit) as ended, caplog.at_level("INFO"):
        sys.exit(main(["fit", "--config=crossview-synthetic", *SMALL, "--data.val.init_args.number=50"]))
    assert ended.value.code == code
    last = Path("runs/crossview-synthetic/checkpoints/last.ckpt")
    assert f"stopped at step 2; to go on, repeat the command with --ckpt_path {last}" in caplog.text
    assert "weights_only" not in caplog.text
    assert capsys.readouterr().err.endswith("interrupted\n") is (code == 130)
    assert [last.is_file(), Path("runs/crossview-synthetic/weights.safetensors").exists()] == [True, False]


def test_a_training_names_its_folder_on_a_full_disk(trained, tmp_path, monkeypatch, refused):
    error = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    monkeypatch.setattr("lightning_modules.callbacks.ExpectedTime.on_train_start", Mock(side_effect=error))
    refused(["fit", *trained[1], f"--trainer.default_root_dir={tmp_path}"], f"{tmp_path}: No space left on device")


def test_a_training_does_not_replace_another(trained, refused):
    folder, options = trained
    last = folder / "checkpoints/last.ckpt"
    before = last.stat().st_mtime_ns
    refused(["fit", *options], f"{folder} holds a run already: go on with it by --ckpt_path {last}, or choose another")
    assert last.stat().st_mtime_ns == before


def test_configurations_are_found_by_name_from_any_folder(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["config"]) == 0
    names = capsys.readouterr().out.split()
    assert sorted(names) == sorted(p.relative_to(FOLDER).with_suffix("").as_posix() for p in FOLDER.rglob("*.yaml"))
    assert main(["config", "ablations/base"]) == 0
    assert capsys.readouterr().out == (FOLDER / "ablations/base.yaml").read_text()
    assert find_config("ablations/base") == FOLDER / "ablations/base.yaml"
    Path("crossview").write_text("seed_everything: 7")  # a file comes before a name
    assert find_config("crossview") == Path("crossview")


def help_of(*words):
    """What ``--help`` prints."""
    with contextlib.redirect_stdout(io.StringIO()) as printed, pytest.raises(SystemExit) as caught:
        main([*words])
    assert caught.value.code == 0
    return printed.getvalue().rstrip()


@pytest.mark.parametrize("command", [(), *((name,) for name in (*TRAINING, *sorted(TOOLS), "completion"))])
def test_help_fits_a_screen_and_ends_with_examples_that_parse(command, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    lines = help_of(*command, "--help").splitlines()
    assert len(lines) <= 40
    assert max(map(len, lines)) <= 80
    examples = "\n".join(lines[lines.index("examples:") + 1 :]).replace("\\\n", "").splitlines()
    parser = make_parser()
    for example in re.split(r" && |\n", "\n".join(examples)):
        words = shlex.split(example.partition(">")[0])
        assert words[0] == "learnnorm"
        assert parser.parse_args(words[1:]).command == words[1]


def test_help_of_a_training_lists_all_options_or_needs_no_extra(monkeypatch):
    assert "--trainer.gradient_clip_val" in help_of("fit", "--help-all")
    for module in ("lightning_modules.training_command", "pytorch_lightning", "jsonargparse", "yaml"):
        monkeypatch.setitem(sys.modules, module, None)
    assert "--help-all" in help_of("fit", "--config", "crossview", "-h")
