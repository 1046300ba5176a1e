"""The command that writes layers as programs, whose content ``tests/test_layer_export.py`` checks."""

from unittest.mock import Mock

import pytest
import torch

from kornia_learnnorm import EightPoint, LearnedEightPoint
from kornia_learnnorm.cli import export
from kornia_learnnorm.cli.main import main


def test_program(tmp_path, capsys, monkeypatch):
    program = torch.export.export(torch.nn.Identity(), (torch.ones(3),))
    monkeypatch.setattr(export, "export_layer", made := Mock(return_value=program))
    out = tmp_path / "eight.pt2"
    words = ["export", "crossview", "--format", "pt2", "--out", str(out), "--points", "8", "--inputs", "mask"]
    assert main(words) == 0
    layer, *options = made.call_args.args
    assert (type(layer), options) == (EightPoint, [["mask"], 8])
    assert capsys.readouterr().out == f"wrote {out}: {out.stat().st_size / 1e6:.1f} MB\n"
    assert [*tmp_path.iterdir()] == [out]
    assert torch.export.load(out).module()(torch.arange(3.0)).tolist() == [0, 1, 2]


@pytest.mark.parametrize("networks", [["network"], ["stage1", "stage2"]])
def test_networks_as_onnx(tmp_path, monkeypatch, networks):
    programs = {name: Mock(**{"model_proto.SerializeToString": lambda n=name: n.encode()}) for name in networks}
    monkeypatch.setattr(export, "export_networks", made := Mock(return_value=programs))
    assert main(["export", "robust-tiny", "--format", "onnx", "--out", str(tmp_path / "own.onnx")]) == 0
    assert isinstance(made.call_args.args[0], LearnedEightPoint)
    expected = {"own.onnx": "network"} if networks == ["network"] else {f"own-{name}.onnx": name for name in networks}
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == expected


def test_what_cannot_be_written(refused, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for words, message in [
        (["rubust", "--format", "pt2", "--out", "a.pt2"], "no weights 'rubust': expected a .safetensors file or one"),
        (["robust", "--format", "pt2", "--out", "a.onnx"], "--format pt2 is written to a .pt2 file, got 'a.onnx'"),
        (["robust", "--format", "onnx", "--out", "a.onnx", "--points", "8"], "--points belong to --format pt2"),
        (["crossview", "--format", "pt2", "--out", "a.pt2", "--inputs", "scores"], "are weights, mask, got scores"),
        (["robust", "--format", "pt2", "--out", "none/a.pt2"], "the folder none does not exist"),
    ]:
        refused(["export", *words], message)
        assert [*tmp_path.iterdir()] == []
