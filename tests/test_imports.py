"""What importing the package loads, and the names of its files."""

import subprocess
import sys
from collections import Counter
from pathlib import Path

HEAVY = ["pytorch_lightning", "lightning", "cv2", "h5py", "matplotlib", "jsonargparse", "torchmetrics", "tabulate"]
HEAVY += ["gradio", "huggingface_hub"]


def test_no_file_name_occurs_twice():
    """A responsibility has one place to look for."""
    files = (Path(__file__).parents[1] / "kornia_learnnorm").rglob("*.py")
    names = Counter(path.stem for path in files if path.stem != "__init__")
    assert [name for name, number in names.items() if number > 1] == []


def test_importing_the_package_loads_nothing_heavy():
    code = f"import sys, kornia_learnnorm; print(*[name for name in {HEAVY} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []
