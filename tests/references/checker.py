"""The run-time type checker of the test suite: beartype, where an int is a float as it is for mypy (PEP 484)."""

from beartype import BeartypeConf, beartype

checked = beartype(conf=BeartypeConf(is_pep484_tower=True))
