"""A store and a run that the tests of runs and reports share."""

from __future__ import annotations

import shutil

import pytest

from kornia_learnnorm.cli.main import main
from kornia_learnnorm.cli.synthesize import synthetic_store
from kornia_learnnorm.data.store import write_store
from kornia_learnnorm.evaluation.runs import example


@pytest.fixture(scope="session")
def store(tmp_path_factory):
    path = tmp_path_factory.mktemp("store") / "scenes.h5"
    write_store(path, synthetic_store(pairs=3, points=330, seed=1))
    return path


@pytest.fixture(scope="session")
def methods():
    return ["none", "Hartley", "whitening", "crossview", "Hartley+optimal", "Hartley+LM"]


@pytest.fixture(scope="session")
def command(store, methods):
    """The command that makes the run, without its folder."""
    return ["evaluate", str(store), "--methods", *methods, "--out"]


@pytest.fixture(scope="session")
def run(command, tmp_path_factory):
    """A run, not to be changed."""
    folder = tmp_path_factory.mktemp("runs") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(example, "TRIALS", 20)
        assert main([*command, str(folder)]) == 0
    return folder


@pytest.fixture
def copied(run, tmp_path):
    return shutil.copytree(run, tmp_path / "run")


@pytest.fixture
def few_trials(monkeypatch):
    monkeypatch.setattr(example, "TRIALS", 20)
