"""Write a layer as a program that runs without this package: ``learnnorm export``."""

import argparse
from io import BytesIO
from pathlib import Path

import torch

from kornia_learnnorm.files import atomic_write
from kornia_learnnorm.layer_export import export_layer, export_networks, load_layer

EXAMPLES = """\
learnnorm export robust --format pt2 --out robust.pt2 --inputs mask scores
learnnorm export robust --format onnx --out robust.onnx"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``learnnorm export`` to a parser."""
    add = parser.add_argument
    add("weights", metavar="NAME_OR_PATH", help="name of shipped weights, a file, or MODULE:FILE with your own parts")
    add("--format", choices=["pt2", "onnx"], required=True, help="pt2: the layer, takes minutes; onnx: its networks")
    text = "file to write, .pt2 or .onnx; several networks are written to FILE-stage1.onnx and so on"
    add("--out", metavar="FILE", type=Path, required=True, help=text)
    add("--inputs", metavar="INPUT", nargs="+", default=[], help="inputs besides the points: weights, mask, scores")
    add("--points", metavar="N", type=int, help="fixed number of correspondences (default: any number from 9 on)")


def run(args: argparse.Namespace) -> int:
    """Write the program, or one file for each network."""
    if args.out.suffix != f".{args.format}":
        raise ValueError(f"--format {args.format} is written to a .{args.format} file, got {str(args.out)!r}")
    if args.format == "onnx":
        if args.inputs or args.points is not None:
            raise ValueError("--inputs and --points belong to --format pt2: the networks are written by themselves")
        programs = export_networks(load_layer(args.weights))
        for name, program in programs.items():
            file = args.out if len(programs) == 1 else args.out.with_stem(f"{args.out.stem}-{name}")
            with atomic_write(file) as temporary:
                temporary.write_bytes(program.model_proto.SerializeToString())
            print(f"wrote {file}: {file.stat().st_size / 1e6:.1f} MB")
        return 0
    with atomic_write(args.out) as temporary:  # a path that cannot be written is refused before the work
        buffer = BytesIO()  # a file would give its temporary name to the archive
        torch.export.save(export_layer(load_layer(args.weights), args.inputs, args.points), buffer)
        temporary.write_bytes(buffer.getvalue())
    print(f"wrote {args.out}: {args.out.stat().st_size / 1e6:.1f} MB")
    return 0
