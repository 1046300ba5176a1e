"""Copies of the sequences on disk, to be changed."""

import shutil

import pytest


def copy_of(dataset):
    @pytest.fixture(name=dataset)
    def copy(written, tmp_path):
        return shutil.copytree(written / dataset, tmp_path / dataset)

    return copy


kitti, tum, cambridge, colmap = map(copy_of, ("kitti", "tum", "cambridge", "colmap"))
