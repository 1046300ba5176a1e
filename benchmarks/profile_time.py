"""Show what the time of the solvers and of the training steps is made of, by PyTorch's profiler on one thread.

    python benchmarks/profile_time.py [--steps 40]

Solvers take 2,048 samples of eight and, where the name says so, one. Training steps are those of
``learnnorm fit --config CONFIG`` with synthetic data. A cell is the share of the time in percent that passes in

- factorisations: LU and eigenvalue decompositions, and the solution of linear systems with them;
- products: batched matrix products, of the solvers and of attention;
- layers: the products of linear layers and convolutions;
- memory: copies, concatenation and gathering;
- arithmetic: all other operations, element by element or reducing;
- outside: Python and PyTorch between the operations; the profiler makes it larger.
"""

import tempfile
import time
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO

import speed
import torch
from shared import make_parser
from torch.profiler import ProfilerActivity, profile

from kornia_learnnorm.cli.main import main as learnnorm
from kornia_learnnorm.evaluation.tables import format_table

GROUPS = {
    "factorisations": ("linalg_lu", "linalg_solve", "_linalg", "linalg_eigh", "linalg_qr", "linalg_cholesky"),
    "products": ("bmm", "baddbmm"),
    "layers": ("addmm", "mm", "mkldnn", "convolution"),
    "memory": ("copy", "cat", "stack", "gather", "index", "scatter", "fill", "zero", "clone", "empty", "_local_scalar"),
}
COLUMNS = (*GROUPS, "arithmetic", "outside")
CALLS = 20  # of a solver
SOLVERS = ("kornia", "Hartley", "whitening", "optimal", "reweighted", "crossview", "paper")
CONFIGS = ("crossview-synthetic", "robust-synthetic")


def group_of(name: str) -> str:
    """Return the group of an operation."""
    operation = name.removeprefix("aten::")
    return next((group for group, starts in GROUPS.items() if operation.startswith(starts)), "arithmetic")


def shares(run: Callable[[], object]) -> dict[str, float]:
    """Return the shares of the time of a run by groups of operations, percent, and its milliseconds."""
    with profile(activities=[ProfilerActivity.CPU]) as found:
        start = time.perf_counter()
        run()
        milliseconds = 1e3 * (time.perf_counter() - start)
    spent = dict.fromkeys(COLUMNS, 0.0)
    for event in found.key_averages():
        if event.key.startswith("aten::"):
            spent[group_of(event.key)] += event.self_cpu_time_total / 1e3
    spent["outside"] = milliseconds - sum(spent.values())
    return {group: 100 * value / milliseconds for group, value in spent.items()}


def solver_shares(name: str, case: speed.Case, backward: bool) -> dict[str, float]:
    """Return the shares of a solver's time."""
    method, points = speed.solvers("cpu")[name], speed.correspondences(case, "cpu", torch.float32)
    speed.run_once(method, points, backward)
    return shares(lambda: [speed.run_once(method, points, backward) for _ in range(CALLS)])


def training_shares(config: str, steps: int) -> dict[str, float]:
    """Return the shares of the time of a training's steps."""
    with tempfile.TemporaryDirectory() as folder:
        options = [f"--trainer.max_steps={steps}", "--trainer.limit_val_batches=0", "--trainer.accelerator=cpu"]
        command = ["fit", "--config", config, f"--trainer.default_root_dir={folder}", *options]
        with redirect_stdout(StringIO()), redirect_stderr(StringIO()):
            return shares(lambda: learnnorm(command))


def main() -> None:
    """Profile and print the table."""
    parser = make_parser(__doc__)
    parser.add_argument("--steps", type=int, default=40, help="of each training")
    args = parser.parse_args()
    torch.set_num_threads(1)
    many, one = speed.Case(2048, 8), speed.Case(1, 8)
    found = {f"{name}, forward": solver_shares(name, many, False) for name in SOLVERS}
    found |= {f"{name}, forward and backward": solver_shares(name, many, True) for name in SOLVERS}
    found |= {f"{name}, one sample": solver_shares(name, one, False) for name in SOLVERS}
    found |= {f"fit {config}": training_shares(config, args.steps) for config in CONFIGS}
    print(format_table(["", *COLUMNS], [[name, *(f"{row[c]:.0f}" for c in COLUMNS)] for name, row in found.items()]))


if __name__ == "__main__":
    main()
