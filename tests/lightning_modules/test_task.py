"""The task on samples and on sets of matches: a few steps of training on small data."""

import pytest
import torch
from safetensors.torch import load_file
from scenes import raises
from train_processes import make_data, make_trainer, normaliser_task

import kornia_learnnorm as kln
from kornia_learnnorm.data.synthetic.random_matches import random_matches, random_planes
from kornia_learnnorm.data.training_samples import SyntheticSamples, block_generator
from kornia_learnnorm.data.training_sets import RandomSets, SyntheticSets
from lightning_modules.callbacks import ExportWeights, WritePredictions
from lightning_modules.datamodule import EVALUATION_SEED, CorrespondenceDataModule
from lightning_modules.task import EstimatorTask, Median, SetLoss

SMALL = {"width": 16, "depth": 1, "stages": 2}
FASTER, STEADY = ({"optimizer": lambda params, lr=lr: torch.optim.AdamW(params, lr)} for lr in (1e-2, 5e-3))
TRANSFER = SetLoss(labelled=kln.LogEpipolarLoss(residual=kln.transfer_distance))
OF_SETS = {  # estimators, and how they are trained on sets of matches
    "layer": lambda: (kln.LearnedEightPoint(**SMALL), {}),
    "normaliser": lambda: (kln.EightPoint(kln.LearnedNormalizer(kln.Hartley(), kln.CrossViewNetwork(16, 1))), STEADY),
    "pose": lambda: (kln.LearnedRelativePose(**SMALL, samples=4), {"loss": SetLoss(pose_weight=0.5), **FASTER}),
    "homography": lambda: (kln.LearnedHomography(**SMALL), {"loss": TRANSFER, **FASTER}),
}
STEPS = [("layer", True, 40, 0.05), ("layer", False, 100, 0.01), ("normaliser", True, 120, 0.02)]
STEPS += [("pose", True, 180, 0.1), ("homography", True, 60, 0.05)]  # and the least decrease of the loss


def set_task(kind="layer"):
    torch.manual_seed(0)
    estimator, arguments = OF_SETS[kind]()
    return EstimatorTask(estimator, **arguments)


def make_sets(labels=True, matches=random_matches, **arguments):
    source = SyntheticSets(32, matches, labels)
    sets = RandomSets([source], **{"sizes": (16, 64), "correspondences": 512, "batches": 20, **arguments})
    return CorrespondenceDataModule(sets, sets, batch_size=None)


@pytest.mark.parametrize("precision", ["32-true", "bf16-mixed"])
def test_samples_lower_the_loss(tmp_path, precision):
    """In bfloat16 the network, not the solver: the loss falls as in float32, and matrices are float64."""
    task, data = normaliser_task(optimizer=lambda params: torch.optim.AdamW(params, lr=2e-2, fused=True)), make_data()
    batch = SyntheticSamples(number=1000).draw(99, 0)
    before, seen = task.compute_loss(batch).item(), []
    network = task.trained.network
    network.set_network.head.register_forward_hook(lambda m, a, out: seen.append(out.dtype))
    network.register_forward_hook(lambda m, a, out: seen.append(out[0].dtype))
    options = {"enable_checkpointing": False, "gradient_clip_val": 1.0}  # with a fused optimiser, as configurations do
    make_trainer(tmp_path, max_steps=80, precision=precision, **options).fit(task, data)
    assert set(seen[::2]) == {torch.bfloat16 if precision == "bf16-mixed" else torch.float32}
    assert set(seen[1::2]) == {torch.float64}
    assert all(p.dtype == torch.float32 and p.isfinite().all() for p in task.parameters())
    assert task.compute_loss(batch).item() < before - 0.02


@pytest.mark.parametrize(("kind", "labels", "steps", "least"), STEPS)
def test_sets_lower_the_loss(kind, labels, steps, least, tmp_path):
    matches = random_planes if kind == "homography" else random_matches
    task, data = set_task(kind), make_sets(labels, matches)
    batch = SyntheticSets(32, matches, labels).draw(512, 32, block_generator(9))
    before = task.compute_loss(batch).item()
    options = {"enable_checkpointing": False, "gradient_clip_val": 1.0, "limit_val_batches": 4}
    (trainer := make_trainer(tmp_path, max_steps=steps, **options)).fit(task, data)
    assert task.compute_loss(batch).item() < before - least
    assert {"val/median_32", "val/median_256"} <= {*trainer.callback_metrics}


def test_what_cannot_be_trained_on(tmp_path):
    raises(ValueError, "sample_gradient must be positive or None, got -1", normaliser_task, sample_gradient=-1)
    sets = SyntheticSets(8).draw(4, 20, block_generator(1))
    without = sets._replace(heldout1=sets.heldout1[:, :0], heldout2=sets.heldout2[:, :0])
    raises(ValueError, "SetLoss needs held-out correspondences, got none", set_task().validation_step, without, 0)
    sets.K1[1] = torch.nan
    assert [set_task(kind)._finite(sets)[1] for kind in ("layer", "pose")] == [0, 1]
    (median := Median()).update(torch.zeros(0))  # all sets left out
    assert median.compute().isnan()
    for layer, kind in ((kln.Hartley(), "LearnedLayer"), (kln.EightPoint(), "LearnedNormalizer")):
        raises(TypeError, f"expected a {kind} .*, got Hartley", EstimatorTask, layer)
    endless = make_trainer(tmp_path, max_steps=-1, max_time="00:00:01:00", limit_val_batches=0)
    raises(ValueError, r"give trainer.max_steps or trainer.max_epochs", endless.fit, set_task(), make_sets())
    empty = make_trainer(tmp_path, [ExportWeights()], max_steps=3, limit_train_batches=0)
    raises(ValueError, "ended before its first step", empty.fit, normaliser_task(), make_data())
    assert not (tmp_path / "weights.safetensors").exists()


def test_betas_of_your_own_stay(tmp_path):
    for betas, expected in [((0.9, 0.99), 0.95), ((0.5, 0.99), 0.5)]:
        task = normaliser_task(optimizer=lambda params, betas=betas: torch.optim.AdamW(params, 1e-3, betas))
        options = {"max_steps": 40, "limit_val_batches": 0, "enable_checkpointing": False}
        (trainer := make_trainer(tmp_path, **options)).fit(task, make_data())
        assert trainer.optimizers[0].param_groups[0]["betas"][0] == pytest.approx(expected, abs=1e-3)


def test_predictions_of_homographies_have_their_own_distance():
    sets = SyntheticSets(8, random_planes).draw(2, 20, block_generator(0))
    found = set_task("homography").eval().predict_step(sets, 0)
    distance = kln.transfer_distance(sets.points1.double(), sets.points2.double(), found["F_mat"])
    torch.testing.assert_close(found["residual"], distance.mean(-1))


def test_pose_loss_counts_sets_with_cameras_alone():
    sets = SyntheticSets(8).draw(4, 20, block_generator(1))
    unknown = torch.full_like(sets.E_mat, torch.nan)
    sets = sets._replace(E_mat=torch.where(torch.arange(4)[:, None, None] < 2, sets.E_mat, unknown))
    F_mat = torch.rand(4, 3, 3, dtype=torch.float64, requires_grad=True)
    both, pixels = (SetLoss(pose_weight=weight)(sets, F_mat, None) for weight in (0.5, 0.0))
    assert torch.equal(both[2:], pixels[2:])
    assert (both != pixels)[:2].all()
    assert torch.autograd.grad(both.sum(), F_mat)[0].isfinite().all()
    raises(ValueError, r"pose_weight must be in \[0, 1\], got 2", SetLoss, pose_weight=2)


def test_a_loss_leaves_the_estimator_as_it_was():
    task, batch = set_task(), SyntheticSets(8).draw(4, 20, block_generator(1))
    task.compute_loss(batch)
    raises(ValueError, "must be finite", task.compute_loss, batch._replace(points1=batch.points1 * torch.nan))
    assert not task.estimator.detach_stages
    assert not any(network._forward_hooks for network in task.estimator.networks)


def test_sample_gradients_are_limited():
    batch, norms = next(iter(make_data().train_dataloader())), {}
    for limit in (None, 0.1):
        task, kept = normaliser_task(sample_gradient=limit), []
        task.trained.network.set_network.register_forward_hook(lambda m, a, out, kept=kept: kept.append(out))
        (gradient,) = torch.autograd.grad(task.compute_loss(batch), kept[0])
        norms[limit] = gradient.norm(dim=-1)
    most = 0.1 / len(batch.pair) * (1 + 1e-5)  # per sample and view
    assert norms[None].max() > most
    assert norms[0.1].max() <= most
    small = norms[None] < 0.99 * most
    torch.testing.assert_close(norms[0.1][small], norms[None][small])


def test_metrics_of_an_untrained_network_are_whitening_s(tmp_path):
    task, data = normaliser_task(), make_data()
    (got,) = make_trainer(tmp_path, enable_checkpointing=False).test(task, data, verbose=False)
    x1, x2 = (p.double() for p in data.test.draw(EVALUATION_SEED, 0)[:2])
    F_mats = (kln.find_fundamental(x1, x2, normalizer=n) for n in (kln.Hartley(), kln.Whitening()))
    hartley, whitening = (kln.symmetric_epipolar_distance(x1, x2, F_mat).mean(-1) for F_mat in F_mats)
    assert got["test/better_than_hartley"] == pytest.approx((whitening < hartley).double().mean().item(), abs=1e-6)
    assert got["test/better_than_whitening"] == 0
    assert got["test/log_sed"] == pytest.approx((whitening + 1e-3).log().mean().item(), abs=1e-5)


@pytest.mark.parametrize("make", [normaliser_task, set_task])
def test_export_and_predictions(make, tmp_path):
    task, data = make(), make_data()
    trainer = make_trainer(tmp_path, [ExportWeights(), WritePredictions()], max_steps=3, enable_checkpointing=False)
    trainer.fit(task, data)
    exported = type(task.trained).from_pretrained(tmp_path / "weights.safetensors")
    assert exported.trained_on == ("synthetic scenes",)
    torch.testing.assert_close(exported.state_dict(), task.trained.state_dict(), rtol=0, atol=0)
    layer = kln.EightPoint(exported) if make is normaliser_task else exported
    trainer.predict(task, data)
    written = load_file(tmp_path / "predictions.safetensors")
    assert ("T1" in written) == (make is normaliser_task)
    samples = data.test.draw(EVALUATION_SEED, 0)
    assert torch.equal(written["pair"], samples.pair)
    for batch in data.test_dataloader():  # as in the run: rounding in the network depends on it
        rows = torch.isin(samples.pair, batch.pair)
        x1, x2 = samples.points1[rows].double(), samples.points2[rows].double()
        F_mat = layer(x1, x2)
        torch.testing.assert_close(written["F_mat"][rows], F_mat)
        residual = kln.symmetric_epipolar_distance(x1, x2, F_mat).mean(-1)
        torch.testing.assert_close(written["residual"][rows], residual)


def test_heldout_loss_and_epoch_schedule(tmp_path):
    task = normaliser_task(
        loss=kln.EpipolarLoss(heldout_weight=0.5),
        optimizer=lambda params: torch.optim.Adamax(params, lr=1e-3),
        lr_scheduler=lambda optimizer: torch.optim.lr_scheduler.StepLR(optimizer, 1, 0.8),
    )
    trainer = make_trainer(tmp_path, max_steps=20, enable_checkpointing=False)
    trainer.fit(task, make_data())
    epochs = 20 // trainer.num_training_batches
    assert trainer.optimizers[0].param_groups[0]["lr"] == pytest.approx(1e-3 * 0.8**epochs)


@pytest.mark.parametrize("steps", [1, 2])
def test_every_number_of_steps_has_a_schedule(tmp_path, steps):
    trainer = make_trainer(tmp_path, max_steps=steps, limit_val_batches=0, enable_checkpointing=False)
    trainer.fit(set_task(), make_sets(correspondences=32))
    assert trainer.global_step == steps
