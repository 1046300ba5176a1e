"""Files from strangers: nothing in them is run, and a small one takes no large memory. Each is built here."""

import json
import pickle
import re
import struct
import zipfile
import zlib
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from scenes import raises

import kornia_learnnorm as kln
from kornia_learnnorm.cli.main import main
from kornia_learnnorm.data.images import image_size, read_image
from kornia_learnnorm.evaluation.runs.results_store import read_arrays

ROOT = Path(__file__).parent.parent


class Touches:
    """Unpickled, it makes a file."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


@pytest.fixture
def made(tmp_path):
    path = tmp_path / "made"
    pickle.loads(pickle.dumps(Touches(path)))
    assert path.exists()
    path.unlink()
    yield path
    assert not path.exists()


class TestCheckpoints:
    @pytest.fixture
    def last(self, trained):
        return trained[0] / "checkpoints/last.ckpt"

    @pytest.fixture
    def rejected(self, trained, refused):

        def check(path, command="fit"):
            message = f"{path} is not a checkpoint of a training run"
            refused([command, *trained[1], f"--ckpt_path={path}"], message)

        return check

    def test_code_is_not_run(self, last, made, tmp_path, rejected):
        torch.save(torch.load(last, weights_only=True) | {"callbacks": Touches(made)}, tmp_path / "forged.ckpt")
        for command in ("fit", "predict"):
            rejected(tmp_path / "forged.ckpt", command)
        (tmp_path / "plain.ckpt").write_bytes(pickle.dumps(Touches(made)))
        rejected(tmp_path / "plain.ckpt")

    def test_a_checkpoint_configures_nothing(self, trained, last, made, tmp_path):
        """Lightning's command takes the model's arguments from a checkpoint, and they can name classes."""
        forged = {"normalizer": {"class_path": "subprocess.Popen", "init_args": {"args": ["touch", str(made)]}}}
        torch.save(torch.load(last, weights_only=True) | {"hyper_parameters": forged}, tmp_path / "forged.ckpt")
        assert main(["validate", *trained[1], f"--ckpt_path={tmp_path / 'forged.ckpt'}"]) == 0

    def test_broken(self, last, tmp_path, rejected):
        path = tmp_path / "broken.ckpt"
        path.write_bytes(last.read_bytes()[:-50])
        rejected(path)
        for content in ([1], {"state_dict": {"a": "b"}}):
            torch.save(content, path)
            rejected(path)

    def test_bomb(self, tmp_path, rejected):
        """A compressed checkpoint, which PyTorch would unfold."""
        path = tmp_path / "bomb.ckpt"
        torch.save({"state_dict": {"a": torch.zeros(10**7)}}, tmp_path / "stored.ckpt")
        with zipfile.ZipFile(tmp_path / "stored.ckpt") as stored, zipfile.ZipFile(path, "w", 8) as packed:
            for entry in stored.infolist():
                packed.writestr(entry.filename, stored.read(entry))
        assert path.stat().st_size < 10**5
        rejected(path)


class TestWeights:
    def test_forged_headers(self, tmp_path):
        for content in [
            struct.pack("<Q", 2**63) + b"{}",
            struct.pack("<Q", 58) + b'{"a":{"dtype":"F32","shape":[9],"data_offsets":[0,99999]}}',
            struct.pack("<Q", 64) + b'{"a":{"dtype":"F32","shape":[4294967296,4294967296],"data_offsets'[:64],
            pickle.dumps(Touches(Path("/nowhere"))),
        ]:
            (tmp_path / "forged.safetensors").write_bytes(content)
            with pytest.raises(ValueError, match=r"forged\.safetensors.* is not a safetensors file"):
                kln.LearnedNormalizer.from_pretrained(tmp_path / "forged.safetensors")

    def test_an_architecture_takes_no_memory_of_its_own(self, tmp_path):
        for numbers, message in [
            ({"width": 10**6, "depth": 4}, "numbers can be at most 4096, got 1000000"),
            ({"width": 8, "depth": 10**9}, "numbers can be at most 4096, got 1000000000"),
            ({"width": 4096, "depth": 100}, "the tensors do not fit the architecture"),  # 20 GB of weights
            ({"width": -1, "depth": 1}, "describes no normaliser of this version"),
        ]:
            architecture = {"base": {"name": "Whitening", "floor": 1e-6}, "transform": "spd_transform"}
            architecture["network"] = {"name": "CrossViewNetwork", **numbers}
            metadata = {"format": "kornia_learnnorm.normalizer.v1", "architecture": json.dumps(architecture)}
            save_file({"network.set_network.head.2.bias": torch.zeros(5)}, tmp_path / "forged.safetensors", metadata)
            raises(ValueError, message, kln.LearnedNormalizer.from_pretrained, tmp_path / "forged.safetensors")


@pytest.mark.parametrize("size", [2**31 - 1, 14_000])
def test_pixels_that_an_image_declares(tmp_path, size):
    def chunk(name, data):
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    path, header = tmp_path / "large.png", struct.pack(">IIBBBBB", size, size, 8, 0, 0, 0, 0)
    parts = [(b"IHDR", header), (b"IDAT", zlib.compress(bytes(1000))), (b"IEND", b"")]
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(chunk(*part) for part in parts))
    raises(ValueError, r"large\.png .* exceeds limit of 178956970 pixels", read_image, path)
    assert image_size(path) == (0, 0)


def test_no_pickle_in_arrays_is_read(made, tmp_path):
    np.savez(tmp_path / "forged.npz", plain_residual=np.array([Touches(made)], object))
    raises(ValueError, r"forged\.npz is damaged", read_arrays, tmp_path / "forged.npz")


def test_actions_are_pinned():
    """Should there be workflows, each action is named by the full hash of its commit."""
    for path in (ROOT / ".github").glob("**/*.y*ml"):
        for action in re.findall(r"uses:\s*(\S+)", path.read_text()):
            assert action.startswith("./") or re.search(r"@[0-9a-f]{40}$", action), (path, action)
