"""Layers in folders and repositories of the Hugging Face Hub, without network."""

import json

import pytest
import torch
from scenes import raises

import kornia_learnnorm as kln

hub = pytest.importorskip("kornia_learnnorm.hub")
LAYERS = [(kln.LearnedEightPoint, "robust-tiny"), (kln.LearnedRelativePose, "robust-pose-synthetic")]
LAYERS += [(kln.LearnedHomography, "robust-homography")]
LAYERS += [(kln.LearnedNormalizer, "crossview-synthetic"), (kln.MatchRefiner, "refiner")]


@pytest.fixture
def folder(tmp_path):
    hub.HubModel(kln.LearnedEightPoint.from_pretrained("robust-tiny")).save_pretrained(tmp_path / "tiny")
    return tmp_path / "tiny"


@pytest.mark.parametrize(("layer_class", "name"), LAYERS)
def test_a_layer_returns_from_a_folder(layer_class, name, tmp_path):
    layer = layer_class.from_pretrained(name)
    hub.HubModel(layer).save_pretrained(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["README.md", "config.json", "model.safetensors"]
    loaded = hub.HubModel.from_pretrained(tmp_path)
    values = [torch.rand(2, 9, 2) * 600, torch.rand(2, 9, 2) * 600]
    values += [torch.eye(3)] * 2 if layer_class is kln.LearnedRelativePose else []
    values = [*torch.rand(2, 2, 1, 600, 600), *values] if layer_class is kln.MatchRefiner else values
    assert type(loaded.layer) is layer_class
    assert not loaded.training
    assert loaded.layer.trained_on == layer.trained_on
    torch.testing.assert_close(loaded(*values), layer(*values))
    assert layer_class.from_pretrained(tmp_path / "model.safetensors").trained_on == layer.trained_on


def test_the_card_names_the_class_and_the_training_data(folder):
    card = folder / "README.md"
    for part in ("library_name: kornia_learnnorm", "`LearnedEightPoint`", "synthetic scenes"):
        assert part in card.read_text(encoding="utf-8")
    card.write_text("my own", encoding="utf-8")
    hub.HubModel.from_pretrained(folder).save_pretrained(folder)
    assert card.read_text(encoding="utf-8") == "my own"


@pytest.mark.parametrize("config", [None, {}, {"class_name": "Linear"}])
def test_a_folder_without_a_layer_of_this_package_is_refused(config, folder):
    (folder / "config.json").unlink()
    if config is not None:
        (folder / "config.json").write_text(json.dumps(config))
    raises(ValueError, r"config\.json of .*tiny .* LearnedEightPoint", hub.HubModel.from_pretrained, folder)


def test_weights_of_another_class_or_none_and_other_modules_are_refused(folder):
    (folder / "config.json").write_text(json.dumps({"class_name": "LearnedNormalizer"}))
    raises(ValueError, r"LearnedNormalizer.* LearnedEightPoint", hub.HubModel.from_pretrained, folder)
    (folder / "model.safetensors").unlink()
    raises(FileNotFoundError, r"model\.safetensors", hub.HubModel.from_pretrained, folder)
    with pytest.raises(TypeError, match=r"LearnedEightPoint, LearnedRelativePose, .*, MatchRefiner, got EightPoint"):
        hub.HubModel(kln.EightPoint())
