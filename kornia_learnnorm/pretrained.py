"""Files of trained weights: tensors, architecture and training data in one safetensors file.

A file names the parts to build, one of your own by its import path; only a module that the caller names is imported.
"""

import importlib
import inspect
import json
from collections.abc import Callable, Collection, Mapping
from contextlib import suppress
from os import PathLike
from pathlib import Path
from typing import Any, TypeVar

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import nn

from kornia_learnnorm.files import atomic_write, explained
from kornia_learnnorm.optional import working_folder_importable

WEIGHTS = Path(__file__).parent / "weights"
CLASSES = {  # of the modules that files hold, by the format and the two-view model
    ("kornia_learnnorm.normalizer.v1", ""): "LearnedNormalizer",
    ("kornia_learnnorm.eight_point.v1", "fundamental"): "LearnedEightPoint",
    ("kornia_learnnorm.eight_point.v1", "essential"): "LearnedRelativePose",
    ("kornia_learnnorm.eight_point.v1", "homography"): "LearnedHomography",
    ("kornia_learnnorm.match_refiner.v1", ""): "MatchRefiner",
}
MAX_ARCHITECTURE_INT = 4096  # largest width, depth or number of iterations that a file may name

Module = TypeVar("Module", bound=nn.Module)


def save_module(path: str | Path, module: nn.Module, file_format: str, architecture: Mapping[str, Any]) -> None:
    """Write weights, architecture (for JSON) and ``trained_on`` of a module to one ``.safetensors`` file."""
    if Path(path).suffix != ".safetensors":
        raise ValueError(f"weights are written to a .safetensors file, got {str(path)!r}")
    state = {key: value.detach().cpu().contiguous() for key, value in module.state_dict().items()}
    texts = {"architecture": json.dumps(architecture), "trained_on": json.dumps(module.trained_on)}
    with atomic_write(path) as beside:
        try:
            save_file(state, beside, metadata={"format": file_format, **texts})
        except SafetensorError as error:
            raise OSError(f"{path} could not be written: {error}") from error


def load_module(
    name: str | Path, file_format: str, kind: str, build: Callable[[dict[str, Any]], Module], model: str = ""
) -> Module:
    """Load a module that :func:`save_module` wrote, by name or file, in evaluation mode and the dtype of its weights.

    ``build`` makes it from the architecture on the device ``meta``: weights take no memory before their shapes are
    known to be those in the file. Errors name the kind, and shipped weights of this format and two-view model.
    """
    path = weights_path(name)
    if not path.is_file() and Path(name).is_file():
        raise ValueError(f"{name} is not a .safetensors file by its name; load_state_dict takes a saved state_dict")
    shipped = shipped_weights(file_format)
    fitting = ", ".join([other for other in shipped if weights_model(other) == model] or shipped)
    if not path.is_file():
        raise FileNotFoundError(f"no weights {str(name)!r}: expected a .safetensors file or one of {fitting}")
    with explained(f"{path} is not a safetensors file", SafetensorError), safe_open(path, "pt") as file:
        metadata = file.metadata() or {}
        state = {key: file.get_tensor(key).clone() for key in file.keys()}  # noqa: SIM118 (not a dict)
    if (got := metadata.get("format")) != file_format:
        owner = CLASSES.get((str(got), weights_model(path)))
        held = f"{got!r} of a {owner}" if owner else repr(got)
        expected = f"{file_format!r} of a {CLASSES.get((file_format, model), 'layer')}, such as {fitting}"
        raise ValueError(f"{name}: expected format {expected}, got {held}")
    errors = ValueError, KeyError, TypeError, AttributeError, RuntimeError
    with explained(f"{path} describes no {kind} of this version and class", *errors), torch.device("meta"):
        module = build(dict(json.loads(metadata.get("architecture", ""))))
    try:
        module.load_state_dict(state, strict=True, assign=True)
    except RuntimeError as error:
        text = " ".join(str(error).split())
        raise ValueError(f"{path}: the tensors do not fit the architecture: {text}") from error
    if broken := [key for key, value in state.items() if not bool(value.isfinite().all())]:
        raise ValueError(f"{path}: NaN or infinite weights in {', '.join(broken[:3])}")
    if any(value.is_meta for value in (*module.parameters(), *module.buffers())):
        raise ValueError(f"{path}: a constructor makes a tensor that state_dict does not hold: register it as a buffer")
    names, text = None, metadata.get("trained_on", "[]")
    with suppress(ValueError):
        names = json.loads(text)
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise ValueError(f"{path}: trained_on must be a JSON list of names, got {text[:80]!r}")
    module.trained_on = tuple(names)  # type: ignore[assignment]
    return module.eval()


def shipped_weights(file_format: str | None = None) -> list[str]:
    """Return the names of the weights that ship with the package, of one format or of all."""
    paths = WEIGHTS.glob("*.safetensors")
    return sorted(path.stem for path in paths if file_format in (None, _metadata(path)["format"]))


def own_weights(name: str | Path) -> tuple[str, str]:
    """Return the module and the file of ``MODULE:FILE.safetensors``, weights of own parts; no module elsewhere."""
    module, _, path = str(name).rpartition(":")
    return (module, path) if Path(path).suffix == ".safetensors" else ("", str(name))


def weights_format(name: str | Path) -> str | None:
    """Return the format of shipped weights or of a file: "" of a file of no format, None where there is no file."""
    path = weights_path(name)
    if not path.is_file():
        return "" if Path(name).is_file() else None
    with suppress(SafetensorError):
        return _metadata(path).get("format", "")
    return ""


def weights_model(name: str | Path) -> str:
    """Return the two-view model that weights name, "" where there is none; loading the file tells what is wrong."""
    with suppress(OSError, SafetensorError, ValueError, LookupError, TypeError):
        return str(json.loads(_metadata(weights_path(name))["architecture"])["model"])
    return ""


def weights_path(name: str | Path) -> Path:
    """Return the file of shipped weights, of some of which the wheel has only the card, or a ``.safetensors`` path."""
    if not isinstance(name, str | PathLike):
        raise TypeError(f"expected a name or a path of weights, got {name!r}")
    if Path(name).suffix == ".safetensors":
        return Path(name)
    path = WEIGHTS / f"{name}.safetensors"
    if not path.is_file() and str(name) in {card.stem for card in WEIGHTS.glob("*.md")}:
        advice = f"take kornia_learnnorm/weights/{path.name} from the repository, and give its path or put it into"
        raise FileNotFoundError(f"the weights {str(name)!r} are not in the wheel: {advice} {WEIGHTS}")
    return path


def _metadata(path: Path) -> dict[str, str]:
    with safe_open(path, "pt") as file:
        return file.metadata() or {}


def check_architecture(*parts: Mapping[str, Any]) -> None:
    """Raise a ValueError for numbers that no module of this package needs, and that would take all memory."""
    if large := [v for part in parts for v in part.values() if isinstance(v, int) and v > MAX_ARCHITECTURE_INT]:
        raise ValueError(f"numbers can be at most {MAX_ARCHITECTURE_INT}, got {large[0]}")


def name_part(part: Any, *modules: Any) -> str:
    """Return the name of a class or function: its own in one of this package's modules, elsewhere its import path."""
    module, name = getattr(part, "__module__", ""), getattr(part, "__name__", "")
    if any(getattr(known, name, None) is part for known in modules):
        return str(name)
    with working_folder_importable(), suppress(ImportError, AttributeError, ValueError):
        if module != "__main__" and getattr(importlib.import_module(module), name) is part:
            return f"{module}.{name}"
    raise TypeError(f"{part!r} cannot be imported by its name: define it at the top level of a module, not in a script")


def describe_part(part: object, *modules: Any) -> dict[str, Any]:
    """Return the name of a module and its constructor's arguments: numbers and texts, kept as attributes."""
    name, arguments = name_part(type(part), *modules), inspect.signature(type(part)).parameters.values()
    # A part without its own constructor shows the `*args, **kwargs` of `nn.Module`.
    keys = [argument.name for argument in arguments if argument.kind is argument.POSITIONAL_OR_KEYWORD]
    if missing := [key for key in keys if not hasattr(part, key)]:
        raise TypeError(f"{name} cannot be saved: its constructor must keep {missing[0]!r} as an attribute")
    values = {key: getattr(part, key) for key in keys}
    for key, value in values.items():
        if not isinstance(value, bool | int | float | str | None):
            raise TypeError(f"{name} cannot be saved with its architecture: {key} is {value!r}, not a number or a text")
    return {**values, "name": name}


def find_part(name: str, own_modules: Collection[str], *modules: Any) -> Any:
    """Return the class or function that a file names: a public one of ``modules``, or one of ``own_modules``."""
    for known in modules:
        if name in known.__all__:
            return getattr(known, name)
    module, _, attribute = name.rpartition(".")
    if not module:
        raise ValueError(f"unknown part {name!r}")
    if module not in ([own_modules] if isinstance(own_modules, str) else own_modules):
        how = f"import it by own_modules=[{module!r}], on the command line by {module}:FILE"
        raise ValueError(f"{name} is not of this package; if you trust the module, {how}")
    with working_folder_importable(), explained(f"{name} cannot be imported"):
        found = getattr(importlib.import_module(module), attribute)
    if not callable(found) or getattr(found, "__module__", None) != module:
        raise ValueError(f"{name} is not a class or function that {module} defines")
    return found
