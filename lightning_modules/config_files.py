"""The training configurations that ship with the package, by name."""

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

OPTIONS = ("-c", "--config")
PACKAGED = Path(__file__).parent / "configs"  # where a wheel has them
FOLDER = PACKAGED if PACKAGED.is_dir() else Path(__file__).parents[1] / "configs"  # of the repository


def config_names() -> list[str]:
    """Return the names of the configurations, such as ``crossview`` and ``ablations/base``."""
    paths = [path.relative_to(FOLDER).with_suffix("") for path in FOLDER.rglob("*.yaml")]
    return [path.as_posix() for path in sorted(paths, key=lambda path: (len(path.parts), path))]


def find_config(name: str) -> Path:
    """Return the file of a configuration, which is given by its name or by its path."""
    if Path(name).is_file():
        return Path(name)
    names = config_names()
    if name not in names:
        known = ", ".join(known for known in names if "/" not in known)
        raise FileNotFoundError(f"no configuration {name}: expected a file, or one of {known}, ablations/*, table1/*")
    return FOLDER / f"{name}.yaml"


def with_config_paths(args: Sequence[str]) -> list[str]:
    """Return command-line arguments with the names of configurations replaced by their paths."""
    words = [word for arg in args for word in (arg.split("=", 1) if arg.startswith("--config=") else [arg])]
    return [str(find_config(word)) if before in OPTIONS else word for before, word in pairwise(["", *words])]


def names_task(args: Sequence[str]) -> bool:
    """Return whether a configuration of :func:`with_config_paths` names the class of its task."""
    import yaml

    for path in (after for before, after in pairwise(args) if before in OPTIONS):
        try:
            with Path(path).open(encoding="utf-8") as file:  # whose name is in the messages of yaml
                model = yaml.safe_load(file)["model"]
        except (yaml.YAMLError, UnicodeDecodeError) as error:
            raise ValueError(f"{path} is not a configuration: {' '.join(str(error).split())}") from error
        except (LookupError, TypeError):  # an error of jsonargparse, or no model
            continue
        if isinstance(model, dict) and "class_path" in model:
            return True
    return False
