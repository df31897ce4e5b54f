"""The command ``pnpnet``. Each subcommand is a module: the module's docstring is the help of the subcommand.

A module's ``run`` returns the exit code. PyTorch is imported after parsing, so bad arguments are reported at once.
"""

from __future__ import annotations

import argparse
import sys

from kornia_pnpnet import __version__
from kornia_pnpnet.cli import demo, evaluate, export, listing, solve
from kornia_pnpnet.cli.arguments import ARGUMENTS, OneLineParser

#: All commands by name, in the order of ``pnpnet --help``.
COMMANDS = {"solve": solve, "evaluate": evaluate, "export": export, "list": listing, "demo": demo}


def make_parser() -> argparse.ArgumentParser:
    """Build the parser of ``pnpnet``. The parsed ``command`` is a key of :data:`COMMANDS`."""
    parser = OneLineParser(prog="pnpnet", description="Camera poses from 2D-3D matches, even when some are wrong.")
    parser.add_argument("--version", action="version", version=f"pnpnet {__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", dest="command", required=True)
    for name, command in COMMANDS.items():
        text = command.__doc__ or ""
        help_, form = text.partition("\n")[0].rstrip("."), argparse.RawDescriptionHelpFormatter
        added = commands.add_parser(name, help=help_, description=text, formatter_class=form)
        for argument, about in ARGUMENTS[name].items():
            added.add_argument(argument, **about)
    return parser


def main(argv: list[str] | None = None) -> int:
    """Run the command line with the arguments ``argv``. ``None`` means the arguments of the process.

    Returns:
        The exit code: 0 for success, 1 when ``solve`` found no pose, 2 for bad input, 130 after an interruption.
    """
    try:
        arguments = make_parser().parse_args(argv)
        from kornia_pnpnet.core.performance import keep_freed_memory

        keep_freed_memory()
        code: int = COMMANDS[arguments.command].run(arguments)
        return code
    except KeyboardInterrupt:
        print("pnpnet: interrupted", file=sys.stderr)
        return 130
    except Exception as error:
        print(f"pnpnet: {_reason(error)}", file=sys.stderr)
        return 2


def _reason(error: Exception) -> str:
    """Describe in one line an error of the input or of the machine. Raise any other error again."""
    if isinstance(error, OSError) and error.filename and error.strerror:
        return " ".join(f"{error.filename}: {error.strerror}".splitlines())  # file names may contain line breaks
    from kornia.core.exceptions import BaseError

    notes = [f"({note})" for note in getattr(error, "__notes__", ())]
    reason = " ".join(" ".join([str(error) or type(error).__name__, *notes]).split())
    if isinstance(error, (BaseError, OSError, ImportError, ValueError)):
        return reason
    if isinstance(error, MemoryError) or (isinstance(error, RuntimeError) and "allocate" in str(error)):
        return f"not enough memory: {reason}"
    raise error
