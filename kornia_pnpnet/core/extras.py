"""Packages that only some parts of the library need, and how to install them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


def how_to_install(extra: str) -> str:
    """Return the command that installs an extra from a clone. No package index has this library yet."""
    return f"in a clone of kornia_pnpnet, pip install '.[{extra}]'"


@contextmanager
def needs(extra: str, message: str) -> Iterator[None]:
    """A context for imports of an extra's packages. An ``ImportError`` names the command that installs the extra.

    Example:
        >>> with needs("eval", "Pictures need matplotlib"):
        ...     import a_missing_package
        Traceback (most recent call last):
        ...
        ImportError: Pictures need matplotlib: in a clone of kornia_pnpnet, pip install '.[eval]'
    """
    try:
        yield
    except ImportError as error:
        why = "" if isinstance(error, ModuleNotFoundError) else f" ({error})"
        raise ImportError(f"{message}{why}: {how_to_install(extra)}") from error
