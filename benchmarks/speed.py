"""Time estimators of the fundamental matrix side by side: eights and larger sets, forward and backward, one and many.

    python benchmarks/speed.py [--out speed.json] [--device cpu] [--dtype float32] [--quick]
    python benchmarks/speed.py --compile [LAYER ...] [--out compile.json] [--device cpu] [--dtype float32]

All methods take turns in one process on the same synthetic correspondences, with 40 % outliers in sets of more than
eight. The tables have the median time of a batch in milliseconds and, in brackets, its ratio to Kornia's
``find_fundamental``. Estimators of single pairs (OpenCV, PoseLib, RANSAC) are called once for each set of the batch.
Tables of memory have the most that a call holds at once in tensors of PyTorch beside its input, in MiB.

With --compile, a line for each compiled layer, forward and backward, has the time of the first call, which compiles it
without any cache and with one thread, as wall time and as processor time, which other programs change little; and the
shortest time of later calls with torch.compile and without.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import time
import warnings
from collections.abc import Callable
from itertools import accumulate
from pathlib import Path
from typing import NamedTuple

import torch
from kornia.geometry.epipolar import find_fundamental
from shared import make_parser, write_json
from torch import Tensor, nn
from torch.profiler import ProfilerActivity, profile

import kornia_learnnorm as kln
from kornia_learnnorm.data.synthetic import random_scenes
from kornia_learnnorm.evaluation.tables import format_table

KORNIA = "kornia"
SECONDS = 1.0  # spent on a method in a table's cell, at most
MIN_TURNS, MAX_TURNS = 5, 101
MAX_WARM_MILLISECONDS = 3000  # of a batch; what takes longer is run once
LARGE_FOR_PAIRS = 64  # sets in a batch, above which estimators of single pairs are left out
LATER_CALLS = 101  # of a compiled layer

Method = Callable[[Tensor, Tensor], Tensor]


class Case(NamedTuple):
    """A size of the input."""

    batch: int
    number: int  # of correspondences in a set

    def __str__(self) -> str:
        """Return the size as the tables print it."""
        return f"{self.batch} x {self.number}"


EIGHTS = [Case(batch, 8) for batch in (1, 64, 2048, 16384)]
LARGEST_ON_GPU = Case(65536, 8)
COMPILED = {
    **dict.fromkeys((KORNIA, "Hartley", "whitening", "optimal"), EIGHTS[1:3]),
    **dict.fromkeys(("reweighted", "crossview"), EIGHTS[1:2]),
    "learned": [Case(32, 128)],
}
SETS = [Case(batch, number) for number in (32, 128, 512, 2000) for batch in (1, 32)] + [Case(64, 128), Case(64, 1000)]


def solvers(device: str) -> dict[str, Method]:
    """Return differentiable solvers without outlier rejection."""

    def ours(normalizer: nn.Module, **options: str) -> Method:
        module = normalizer.to(device)
        return lambda x1, x2: kln.find_fundamental(x1, x2, normalizer=module, **options)

    return {
        KORNIA: find_fundamental,
        "Hartley": ours(kln.Hartley()),
        "EightPoint": kln.EightPoint().to(device),
        "whitening": ours(kln.Whitening()),
        "optimal": ours(kln.Hartley(), rank2="optimal"),
        "reweighted": ours(kln.ReweightedWhitening()),
        "crossview": ours(kln.LearnedNormalizer.from_pretrained("crossview")),
        "paper": ours(kln.LearnedNormalizer.from_pretrained("paper")),
    }


def robust(device: str) -> dict[str, Method]:
    """Return estimators for correspondences with outliers."""
    start = kln.EightPoint()

    def refined(x1: Tensor, x2: Tensor) -> Tensor:
        return kln.refine_fundamental(x1, x2, start(x1, x2), loss=kln.GemanMcClure(1.0)).F_mat

    return {
        KORNIA: find_fundamental,
        "Hartley + LM": refined,
        "learned": kln.LearnedEightPoint.from_pretrained().to(device),
    }


def single_pairs() -> dict[str, Method]:
    """Return the estimators of single pairs that are installed, without gradients."""
    ransac = kln.RANSAC(seed=0)
    methods: dict[str, Method] = {"RANSAC": lambda x1, x2: ransac(x1, x2)[0]}
    try:
        import cv2

        def opencv(x1: Tensor, x2: Tensor) -> Tensor:
            return torch.from_numpy(cv2.findFundamentalMat(x1.numpy(), x2.numpy(), cv2.FM_8POINT)[0])

        methods["OpenCV FM_8POINT"] = opencv
    except ImportError:
        pass
    try:
        import poselib

        def lo_ransac(x1: Tensor, x2: Tensor) -> Tensor:
            return torch.from_numpy(poselib.estimate_fundamental(x1.double().numpy(), x2.double().numpy(), {}, {})[0])

        methods["PoseLib"] = lo_ransac
    except ImportError:
        pass
    return {name: _one_by_one(method) for name, method in methods.items()}


def _one_by_one(method: Method) -> Method:
    return lambda x1, x2: torch.stack([method(*pair).to(x1) for pair in zip(x1, x2, strict=True)])


def correspondences(case: Case, device: str, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """Return noisy correspondences of synthetic scenes, two fifths of them outliers where there are more than eight."""
    generator = torch.Generator().manual_seed(0)
    scenes = random_scenes(case.batch, case.number, generator)
    points1, points2 = scenes.points1.to(dtype), scenes.points2.to(dtype)
    if case.number > 8:
        wrong = 2 * case.number // 5
        drawn = torch.rand(case.batch, wrong, 2, generator=generator).to(dtype) * scenes.image_size[:, None].to(dtype)
        points2 = torch.cat([drawn, points2[:, wrong:]], 1)
    return points1.to(device), points2.to(device)


def run_once(method: Method, points: tuple[Tensor, Tensor], backward: bool) -> float:
    """Return the milliseconds of one call."""
    leaves = [p.clone().requires_grad_(backward) for p in points]
    start = time.perf_counter()
    with torch.set_grad_enabled(backward):
        F_mat = method(*leaves)
    if backward:
        F_mat[:, 0].sum().backward()
    if points[0].is_cuda:
        torch.cuda.synchronize()
    return 1e3 * (time.perf_counter() - start)


def measure(methods: dict[str, Method], case: Case, args: argparse.Namespace, backward: bool) -> dict[str, float]:
    """Return the median milliseconds of each method on one batch, taken in turns."""
    points = correspondences(case, args.device, getattr(torch, args.dtype))
    times = {name: [run_once(method, points, backward)] for name, method in methods.items()}
    short = [name for name in methods if times[name][0] < MAX_WARM_MILLISECONDS]
    for name in short:
        times[name] = [run_once(methods[name], points, backward)]  # without the warm-up
    budget = 1e3 * SECONDS / (5 if args.quick else 1)
    short = [name for name in short if times[name][0] < MAX_WARM_MILLISECONDS]
    for _ in range(int(min(MAX_TURNS, max(MIN_TURNS, len(short) * budget / sum(times[name][0] for name in short))))):
        for name in short:
            times[name].append(run_once(methods[name], points, backward))
    return {name: statistics.median(values) for name, values in times.items()}


def peak_memory(method: Method, points: tuple[Tensor, Tensor], backward: bool) -> float:
    """Return the MiB of tensors that one call holds at most, beside its input."""
    if points[0].is_cuda:
        torch.cuda.reset_peak_memory_stats()
        before = torch.cuda.memory_allocated()
        run_once(method, points, backward)
        return (torch.cuda.max_memory_allocated() - before) / 2**20
    os.environ.setdefault("KINETO_LOG_LEVEL", "99")  # the profiler prints two lines for each use
    with profile(activities=[ProfilerActivity.CPU], profile_memory=True) as found:
        run_once(method, points, backward)
    changes = [event for event in found.profiler.kineto_results.events() if event.name() == "[memory]"]
    changes.sort(key=lambda event: event.start_ns())
    return max(accumulate((event.nbytes() for event in changes), initial=0)) / 2**20


def measure_compiled(method: Method, case: Case, args: argparse.Namespace) -> dict[str, float]:
    """Return the seconds of the first call of a compiled layer, and the milliseconds of later and uncompiled calls."""
    import torch._inductor.config as inductor

    torch.compiler.reset()
    points = correspondences(case, args.device, getattr(torch, args.dtype))
    compiled = torch.compile(method, fullgraph=True)
    start = sum(os.times()[:4])  # of this process and of the compiler, its child
    with warnings.catch_warnings(), inductor.patch(force_disable_caches=True, compile_threads=1):
        warnings.simplefilter("ignore")  # of torch.compile, about its own code
        first = run_once(compiled, points, backward=True) / 1e3
    processor = sum(os.times()[:4]) - start

    def shortest(method: Method) -> float:
        return min(run_once(method, points, backward=True) for _ in range(LATER_CALLS))

    found = {"first call, s": first, "first call, processor s": processor}
    return found | {"later calls, ms": shortest(compiled), "not compiled, ms": shortest(method)}


def machine(args: argparse.Namespace) -> dict[str, object]:
    """Return what the times depend on."""
    processor = platform.processor()
    for line in Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []:
        if line.startswith("model name"):
            processor = line.partition(":")[2].strip()
            break
    card = torch.cuda.get_device_name() if args.device.startswith("cuda") else None
    return {
        "processor": processor,
        "threads": torch.get_num_threads(),
        "load": round(os.getloadavg()[0], 1),
        "torch": torch.__version__,
        "device": card or args.device,
        "dtype": args.dtype,
        "compiled": args.compile is not None,
    }


def table(results: dict[str, dict[str, float]]) -> str:
    """Return a table with a row for each method and a column for each size, with ratios to Kornia's in brackets."""
    methods = list(dict.fromkeys(name for times in results.values() for name in times))

    def cell(times: dict[str, float], name: str) -> str:
        if name not in times:
            return "-"
        return f"{times[name]:.3g} ({times[name] / times[KORNIA]:.2f})"

    rows = [[name, *(cell(times, name) for times in results.values())] for name in methods]
    return format_table(["method", *results], rows)


def main() -> None:
    """Measure, print the tables and write the file."""
    parser = make_parser(__doc__)
    parser.add_argument("--out", type=Path, help="JSON file for the results")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--dtype", choices=["float32", "float64"], default="float32")
    text = "torch.compile all or some of " + ", ".join(COMPILED)
    parser.add_argument("--compile", metavar="LAYER", choices=COMPILED, nargs="*", help=text)
    parser.add_argument("--quick", action="store_true", help="fewer turns and sizes")
    args = parser.parse_args()
    if args.out is not None:
        args.out.parent.mkdir(parents=True, exist_ok=True)
    differentiable, outliers = solvers(args.device), robust(args.device)
    found: dict[str, object] = {"machine": machine(args)}
    print(json.dumps(found["machine"]), flush=True)
    if args.compile is not None:
        for name in args.compile or COMPILED:
            layer = outliers[name] if name in outliers else differentiable[name]
            for case in COMPILED[name]:
                title = f"{name}, {case}"
                found[title] = measure_compiled(layer, case, args)
                print(f"{title}: " + ", ".join(f"{key} {value:.3g}" for key, value in found[title].items()), flush=True)
                write_json(args.out, found)
    else:
        measure_all(differentiable, outliers, args, found)


def measure_all(
    differentiable: dict[str, Method], outliers: dict[str, Method], args: argparse.Namespace, found: dict[str, object]
) -> None:
    """Measure all methods at all sizes, print the tables and add the times to a dictionary."""
    pairs = single_pairs() if args.device == "cpu" else {}
    eights, sets = (EIGHTS[:3], [SETS[3], SETS[5]]) if args.quick else (EIGHTS, SETS)
    if args.device.startswith("cuda"):
        eights = [*eights, LARGEST_ON_GPU]
    solvers = {name: differentiable[name] for name in (KORNIA, "Hartley", "EightPoint", "whitening", "optimal")}
    groups = {
        "sets of eight": (eights, differentiable, ("OpenCV FM_8POINT",)),
        "larger sets: solvers": (sets, solvers, ()),
        "larger sets: robust estimators": (sets, outliers, ("RANSAC", "PoseLib")),
    }
    for group, (cases, methods, others) in groups.items():
        for backward in (False, True):
            times, memory = {}, {}
            for case in cases:
                alone = {name: pairs[name] for name in others if name in pairs and not backward}
                chosen = methods | (alone if case.batch <= LARGE_FOR_PAIRS else {})
                times[str(case)] = measure(chosen, case, args, backward)
                points = correspondences(case, args.device, getattr(torch, args.dtype))
                memory[str(case)] = {name: peak_memory(f, points, backward) for name, f in methods.items()}
            title = f"{group}, {'forward and backward' if backward else 'forward'}"
            for name, results, unit in ((title, times, "ms a batch"), (f"{title}, memory", memory, "MiB")):
                found[name] = results
                print(f"\n{name}: {unit} (ratio to Kornia)\n\n{table(results)}", flush=True)
            write_json(args.out, found)


if __name__ == "__main__":
    main()
