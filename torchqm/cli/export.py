"""``torchqm export``: a trained network as one small file."""

import argparse
from pathlib import Path
from typing import Any

from torchqm.cli.checkpoint import CHECKPOINT_HELP
from torchqm.cli.console import UserError, warnings_as_lines

__all__ = ["add_parser", "run"]

_DESCRIPTION = """\
Write the network of a training run to one safetensors file: its weights, its options and how
it was trained, and nothing that is executed when it is read. 'torchqm match --checkpoint' and
'torchqm benchmark --methods learned:FILE' read it, without PyTorch Lightning."""


def add_parser(commands: Any) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser(
        "export",
        help="a trained network as one small file",
        description=_DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument("run_path", metavar="RUN", help=CHECKPOINT_HELP)
    parser.add_argument(
        "--out", type=Path, required=True, metavar="FILE", help="file to write; ends with .safetensors, is replaced"
    )
    parser.set_defaults(run=run, threads=None, default_threads=1)


def run(arguments: argparse.Namespace) -> None:
    """Read a checkpoint and write it anew."""
    from torchqm.learn.checkpoints import find_weights
    from torchqm.learn.files import digest, load_net, save_net

    try:
        with warnings_as_lines():
            found = find_weights(arguments.run_path)
        net = load_net(found)
        path = save_net(net, arguments.out, _about(found))
    except ValueError as error:
        raise UserError(str(error)) from error
    except OSError as error:
        raise UserError(f"{arguments.out}: cannot be written ({error.strerror or error})") from error
    n = sum(value.numel() for value in net.state_dict().values())
    print(f"{found}: {net.options.setup}, {net.options.network}, k = {net.options.k}, {n} numbers")
    print(f"digest: {digest(net)}")
    print(f"written: {path} ({path.stat().st_size} bytes)")


def _about(checkpoint: Path) -> dict[str, Any]:
    """How it was trained: the configuration and versions that its run folder holds."""
    import json

    import yaml

    about: dict[str, Any] = {"checkpoint": checkpoint.name}
    folder = checkpoint.parent.parent
    for name, file, parse in (("config", "config.yaml", yaml.safe_load), ("versions", "versions.json", json.loads)):
        path = folder / file
        if not path.is_file():
            continue
        try:
            about[name] = parse(path.read_text("utf-8"))
        except (OSError, ValueError, yaml.YAMLError) as error:
            raise ValueError(f"{path}: cannot be read ({' '.join(str(error).split())})") from error
    return about
