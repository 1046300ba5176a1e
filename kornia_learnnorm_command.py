"""The console script ``learnnorm``: outside the package, whose import loads torch and can be interrupted as well."""

import sys

__all__ = ["main"]


def main() -> int:
    """Run the command line and return its exit code, 130 also where Ctrl-C comes while modules are imported."""
    try:
        import numpy  # noqa: F401  # first: imported by torch, it would swallow Ctrl-C

        from kornia_learnnorm.cli.main import main as run

        return run()
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130
