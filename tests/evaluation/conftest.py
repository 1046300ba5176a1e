"""Runs of predictions and of robust estimators that the tests of reports and runs share."""

import shutil
from dataclasses import replace

import pytest

from kornia_learnnorm.cli.main import main
from kornia_learnnorm.data.store_writer import write_store
from kornia_learnnorm.data.synthetic.scenes import synthetic_store
from kornia_learnnorm.evaluation.robust import robust_estimators

METHODS = ["none", "Hartley", "whitening", "crossview", "Hartley+optimal", "Hartley+LM"]
ESTIMATORS = ["opencv-usac", "RANSAC", "RANSAC:whitening", "ground-truth"]


@pytest.fixture(scope="session")
def store(tmp_path_factory):
    path = tmp_path_factory.mktemp("store") / "scenes.h5"
    write_store(path, synthetic_store(pairs=3, points=330, seed=1))
    return path


@pytest.fixture(scope="session")
def command(store):
    """The command that makes the run, without its folder."""
    return ["evaluate", str(store), "--methods", *METHODS, "--out"]


@pytest.fixture(scope="session")
def run(command, tmp_path_factory):
    """A run, not to be changed."""
    folder = tmp_path_factory.mktemp("runs") / "run"
    assert main([*command, str(folder)]) == 0
    return folder


@pytest.fixture
def copied(run, tmp_path):
    return shutil.copytree(run, tmp_path / "run")


@pytest.fixture
def reading(copied, command):
    """The commands that read a run: the report, and the command that made it."""
    return ["report", copied], [*command, copied]


@pytest.fixture(scope="session")
def robust_store(tmp_path_factory):
    """A store that is called what the paper's data are."""
    path = tmp_path_factory.mktemp("store") / "kitti_06.h5"
    write_store(path, replace(synthetic_store(pairs=1, points=330, seed=1), dataset="KITTI odometry 06"))
    return path


@pytest.fixture(scope="session")
def robust_command(robust_store):
    return ["robust", str(robust_store), "--pairs", "2", "--seeds", "2", "--estimators", *ESTIMATORS, "--out"]


@pytest.fixture(scope="session")
def robust_run(robust_command, tmp_path_factory):
    """A run of robust estimators, not to be changed."""
    folder = tmp_path_factory.mktemp("runs") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(robust_estimators, "MAX_SAMPLES", 200)
        assert main([*robust_command, str(folder)]) == 0
    return folder


@pytest.fixture
def robust_copied(robust_run, tmp_path):
    return shutil.copytree(robust_run, tmp_path / "run")


@pytest.fixture
def robust_again(robust_copied, robust_command):
    return [*robust_command, str(robust_copied)]
