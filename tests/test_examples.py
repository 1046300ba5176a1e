"""The scripts in examples/, cut short: they run, what they train gets better."""

import asyncio
import importlib
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest
import torch

import kornia_learnnorm as kln
from kornia_learnnorm.data.synthetic import orbit
from kornia_learnnorm.data.synthetic.random_matches import random_matches
from kornia_learnnorm.data.synthetic.render import render_pair, write_pair

EXAMPLES = Path(__file__).parents[1] / "examples"


@pytest.fixture
def example(monkeypatch):
    """Import an example as when it is run: its folder is on the path."""
    monkeypatch.syspath_prepend(EXAMPLES)
    return importlib.import_module


@pytest.mark.parametrize(("name", "steps", "gain"), [("predict_weights", 64, 0.3), ("guided_sampling", 20, 0.5)])
def test_learns_from_synthetic_pairs(name, steps, gain, example, monkeypatch):
    monkeypatch.delenv("LEARNNORM_DATA", raising=False)
    before, after = example(name).main(["--steps", str(steps), "--points", "128"])
    assert after < gain * before


def test_runs_on_real_pairs(example, real_data):
    before, after = example("predict_weights").main(["--steps", "2", "--points", "64", "--pairs", "2"])
    assert 0 < min(before, after) <= max(before, after) < 10


def test_kornia_ransac_example(example, monkeypatch):
    monkeypatch.delenv("LEARNNORM_DATA", raising=False)
    results = example("kornia_ransac").main(["--samples", "100", "--pairs", "2"])
    assert len(results) == 7
    assert all(f1 > 50 and error < 3 for f1, error in results.values())


def test_weights_of_matches_learn_which_are_coarse_without_labels(example, monkeypatch):
    """Half of the matches have noise of 2 px and descriptors of their own."""
    module = example("finetune_lightglue")
    monkeypatch.setattr(module, "HALF", 64)
    generator = torch.Generator().manual_seed(0)
    scene = orbit(3, 160, generator, noise=0.1)
    coarse = torch.rand(3, 160, generator=generator) < 0.5
    points = torch.cat([scene.points1, scene.points2], -1).double()
    points += 2 * coarse[..., None] * torch.randn(3, 160, 4, generator=generator)
    descriptors = torch.where(coarse, 1.0, -1.0)[:, None, :, None].expand(3, 2, 160, 96)
    pairs = [module.Pair(*fields) for fields in zip(points, torch.full((3, 160), 0.5), descriptors, strict=True)]
    layer, weigh = kln.LearnedEightPoint.from_pretrained(), module.MatchWeights()
    assert torch.equal(weigh(pairs[0]), torch.ones(160, dtype=torch.float64))
    before = module.held_out_loss(layer, weigh, pairs)
    module.train(layer, weigh, pairs, steps=12, batch=1)
    assert module.held_out_loss(layer, weigh, pairs) < before - 0.02
    weights = weigh(pairs[0])
    assert weights[coarse[0]].mean() < 0.9 < 1.1 < weights[~coarse[0]].mean()


def test_folders_of_images_are_trained_on(example, cached_weights, tmp_path):
    cached_weights("xfeat.pt", "xfeat-lighterglue.pt")
    write_pair(tmp_path, render_pair(0, width=240, height=180))
    before, after = example("finetune_lightglue").main([str(tmp_path), "--steps", "0"])
    assert before == after


def test_one_line_changes_nothing_but_the_solver(example):
    errors = example("one_line").main(["--scenes", "300"])
    kornia, same, whitening, learned = errors.values()
    assert same == pytest.approx(kornia, rel=1e-3)
    assert learned < whitening < kornia


def test_the_page_of_a_hosted_space_is_built(example):
    pytest.importorskip("gradio", reason="Gradio is not installed")

    async def build():  # outside of a running loop, Gradio leaves loops open
        return example("app").app

    labels = [block["props"].get("label") for block in asyncio.run(build()).get_config_file()["components"]]
    assert {"Detector", "Matcher", "Model", "Threshold, px", "Cameras"} <= {*labels}


@pytest.fixture
def gluefactory(monkeypatch):
    """What the example needs of glue-factory: a base class that merges and keeps the options, and poses."""

    class BaseEstimator:
        def __init__(self, conf):
            options = SimpleNamespace(**{**self.default_conf["options"], **conf.pop("options", {})})
            self.conf = SimpleNamespace(**{**self.default_conf, **conf, "options": options})
            self._init(self.conf)

        def __call__(self, data):
            return self._forward(data)

    class Pose(SimpleNamespace):
        from_Rt = classmethod(lambda cls, R, t: cls(R=R, t=t))  # noqa: N815
        from_4x4mat = classmethod(lambda cls, T: cls(R=T[:3, :3], t=T[:3, 3]))

        def to(self, other):
            return Pose(R=self.R.to(other), t=self.t.to(other))

    for name in ("gluefactory", "gluefactory.geometry", "gluefactory.robust_estimators"):
        monkeypatch.setitem(sys.modules, name, ModuleType(name))
    monkeypatch.setitem(sys.modules, "gluefactory.geometry.wrappers", SimpleNamespace(Pose=Pose))
    base = SimpleNamespace(BaseEstimator=BaseEstimator)
    monkeypatch.setitem(sys.modules, "gluefactory.robust_estimators.base_estimator", base)


@pytest.mark.parametrize("weights", [None, "robust-pose"])
def test_estimator_of_gluefactory(example, gluefactory, weights):
    module = example("gluefactory_estimator")
    (estimator,) = (c for c in vars(module).values() if isinstance(c, type) and c.__module__ == module.__name__)
    drawn = random_matches(1, 300, 20, torch.Generator().manual_seed(3))
    cameras = [SimpleNamespace(calibration_matrix=lambda K=K: K[0].float()) for K in (drawn.K1, drawn.K2)]
    values = drawn.points1[0].float(), drawn.points2[0].float(), *cameras
    data = dict(zip(estimator.required_data_keys, values, strict=True))
    found = estimator({"name": "learnnorm", "ransac_th": 1.5, "options": {"weights": weights}})(data)
    assert found["success"]
    R, t = found["M_0to1"].R, found["M_0to1"].t
    E_mat = torch.linalg.cross(t[:, None], R, dim=0).double()
    cosine = (E_mat / E_mat.norm() * drawn.E_mat[0]).sum().abs()
    assert (R.dtype, cosine) == (torch.float32, pytest.approx(1, abs=1e-3))
    assert (found["inliers"] == (drawn.inliers[0] > 0)).double().mean() > 0.85

    few = estimator({})({**data, "m_kpts0": data["m_kpts0"][:5], "m_kpts1": data["m_kpts1"][:5]})
    assert (few["success"], few["inliers"].tolist()) == (False, [False] * 5)
    assert torch.equal(few["M_0to1"].R, torch.eye(3))
