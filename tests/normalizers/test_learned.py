"""The learned normaliser: its base, its invariances, its files."""

import copy
import json

import numpy as np
import pytest
import torch
from kornia.geometry.epipolar import normalize_points
from pairwise import pairwise
from references import epipolar_distances, mapped, signless
from scenes import DTYPES, correspondences, last_layer, paper, raises, rewrite_weights, shaken, small, uniform
from torch import nn

import kornia_learnnorm as kln
from kornia_learnnorm import Hartley, LearnedNormalizer, Whitening, find_fundamental
from kornia_learnnorm.data.training_samples import block_generator
from kornia_learnnorm.data.training_sets import SyntheticSets
from kornia_learnnorm.geometry.transforms import paper_transform, spd_transform


def public(module: nn.Module) -> dict[str, object]:
    return {name: value for name, value in vars(module).items() if not name.startswith("_")}


@pytest.fixture(params=[small, paper])
def untrained(request):
    return request.param()


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "weights.safetensors"
    shaken(small()).save_pretrained(path)
    return path


class TestForward:
    @pairwise(base=["", "Identity", "Hartley", "Whitening", "ReweightedWhitening"], num_points=[8, 20], dtype=DTYPES)
    def test_untrained_is_exactly_the_base(self, base, num_points, dtype):
        normalizer = small(getattr(kln, base)()) if base else paper()
        points = [p.to(dtype) for p in correspondences("handheld", 5, num_points)]
        for w in (None, uniform(5, num_points, low=0.1)):
            expected = normalizer.base(*(p.double() for p in points), w)
            torch.testing.assert_close(normalizer(*points, w), tuple(T.to(dtype) for T in expected), rtol=0, atol=0)

    def test_untrained_can_start_to_learn(self, untrained):
        torch.cat(untrained(*correspondences("handheld", 4, 12))).sum().backward()
        assert last_layer(untrained).weight.grad.abs().sum() > 0
        assert all(parameter.grad.isfinite().all() for parameter in untrained.parameters())

    def test_the_network_computes_in_its_own_dtype(self, untrained):
        normalizer, points = shaken(untrained).double(), correspondences("handheld", 4, 12)
        double, single = normalizer(*points), copy.deepcopy(normalizer).float()(*points)
        torch.testing.assert_close(single, double, rtol=1e-3, atol=1e-3)
        assert not any(torch.equal(rounded, exact) for rounded, exact in zip(single, double, strict=True))

    def test_defaults_are_those_of_the_shipped_weights(self):
        LearnedNormalizer().load_state_dict(LearnedNormalizer.from_pretrained("crossview").state_dict())
        default, named = LearnedNormalizer.from_pretrained(), LearnedNormalizer.from_pretrained("crossview")
        assert all(torch.equal(value, named.state_dict()[key]) for key, value in default.state_dict().items())

    def test_composes_builder_and_base(self):
        class Known(nn.Module):
            def forward(self, points1, points2, weights=None):
                self.seen = points1, points2, weights
                return points1.new_full((2, 3), 0.1), points1.new_full((2, 3), -0.2)

        network, points, weights = Known(), correspondences("driving", 2, 9), uniform(2, 9)
        for base in (Hartley(), kln.PerView(normalize_points)):
            found = LearnedNormalizer(base, network, paper_transform)(*points, weights)
            views = zip(found, base(*points, weights), (0.1, -0.2), points, network.seen[:2], strict=True)
            for T, H, p, x, seen in views:
                B = paper_transform(torch.full((3,), p, dtype=torch.float64))
                torch.testing.assert_close(T, B @ H)
                np.testing.assert_allclose(seen.numpy(), mapped(H, x), rtol=1e-6, atol=1e-9)
            assert torch.equal(network.seen[2], weights)

    @pairwise(base=[Whitening, kln.ReweightedWhitening], num_points=[8, 10], dtype=DTYPES)
    def test_gradients_reach_points_weights_and_parameters(self, base, num_points, dtype):
        normalizer, points = shaken(small(base())), correspondences("handheld", 4, num_points)
        values = [p.to(dtype).requires_grad_() for p in (*points, uniform(4, num_points))]
        signless(find_fundamental(*values, normalizer)).sum().backward()
        for value in (*values, *normalizer.parameters()):
            assert torch.isfinite(value.grad).all()
            assert value.grad.count_nonzero() > 0


class TestFiles:
    @pytest.mark.parametrize(
        "parts",
        [
            *((base, kln.CrossViewNetwork(8, 1, bound=2.0)) for base in (kln.Identity(), Hartley(), Whitening(1e-4))),
            (kln.ReweightedWhitening(3, 0.2), kln.CrossViewNetwork(8, 1, features="own")),
            (Whitening(), kln.CrossViewNetwork(8, 1, features="both")),
            (Hartley(), kln.PaperNetwork(16, 3), paper_transform),
        ],
    )
    def test_round_trip(self, parts, tmp_path):
        normalizer = shaken(LearnedNormalizer(*parts))
        normalizer.trained_on = ("kitti_00", "tum@0:9")
        normalizer.save_pretrained(tmp_path / "weights.safetensors")
        loaded = LearnedNormalizer.from_pretrained(tmp_path / "weights.safetensors")
        assert not loaded.training
        assert loaded.trained_on == ("kitti_00", "tum@0:9")
        assert loaded.transform is normalizer.transform
        for part, saved in ((loaded.base, normalizer.base), (loaded.network, normalizer.network)):
            assert type(part) is type(saved)
            assert public(part) == public(saved)
        points = correspondences("driving", 5, 9)
        torch.testing.assert_close(loaded(*points), normalizer(*points), rtol=0, atol=0)

    def test_overwrites_and_keeps_dtype_and_mode(self, file):
        """A float64 network comes back as one, and others may read the file as any that its owner makes."""
        normalizer = shaken(small(), seed=1).double().train()
        normalizer.save_pretrained(str(file))
        assert [entry.name for entry in file.parent.iterdir()] == [file.name]
        loaded = LearnedNormalizer.from_pretrained(str(file))
        assert all(torch.equal(value, normalizer.state_dict()[key]) for key, value in loaded.state_dict().items())
        assert next(loaded.network.parameters()).dtype == torch.float64
        file.with_name("other").touch()
        assert file.stat().st_mode == file.with_name("other").stat().st_mode
        assert normalizer.training  # saving changes nothing

    @pytest.mark.parametrize("name", ["crossview", "crossview-synthetic"])  # for eights
    def test_shipped_weights_of_eights(self, name, dtype):
        normalizer = LearnedNormalizer.from_pretrained(name)
        assert not normalizer.training
        for scene in ("driving", "handheld"):
            points = [p.to(dtype) for p in correspondences(scene, 300, noise=0.5)]
            with torch.no_grad():
                found, hartley = (find_fundamental(*points, normalizer=n).double() for n in (normalizer, Hartley()))
            better = epipolar_distances(*points, found).mean(1) < epipolar_distances(*points, hartley).mean(1)
            assert better.mean() > 0.9

    def test_shipped_weights_of_sets(self):
        """On synthetic matches, noisy and some of them wrong; eights are left to the other weights."""
        sets, errors = SyntheticSets(32).draw(128, 64, block_generator(5)), []
        heldout = sets.heldout1.double(), sets.heldout2.double()
        for normalizer in (LearnedNormalizer.from_pretrained("crossview-sets"), Hartley()):
            with torch.no_grad():
                F_mat = find_fundamental(sets.points1.double(), sets.points2.double(), normalizer=normalizer)
            errors.append(kln.symmetric_epipolar_distance(*heldout, F_mat).median())
        assert errors[0] < 0.9 * errors[1]

    @pytest.mark.parametrize("name", ["nonsense", "", "nonsense.safetensors", "crossview.pt", "folder.safetensors"])
    def test_unknown_name(self, name, tmp_path, monkeypatch):
        """The message lists those that ship, without weights of another kind."""
        (tmp_path / "folder.safetensors").mkdir()
        monkeypatch.chdir(tmp_path)
        with pytest.raises(FileNotFoundError, match=f"{name!r}.* crossview, crossview-sets, .*, paper$"):
            LearnedNormalizer.from_pretrained(name)


class TestMaxPoints:
    def test_absent_correspondences_do_not_count(self):
        normalizer, points = shaken().double(), correspondences("handheld", 2, 20)
        weights = torch.ones(2, 20)
        weights[1, 12:] = 0
        own, base = normalizer(*points, weights), Hartley()(*points, weights)
        normalizer.max_points = 12
        for found, hartley, unlimited in zip(normalizer(*points, weights), base, own, strict=True):
            assert torch.equal(found[0], hartley[0])
            assert torch.equal(found[1], unlimited[1])

    def test_larger_sets_get_hartleys_without_the_network(self):
        normalizer, points, calls = shaken(), correspondences("handheld", 4, 20), []
        own, weights = normalizer(*points), torch.rand(4, 20) + 0.1
        normalizer.network.register_forward_hook(lambda *args: calls.append(args))
        normalizer.max_points = 19
        for values in (points, (*points, weights)):
            assert all(map(torch.equal, normalizer(*values), Hartley()(*values)))
        assert not calls
        normalizer.max_points = 20
        assert all(map(torch.equal, normalizer(*points), own))
        assert len(calls) == 1

    def test_is_saved_and_at_least_eight(self, file):
        LearnedNormalizer(Whitening(), max_points=9).save_pretrained(file)
        assert LearnedNormalizer.from_pretrained(file).max_points == 9
        assert LearnedNormalizer.from_pretrained("paper").max_points is None  # a file without it
        for number in (7, 8.5):
            message = rf"max_points must be a whole number, at least 8, got {number}"
            raises(ValueError, message, LearnedNormalizer, max_points=number)
        raises(TypeError, "normalizer must be a module or function, got 'Hartley'", LearnedNormalizer, "Hartley")


BIAS = "network.set_network.head.2.bias"
OTHER_WIDTH = {"name": "CrossViewNetwork", "width": 8, "depth": 2}
NO_FIT, UNKNOWN = r"the tensors do not fit the architecture(.|\n)*", "describes no normaliser of this version"
PARTS = [
    *(("base", {"name": name}) for name in ("Unknown", "os", "Module")),
    *(("base", value) for value in ({"floor": 1e-6}, {"name": "Whitening", "ceiling": 3}, "Whitening")),
    ("base", {"name": "ReweightedWhitening", "iterations": -1, "damping": 0.1}),
    ("network", {"name": "CrossViewNetwork", "width": "wide"}),
    *(("network", value) for value in ({"name": "Whitening"}, None)),
    *(("transform", value) for value in ("CrossViewNetwork", "__builtins__", 3)),
]


class TestStrictness:
    @pytest.mark.parametrize(
        ("change", "message"),
        [
            (lambda state, _: state.pop(BIAS), rf"{NO_FIT}Missing key.*head\.2\.bias"),
            (lambda state, _: state.update(extra=torch.zeros(1)), f"{NO_FIT}Unexpected key.*extra"),
            (lambda state, _: state.update({BIAS: torch.zeros(4)}), f"{NO_FIT}size mismatch"),
            (lambda _, metadata: metadata.pop("architecture"), UNKNOWN),
            (lambda _, metadata: metadata.clear(), "expected format .* got None"),
            ({"format": "another.v9"}, r"normalizer\.v1.* got 'another\.v9'"),
            *(({"architecture": text}, UNKNOWN) for text in ("no json", "[]", "null", "{}")),
            *(({"trained_on": text}, "trained_on must be .*, got") for text in ("kitti_00", '"kitti_00"', "[0]")),
            (("network", OTHER_WIDTH), "the tensors do not fit"),
            *((part, UNKNOWN) for part in PARTS),
        ],
    )
    def test_one_thing_wrong(self, file, change, message):
        def rewrite(state, metadata):
            if callable(change):
                change(state, metadata)
            elif isinstance(change, dict):
                metadata.update(change)
            else:
                metadata["architecture"] = json.dumps(json.loads(metadata["architecture"]) | dict([change]))

        rewrite_weights(file, rewrite)
        with pytest.raises(ValueError, match=message) as caught:
            LearnedNormalizer.from_pretrained(file)
        assert file.name in str(caught.value)


def test_parts_that_cannot_be_saved_leave_the_file_as_it_was(file):
    before = file.read_bytes()
    for parts in [
        {"network": nn.Linear(2, 5)},
        {"transform": lambda params: spd_transform(params)},
        {"base": kln.PerView(normalize_points)},
        {"base": type("Whitening", (Whitening,), {})()},  # the name is not enough
    ]:
        with pytest.raises(TypeError, match=r"cannot be imported by its name|cannot be saved"):
            LearnedNormalizer(**parts).save_pretrained(file)
        assert file.read_bytes() == before
        assert [entry.name for entry in file.parent.iterdir()] == [file.name]


def test_wrong_targets(tmp_path):
    raises(FileNotFoundError, "nowhere", small().save_pretrained, tmp_path / "nowhere" / "weights.safetensors")
    (tmp_path / "weights.safetensors").mkdir()
    raises(ValueError, "not a regular file", small().save_pretrained, tmp_path / "weights.safetensors")
