"""Reading a YAML file of the user's: what is wrong with it in one line that names it."""

from pathlib import Path
from typing import Any

from torchqm.cli.console import UserError

__all__ = ["read_yaml"]


def read_yaml(path: Path) -> Any:
    """What a YAML file holds.

    Raises:
        UserError: it is not there, or not YAML.
    """
    import yaml

    try:
        return yaml.safe_load(path.read_text("utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        text = error.strerror if isinstance(error, OSError) and error.strerror else " ".join(str(error).split())
        raise UserError(f"{path}: not readable as YAML ({text})") from error
