"""The version of the package, alone in its file so that setuptools can read it without importing torch."""

__all__ = ["__version__"]

__version__ = "0.1.0"
