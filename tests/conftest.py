"""Fixtures and settings that all tests share."""

import os
import re
from pathlib import Path

import hypothesis
import pytest
import torch

from kornia_learnnorm.cli.main import main

ROOT = Path(__file__).parents[1]
if (ROOT / ".weights").is_dir():  # made by make weights
    os.environ.setdefault("TORCH_HOME", str(ROOT / ".weights"))

hypothesis.settings.register_profile(
    "package",
    max_examples=25,
    deadline=None,
    suppress_health_check=[hypothesis.HealthCheck.too_slow],  # with the deadline, what a busy machine would decide
    derandomize=True,
    database=None,
    print_blob=True,
)
hypothesis.settings.register_profile("few", hypothesis.settings.get_profile("package"), max_examples=8)
hypothesis.settings.load_profile("package")

TESTS = Path(__file__).parent
NUMERICAL = {"geometry", "models", "normalizers", "estimators", "ransac", "metrics"}  # folders
NUMERICAL |= {"test_training_losses.py", "test_diagnostics.py", "test_searched_normalizer.py"}
NUMERICAL |= {"test_parallax.py", "test_repeated_texture.py"}
# Tests that do not depend on the order of rounding: shapes, errors, files, random draws, and derivatives against
# differences, whose tolerance is far above it.
STEADY = r"smoke|wrong|exceptions|TestFiles|TestStrictness|gradcheck|::test_gradients(\[|$)"
STEADY += r"|TestGradients::test_(first|second)|test_(statistics|call_counts|matches|samplers|threads)\.py"
DEVICES = ["cpu", "cuda"] if torch.cuda.is_available() else ["cpu"]


def pytest_collection_modifyitems(items):
    """Mark the tests that compare numbers, by their folder or file; long tests go first, so that none is the last."""
    items.sort(key=lambda item: item.get_closest_marker("long") is None)
    for item in items:
        numerical = item.path.is_relative_to(TESTS) and NUMERICAL & {*item.path.relative_to(TESTS).parts}
        if numerical and not re.search(STEADY, item.nodeid):
            item.add_marker("numerical")


@pytest.fixture(params=DEVICES)
def device(request):
    return torch.device(request.param)


@pytest.fixture(params=[torch.float32, torch.float64], ids=["float32", "float64"])
def dtype(request):
    return request.param


@pytest.fixture
def generator():
    """Source of randomness on the CPU, the same in every test."""
    return torch.Generator().manual_seed(0)


@pytest.fixture(scope="session")
def real_data():
    """The folder of real data, without which a test is skipped."""
    folder = os.environ.get("LEARNNORM_DATA")
    if not folder:
        pytest.skip("LEARNNORM_DATA does not name a folder of real data")
    return Path(folder)


@pytest.fixture(scope="session")
def cached_weights():
    """A function that skips a test unless torch.hub's cache has all of these files."""

    def check(*files):
        folder = Path(torch.hub.get_dir(), "checkpoints")
        if missing := [file for file in files if not (folder / file).is_file()]:
            pytest.skip(f"{', '.join(missing)} not in {folder}: make weights")

    return check


@pytest.fixture(scope="session")
def written(tmp_path_factory):
    """Sequences on disk in the layouts of all datasets, not to be changed."""
    pytest.importorskip("PIL.Image", reason="Pillow is not installed")
    from make_sequences import LAYOUTS

    folder = tmp_path_factory.mktemp("sequences")
    for name, write in LAYOUTS.items():
        write(folder / name)
    return folder


@pytest.fixture(scope="session")
def planes(tmp_path_factory):
    """The folder of the images of two planes, not to be changed."""
    pytest.importorskip("cv2", reason="OpenCV is not installed")
    from two_planes import write_images

    return write_images(tmp_path_factory.mktemp("planes"))


@pytest.fixture(scope="session")
def result(planes):
    """The estimate of two images of the planes."""
    from kornia_learnnorm.two_view.estimate_pair import estimate_pair

    return estimate_pair(planes / "left.png", planes / "right.png")


@pytest.fixture
def refused(capsys):
    """A function that checks that a command ends with one line, which has a message in it, and prints nothing else."""

    def check(command, message):
        capsys.readouterr()
        assert main([*map(str, command)]) == 2
        printed = capsys.readouterr()
        assert printed.out == ""
        assert printed.err.startswith(f"learnnorm {command[0]}: error: ")
        assert printed.err.count("\n") == 1
        assert message in printed.err

    return check


@pytest.fixture(scope="session")
def program():
    """LightningCLI warns about arguments from Python while pytest's own are on the command line."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sys.argv", ["learnnorm"])
        yield


@pytest.fixture(scope="session")
def trained(program, tmp_path_factory):
    """The folder of a run of a few steps, and the options that it was made with."""
    folder = tmp_path_factory.mktemp("run")
    network = "--model.estimator.init_args.normalizer.init_args.network.init_args"
    options = [
        *("--config", str(TESTS.parent / "configs/crossview-synthetic.yaml"), "--data.batch_size=16"),
        *(f"--data.{stage}.init_args.number=100" for stage in ("train", "val", "test")),
        *(f"{network}.width=8", f"{network}.depth=1", "--trainer.max_steps=3"),
        *("--trainer.enable_progress_bar=false", f"--trainer.default_root_dir={folder}"),
    ]
    assert main(["fit", *options]) == 0
    return folder, options


@pytest.fixture(autouse=True)
def _global_seed():
    """Networks draw their first weights from the global generator."""
    torch.manual_seed(0)
