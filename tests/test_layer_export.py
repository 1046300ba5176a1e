"""Exported layers against eager ones: in this process, in one without this package, compiled ahead of time, as ONNX."""

import shutil
import subprocess
import sys

import pytest
import torch
from references import signless, up_to_sign
from scenes import inputs, raises, shaken, shaken_estimator

import kornia_learnnorm as kln
from kornia_learnnorm.estimators import learned_eight_point, learned_homography, pose_stages
from kornia_learnnorm.layer_export import export_layer, export_networks, load_layer
from kornia_learnnorm.pretrained import shipped_weights

pytestmark = pytest.mark.long
SIZES = [(1, 9), (5, 64), (1, 300)]

# Loads programs and runs them on stored inputs, where this package and Kornia cannot be imported.
WITHOUT_THE_PACKAGE = """
import sys

class Blocker:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ("kornia_learnnorm", "kornia"):
            raise ImportError(f"{name} is not to be imported")

sys.meta_path.insert(0, Blocker())
import torch

program, cases = torch.load(sys.argv[1])
if program.endswith(".aoti.pt2"):
    run = torch._inductor.aoti_load_package(program)
else:
    run = torch.export.load(program).module()
for points, given, expected in cases:
    torch.testing.assert_close(tuple(run(*points, **given)), tuple(expected), rtol=1e-4, atol=1e-5)
assert not [name for name in sys.modules if name.partition(".")[0] in ("kornia_learnnorm", "kornia")]
"""


@pytest.fixture(autouse=True)
def _no_cache_of_shapes():
    with torch._dynamo.config.patch(fake_tensor_cache_enabled=False):  # it takes a third of the time of an export
        yield


def sets(batch_size: int, num_points: int, kind: str = "fundamental") -> list[torch.Tensor]:
    return [value.float() for value in inputs(kind, batch_size, num_points)]


@torch.no_grad()
def estimates(layer, *points, **given) -> tuple[torch.Tensor, ...]:
    """What a program of the layer returns."""
    found = layer.estimate(*points, **given)
    if isinstance(layer, kln.LearnedRelativePose):
        return found.E_mat, found.R, found.t, found.determined, found.weights
    return (found[0], found.determined, *([] if isinstance(layer, kln.EightPoint) else [found.weights]))


def check(program, layer, *points, **given) -> None:
    """Check that a program returns what the layer does."""
    found, expected = program(*points, **given), estimates(layer, *points, **given)
    assert [v.dtype for v in found] == [v.dtype for v in expected]
    assert up_to_sign(found[0].detach().cpu(), expected[0].cpu()) < 1e-6
    torch.testing.assert_close(tuple(found)[1:], expected[1:], rtol=1e-5, atol=1e-6)


def check_without_the_package(program, cases, folder) -> None:
    torch.save((str(program), cases), folder / "cases.pt")
    command = [sys.executable, "-I", "-c", WITHOUT_THE_PACKAGE, str(folder / "cases.pt")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=200, check=False)
    assert done.returncode == 0, done.stderr


def check_gradients_of_program(program, layer, *points, **given) -> None:
    points = [value.clone().requires_grad_() for value in points]
    calls = program, layer.estimate
    found = [torch.autograd.grad(signless(call(*points, **given)[0]).sum(), points) for call in calls]
    torch.testing.assert_close(*found, rtol=1e-3, atol=1e-6)


def test_any_batch_and_number_of_points(monkeypatch):
    monkeypatch.setattr(learned_eight_point, "LOCAL_STEPS", 1)
    layer = shaken_estimator(stages=1, depth=1, refine_steps=1, samples=8)
    run = export_layer(layer, ["mask", "scores"]).module()
    for batch_size, num_points in SIZES:  # the first set has eight correspondences, the last one all rows
        mask = torch.arange(num_points) < torch.linspace(8, num_points, batch_size).long()[:, None]
        points, given = sets(batch_size, num_points), {"mask": mask, "scores": torch.rand(batch_size, num_points)}
        check(run, layer, *points, **given)
        eight = layer(*(p[:1, :8] for p in points), scores=given["scores"][:1, :8])
        assert up_to_sign(run(*points, **given)[0][:1], eight.detach()) < 1e-5
    with pytest.raises(AssertionError, match=r"points1.size\(\)\[1\] >= 9"):
        run(*sets(2, 8), mask=torch.ones(2, 8, dtype=torch.bool), scores=torch.ones(2, 8))
    assert not any(value.requires_grad for value in run(points[0].requires_grad_(), points[1], **given))


@pytest.mark.parametrize(("cls", "kind"), [(kln.LearnedRelativePose, "pose"), (kln.LearnedHomography, "homography")])
def test_siblings(cls, kind, monkeypatch):
    for part, name in ((pose_stages, "EARLY_STEPS"), (pose_stages, "LOCAL_STEPS"), (learned_homography, "LOCAL_STEPS")):
        monkeypatch.setattr(part, name, 1)
    layer = cls(width=8, depth=1, stages=1, refine_steps=1, samples=4)
    program = export_layer(layer, ["scores"]).module()
    for size in SIZES:
        check(program, layer, *sets(*size, kind), scores=torch.rand(size))


def test_weights_mask_and_gradients_also_without_the_package(tmp_path):
    network = kln.CrossViewNetwork(width=8, depth=1)
    layer, points = kln.EightPoint(shaken(kln.LearnedNormalizer(kln.Whitening(), network))), sets(4, 8)
    points[0][2] = points[0][2, :1]  # coincident
    mask, weights = torch.ones(4, 8, dtype=torch.bool), torch.rand(4, 8) + 0.5
    mask[3, 5:] = False
    run = export_layer(layer, ["weights", "mask"], num_points=8, gradients=True).module()
    assert run(*points, mask=mask, weights=weights)[1].tolist() == [True, True, False, False]
    determined, given = [p[:2] for p in points], {"mask": mask[:2], "weights": weights[:2]}
    check(run, layer, *determined, **given)
    check_gradients_of_program(run, layer, *determined, **given)
    layer, points = kln.EightPoint(kln.Whitening()), sets(3, 20)
    program = export_layer(layer, gradients=True)
    check_gradients_of_program(program.module(), layer, *points)
    torch.export.save(program, tmp_path / "layer.pt2")
    check_without_the_package(tmp_path / "layer.pt2", [(points, {}, estimates(layer, *points))], tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("name", shipped_weights())
def test_shipped_weights(name):
    layer = load_layer(name)
    most = 12 if name.startswith("crossview") else 300
    program = export_layer(layer).module()
    for batch_size, num_points in SIZES:
        kind = "pose" if isinstance(layer, kln.LearnedRelativePose) else "fundamental"
        check(program, layer, *sets(batch_size, min(num_points, most), kind))
    if isinstance(layer, kln.EightPoint):
        check(export_layer(layer, num_points=8).module(), layer, *sets(5, 8))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # Inductor's own
@pytest.mark.skipif(shutil.which("g++") is None, reason="there is no C++ compiler")
@pytest.mark.timeout(900)
def test_compiled_ahead_of_time(tmp_path):
    layer, path = shaken_estimator(stages=2, depth=1, refine_steps=1), tmp_path / "layer.aoti.pt2"
    torch._inductor.aoti_compile_and_package(export_layer(layer), package_path=str(path))
    check_without_the_package(path, [(p, {}, estimates(layer, *p)) for p in (sets(*size) for size in SIZES)], tmp_path)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no GPU")
def test_program_of_a_layer_on_the_gpu():
    layer = shaken_estimator(stages=1, depth=1, refine_steps=1).cuda()
    check(export_layer(layer).module(), layer, *(points.cuda() for points in sets(5, 64)))


class TestNetworks:
    @pytest.fixture(autouse=True)
    def _packages(self):
        for name in ("onnx", "onnxscript", "onnxruntime"):
            pytest.importorskip(name, reason=f"{name} is not installed")

    def check(self, program, network, example):
        import onnxruntime

        run = onnxruntime.InferenceSession(program.model_proto.SerializeToString(), providers=["CPUExecutionProvider"])
        with torch.no_grad():
            expected = network(**example)
        found = run.run(None, {name: value.numpy() for name, value in example.items()})
        for got, value in zip(found, expected, strict=True):
            torch.testing.assert_close(torch.from_numpy(got), value, rtol=1e-4, atol=1e-4)

    def test_stages(self):
        raises(ValueError, "no network: its normaliser is Hartley", export_networks, kln.EightPoint())
        layer = shaken_estimator(depth=1)
        programs = export_networks(layer)
        assert [*programs] == ["stage1", "stage2"]
        for network, program, features in zip(layer.networks, programs.values(), (9, 14), strict=True):
            for size in [(1, 8), (5, 300)]:
                example = {"features": torch.randn(*size, features), "absent": torch.rand(size) < 0.2}
                self.check(program, network, example)

    def test_network_of_a_normaliser(self):
        network = kln.CrossViewNetwork(width=8, depth=1)
        layer = kln.EightPoint(shaken(kln.LearnedNormalizer(network=network))).double().train()
        (program,) = export_networks(layer).values()
        assert layer.training
        assert next(layer.parameters()).dtype == torch.float64
        for batch_size, num_points in [(1, 8), (5, 12)]:
            example = {key: torch.randn(batch_size, num_points, 2) for key in ("points1", "points2")}
            example["null_matrix"] = torch.nn.functional.normalize(torch.randn(batch_size, 3, 3), dim=(1, 2))
            self.check(program, layer.float().eval().normalizer.network, example)


def test_wrong_arguments():
    for layer, options, error, message in [
        (torch.nn.Linear(2, 2), {}, TypeError, "got .*Linear"),
        (kln.EightPoint(), {"inputs": ["scores"]}, ValueError, "weights, mask, got scores"),
        (kln.EightPoint(), {"num_points": 7}, ValueError, "num_points .* 8, got 7"),
    ]:
        raises(error, message, export_layer, layer, **options)


def test_load_layer():
    kinds = {"tiny": kln.LearnedEightPoint, "pose": kln.LearnedRelativePose, "homography": kln.LearnedHomography}
    assert all(isinstance(load_layer(f"robust-{name}"), kind) for name, kind in kinds.items())
    raises(FileNotFoundError, r"'rubust'.* crossview.* robust(?!.*refiner)", load_layer, "rubust")
    raises(ValueError, r"\.safetensors", load_layer, __file__)
