"""Sequences on disk, in the layouts of all datasets."""

from __future__ import annotations

import shutil

import pytest


@pytest.fixture(scope="session")
def written(tmp_path_factory):
    """All layouts, not to be changed."""
    pytest.importorskip("PIL.Image", reason="Pillow is not installed")
    from make_sequences import LAYOUTS

    folder = tmp_path_factory.mktemp("sequences")
    for name, write in LAYOUTS.items():
        write(folder / name)
    return folder


@pytest.fixture
def kitti(written, tmp_path):
    return shutil.copytree(written / "kitti", tmp_path / "kitti")


@pytest.fixture
def tum(written, tmp_path):
    return shutil.copytree(written / "tum", tmp_path / "tum")


@pytest.fixture
def cambridge(written, tmp_path):
    return shutil.copytree(written / "cambridge", tmp_path / "Church")


@pytest.fixture
def colmap(written, tmp_path):
    return shutil.copytree(written / "colmap", tmp_path / "colmap")
