"""The tables that ``evaluate`` prints and ``report`` makes of them, on files that the tests write."""

import json

import numpy as np
import pytest
import torch
from references import epipolar_distances

import kornia_learnnorm as kln
from kornia_learnnorm.cli.main import main
from kornia_learnnorm.data.match_sets import draw_samples
from kornia_learnnorm.data.store import read_store
from kornia_learnnorm.data.store_writer import write_store
from kornia_learnnorm.data.synthetic.scenes import synthetic_store
from kornia_learnnorm.evaluation.diagnostics import diagnose
from kornia_learnnorm.evaluation.report.method_tables import report_tables
from kornia_learnnorm.evaluation.runs.prediction_run import read_run
from kornia_learnnorm.evaluation.tables import tables_as_json
from kornia_learnnorm.metrics.statistics import bootstrap_interval


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Stores of nine pairs and weights whose rates are neither 0 nor 100."""
    folder = tmp_path_factory.mktemp("compared")
    store = synthetic_store(pairs=3, points=90)
    write_store(folder / "known.h5", store)
    for name in ("other", "tilted"):
        (folder / name).mkdir()
    write_store(folder / "other/known.h5", store)
    network = kln.CrossViewNetwork(width=8, depth=1)
    torch.nn.init.constant_(network.set_network.head[-1].bias, 0.3)
    kln.LearnedNormalizer(kln.Hartley(), network).save_pretrained(folder / "tilted/weights.safetensors")
    return folder


def samples_of(folder, store, **options):
    """Filtered samples below the limit, and the number before it."""
    samples = draw_samples(read_store(folder / store), torch.Generator().manual_seed(0), **options)
    return samples.with_residual_below(60.0), len(samples.pair)


def errors_by_hand(folder, samples):
    """Mean distance of each sample's points and median one of its pair's inliers, by method, from NumPy's distances."""
    store, points = read_store(folder / "known.h5"), (samples.points1.double(), samples.points2.double())
    weights = kln.LearnedNormalizer.from_pretrained(folder / "tilted/weights.safetensors")
    own, truth = {}, {}
    for name, normalizer in {"Hartley": kln.Hartley(), "whitening": kln.Whitening(), "tilted": weights}.items():
        F_mat = kln.find_fundamental(*points, normalizer=normalizer).detach()
        own[name], truth[name] = epipolar_distances(*points, F_mat).mean(1), []
        for F_sample, pair in zip(F_mat, samples.pair, strict=True):
            x1, x2 = (points.astype(float) for points in store.matches(pair, 0.8)[:2])
            inliers = epipolar_distances(x1, x2, store.F[pair]) < 1
            truth[name].append(np.median(epipolar_distances(x1[inliers], x2[inliers], F_sample)))
    return own, {name: np.array(values) for name, values in truth.items()}


def tables_of_report(folder, capsys, *words):
    """The tables of a report of a run that is kept, by their titles, and their rows by method."""
    assert main(["evaluate", *words, "--out", str(folder)]) == 0
    capsys.readouterr()
    tables = json.loads(tables_as_json("", report_tables(read_run(folder))))["tables"]
    return {table["title"]: {row["method"]: row for row in table["rows"] if "method" in row} for table in tables}


def test_the_commands_agree_with_a_computation_by_hand(folder, tmp_path, capsys):
    shared = [str(folder / "known.h5"), "--methods", "Hartley", "whitening", "--weights"]
    shared += [str(folder / "tilted/weights.safetensors")]
    samples, drawn = samples_of(folder, "known.h5")
    own, truth = errors_by_hand(folder, samples)
    tables, rates = tables_of_report(tmp_path / "run", capsys, *shared), []
    for title, column, errors, baseline in [
        ("Better than Hartley, filtered", f"known: {len(samples.pair)} of {drawn}", own, "Hartley"),
        ("Better than whitening, filtered", f"known: {len(samples.pair)} of {drawn}", own, "whitening"),
        ("Fit and accuracy: known, filtered", "truth: better than Hartley %", truth, "Hartley"),
    ]:
        better = errors["tilted"] < errors[baseline]
        assert 0 < better.mean() < 1
        interval = bootstrap_interval(torch.from_numpy(better), samples.pair)
        low, high = (float(f"{100 * end:.1f}") for end in interval)
        rates.append(float(f"{100 * better.mean():.1f}"))
        assert tables[title]["tilted"][column] == {"value": rates[-1], "low": low, "high": high}
    assert main(["evaluate", *shared, "--json", "-"]) == 0
    table, _ = json.loads(capsys.readouterr().out)["tables"]
    hartley, whitening, tilted = ([*row.values()][1:] for row in table["rows"])
    numbers = own["tilted"].mean(), np.median(own["tilted"]), np.median(truth["tilted"])
    assert tilted == [*rates[:2], *(float(f"{number:.3f}") for number in numbers), rates[2]]
    assert hartley[0] is hartley[-1] is whitening[1] is None


def test_diagnostics(folder, tmp_path, capsys):
    words = [str(folder / "known.h5"), "--methods", "Hartley", "whitening", "--size", "20"]
    rows = tables_of_report(tmp_path / "run", capsys, *words)["Fit and accuracy: known, filtered"]
    samples, _ = samples_of(folder, "known.h5", size=20)
    columns = ["condition number", "rho", "distance 1", "distance 2", "error due to rank 2 %"]
    for name, normalizer in {"Hartley": kln.Hartley(), "whitening": kln.Whitening()}.items():
        *expected, share = (np.median(v) for v in diagnose(samples.points1, samples.points2, normalizer))
        texts = [*(f"{value:.4g}" for value in expected), f"{100 * share:z.0f}"]
        assert [rows[name][column] for column in columns] == [*map(float, texts)]


def test_evaluate_says_what_its_rows_are(folder, tmp_path, capsys):
    """Weights that replace shipped ones, those that were trained on the store, and methods of a command before."""
    layer, own = kln.LearnedNormalizer(), tmp_path / "crossview" / "weights.safetensors"
    layer.trained_on = ("known@0:1",)
    own.parent.mkdir()
    layer.save_pretrained(own)
    command = ["evaluate", str(folder / "known.h5"), "--max-samples", "8", "--out", str(tmp_path / "run")]
    assert main([*command, "--methods", "none", "Hartley"]) == 0
    assert "from before" not in capsys.readouterr().err
    assert main([*command, "--methods", "whitening", "--weights", str(own)]) == 0
    printed = capsys.readouterr()
    assert f"crossview is {own} here, not the weights of this name that ship" in printed.err
    assert f"{tmp_path / 'run'} also holds, from before: none, Hartley" in printed.err
    assert "trained on pairs of this store: crossview\n" in printed.out
    assert "mean, median: symmetric epipolar distance" in printed.out


def test_json_has_the_numbers_of_the_tables(folder, tmp_path, capsys):
    words = ["evaluate", str(folder / "known.h5"), "--methods", "Hartley", "crossview"]
    path = tmp_path / "tables.json"
    assert main([*words, "--json", str(path)]) == 0
    printed = capsys.readouterr().out
    assert printed.endswith(f"\nwrote {path}\n")
    assert main([*words, "--json", "-"]) == 0
    found, again = json.loads(path.read_text()), json.loads(capsys.readouterr().out)
    assert found["tables"] == again["tables"]
    assert found["command"] == f"learnnorm {' '.join(words)} --json {path}"
    assert found["version"] == kln.__version__
    lines = [line.strip("|").split("|") for line in printed.splitlines() if line.startswith("|") and ":--" not in line]
    lines = [[cell.strip() for cell in line] for line in lines]
    for table in found["tables"]:
        assert lines.pop(0) == [*table["rows"][0]]
        for name, *values in map(dict.values, table["rows"]):
            assert lines[0][0] == name
            assert [None if cell == "-" else float(cell) for cell in lines.pop(0)[1:]] == values
    assert lines == []


def test_json_is_not_written_where_a_command_fails_or_over_its_input(folder, tmp_path, refused):
    store = tmp_path / "known.h5"
    store.write_bytes((folder / "known.h5").read_bytes())
    refused(["evaluate", f"{store}@0:2", "--json", store], "known.h5: expected a new file or -")
    refused(["evaluate", store, "--json", tmp_path / "none/a.json"], "none does not exist")
    refused(["evaluate", store, "--seed", "-1"], "seed must be 0 or more, got -1")
    own = tmp_path / "own.safetensors"
    refused(["evaluate", store, "--methods", f"{own}+LM", "--json", own], "own.safetensors: expected a new file or -")
    refused(["evaluate", store, "--json", tmp_path / "a.json", "--weights", "nothing"], "no weights")
    assert [*tmp_path.iterdir()] == [store]


def test_stores_and_weights_are_checked_first(folder, refused):
    (folder / "cut.h5.parts").mkdir()
    for stores, weights, message in [
        (["known.h5"], ["tilted", "other/tilted"], "two methods have the same name, tilted: "),
        (["known.h5", "other/known.h5"], ["tilted"], "two files have the same name, known: "),
        (["known.h5", "none.h5"], ["tilted"], "no store at"),
        (["cut.h5"], ["tilted"], "was interrupted: run the same learnnorm match again"),
        (["tilted"], ["tilted"], "tilted; it is a folder, and learnnorm match folder makes"),
        (["known.h5", "known.h5@2:19"], ["tilted"], "pairs 2:19 were asked for, the store has 0:9"),
        (["tilted/weights.safetensors"], ["tilted"], "not a readable HDF5 file"),
    ]:
        stores = [folder / store for store in stores]
        weights = [folder / name / "weights.safetensors" if "." not in name else folder / name for name in weights]
        refused(["evaluate", *stores, "--weights", *weights], message)
