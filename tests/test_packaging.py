"""The package: names of its files, what importing it loads; its wheel, with configurations and weights."""

import os
import re
import subprocess
import sys
import tomllib
import zipfile
from collections import Counter
from importlib import import_module
from pathlib import Path

import pytest

import kornia_learnnorm as kln

ROOT = Path(__file__).parents[1]
HEAVY = ["pytorch_lightning", "lightning", "cv2", "h5py", "matplotlib", "jsonargparse", "torchmetrics", "tabulate"]
HEAVY += ["gradio", "huggingface_hub"]
BUILD = "from hatchling.build import build_wheel; import sys; build_wheel(sys.argv[1])"


@pytest.fixture(scope="module")
def wheels(tmp_path_factory):
    pytest.importorskip("hatchling", reason="hatchling is not installed")
    folders = [tmp_path_factory.mktemp("wheel") for _ in range(2)]
    for folder in folders:
        subprocess.run([sys.executable, "-c", BUILD, folder], cwd=ROOT, check=True, capture_output=True, timeout=120)
    return [next(folder.glob("*.whl")) for folder in folders]


def test_two_builds_are_the_same(wheels):
    assert wheels[0].name.startswith(f"kornia_learnnorm-{kln.__version__}-")
    assert wheels[0].read_bytes() == wheels[1].read_bytes()
    assert wheels[0].stat().st_size < 4e6


def test_the_wheel_has_configurations_and_weights(wheels):
    names = set(zipfile.ZipFile(wheels[0]).namelist())
    for path in (ROOT / "configs").rglob("*.yaml"):
        assert f"lightning_modules/{path.relative_to(ROOT).as_posix()}" in names
    left_out = {"paper.safetensors", "robust-pose.safetensors"}  # for comparisons
    for path in (ROOT / "kornia_learnnorm/weights").iterdir():
        assert (path.relative_to(ROOT).as_posix() in names) == (path.name not in left_out)
    tops = {name.partition("/")[0] for name in names}
    information = f"kornia_learnnorm-{kln.__version__}.dist-info"
    assert tops == {"kornia_learnnorm", "lightning_modules", "kornia_learnnorm_command.py", information}
    entry_points = zipfile.ZipFile(wheels[0]).read(f"{information}/entry_points.txt").decode()
    assert "learnnorm = kornia_learnnorm_command:main" in entry_points  # where an interrupted import is caught


def test_readme_of_an_index_has_absolute_links(monkeypatch):
    monkeypatch.syspath_prepend(ROOT)
    metadata = {"urls": {"Repository": "https://github.com/owner/name/"}}
    import_module("hatch_build").Readme(str(ROOT), {}).update(metadata)
    text, readme = metadata["readme"]["text"], (ROOT / "README.md").read_text(encoding="utf-8")
    assert re.findall(r"\]\((?!https://)[^)]*|src=\"(?!https://)[^\"]*", text) == []
    assert re.sub("https://github.com/owner/name/(blob|raw)/main/", "", text) == readme


def test_the_wheel_finds_its_configurations_in_any_folder(wheels, tmp_path):
    zipfile.ZipFile(wheels[0]).extractall(tmp_path / "site")
    command = [sys.executable, "-m", "kornia_learnnorm.cli.main", "config", "crossview"]
    options = {"env": {**os.environ, "PYTHONPATH": str(tmp_path / "site")}, "text": True, "timeout": 120}
    found = subprocess.run(command, cwd=tmp_path, check=True, capture_output=True, **options)
    assert found.stdout == (ROOT / "configs/crossview.yaml").read_text(encoding="utf-8")


def test_every_extra_is_checked():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    documented = (ROOT / "docs/install.md").read_text(encoding="utf-8")
    checks = import_module("check_extras").CHECKS
    assert set(checks) == set(project["optional-dependencies"]) - {"dev", "docs", "all"} | {"core"}
    assert [extra for extra in checks if extra != "core" and f"\n| `{extra}` |" not in documented] == []


def test_no_file_name_occurs_twice():
    """A responsibility has one place to look for."""
    names = Counter(path.stem for path in (ROOT / "kornia_learnnorm").rglob("*.py") if path.stem != "__init__")
    assert [name for name, number in names.items() if number > 1] == []


def test_importing_the_package_loads_nothing_heavy():
    code = f"import sys, kornia_learnnorm; print(*[name for name in {HEAVY} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []
