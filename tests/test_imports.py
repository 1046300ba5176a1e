"""Which room may import which, which libraries the core needs, and what importing the package loads."""

import ast
import subprocess
import sys
from collections import Counter
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGES = ("kornia_learnnorm", "lightning_modules")

# From the bottom up. A room imports from itself and from lower floors; rooms of one floor do not import each other.
FLOORS = [
    {"files", "optional", "protocol"},
    {"geometry", "pretrained"},
    {"models"},
    {"normalizers", "metrics", "training_losses"},
    {"estimators"},
    {"ransac"},
    {"data", "layer_export", "hub"},
    {"two_view"},
    {"evaluation", "lightning_modules"},
    {"browser_demo"},
    {"kornia_learnnorm"},  # the package's __init__, with the public names
    {"cli"},
]
FLOOR = {room: number for number, rooms in enumerate(FLOORS) for room in rooms}
CORE = set().union(*FLOORS[:6])
CORE_NEEDS = {"filelock", "kornia", "kornia_learnnorm", "numpy", "safetensors", "torch", *sys.stdlib_module_names}
# cli/main.py names Lightning only to say which extra brings it.
PLACES = {"argparse": {"cli"}, "pytorch_lightning": {"lightning_modules", "cli"}}
HEAVY = ["pytorch_lightning", "lightning", "cv2", "h5py", "matplotlib", "jsonargparse", "torchmetrics", "tabulate"]
HEAVY += ["gradio", "huggingface_hub"]


def room_of(name: str) -> str:
    """Return the first folder or module below the package that a name lies in, or the package itself."""
    package, _, rest = name.partition(".")
    return rest.partition(".")[0] if package == "kornia_learnnorm" and rest else package


def imports(tree: ast.AST) -> set[str]:
    """Return the full names of all imports: at the top, in functions, and by import_module of a literal."""
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


@cache
def all_imports():
    """Return pairs of a module and a name that it imports."""
    paths = [path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))]
    names = [".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__") for path in paths]
    trees = [ast.parse(path.read_text(encoding="utf-8")) for path in paths]
    return [(name, found) for name, tree in zip(names, trees, strict=True) for found in sorted(imports(tree))]


def climbs(importer: str, name: str) -> bool:
    """Return whether a module may not import a name, since it lies on the same or a higher floor in another room."""
    own, other = room_of(importer), room_of(name)
    if other not in FLOOR:  # a public name of the package itself
        other = "kornia_learnnorm"
    return own != other and FLOOR[other] >= FLOOR[own]


def test_imports_point_one_way():
    own = [(importer, name) for importer, name in all_imports() if name.partition(".")[0] in PACKAGES]
    assert [pair for pair in own if climbs(*pair)] == []
    assert climbs("kornia_learnnorm.geometry.dlt", "kornia_learnnorm.normalizers.closed_form.Hartley")
    assert climbs("kornia_learnnorm.metrics.inliers", "kornia_learnnorm.training_losses.EpipolarLoss")
    assert climbs("kornia_learnnorm.data.store", "kornia_learnnorm.EightPoint")
    assert not climbs("kornia_learnnorm.ransac.ransac", "kornia_learnnorm.geometry.dlt.solve_rows")


def test_libraries_have_their_place():
    needs = [(importer, name.partition(".")[0]) for importer, name in all_imports()]
    core = [(importer, library) for importer, library in needs if room_of(importer) in CORE]
    assert [pair for pair in core if pair[1] not in CORE_NEEDS] == []
    assert [pair for pair in needs if pair[1] in PLACES and room_of(pair[0]) not in PLACES[pair[1]]] == []


def test_no_file_name_occurs_twice():
    """A responsibility has one place to look for."""
    names = Counter(path.stem for path in (ROOT / "kornia_learnnorm").rglob("*.py") if path.stem != "__init__")
    assert [name for name, number in names.items() if number > 1] == []


def test_importing_the_package_loads_nothing_heavy():
    code = f"import sys, kornia_learnnorm; print(*[name for name in {HEAVY} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []
