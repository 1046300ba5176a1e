"""Files of trained weights: tensors, architecture and training data in one safetensors file."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from hashlib import sha256
from pathlib import Path
from typing import Any, TypeVar

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import nn

from kornia_learnnorm.files import atomic_write

__all__ = ["check_architecture", "load_module", "save_module", "shipped_weights", "weights_digest", "weights_format"]

WEIGHTS = Path(__file__).parent / "weights"
CLASSES = {  # of the modules that files hold, by the format
    "kornia_learnnorm.normalizer.v1": "LearnedNormalizer",
    "kornia_learnnorm.eight_point.v1": "LearnedEightPoint",
}
MAX_ARCHITECTURE_INT = 4096  # largest width, depth or number of iterations that a file may name

Module = TypeVar("Module", bound=nn.Module)


def save_module(path: str | Path, module: nn.Module, form: str, architecture: Mapping[str, Any]) -> None:
    """Write weights, architecture and ``trained_on`` of a module to one file, beside the target and then renamed.

    Args:
        path: the file to write.
        module: the module, with the attribute ``trained_on``.
        form: name of the format.
        architecture: what builds the module again, for JSON.

    Raises:
        ValueError: if ``path`` does not end in ``.safetensors``.
        OSError: if it cannot be written.

    """
    if Path(path).suffix != ".safetensors":
        raise ValueError(f"weights are written to a .safetensors file, got {str(path)!r}")
    state = {key: value.detach().cpu().contiguous() for key, value in module.state_dict().items()}
    metadata = {
        "format": form,
        "architecture": json.dumps(architecture),
        "trained_on": json.dumps(module.trained_on),
    }
    with atomic_write(path) as beside:
        try:
            save_file(state, beside, metadata=metadata)
        except SafetensorError as error:
            raise OSError(f"{path} could not be written: {error}") from error


def load_module(name: str | Path, form: str, build: Callable[[Path, str], Module]) -> Module:
    """Load a module that :func:`save_module` wrote: one that ships with the package, by name, or a file.

    Args:
        name: name of shipped weights, or the path of a ``.safetensors`` file.
        form: name of the format that is expected.
        build: makes the module of the path, for messages, and the architecture as JSON text; called on the device
            ``meta``, where weights take no memory before their shapes are known to be those in the file.

    Returns:
        the module, in evaluation mode, in the dtype of its weights.

    Raises:
        FileNotFoundError: if there are no such weights; the message lists those that ship.
        ValueError: if the file is not of the format or its tensors do not fit.

    """
    path = weights_path(name)
    if not path.is_file() and Path(name).is_file():
        raise ValueError(f"{name} is not a .safetensors file by its name")
    if not path.is_file():
        raise FileNotFoundError(
            f"no weights {str(name)!r}: expected a .safetensors file or one of {', '.join(shipped_weights(form))}"
        )
    try:
        with safe_open(path, "pt") as file:
            metadata = file.metadata() or {}
            state = {key: file.get_tensor(key).clone() for key in file.keys()}  # noqa: SIM118 (not a dict)
    except SafetensorError as error:
        raise ValueError(f"{path} is not a safetensors file: {error}") from error
    if metadata.get("format") != form:
        got, fitting = metadata.get("format"), ", ".join(shipped_weights(form))
        if got in CLASSES:
            raise ValueError(
                f"{name} holds the weights of a {CLASSES[got]}, expected those of a {CLASSES[form]}, such as {fitting}"
            )
        raise ValueError(
            f"{path} has another format: expected format {form!r}, got {got!r}; the package's of that format: {fitting}"
        )
    with torch.device("meta"):
        module = build(path, metadata.get("architecture", ""))
    try:
        module.load_state_dict(state, strict=True, assign=True)
    except RuntimeError as error:
        text = " ".join(str(error).split())
        raise ValueError(f"{path}: the tensors do not fit the architecture: {text}") from error
    module.to(next(iter(state.values())).dtype if state else None)
    broken = [key for key, value in state.items() if not bool(value.isfinite().all())]
    if broken:
        raise ValueError(f"{path}: NaN or infinite weights in {', '.join(broken[:3])}")
    module.trained_on = _read_names(path, metadata.get("trained_on", "[]"))  # type: ignore[assignment]
    return module.eval()


def shipped_weights(form: str | None = None) -> list[str]:
    """Return the names of the weights that ship with the package, of one format or of all."""
    names = []
    for path in WEIGHTS.glob("*.safetensors"):
        with safe_open(path, "pt") as file:
            if form is None or file.metadata()["format"] == form:
                names.append(path.stem)
    return sorted(names)


def weights_format(name: str | Path) -> str | None:
    """Return the format of shipped weights by name or of a file; None where there is no such file.

    A file that is none of this package has the format "".
    """
    path = weights_path(name)
    if not path.is_file():
        return "" if Path(name).is_file() else None
    try:
        with safe_open(path, "pt") as file:
            return str((file.metadata() or {}).get("format", ""))
    except SafetensorError:
        return ""


def weights_digest(name: str | Path) -> str:
    """Return what tells files of weights apart, of shipped weights by name or of a file."""
    return sha256(weights_path(name).read_bytes()).hexdigest()[:16]


def weights_path(name: str | Path) -> Path:
    """Return the file of shipped weights, or the path that ends in ``.safetensors`` as it is."""
    return Path(name) if Path(name).suffix == ".safetensors" else WEIGHTS / f"{name}.safetensors"


def check_architecture(*parts: Mapping[str, Any]) -> None:
    """Raise a ValueError for numbers that no module of this package needs, and that would take all memory."""
    large = [v for part in parts for v in part.values() if isinstance(v, int) and v > MAX_ARCHITECTURE_INT]
    if large:
        raise ValueError(f"numbers can be at most {MAX_ARCHITECTURE_INT}, got {large[0]}")


def _read_names(path: Path, text: str) -> tuple[str, ...]:
    """Return the names in a JSON list."""
    try:
        names = json.loads(text)
    except ValueError:
        names = None
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise ValueError(f"{path}: trained_on must be a JSON list of names, got {text[:80]!r}")
    return tuple(names)
