"""A network and a loss of one's own, as docs/own-modules.md has them: trained, saved, loaded and evaluated."""

import json
import re
import shutil
import sys
from pathlib import Path

import pytest
import torch
from scenes import correspondences, raises, rewrite_weights

import kornia_learnnorm as kln
from kornia_learnnorm.cli.main import main
from kornia_learnnorm.data.store_writer import write_store
from kornia_learnnorm.data.synthetic.scenes import synthetic_store
from kornia_learnnorm.layer_export import load_layer

PAGE = Path(__file__).parents[2] / "docs/own-modules.md"
SMALL = ["--trainer.max_steps=20", "--trainer.enable_progress_bar=false", "--trainer.default_root_dir=run"]
SMALL += [f"--data.{stage}.init_args.number=512" for stage in ("train", "val")]
NETWORK = "--model.estimator.init_args.normalizer.init_args.network"
BROKEN = """
from own_modules import *
class Forgets(PointNetwork):
    def __init__(self, width: int = 8):
        super().__init__(width)
        del self.width
class Listed(PointNetwork):
    def __init__(self, width: int = 8, sizes: list[int] = [1]):
        super().__init__(width)
        self.sizes = sizes
class Constant(PointNetwork):
    def __init__(self):
        super().__init__()
        self.register_buffer("grid", torch.ones(2), persistent=False)
class Single(PointNetwork):
    def forward(self, points1, points2, weights=None):
        return self.view(points1, points2, weights)
class Held(MedianLoss):
    def forward(self, points1, points2, F_mat, *heldout):
        return F_mat.sum() * heldout[0].mean()
class Hidden(PointNetwork):
    def __init__(self):
        super().__init__()
        self.hidden = torch.ones(2)
    def forward(self, points1, points2, weights=None):
        return [params * self.hidden[:1] for params in super().forward(points1, points2, weights)]
class Detached(PointNetwork):
    def forward(self, *values):
        return [params.detach() for params in super().forward(*values)]
class Flat(PointNetwork):
    def forward(self, *values):
        return [params[0] for params in super().forward(*values)]
class Broken(MedianLoss):
    def forward(self, *points):
        return super().forward(*points) * (torch.nan if len(points[0]) > 2 else 1.0)
class ThreeSets(MedianLoss):
    def forward(self, *points):
        return super().forward(*points)[:3]
def make(width: int = 8) -> PointNetwork:
    class Local(PointNetwork):
        pass
    return Local(width)
"""


@pytest.fixture(scope="module")
def run(program, tmp_path_factory):
    """A folder with the page's module and the weights that were trained with it."""
    folder = tmp_path_factory.mktemp("own")
    (folder / "own_modules.py").write_text(re.search(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)[1])
    (folder / "broken_modules.py").write_text(BROKEN)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        assert main(["fit", "--config", "own", *SMALL]) == 0
        yield folder
    for name in ("own_modules", "broken_modules"):
        sys.modules.pop(name, None)


@pytest.fixture
def weights(run, monkeypatch):
    monkeypatch.chdir(run)
    return Path("run/weights.safetensors")


def test_weights_come_back_where_the_module_is_trusted(weights):
    points = correspondences("driving", 2, 9)
    normalizer = kln.LearnedNormalizer.from_pretrained(weights, own_modules=["own_modules"])
    assert type(normalizer.network).__module__ == "own_modules"
    assert normalizer.trained_on == ("synthetic scenes",)
    for T, base in zip(normalizer(*points), kln.Hartley()(*points), strict=True):
        assert T.isfinite().all()
        assert not torch.isclose(T, base, rtol=1e-6).all()


def test_nothing_is_imported_without_trust(weights, monkeypatch):
    monkeypatch.delitem(sys.modules, "own_modules")
    message = r"own_modules\.PointNetwork is not of this package.*own_modules=\['own_modules'"
    raises(ValueError, message, kln.LearnedNormalizer.from_pretrained, weights)
    for trusted in (["os"], "my_own_modules"):
        with pytest.raises(ValueError, match="is not of this package"):
            kln.LearnedNormalizer.from_pretrained(weights, own_modules=trusted)
    assert "own_modules" not in sys.modules


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("own_modules.nn", "is not a class or function that own_modules defines"),
        ("own_modules.Missing", "cannot be imported: AttributeError"),
        ("gone_modules.Network", "cannot be imported: ModuleNotFoundError"),
    ],
)
def test_a_trusted_module_gives_only_what_it_defines(name, message, weights, tmp_path):
    def rename(_, metadata):
        architecture = json.loads(metadata["architecture"])
        metadata["architecture"] = json.dumps(architecture | {"network": architecture["network"] | {"name": name}})

    rewrite_weights(shutil.copy(weights, tmp_path), rename)
    with pytest.raises(ValueError, match=message):
        kln.LearnedNormalizer.from_pretrained(tmp_path / weights.name, own_modules=["own_modules", "gone_modules"])


def test_evaluate_shows_them(weights, capsys, refused):
    write_store("s.h5", synthetic_store(pairs=2, points=80))
    name = f"own_modules:{weights}"
    assert main(["evaluate", "s.h5", "--methods", "Hartley", "--weights", name, f"{name}+LM"]) == 0
    out = capsys.readouterr().out
    assert out.count("| run ") == out.count("| run+LM ") == 2
    assert type(load_layer(name).normalizer.network).__module__ == "own_modules"
    refused(["evaluate", "s.h5", "--methods", "Hartley", weights], "own_modules.PointNetwork is not of this package")


def test_what_cannot_be_saved_is_refused_before_the_first_step(run, tmp_path, monkeypatch, refused):
    monkeypatch.chdir(run)
    for network, message in [
        ("broken_modules.Forgets", "must keep 'width' as an attribute"),
        ("broken_modules.Listed", "sizes is [1], not a number or a text"),
        ("broken_modules.Constant", "a tensor that state_dict does not hold"),
        ("broken_modules.make", "cannot be imported by its name"),
        ("broken_modules.Hidden", "expected device cpu!: register its tensors as buffers"),
        ("broken_modules.Detached", "the network sends no gradient"),
        ("gone_modules.Network", "No module named 'gone_modules'"),
    ]:
        options = [*SMALL, f"--trainer.default_root_dir={tmp_path}", f"{NETWORK}={network}"]
        refused(["fit", "--config", "own", *options], message)
        assert not [*tmp_path.rglob("*.safetensors"), *tmp_path.rglob("*.ckpt")]


@pytest.mark.filterwarnings("ignore:a step was skipped")
def test_what_fails_in_training_is_named(run, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(run)
    for option, message in [
        (f"{NETWORK}=broken_modules.Single", "must return (params1, params2), got <class 'torch.Tensor'>"),
        ("--model.loss=broken_modules.Held", "ValueError: the loss is NaN: does it need held-out points, num_heldout"),
        (f"{NETWORK}=broken_modules.Flat", "params1 and params2 must have shape (B, P), got [[5], [5]]"),
        ("--model.loss=broken_modules.Broken", "20 steps in a row were skipped: no samples, or no finite gradient"),
        ("--model.loss=broken_modules.ThreeSets", "sets, got [3]"),
    ]:
        assert main(["fit", "--config", "own", *SMALL, f"--trainer.default_root_dir={tmp_path}", option]) == 2
        assert message in capsys.readouterr().err
