"""Guards of the speed that do not depend on the machine: operations and factorisations of a forward pass."""

import sys
from collections import Counter
from pathlib import Path

import pytest
import torch
from scenes import correspondences
from torch.utils._python_dispatch import TorchDispatchMode

import kornia_learnnorm
from kornia_learnnorm import EightPoint, Hartley, LearnedEightPoint, LearnedNormalizer, ReweightedWhitening, Whitening

READS = ("_local_scalar_dense", "is_nonzero", "nonzero")  # for which a GPU would wait
# By both of their names: in inference mode, operations arrive before they are taken apart.
FACTORISATIONS = ("linalg_lu_factor_ex", "_linalg_eigh", "_linalg_svd", "linalg_qr", "_linalg_det", "linalg_inv_ex")
FACTORISATIONS += ("linalg_eigh", "linalg_svd", "linalg_det")


def python_calls(function, *arguments) -> tuple[int, int]:
    """Return how many calls of the package's own functions a call makes, and in how many files."""
    root, files = str(Path(kornia_learnnorm.__file__).parent), Counter()

    def profile(frame, event, arg):
        if event == "call" and frame.f_code.co_filename.startswith(root):
            files[frame.f_code.co_filename] += 1

    function(*arguments)
    sys.setprofile(profile)
    try:
        function(*arguments)
    finally:
        sys.setprofile(None)
    return files.total(), len(files)


@pytest.mark.skipif(sys.version_info >= (3, 14), reason="what counts as a call differs between versions of Python")
@torch.no_grad()
def test_python_calls_of_a_forward_pass():
    for layer, num_points, most, files in [
        (EightPoint(), 8, 35, 6),
        (LearnedEightPoint.from_pretrained(), 50, 206, 15),  # sets of few outliers, which leave stages out
        (LearnedEightPoint.from_pretrained().train(), 50, 289, 18),
    ]:
        points = correspondences("handheld", 4, num_points, seed=4)
        calls, found = python_calls(layer, *points)
        assert calls <= most
        assert found <= files


class Operations(TorchDispatchMode):
    """Counts the operations that reach the device, by name."""

    def __init__(self):
        super().__init__()
        self.names = Counter()

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        self.names[function.overloadpacket._qualified_op_name.partition("::")[2]] += 1
        return function(*args, **(kwargs or {}))


@pytest.mark.skipif(torch.__version__ < "2.13", reason="older versions of PyTorch split operations into more")
def test_operations_of_a_forward_pass():
    for layer, num_points, most, factorisations in [
        (EightPoint(Hartley()), 8, 200, 1),
        (EightPoint(Whitening()), 8, 320, 1),
        (EightPoint(Hartley(), rank2="optimal"), 8, 381, 2),
        (EightPoint(ReweightedWhitening()), 8, 1266, 1),
        (EightPoint(LearnedNormalizer.from_pretrained()), 8, 1837, 1),
        (EightPoint(Hartley()), 128, 232, 1),
        (LearnedEightPoint.from_pretrained(), 128, 2090, 5),
        (LearnedEightPoint.from_pretrained().train(), 128, 3290, 8),
    ]:
        points = correspondences("handheld", 64, num_points)
        with torch.no_grad(), Operations() as operations:
            layer(*points)
        assert sum(operations.names.values()) <= most
        assert sum(operations.names[name] for name in FACTORISATIONS) <= factorisations
        assert sum(operations.names[name] for name in READS) <= (8 if isinstance(layer, LearnedEightPoint) else 3)
