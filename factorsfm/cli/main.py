"""The command line: parses the arguments, runs the command, and prints its outcome."""

from __future__ import annotations

import argparse
import io
import logging
import os
import sys
from collections.abc import Sequence
from contextlib import suppress
from logging.handlers import MemoryHandler
from typing import Any, NoReturn

from factorsfm.cli import align, batch, demo, export, extend, overlay, reconstruct, solve, stream, view
from factorsfm.cli.progress_line import LogHandler, ProgressLine
from factorsfm.support.errors import FactorsfmError, ReconstructionError
from factorsfm.support.json_text import as_text, is_text
from factorsfm.support.program import program_version

logger = logging.getLogger(__name__)

BAD_INPUT, NOT_RECONSTRUCTED, INTERRUPTED = 2, 3, 130

_COMMANDS = {
    module.COMMAND.name: module.COMMAND
    for module in (reconstruct, stream, batch, extend, solve, view, align, demo, export, overlay)
}
_LOGGED = 1000  # log lines that wait for the end


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command.

    Returns:
        The exit status: 0 done, 2 bad input, 3 the shot cannot be reconstructed, 130 interrupted.
    """
    _open_outputs()
    arguments = _parsed(sys.argv[1:] if argv is None else argv)
    command = _COMMANDS[arguments.command]
    terminal = sys.stderr.isatty()
    progress = ProgressLine(sys.stderr, enabled=terminal and not arguments.verbose)
    lines = LogHandler(progress, all_alike=arguments.verbose > 0)
    log = _start_log(lines, arguments.verbose, at_once=terminal or arguments.verbose > 0 or command.followed)
    try:
        with progress:
            said = command.run(arguments, progress)
            progress.clear()
    except ReconstructionError as error:
        return _complain(f"error: {error}", NOT_RECONSTRUCTED)
    except FactorsfmError as error:
        log.buffer.clear()
        return _complain(f"error: {error}", BAD_INPUT)
    except KeyboardInterrupt:
        return _complain("interrupted", INTERRUPTED)
    except (OSError, MemoryError) as error:  # from the machine; not an error of the program
        logger.debug("", exc_info=True)
        log.buffer.clear()
        return _complain(f"error: {str(error) or 'not enough memory'}", BAD_INPUT)
    finally:
        with suppress(OSError):  # of standard error, which may be full
            log.flush()
            lines.say_rest()
    _say(as_text(said))
    return 0


def _open_outputs() -> None:
    """Let standard output and error take every text: what their encoding does not know becomes an escape.

    A closed one leads nowhere.
    """
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_WRONLY), "w", encoding="utf-8"))
        elif isinstance(stream, io.TextIOWrapper) and stream.errors == "strict":
            stream.reconfigure(errors="backslashreplace")


def _say(text: str) -> None:
    """Print the outcome. Everything is written by then, so an output that is full or gone is no failure."""
    try:
        print(text, flush=True)
    except OSError as error:
        _complain(f"done, but standard output cannot be written: {error.strerror or error}", 0)
        with suppress(OSError):  # else the rest is written once more at the end of the program, and fails again
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _start_log(lines: LogHandler, verbose: int, *, at_once: bool) -> MemoryHandler:
    """Log to stderr, at once or at the end; the end can drop the warnings, so that bad input is one line."""
    level = (logging.WARNING, logging.INFO, logging.DEBUG)[min(verbose, 2)]
    log = MemoryHandler(_LOGGED, logging.DEBUG if at_once else logging.CRITICAL, lines)
    logging.basicConfig(level=level, handlers=[log])
    logging.captureWarnings(True)
    return log


def _complain(message: str, status: int) -> int:
    with suppress(OSError):
        print(f"factorsfm: {' '.join(message.split())}", file=sys.stderr, flush=True)
    return status


# --- the arguments ------------------------------------------------------------------------------------------------


class _Parser(argparse.ArgumentParser):
    """Prints errors in one line, like all errors of the command line."""

    def error(self, message: str) -> NoReturn:
        sys.exit(_complain(f"error: {message} (see {self.prog} --help)", BAD_INPUT))


def _parsed(argv: Sequence[str]) -> argparse.Namespace:
    parser = _parser()
    if strange := [argument for argument in argv if not is_text(argument)]:
        parser.error(f"the argument {strange[0]!r} is not UTF-8")
    return parser.parse_args(argv)


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="factorsfm",
        description="Depth-guided structure from motion for shots with little parallax.",
        epilog="Exit status: 0 done, 2 bad input, 3 the shot cannot be reconstructed, 130 interrupted.",
    )
    parser.add_argument("--version", action="version", version=f"factorsfm {program_version()}")
    verbose: dict[str, Any] = {"action": "count", "help": "log what happens; twice: in every detail"}
    parser.add_argument("-v", "--verbose", default=0, **verbose)
    common = _Parser(add_help=False)  # no default: it would overwrite a -v before the command
    common.add_argument("-v", "--verbose", default=argparse.SUPPRESS, **verbose)
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for command in _COMMANDS.values():
        command.add_arguments(
            commands.add_parser(command.name, parents=[common], help=command.help, description=command.description)
        )
    return parser
