"""Refiners of matches: sets with images from stores, the loss, and a training on rendered pairs by the command line."""

import json
import shutil

import numpy as np
import pytest
import torch
from PIL import Image
from scenes import raises, seeded, store_of

import kornia_learnnorm as kln
from kornia_learnnorm.cli.main import main
from kornia_learnnorm.data.image_sets import ImageSets, find_images
from kornia_learnnorm.data.store_writer import write_store
from kornia_learnnorm.data.synthetic.render import render_pair
from kornia_learnnorm.data.training_sets import RandomSets, SyntheticSets
from lightning_modules.refiner_task import HeldOutLoss, RefinerTask, all_matches

pytestmark = pytest.mark.usefixtures("program")
WIDTH, HEIGHT = 200, 150
NOISE = 0.7  # pixels, standard deviation of each coordinate of the second points


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Images of two rendered pairs, and a store of their exact matches with noise, the second pair of other names."""
    pytest.importorskip("cv2")
    folder, rng, points, names, pairs = tmp_path_factory.mktemp("rendered"), np.random.default_rng(0), [], [], []
    for seed in range(2):
        pair = render_pair(seed, WIDTH, HEIGHT)
        for view in (1, 2):
            (folder / f"images/place{seed}").mkdir(parents=True, exist_ok=True)
            Image.fromarray(getattr(pair, f"image{view}")).save(folder / f"images/place{seed}/s{seed}v{view}.png")
        rows = rng.permutation(len(pair.points1))[:200]
        noise = rng.normal(0, NOISE, (len(rows), 2))
        points.append([pair.points1[rows], pair.points2[rows] + noise])
        names.append([f"place{seed}/s{seed}v1.png", "elsewhere/s1v2.extra.jpg" if seed else "place0/s0v2.png"])
        pairs.append(pair)
    offsets = np.cumsum([0, *(len(views[0]) for views in points)])
    known = {"F": "F_mat", "R": "R", "t": "t"}
    known = {name: np.stack([getattr(pair, field) for pair in pairs]) for name, field in known.items()}
    known["K"] = np.stack([np.stack([pair.K] * 2) for pair in pairs])
    points1, points2 = (np.concatenate([views[k] for views in points]) for k in range(2))
    store = store_of(points1, points2, offsets, [*map(tuple, names)], (WIDTH, HEIGHT), **known)
    write_store(folder / "matches.h5", store)
    return folder


def source(folder, part="", **options):
    return ImageSets([f"{folder}/matches.h5{part}"], [f"{folder}/images"], **options)


def true_distance(sets, points1, points2):
    F_mat = torch.linalg.inv(sets.K2).mT @ sets.E_mat @ torch.linalg.inv(sets.K1)
    return kln.symmetric_epipolar_distance(points1.double(), points2.double(), F_mat.double())


@pytest.mark.parametrize("seed", range(6))
def test_images_matches_and_cameras_are_mapped_alike(folder, seed):
    sets = source(folder, jitter=0.0).draw(3, 40, seeded(seed))
    assert sets.points1.shape == sets.heldout2.shape == (3, 40, 2)
    assert sets.image1.dtype == torch.uint8
    assert true_distance(sets, *all_matches(sets)).median() < 4 * NOISE
    views = zip((sets.image1, sets.image2), (sets.points1, sets.points2), strict=True)
    patches = [kln.MatchRefiner(5)._normalized_patches(*view, torch.eye(2).expand(3, 40, 2, 2))[0] for view in views]
    assert (patches[0] * patches[1]).mean(1).median() > 0.3
    rows = torch.cat([sets.points1, sets.heldout1], 1)[0]
    assert len(torch.unique(rows, dim=0)) == len(rows)  # the halves share no match


def test_draws(folder):
    given = source(folder, symmetries=False)
    first, second, other = (given.draw(2, 30, seeded(seed)) for seed in (0, 0, 1))
    assert all(a is b or torch.equal(a, b) for a, b in zip(first, second, strict=True))
    assert not torch.equal(first.points1, other.points1)
    assert first.image1.shape == (2, 1, HEIGHT, WIDTH)
    assert given.draw(1, 10_000, seeded()).points1.shape == (1, 100, 2)


def test_images_of_stores(folder, tmp_path):
    find = find_images([f"{folder}/images"])
    assert find("place0/s0v1.png", (WIDTH, HEIGHT)) == folder / "images/place0/s0v1.png"
    assert find("x/s0v1._c.jpg", (WIDTH // 2, HEIGHT // 2)) == folder / "images/place0/s0v1.png"
    assert find("x/s0v1.png", (HEIGHT, WIDTH)) is find("x/s0v1.5.png", (WIDTH, HEIGHT)) is None
    assert find("none.png", (WIDTH, HEIGHT)) is None
    assert source(folder).left_out == 0
    assert ImageSets([f"{folder}/matches.h5"], [f"{folder}/images/place1"]).left_out == 1
    raises(ValueError, "none of 2 pairs", ImageSets, [f"{folder}/matches.h5"], [str(tmp_path)])
    raises(FileNotFoundError, "no folder of images at", ImageSets, [f"{folder}/matches.h5"], [f"{folder}/none"])
    raises(ValueError, "jitter must be", source, folder, jitter=-1.0)
    shutil.copytree(folder / "images/place0", tmp_path / "copies/place0")
    find = find_images([f"{folder}/images", f"{folder}/images/place0", f"{tmp_path}/copies"])
    assert find("x/s0v1.png", (WIDTH, HEIGHT)) is None  # one of two
    assert find("x/s1v1.png", (WIDTH, HEIGHT)) == folder / "images/place1/s1v1.png"


@pytest.mark.parametrize("kind", ["learned", "eight-point", "RANSAC"])
def test_the_loss_is_that_of_the_other_half(folder, kind):
    sets = source(folder).draw(2, 32, seeded())
    points = all_matches(sets)
    moved = kln.MatchRefiner()(sets.image1, sets.image2, *points)
    estimator = kln.LearnedEightPoint.from_pretrained("robust-tiny") if kind == "learned" else kln.EightPoint()
    if kind == "RANSAC":
        estimator = kln.RANSAC(inl_th=3.0, seed=0)
    loss = HeldOutLoss(estimator, scale_weight=0.5)(sets, moved)
    expected = torch.zeros(2).double()
    halves = [[p[:, :32].double() for p in points], [p[:, 32:].double() for p in points]]
    for fit, test in (halves, halves[::-1]):
        pairs = zip(*fit, strict=True)
        F_mat = torch.stack([estimator(*pair)[0] for pair in pairs]) if kind == "RANSAC" else estimator(*fit)
        distance = kln.symmetric_epipolar_distance(*test, F_mat).clamp(max=6)
        expected += ((distance + 0.05).log() + 0.5 * 2**0.5 * distance / 2).mean(-1) / 2  # the scale is one
    torch.testing.assert_close(loss.double(), expected, atol=1e-5, rtol=0)


def test_bad_arguments_of_the_loss():
    with pytest.raises(TypeError, match="expected an estimator of fundamental matrices, got LearnedHomography"):
        HeldOutLoss(kln.LearnedHomography())
    raises(ValueError, "floor and ceiling", HeldOutLoss, floor=0.0)


def test_labels_take_the_place_of_matrices_where_they_are_known(folder):
    sets = source(folder).draw(2, 32, seeded())
    assert sets.E_mat.isfinite().all()
    unknown = sets._replace(E_mat=torch.where(torch.tensor([True, False])[:, None, None], sets.E_mat, torch.nan))
    points = all_matches(sets)
    found = HeldOutLoss(kln.EightPoint(), labels=True).distances(unknown, *points)
    torch.testing.assert_close(found[0], true_distance(sets, *points)[0], rtol=1e-3, atol=1e-3)  # cameras are float32
    without = HeldOutLoss(kln.EightPoint()).distances(sets, *points)
    torch.testing.assert_close(found[1], without[1])
    raises(ValueError, "sets with cameras", HeldOutLoss(labels=True).distances, sets._replace(K1=None), *points)


@pytest.mark.parametrize("options", [{}, {"detach": True}, {"estimator": kln.RANSAC(seed=0)}])
def test_a_fixed_matrix_sends_no_gradient_to_its_own_half(folder, options):
    sets = source(folder).draw(1, 32, seeded())
    points1, points2 = all_matches(sets)
    points1.requires_grad_()
    HeldOutLoss(**options).distances(sets, points1, points2)[:, :32].sum().backward()  # by the second half's matrix
    assert points1.grad[:, :32].all(-1).any()
    assert bool(points1.grad[:, 32:].any()) == (options == {})


@pytest.mark.parametrize("calibrated", [False, True])
def test_gradients_pass_the_layer_and_leave_it(folder, calibrated):
    kind = kln.LearnedRelativePose if calibrated else kln.LearnedEightPoint
    layer = kind.from_pretrained("robust-pose-synthetic" if calibrated else "robust-tiny")
    task = RefinerTask(kln.MatchRefiner(), HeldOutLoss(layer))
    task.compute_loss(source(folder).draw(2, 16, seeded())).backward()
    assert all(p.grad is None for p in task.loss.estimator.parameters())
    assert task.trained.shift.weight.grad.any()
    assert task.trained.gates.weight.grad.isfinite().all()
    sets = RandomSets([SyntheticSets()], sizes=(16, 16)).draw(0, 0)
    raises(ValueError, "needs sets with images", task.compute_loss, sets)


def test_a_training_moves_matches_nearer_to_the_truth(folder, tmp_path, monkeypatch, capsys, refused):
    """By the command line, with checkpoints, weights, validation and predictions."""
    monkeypatch.setenv("LEARNNORM_DATA", str(folder))
    images = {"paths": [f"{folder}/matches.h5"], "images": [f"{folder}/images"]}
    sources = json.dumps([{"class_path": "kornia_learnnorm.data.image_sets.ImageSets", "init_args": images}])
    data = {"sources": sources, "shares": "null", "sizes": "[64, 64]", "correspondences": 128, "batches": 30}
    options = [f"--data.{stage}.init_args.{name}={value}" for stage in ("train", "val") for name, value in data.items()]
    options = ["--config", "refiner", "--trainer.max_steps=20", "--trainer.enable_progress_bar=false", *options]
    options += ["--trainer.limit_val_batches=2", f"--trainer.default_root_dir={tmp_path / 'run'}"]
    assert main(["fit", *options]) == 0
    refiner = kln.MatchRefiner.from_pretrained(tmp_path / "run/weights.safetensors")
    assert refiner.trained_on == ("matches",)
    sets = source(folder, jitter=0.0).draw(4, 90, seeded(5))
    with torch.no_grad():
        moved = refiner(sets.image1, sets.image2, *all_matches(sets))
    before, after = (true_distance(sets, *points).median() for points in (all_matches(sets), moved[:2]))
    assert after < 0.85 * before
    assert moved.scale.min() > 0
    assert main(["validate", *options, f"--ckpt_path={tmp_path}/run/checkpoints/last.ckpt"]) == 0
    assert "val/median_moved" in capsys.readouterr().out
    for name in ("detached", "eight-point", "labels", "ransac"):
        loss = ["--config", f"ablations/refiner/{name}"]
        refused(["fit", *options, *loss, "--trainer.max_steps=0"], "trainer.max_steps is 0")  # the last that is checked
