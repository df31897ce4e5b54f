"""The command ``pnpnet``: its arguments, the files of pairs that it reads, and one module per command."""

from kornia_pnpnet.cli.main import main

__all__ = ["main"]
