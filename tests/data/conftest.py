"""Small stores, where correspondences lie in one, and copies of the sequences on disk, to be changed."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch

from kornia_learnnorm.data.synthetic.scenes import synthetic_store


@pytest.fixture(scope="session")
def store():
    """Nine pairs of 101 correspondences, not to be changed."""
    return synthetic_store(pairs=3, points=101, seed=2)


@pytest.fixture
def uneven():
    """Six pairs with their rows given to them unevenly; one pair has none."""
    made = synthetic_store(pairs=2, points=30, seed=1)
    return replace(made, offsets=np.array([0, 10, 10, 50, 90, 150, 180]))


@pytest.fixture(scope="session")
def rows_of(store):
    """Return the row of each correspondence in the store, found by its coordinates, and its pair."""
    index = {tuple(row): i for i, row in enumerate(np.c_[store.points1, store.points2].tolist())}

    def find(points1, points2):
        joined = torch.cat([points1, points2], -1)
        rows = [index[tuple(row)] for row in joined.reshape(-1, 4).tolist()]
        rows = np.array(rows).reshape(joined.shape[:-1])
        return rows, np.searchsorted(store.offsets, rows, side="right") - 1

    return find


def copy_of(dataset):
    @pytest.fixture(name=dataset)
    def copy(written, tmp_path):
        return shutil.copytree(written / dataset, tmp_path / dataset)

    return copy


kitti, tum, cambridge, colmap = map(copy_of, ("kitti", "tum", "cambridge", "colmap"))
