"""The methods that an evaluation compares, by name."""

import inspect
import sys
from collections.abc import Callable, Sequence
from hashlib import sha256
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, Literal, NamedTuple

from torch import Tensor

from kornia_learnnorm import Hartley, Identity, LearnedNormalizer, ReweightedWhitening, Whitening, refine_fundamental
from kornia_learnnorm.estimators.learned_layer import FORMAT as LAYER_FORMAT
from kornia_learnnorm.estimators.linear import solve_in_coordinates
from kornia_learnnorm.evaluation.searched_normalizer import SearchedNormalizer
from kornia_learnnorm.files import explained, short_name
from kornia_learnnorm.geometry.problem import LinearProblem
from kornia_learnnorm.models.fundamental import Fundamental
from kornia_learnnorm.normalizers.learned_normalizer import FORMAT
from kornia_learnnorm.normalizers.normalizer import Normalizer, normalizing_transforms
from kornia_learnnorm.optional import working_folder_importable
from kornia_learnnorm.pretrained import own_weights, shipped_weights, weights_format, weights_path

__all__ = ["Method", "default_methods", "find_method"]

CLOSED_FORMS: dict[str, Callable[[], Normalizer]] = {
    "none": Identity,
    "Hartley": Hartley,
    "whitening": Whitening,
    "reweighted": ReweightedWhitening,
    "searched": SearchedNormalizer,
}
REFINED, OPTIMAL = "+LM", "+optimal"  # suffixes of a method's name
SHIPPED = ("paper", "crossview", "crossview-synthetic")  # weights
UNKNOWN = "not known"  # training data
KEPT_METHODS = ("Hartley+optimal", "Hartley+LM", "crossview+LM")  # further default methods of a run that is kept


def default_methods(weights: Sequence[str] = (), *, kept: bool = False) -> tuple[str, ...]:
    """Return the names of the default methods: closed forms, weights, and the search as the limit of them all.

    Of two weights that have one name in tables, ``weights`` replace the shipped ones; ``kept`` adds ``KEPT_METHODS``.
    Weights whose file is not installed are left out.
    """
    *closed_forms, search = CLOSED_FORMS
    given = {short_name_of(name) for name in weights}
    shipped = [name for name in SHIPPED if name not in given and name in shipped_weights(FORMAT)]
    further = [name for name in KEPT_METHODS if kept and base_name(name) not in given]
    return (*closed_forms, *shipped, *weights, search, *further)


class Method(NamedTuple):
    """A normaliser and what follows the direct linear transformation."""

    normalizer: Normalizer  # maps (points1, points2, weights) to two transforms
    rank2: Literal["projection", "optimal"] = "projection"  # how the singularity constraint is enforced
    refined: bool = False  # whether Levenberg-Marquardt follows
    # As in LearnedNormalizer.trained_on; UNKNOWN of weights that do not say it and of code that is not this package's.
    trained_on: tuple[str, ...] = ()

    def estimate(self, points1: Tensor, points2: Tensor) -> Tensor:
        """Return the fundamental matrices (B, 3, 3) of points in pixels, (B, N, 2) float64 each."""
        problem = LinearProblem.from_points(points1, points2, None, Fundamental(self.rank2))
        return self.solve(problem, *normalizing_transforms(self.normalizer, problem))

    def solve(self, problem: LinearProblem, T1: Tensor, T2: Tensor) -> Tensor:
        """Return the fundamental matrices (B, 3, 3) of a problem under the transforms of the normaliser."""
        F_mat = solve_in_coordinates(problem, T1, T2)
        return refine_fundamental(problem.points1, problem.points2, F_mat).F_mat if self.refined else F_mat


def find_method(name: str) -> Method:
    """Return a method by its name; raise ValueError or FileNotFoundError, which say what is wrong, if there is none.

    Args:
        name: ``none``, ``Hartley``, ``whitening``, ``reweighted`` or ``searched``; weights that ship or the path of a
            ``.safetensors`` file, ``module:FILE.safetensors`` where it names parts of that module of your own; or the
            import path of a normaliser class or function, ``package.module:Name``. Modules are looked for in the
            current folder last. With ``+LM``, Levenberg-Marquardt refines the result on the Sampson distance; with
            ``+optimal``, the covariance-weighted correction takes the place of the projection to rank 2.
    """
    base = base_name(name)
    normalizer = _find_normalizer(base)
    trained_on = () if base in CLOSED_FORMS else getattr(normalizer, "trained_on", ()) or (UNKNOWN,)
    return Method(normalizer, "optimal" if name.endswith(OPTIMAL) else "projection", name.endswith(REFINED), trained_on)


def base_name(name: str) -> str:
    """Return a method's name without suffix, the name of its normalisation."""
    return name.removesuffix(REFINED if name.endswith(REFINED) else OPTIMAL)


def _find_normalizer(name: str) -> Normalizer:
    if name in CLOSED_FORMS:
        return CLOSED_FORMS[name]()
    module, path = own_weights(name)
    if module:
        return LearnedNormalizer.from_pretrained(path, [module])
    if ":" in name:
        return _own_normalizer(name)
    shipped, suffix = shipped_weights(FORMAT), Path(name).suffix
    if weights_format(name) == LAYER_FORMAT:
        expected = f"expected those of a LearnedNormalizer, such as {', '.join(shipped)}"
        advice = f"learnnorm robust STORE --out RUN --estimators learned:{name} evaluates them"
        raise ValueError(f"{name} holds the weights of a LearnedEightPoint, {expected}; {advice}")
    if suffix == ".ckpt":
        raise FileNotFoundError(f"{name} is a checkpoint: learnnorm fit writes weights.safetensors beside its folder")
    if name not in shipped and suffix != ".safetensors":
        expected = f"{', '.join([*CLOSED_FORMS, *shipped])}, a .safetensors file or module:Name"
        suffixes = f"each without suffix or with {REFINED} or {OPTIMAL}"
        raise FileNotFoundError(f"no weights {name!r} and no such normalisation: expected {expected}, {suffixes}")
    return LearnedNormalizer.from_pretrained(name)


def _own_normalizer(name: str) -> Normalizer:
    """Return a user's normaliser; its errors become a ValueError with its name."""
    found = _import(name)
    with explained(f"{name!r} cannot be made without arguments, as the class of a method must"):
        made = found() if isinstance(found, type) else found
    if not callable(made):
        raise ValueError(f"{name!r} is not a normaliser: it cannot be called")

    def normalize(points1: Tensor, points2: Tensor, weights: Tensor | None = None) -> tuple[Tensor, Tensor]:
        with explained(f"{name} failed, called with points1, points2 and weights"):
            return normalizing_transforms(made, LinearProblem.from_points(points1, points2, weights, Fundamental()))

    return normalize


def _import(name: str) -> Any:
    """Import a class or function by its import path, from the current folder too, as ``python -m`` does."""
    expected = f"no normaliser at {name!r}, expected module:Name, looked for in {Path.cwd()} too"
    with explained(expected), working_folder_importable():
        return resolve_name(name)


def identify_method(name: str) -> str:
    """Return what a method's predictions depend on: its name, and for weights and own code the digest of the files."""
    base = base_name(name)
    if base in CLOSED_FORMS:
        return name
    module, path = own_weights(base)
    if module:
        files = [Path(path), Path(_import(f"{module}:__file__"))]
    elif ":" in base:  # the module in the import path, and the one that defines the class or function
        found = _import(base)
        parts = (sys.modules[base.partition(":")[0]], inspect.getmodule(found), inspect.getmodule(type(found)))
        files = sorted({Path(file) for part in parts if (file := getattr(part, "__file__", None))})
    else:
        files = [weights_path(base)]
    return f"{name} {sha256(b''.join(path.read_bytes() for path in files)).hexdigest()[:16]}"


def short_name_of(name: str) -> str:
    """Return a method's name for tables and files: for a path, that of the run's folder or of the file."""
    base = base_name(name)
    return short_name(own_weights(base)[1]) + name[len(base) :] if Path(base).suffix == ".safetensors" else name
