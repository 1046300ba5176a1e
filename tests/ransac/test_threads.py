"""The number of threads comes back, however the block ends and whoever else is in one."""

from concurrent.futures import ThreadPoolExecutor
from threading import Barrier

import pytest
import torch

from kornia_learnnorm import RANSAC
from kornia_learnnorm.ransac.threads import one_thread


@pytest.fixture(autouse=True)
def three_threads():
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    yield
    torch.set_num_threads(before)


def test_one_inside_and_all_after_an_error_too():
    with one_thread(), one_thread():
        assert torch.get_num_threads() == 1
    assert torch.get_num_threads() == 3
    with pytest.raises(ValueError, match="inside"), one_thread():
        raise ValueError("inside")
    assert torch.get_num_threads() == 3


def test_callers_that_overlap_and_ransac():
    barrier = Barrier(2)

    def caller(before, inside):
        for _ in range(before):
            barrier.wait()
        with one_thread():
            for _ in range(inside):
                barrier.wait()
        return torch.get_num_threads()

    with ThreadPoolExecutor() as pool:
        assert [*pool.map(caller, (0, 1), (2, 1))] == [3, 3]  # the first enters before the second, and leaves with it
    assert torch.get_num_threads() == 3
    RANSAC(seed=0, max_samples=64)(torch.rand(20, 2), torch.rand(20, 2))
    assert torch.get_num_threads() == 3
