"""Which module may import which, what importing the core loads, and how many modules a folder holds."""

from __future__ import annotations

import ast
import importlib
import re
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

import kornia_learnnorm

ROOT = Path(__file__).parents[1]
PACKAGES = ["kornia_learnnorm", "lightning_modules"]

# From the bottom up. A room imports from itself and from lower floors; rooms of one floor do not import each other.
FLOORS = [
    {"files", "optional", "protocol"},
    {"geometry", "pretrained"},
    {"normalizers", "metrics", "losses"},
    {"estimators"},
    {"ransac"},
    {"data", "export", "hub"},
    {"two_view"},
    {"evaluation", "lightning_modules"},
    {"demo"},
    {"kornia_learnnorm"},  # the package's __init__, with the public names
    {"cli"},
]
FLOOR = {room: number for number, rooms in enumerate(FLOORS) for room in rooms}
CORE = set().union(*FLOORS[:5])
CORE_NEEDS = {"filelock", "kornia", "kornia_learnnorm", "numpy", "safetensors", "torch", *sys.stdlib_module_names}
HEAVY = ["pytorch_lightning", "lightning", "cv2", "h5py", "matplotlib", "jsonargparse", "torchmetrics", "rich", "bokeh"]
HEAVY.append("huggingface_hub")

MOST_MODULES = {"kornia_learnnorm": 7, "cli": 16}  # the command line has one for each command

FILES = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))
NAMES = {path: ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__") for path in FILES}
MODULES = set(NAMES.values())
FOLDERS = sorted({path.parent for path in FILES})


def room_of(module: str) -> str:
    """First folder or module below the package, or the package itself."""
    parts = module.split(".")
    return parts[1] if parts[0] == "kornia_learnnorm" and len(parts) > 1 else parts[0]


def imports(tree: ast.AST) -> set[str]:
    """Full names of all imports: at the top, in functions, for type checkers, and by import_module of a literal."""
    found = set()
    for node in ast.walk(tree):
        match node:
            case ast.Import(names=names):
                found |= {alias.name for alias in names}
            case ast.ImportFrom(module=str(module), names=names, level=0):
                found |= {f"{module}.{alias.name}" for alias in names}
            case ast.ImportFrom():
                raise AssertionError(f"a relative import in line {node.lineno}: write the full name")
            case ast.Call(
                func=ast.Name(id=("import_module" | "import_extra")) | ast.Attribute(attr="import_module"),
                args=[ast.Constant(value=str(module)), *_],
            ):
                found.add(module)
    return found


def module_of(name: str) -> str:
    """The module that an imported name lies in: ``a.b.C`` lies in ``a.b``."""
    return name if name in MODULES else name.rpartition(".")[0]


def climbs(importer: str, name: str) -> bool:
    """Whether a module may not import a name, since it lies on the same or a higher floor in another room."""
    own, other = room_of(importer), room_of(module_of(name))
    return own != other and FLOOR[other] >= FLOOR[own]


@pytest.fixture(params=FILES, ids=NAMES.values())
def source(request):
    """Name and imports of a module."""
    return NAMES[request.param], imports(ast.parse(request.param.read_text(encoding="utf-8")))


def test_every_room_has_a_floor():
    assert {room_of(module) for module in MODULES} == set(FLOOR)


def test_imports_point_one_way(source):
    name, imported = source
    own = {found for found in imported if found.partition(".")[0] in PACKAGES}
    if name == "kornia_learnnorm":
        allowed = tuple(
            f"kornia_learnnorm.{room}." for room in ("evaluation.diagnostics", "evaluation.search", "two_view")
        )
        assert not [n for n in own if room_of(n) not in CORE and not n.startswith(allowed)]
    else:
        assert not [found for found in own if climbs(name, found)]


def test_private_names_stay_in_their_module(source):
    _, imported = source
    assert not [found for found in imported if re.match(rf"({'|'.join(PACKAGES)})\..*\b_(?!_)", found)]


def test_libraries_have_their_place(source):
    name, imported = source
    needs = {found.partition(".")[0] for found in imported}
    assert "argparse" not in needs or room_of(name) == "cli"
    # cli/main.py names Lightning only to say which extra brings it.
    assert not needs & {"pytorch_lightning", "lightning"} or room_of(name) in {"lightning_modules", "cli"}
    if room_of(name) in CORE:
        extra = {"torchmetrics"} if name == "kornia_learnnorm.metrics.modules" else set()
        assert needs <= CORE_NEEDS | extra


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: str(folder.relative_to(ROOT)))
def test_folders_are_small(folder):
    modules = [path.stem for path in folder.glob("*.py") if path.stem != "__init__"]
    assert len(modules) <= MOST_MODULES.get(folder.name, 12)
    prefixes = Counter(stem.partition("_")[0] for stem in modules if "_" in stem)
    assert not [prefix for prefix, number in prefixes.items() if number >= 3]


@pytest.mark.parametrize(
    ("importer", "imported", "expected"),
    [
        ("kornia_learnnorm.geometry.dlt", "kornia_learnnorm.normalizers.learned.LearnedNormalizer", True),
        ("kornia_learnnorm.metrics.pairs", "kornia_learnnorm.losses.EpipolarLoss", True),
        ("kornia_learnnorm.data.store", "kornia_learnnorm", True),
        ("kornia_learnnorm.ransac.ransac", "kornia_learnnorm.geometry.dlt.null_vector", False),
        ("lightning_modules.task", "lightning_modules.datamodule", False),
    ],
)
def test_the_check_of_floors_can_fail(importer, imported, expected):
    assert climbs(importer, imported) == expected


def loaded_after(statement: str) -> list[str]:
    """Names of the heavy packages that a fresh interpreter holds after the statement."""
    code = f"{statement}\nimport sys\nprint(*[name for name in {HEAVY} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return done.stdout.split()


def core() -> list[str]:
    """All modules of the core but the one for torchmetrics."""
    return sorted(name for name in MODULES - {"kornia_learnnorm.metrics.modules"} if room_of(name) in CORE)


def test_importing_the_core_loads_nothing_heavy():
    assert loaded_after(f"import kornia_learnnorm, {', '.join(core())}") == []


def test_the_check_of_heavy_packages_can_fail():
    pytest.importorskip("h5py")
    assert "h5py" in loaded_after("import h5py")


def test_everything_offered_exists():
    assert sorted(kornia_learnnorm.__all__) == sorted(set(kornia_learnnorm.__all__))
    for name in kornia_learnnorm.__all__:
        assert getattr(kornia_learnnorm, name).__doc__
    assert kornia_learnnorm.__version__


@pytest.mark.parametrize("name", core())
def test_modules_offer_what_they_say(name):
    module = importlib.import_module(name)
    assert module.__doc__
    for offered in getattr(module, "__all__", []):
        assert getattr(module, offered).__doc__
        assert getattr(getattr(module, offered), "__module__", name) == name
