"""Copies of the sequences on disk, to be changed."""

import shutil

import pytest


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
