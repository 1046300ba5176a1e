"""Install the wheel with the extras named, ``core`` for none, or with each, and use what they bring."""

import os
import subprocess
import sys
import tempfile
import venv
from pathlib import Path

from make_sequences import write_colmap

ROOT = Path(__file__).parents[1]
TIMEOUT = 1200  # seconds, for one installation or command

ROUND_TRIP = """\
from kornia_learnnorm import LearnedNormalizer
from kornia_learnnorm.hub import HubModel
HubModel(LearnedNormalizer.from_pretrained()).save_pretrained('uploaded')
HubModel.from_pretrained('uploaded')"""

ON_A_CLUSTER = """\
from distributed import LocalCluster
from kornia_learnnorm.cli.main import main
with LocalCluster(n_workers=1, processes=False, protocol='tcp://', dashboard_address=':0') as cluster:
    where = ['--out', 'dask.h5', '--dask', cluster.scheduler_address]
    assert main(['match', 'folder', 'colmap/images/one', *where]) == 0"""

SERVED_PAGE = """\
import subprocess, urllib.request
command = ['learnnorm', 'demo', '--no-browser', '--port', '5107']
with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
    try:
        address = server.stdout.readline().split()[4].rstrip(',')
        assert b'gradio' in urllib.request.urlopen(address, timeout=60).read()
    finally:
        server.terminate()
        server.communicate(timeout=60)"""

ROBUST = ("poselib", "pydegensac", "pymagsac", "pysuperansac")  # estimators of other packages

# Commands in bash, in a folder with synthetic.h5, image1.png, image2.png, run/ and colmap/.
CHECKS = {
    "core": [
        "learnnorm --help",
        "python -c 'import kornia_learnnorm as kln; kln.LearnedEightPoint.from_pretrained()'",
        """(learnnorm evaluate synthetic.h5 2>&1 || true) | grep -F "pip install '.[images]'" """,
        """(learnnorm fit 2>&1 || true) | grep -F "needs pytorch_lightning: run pip install" """,
    ],
    "images": [
        "learnnorm synthesize rendered --pairs 2",
        "learnnorm estimate image1.png image2.png --out pair.png --json pair.json",
        "learnnorm match folder colmap/images/one --out matched.h5 --jobs 1",
        "learnnorm evaluate synthetic.h5 --methods Hartley",
    ],
    "train": [
        "learnnorm fit --config crossview-synthetic --trainer.max_steps 3 --trainer.default_root_dir fit",
        "test -s fit/weights.safetensors",
    ],
    "report": ["learnnorm report run", "test -s run/report.html"],
    "dask": [f'python -c "{ON_A_CLUSTER}"'],
    "colmap": [
        "learnnorm match colmap colmap/images --model colmap/model --out colmap.h5 --jobs 1",
        "learnnorm export-colmap colmap/images --matches colmap.h5 --out colmap.db --jobs 1",
    ],
    "demo": [f'python -c "{SERVED_PAGE}"'],
    "onnx": ["learnnorm export crossview --format onnx --out crossview.onnx", "test -s crossview.onnx"],
    "completion": ["learnnorm completion bash | bash -n"],
    "hub": [f'python -c "{ROUND_TRIP}"'],
    "robust": ["learnnorm robust synthetic.h5 --pairs 1 --out peers --estimators " + " ".join(ROBUST)],
}


def run(command: list[str], folder: Path, environment: dict[str, str] | None = None) -> None:
    """Run a command in a folder, quietly; end with its output if it fails."""
    done = subprocess.run(command, cwd=folder, env=environment, timeout=TIMEOUT, text=True, capture_output=True)
    if done.returncode:
        sys.exit(f"{done.stdout}{done.stderr}\nexit code {done.returncode} of {' '.join(command)}")


def prepare(folder: Path) -> Path:
    """Write the files that the commands need, by this environment's package, and the wheel; return the wheel."""
    run([sys.executable, "-m", "build", "--no-isolation", "--wheel", "--outdir", str(folder)], ROOT)
    learnnorm = [sys.executable, "-m", "kornia_learnnorm.cli.main"]
    run([*learnnorm, "synthesize", str(folder), "--pairs", "2", "--points", "100"], ROOT)
    run([*learnnorm, "evaluate", "synthetic.h5", "--methods", "Hartley", "whitening", "--out", "run"], folder)
    write_colmap(folder / "colmap")
    return next(folder.glob("*.whl"))


def check(extra: str, wheel: Path, torch: str) -> None:
    """Install the wheel with one extra in a new environment and run its commands."""
    with tempfile.TemporaryDirectory() as name:
        venv.create(name, with_pip=True)
        binaries = Path(name) / "bin"
        pip = [str(binaries / "python"), "-m", "pip", "install", "--quiet"]
        run([*pip, torch], wheel.parent)
        run([*pip, str(wheel) if extra == "core" else f"{wheel}[{extra}]"], wheel.parent)
        outside = {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}
        environment = {**outside, "PATH": f"{binaries}{os.pathsep}{os.environ['PATH']}", "OMP_NUM_THREADS": "1"}
        for command in CHECKS[extra]:
            run(["bash", "-euo", "pipefail", "-c", command], wheel.parent, environment)


def main(extras: list[str]) -> None:
    """Check the named extras, or all."""
    if unknown := set(extras) - set(CHECKS):
        sys.exit(f"no check for {', '.join(sorted(unknown))}: expected some of {', '.join(CHECKS)}")
    lines = (ROOT / "requirements.lock").read_text(encoding="utf-8").splitlines()
    torch = next(line for line in lines if line.startswith("torch=="))
    with tempfile.TemporaryDirectory() as folder:
        wheel = prepare(Path(folder))
        for extra in extras or CHECKS:
            check(extra, wheel, torch)
            print(f"{extra}: ok", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
