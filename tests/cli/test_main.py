"""The command line, on files that the tests write."""

import contextlib
import functools
import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from safetensors.torch import load_file
from two_view import epipolar_distances

import kornia_learnnorm as kln
from kornia_learnnorm.cli.main import main
from kornia_learnnorm.data.samples import draw_samples
from kornia_learnnorm.data.store import read_store
from kornia_learnnorm.data.synthetic.stores import synthetic_store
from kornia_learnnorm.data.writer import write_store
from kornia_learnnorm.metrics.bootstrap import bootstrap_interval

FOLDER = Path(__file__).parents[2] / "configs"
CONFIGS = sorted(FOLDER.glob("*.yaml"))
SMALL = ["--trainer.max_steps=3", "--trainer.enable_progress_bar=false", "--data.batch_size=16"]
NETWORK = "model.normalizer.init_args.network.init_args"
SMALL_PAPER_NETWORK = [f"--{NETWORK}.width=8", f"--{NETWORK}.depth=2"]

# Configurations that are given together, by the name of the run; each changes those before it.
BASE = [FOLDER / "ablations/base.yaml"]
PAPER_BASE = [FOLDER / "paper-short.yaml", FOLDER / "ablations/paper-base.yaml"]
ABLATIONS = {
    path.stem: [*BASE, path]
    for path in sorted((FOLDER / "ablations").glob("*.yaml"))
    if path.stem not in ("base", "paper-base", "reduction-log")
} | {
    f"paper-{name}": [*PAPER_BASE, FOLDER / f"ablations/{name}.yaml"]
    for name in ("loss-algebraic", "loss-sampson", "reduction-log")
}
TABLE1 = {
    path.stem: [FOLDER / ("paper-short.yaml" if path.stem.startswith("paper") else "crossview.yaml"), path]
    for path in sorted((FOLDER / "table1").glob("*.yaml"))
}
RUNS = {"base": BASE, "paper-base": PAPER_BASE} | ABLATIONS | TABLE1


@pytest.fixture(autouse=True)
def program(monkeypatch):
    """LightningCLI warns about arguments from Python while pytest's own are on the command line."""
    monkeypatch.setattr("sys.argv", ["learnnorm"])


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """A folder like LEARNNORM_DATA's, with small synthetic stores under the names that the configs use."""
    folder = tmp_path_factory.mktemp("data")
    (folder / "correspondences").mkdir()
    for seed, name in enumerate(("kitti_00", "kitti_01", "kitti_03", "kitti_06", "tum_fr3_office")):
        pairs = 3 if name.startswith("tum") else 2  # of each of three scenes
        write_store(folder / f"correspondences/{name}.h5", synthetic_store(pairs, points=120, seed=seed))
    return folder


def assert_trained(weights):
    """The weights load, and two or three steps have moved the transforms off the base's."""
    normalizer, points = kln.LearnedNormalizer.from_pretrained(weights), (torch.rand(5, 8, 2), torch.rand(5, 8, 2))
    for T, base in zip(normalizer(*points), normalizer.base(*points), strict=True):
        assert torch.isfinite(T).all()
        assert not torch.isclose(T, base, rtol=1e-6).all()


@pytest.mark.parametrize("config", CONFIGS, ids=lambda path: path.stem)
def test_every_config_runs(config, data, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("LEARNNORM_DATA", str(data))
    small = [*SMALL, f"--trainer.default_root_dir={tmp_path}"]
    if "synthetic" in config.stem:
        small += ["--data.train.init_args.number=200", "--data.test.init_args.number=50"]
    if "paper" in config.stem:
        small += SMALL_PAPER_NETWORK
    small += ["--data.val.init_args.number=50"]
    assert main(["fit", "--config", str(config), *small]) == 0
    assert_trained(tmp_path / "weights.safetensors")
    checkpoint = f"--ckpt_path={tmp_path / 'checkpoints/last.ckpt'}"
    for command in ("validate", "test", "predict"):
        assert main([command, "--config", str(config), *small, checkpoint]) == 0
    assert "better_than_hartley" in capsys.readouterr().out
    assert set(load_file(tmp_path / "predictions.safetensors")) == {"F_mat", "T1", "T2", "pair", "residual"}


def together(configs):
    """The options that give several configurations."""
    return [word for config in configs for word in ("--config", str(config))]


@pytest.mark.parametrize("name", RUNS)
def test_every_overlay_runs(name, data, tmp_path, monkeypatch):
    monkeypatch.setenv("LEARNNORM_DATA", str(data))
    small = [
        *SMALL,
        "--trainer.max_steps=2",
        "--data.val.init_args.number=50",
        f"--trainer.default_root_dir={tmp_path}",
    ]
    if name.endswith("handheld"):
        small += ["--data.train.init_args.number=100"]
    if name == "paper-handheld":
        small += ["--data.batch_pairs=20"]
    if FOLDER / "paper-short.yaml" in RUNS[name]:
        small += SMALL_PAPER_NETWORK
    assert main(["fit", *together(RUNS[name]), *small]) == 0
    assert_trained(tmp_path / "weights.safetensors")


@functools.cache
def settings(*configs):
    """All settings of a run, those that no file mentions among them."""
    with contextlib.redirect_stdout(io.StringIO()) as printed, pytest.raises(SystemExit) as caught:
        main(["fit", *together(configs), "--print_config"])
    assert caught.value.code == 0
    return yaml.safe_load(printed.getvalue())


def differences(before, after, name=""):
    """Names of the settings that differ; a part of another class counts as one, whatever its arguments."""
    if before == after:
        return set()
    groups = isinstance(before, dict) and isinstance(after, dict)
    if not groups or before.get("class_path") != after.get("class_path"):
        return {name}
    keys = before.keys() | after.keys()
    return set().union(*(differences(before.get(k), after.get(k), f"{name}.{k}".strip(".")) for k in keys))


def changes(*configs):
    """Names of the settings that the last configuration changes."""
    return differences(settings(*configs[:-1]), settings(*configs))


SEVERAL_CHANGES = {
    "seed-1": {"seed_everything", "data.seed"},
    "seed-2": {"seed_everything", "data.seed"},
    "transform-paper": {"model.normalizer.init_args.transform", f"{NETWORK}.num_parameters"},
}


@pytest.mark.parametrize("name", ABLATIONS)
def test_an_ablation_changes_one_thing(name):
    changed = changes(*ABLATIONS[name])
    if name in SEVERAL_CHANGES:
        assert changed == SEVERAL_CHANGES[name]
    else:
        assert len(changed) == 1, changed


def test_what_the_shorter_paper_runs_change():
    paper, short, shorter = settings(FOLDER / "paper.yaml"), settings(PAPER_BASE[0]), settings(*PAPER_BASE)
    schedule = {"model.lr_scheduler.init_args.step_size", "model.lr_scheduler.init_args.gamma"}
    length = {"trainer.max_epochs", "trainer.check_val_every_n_epoch", "data.batch_pairs"} | schedule
    loss = {"model.loss.init_args.log", "model.sample_gradient"}
    assert differences(paper, short) == length | loss | {"trainer.default_root_dir"}
    assert differences(paper, shorter) == length | {"trainer.default_root_dir"}  # the loss is the paper's again


@pytest.mark.parametrize("name", TABLE1)
def test_other_training_data_leave_normalizer_and_loss_alone(name):
    changed = changes(*TABLE1[name])
    assert any(setting.startswith("data.train") for setting in changed)
    allowed = ("data.train", "data.batch", "trainer.max", "trainer.check_val", "model.lr_scheduler.init_args.step_size")
    assert all(setting.startswith(allowed) for setting in changed), changed


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
        ("cut.ckpt", "cut.ckpt is not a checkpoint of a training run, or not a whole one"),
    ],
)
@pytest.mark.parametrize("command", ["fit", "test"])
def test_wrong_checkpoints(trained, command, file, message, capsys):
    folder, options = trained
    (folder / "text.ckpt").write_text("not a checkpoint")
    whole = (folder / "checkpoints/last.ckpt").read_bytes()
    (folder / "cut.ckpt").write_bytes(whole[: len(whole) // 2])
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

    monkeypatch.setattr("kornia_learnnorm.cli.evaluate.run", interrupt)
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
    for row in ("none", "Hartley", "whitening", "reweighted whitening", "learned: crossview", "searched optimum"):
        assert out.count(f"| {row} ") == 2
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
        (
            ["synthesize", "folder", "--scenes", "moon"],
            "scenes must be among forward driving, hand-held, orbit, got moon",
        ),
        (["diagnose", "none.h5"], "no store at none.h5"),
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


@pytest.mark.parametrize("arguments", [[], ["unknown"], ["evaluate"], ["compare", "s.h5"], ["fit", "--nonsense"]])
def test_bad_usage_exits_with_2(arguments, capsys):
    with pytest.raises(SystemExit) as caught:
        main(arguments)
    assert caught.value.code == 2
    assert "usage" in capsys.readouterr().err.lower()


@pytest.fixture(scope="module")
def compared(tmp_path_factory):
    """Stores of three pairs, with and without ground truth, and a run whose rates are neither 0 nor 100."""
    folder = tmp_path_factory.mktemp("compared")
    store = synthetic_store(pairs=1, points=90)
    write_store(folder / "known.h5", store)
    write_store(folder / "unknown.h5", replace(store, F=np.full_like(store.F, np.nan)))
    for name in ("other", "tilted"):
        (folder / name).mkdir()
    write_store(folder / "other/known.h5", store)
    network = kln.CrossViewNetwork(width=8, depth=1)
    torch.nn.init.constant_(network.set_network.head[-1].bias, 0.3)
    kln.LearnedNormalizer(kln.Hartley(), network).save_pretrained(folder / "tilted/weights.safetensors")
    return folder


def read_tables(text):
    """Titles, and of each table the columns' names and the cells by row and column."""
    titles, tables = text.strip().split("\n\n")[::2], text.strip().split("\n\n")[1::2]
    read = {}
    for title, table in zip(titles, tables, strict=True):
        header, _, *rows = ([cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines())
        read[title] = header, {row[0]: row[1:] for row in rows}
    return read


def test_compare(compared, capsys):
    stores = ["known.h5", "known.h5@1:2", "unknown.h5"]
    weights = [str(compared / "tilted/weights.safetensors"), "crossview"]
    assert main(["compare", *(str(compared / store) for store in stores), "--weights", *weights]) == 0
    tables = read_tables(capsys.readouterr().out)
    assert list(tables) == [
        "better than Hartley %",
        "better than whitening %",
        "ground truth: better than Hartley %",
    ]
    methods = ["none", "Hartley", "whitening", "reweighted whitening", "tilted", "crossview", "searched optimum"]
    drawn = [samples_of(compared, "known.h5"), samples_of(compared, "known.h5@1:2")]
    counts = [f"{len(kept.pair)} of {number} samples" for kept, number in drawn]
    for title, (header, rows) in tables.items():
        columns = [f"known: {counts[0]}, 3 pairs", f"known@1:2: {counts[1]}, 1 pair", f"unknown: {counts[0]}, 3 pairs"]
        assert [text.removesuffix("s") for text in header] == ["method", *(text.removesuffix("s") for text in columns)]
        assert list(rows) == methods
        for method, (three, one, unknown) in rows.items():
            if title.endswith(f"{method} %"):
                assert three == one == unknown == "-"
                continue
            rate, low, high = map(float, three.replace("[", "").replace("]", "").replace(",", "").split())
            assert 0 <= low <= rate <= high <= 100
            assert 0 <= float(one) <= 100  # of one pair there is no interval
            assert unknown == ("-" if title.startswith("ground truth") else three)
    for baseline in ("Hartley", "whitening"):
        assert tables[f"better than {baseline} %"][1]["searched optimum"][:2] == ["100.0 [100.0, 100.0]", "100.0"]


def samples_of(folder, store):
    """Samples that pass the filter, and the number before it."""
    everything, kept = (
        draw_samples(read_store(f"{folder / store}"), torch.Generator().manual_seed(0), max_residual=limit)
        for limit in (None, 60.0)
    )
    return kept, len(everything.pair)


def test_a_compared_rate_by_hand(compared, capsys):
    weights = compared / "tilted/weights.safetensors"
    assert main(["compare", str(compared / "known.h5"), "--weights", str(weights)]) == 0
    tables = read_tables(capsys.readouterr().out)
    store, (samples, _) = read_store(compared / "known.h5"), samples_of(compared, "known.h5")
    points = samples.points1.double(), samples.points2.double()
    F = {
        "Hartley": kln.find_fundamental(*points, normalizer=kln.Hartley()),
        "whitening": kln.find_fundamental(*points, normalizer=kln.Whitening()),
        "tilted": kln.find_fundamental(*points, normalizer=kln.LearnedNormalizer.from_pretrained(weights)),
    }
    own = {name: epipolar_distances(*points, f.detach()).mean(1) for name, f in F.items()}
    truth = {name: [] for name in F}
    for row, pair in enumerate(samples.pair):
        rows = slice(store.offsets[pair], store.offsets[pair + 1])
        x1, x2 = store.points1[rows].astype(float), store.points2[rows].astype(float)
        near = epipolar_distances(x1, x2, store.F[pair]) < 1
        inliers = near & (store.ratio[rows] < 0.8)
        for name, f in F.items():
            distance = np.sort(epipolar_distances(x1[inliers], x2[inliers], f[row].detach()))
            truth[name].append(distance[(len(distance) - 1) // 2])
    for title, baseline, of in [
        ("better than Hartley %", "Hartley", own),
        ("better than whitening %", "whitening", own),
        ("ground truth: better than Hartley %", "Hartley", truth),
    ]:
        better = np.array(of["tilted"]) < np.array(of[baseline])
        assert 0 < better.mean() < 1
        low, high = bootstrap_interval(torch.from_numpy(better), samples.pair)
        expected = f"{100 * better.mean():.1f} [{100 * low:.1f}, {100 * high:.1f}]"
        assert tables[title][1]["tilted"] == [expected]


def test_compare_refuses_the_names_of_its_own_rows(compared, tmp_path, capsys):
    taken = tmp_path / "Hartley.safetensors"
    taken.write_bytes((compared / "tilted/weights.safetensors").read_bytes())
    assert main(["compare", str(compared / "known.h5"), "--weights", str(taken)]) == 2
    assert "a row of every table is called Hartley already" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("stores", "weights", "message"),
    [
        (["known.h5"], ["tilted", "other/tilted"], "two files have the same name, tilted: "),
        (["known.h5"], ["tilted", "tilted"], "two files have the same name, tilted: "),
        (["known.h5", "other/known.h5"], ["tilted"], "two files have the same name, known: "),
        (["known.h5", "none.h5"], ["tilted"], "no store at"),
        (["known.h5", "known.h5@2:9"], ["tilted"], "pairs 2:9 were asked for, the store has 0:3"),
        (["known.h5", "known.h5@2"], ["tilted"], "some pairs of a store are FILE.h5@FIRST:STOP"),
        (["known.h5"], ["tilted", "none"], "no weights"),
        (["tilted/weights.safetensors"], ["tilted"], "not a readable HDF5 file"),
    ],
)
def test_compare_checks_first(compared, stores, weights, message, capsys):
    stores = [str(compared / store) for store in stores]
    weights = [str(compared / run / "weights.safetensors") for run in weights]
    assert main(["compare", *stores, "--weights", *weights]) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.startswith("learnnorm compare: error: ")
    assert printed.err.count("\n") == 1
    assert message in printed.err
