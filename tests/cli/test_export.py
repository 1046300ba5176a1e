"""The command that writes layers as programs, from the command line's words on."""

from __future__ import annotations

import sys

import pytest
import torch
from scenes import correspondences, shaken, up_to_sign

from kornia_learnnorm import EightPoint, Hartley, LearnedNormalizer, PaperNetwork
from kornia_learnnorm.cli.main import main


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    path = tmp_path_factory.mktemp("weights") / "own.safetensors"
    shaken(LearnedNormalizer(Hartley(), PaperNetwork(8, 2, num_parameters=5))).save_pretrained(path)
    return path


def test_program_of_a_file_of_weights(weights, tmp_path, capsys):
    out = tmp_path / "eight.pt2"
    words = ["export", str(weights), "--format", "pt2", "--out", str(out), "--points", "8", "--inputs", "mask"]
    assert main(words) == 0
    assert capsys.readouterr().out == f"wrote {out}: {out.stat().st_size / 1e6:.1f} MB\n"
    assert [*tmp_path.iterdir()] == [out]
    points, mask = [p.float() for p in correspondences("handheld", 3)], torch.ones(3, 8, dtype=torch.bool)
    F_mat, determined = torch.export.load(out).module()(*points, mask=mask)
    assert determined.all()
    expected = EightPoint(LearnedNormalizer.from_pretrained(weights))(*points)
    assert up_to_sign(F_mat, expected.detach()) < 1e-6


def test_network_as_onnx(weights, tmp_path, capsys):
    for name in ("onnxscript", "onnxruntime"):
        pytest.importorskip(name, reason=f"{name} is not installed")
    import onnxruntime

    out = tmp_path / "own.onnx"
    assert main(["export", str(weights), "--format", "onnx", "--out", str(out)]) == 0
    assert capsys.readouterr().out.startswith(f"wrote {out}: ")
    session = onnxruntime.InferenceSession(out, providers=["CPUExecutionProvider"])
    example = {value.name: torch.randn(5, 12, 2) for value in session.get_inputs()}
    assert [*example] == ["points1", "points2"]
    with torch.no_grad():
        expected = LearnedNormalizer.from_pretrained(weights).network(**example)
    found = session.run(None, {name: value.numpy() for name, value in example.items()})
    for got, value in zip(found, expected, strict=True):
        torch.testing.assert_close(torch.from_numpy(got), value, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["rubust", "--format", "pt2", "--out", "a.pt2"], "no weights 'rubust': expected a .safetensors file or one"),
        (["robust", "--format", "pt2", "--out", "a.onnx"], "--format pt2 is written to a .pt2 file, got 'a.onnx'"),
        (["robust", "--format", "onnx", "--out", "a.onnx", "--points", "8"], "--points belong to --format pt2"),
        (["crossview", "--format", "pt2", "--out", "a.pt2", "--inputs", "scores"], "are weights, mask, got scores"),
        (["robust", "--format", "pt2", "--out", "a.pt2", "--points", "7"], "num_points must be at least 8, got 7"),
        (["robust", "--format", "pt2", "--out", "none/a.pt2"], "the folder none does not exist"),
    ],
)
def test_what_cannot_be_written(words, message, refused, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    refused(["export", *words], message)
    assert [*tmp_path.iterdir()] == []


def test_a_missing_package_names_its_extra(refused, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnx", None)
    words = ["export", "paper", "--format", "onnx", "--out", tmp_path / "a.onnx"]
    refused(words, "run pip install '.[onnx]' in a checkout")
