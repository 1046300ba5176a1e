"""The median against NumPy."""

import warnings

import numpy as np
import pytest
import torch

from kornia_learnnorm.metrics.statistics import median


@pytest.mark.parametrize("number", [1, 2, 5, 8])
@pytest.mark.parametrize("dim", [0, -1])
def test_agrees_with_numpy(number, dim, device, dtype):
    values = torch.randn(number, 3, number, dtype=dtype)
    values[values < -0.5] = torch.nan
    values[0, 0, 0] = 1.0
    values[:, 1], values[:, 2] = torch.inf, torch.nan
    found = median(values.to(device), dim)
    assert found.dtype == dtype
    with warnings.catch_warnings(action="ignore"):  # NumPy's of slices that are all NaN
        np.testing.assert_array_equal(found.cpu().numpy(), np.nanmedian(values.numpy(), axis=dim))


def test_of_nothing_is_nan():
    assert median(torch.zeros(2, 0)).isnan().all()
    assert median(torch.zeros(0)).isnan()
