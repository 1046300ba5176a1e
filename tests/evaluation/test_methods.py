"""Methods by name, and what their weights were trained on."""

import sys
from pathlib import Path

import pytest
import torch
import yaml
from scenes import correspondences, raises

import kornia_learnnorm as kln
from kornia_learnnorm.evaluation.methods import SHIPPED, default_methods, find_method, identify_method, short_name_of
from kornia_learnnorm.evaluation.report.method_tables import was_trained_on
from kornia_learnnorm.evaluation.tables import names_of
from kornia_learnnorm.layer_export import load_layer
from kornia_learnnorm.pretrained import WEIGHTS

CONFIGS = Path(__file__).parents[2] / "configs"


def test_estimates_are_those_of_the_normalizer():
    points = correspondences("handheld", 3, 9)
    for name, normalizer in [
        ("Hartley", kln.Hartley()),
        ("crossview", kln.LearnedNormalizer.from_pretrained()),
        ("kornia_learnnorm:Whitening", kln.Whitening()),
    ]:
        assert torch.equal(find_method(name).estimate(*points), kln.find_fundamental(*points, normalizer=normalizer))


def test_unknown():
    before = [*sys.path]
    for name, error, message in [
        ("nothing", FileNotFoundError, "no weights 'nothing'"),
        ("robust", ValueError, "robust STORE --out RUN --estimators learned:robust evaluates them"),
        ("hartley+LM", FileNotFoundError, r"expected none, Hartley, .*paper, .*module:Name, .*\+LM or \+optimal"),
        ("Hartley+optimal+LM", FileNotFoundError, "expected none, Hartley"),
        (":Whitening", ValueError, "expected module:Name"),
        ("runs/own/checkpoints/last.ckpt", FileNotFoundError, "is a checkpoint: learnnorm fit writes"),
        ("no.such.module:Thing", ValueError, "no normaliser at"),
        ("kornia_learnnorm:__version__", ValueError, "cannot be called"),
    ]:
        raises(error, message, find_method, name)
        assert sys.path == before


def test_names(tmp_path):
    path = str(tmp_path / "mine" / "weights.safetensors")
    assert [*map(short_name_of, (path, path + "+LM", "paper"))] == ["mine", "mine+LM", "paper"]
    assert identify_method("paper").startswith("paper ")
    assert identify_method("Hartley+LM") == "Hartley+LM"
    closed_forms = ("none", "Hartley", "whitening", "reweighted")
    assert default_methods() == (*closed_forms, *SHIPPED, "searched")
    assert default_methods([path]) == (*closed_forms, *SHIPPED, path, "searched")
    further = ("Hartley+optimal", "Hartley+LM")
    assert default_methods(kept=True) == (*default_methods(), *further, "crossview+LM")
    own = "runs/crossview/weights.safetensors"  # tables have room for one of a name
    replaced = (*closed_forms, "paper", "crossview-synthetic", own, "searched", *further)
    assert default_methods([own], kept=True) == replaced


def test_weights_that_the_wheel_leaves_out(tmp_path, monkeypatch):
    for name in ("paper.md", "crossview.md", "crossview.safetensors"):
        (tmp_path / name).write_bytes((WEIGHTS / name).read_bytes())
    monkeypatch.setattr("kornia_learnnorm.pretrained.WEIGHTS", tmp_path)
    for load in (kln.LearnedNormalizer.from_pretrained, load_layer, find_method):
        load("crossview")
        raises(FileNotFoundError, "kornia_learnnorm/weights/paper", load, "paper")
    assert set(SHIPPED) & {*default_methods()} == {"crossview"}


class TestTrainedOn:
    @pytest.mark.parametrize(("name", "config"), [("paper", "paper-short"), ("crossview", "crossview")])
    def test_shipped_weights_are_as_configured(self, name, config):
        paths = yaml.safe_load((CONFIGS / f"{config}.yaml").read_text())["data"]["train"]["init_args"]["paths"]
        assert find_method(name).trained_on == find_method(f"{name}+LM").trained_on == tuple(names_of(paths).values())

    def test_without_weights_or_without_names(self, tmp_path):
        assert find_method("whitening").trained_on == find_method("Hartley+optimal").trained_on == ()
        kln.LearnedNormalizer().save_pretrained(tmp_path / "new.safetensors")
        for name in ("kornia_learnnorm:Whitening", f"{tmp_path / 'new.safetensors'}+LM"):
            assert find_method(name).trained_on == ("not known",)

    def test_a_store_of_some_pairs(self):
        for store, trained_on, expected in [
            ("b@5:9", ["a", "b@3:6"], True),
            ("b@6:9", ["a", "b@3:6"], False),
            ("tum", ["tum@0:9"], True),
            ("a", ["not known"], False),
        ]:
            assert was_trained_on(store, trained_on) == expected
