"""``factorsfm view``: the report of a result in the browser."""

from __future__ import annotations

import argparse
import webbrowser
from pathlib import Path

from factorsfm.cli.command import Command, add_shot
from factorsfm.cli.progress_line import ProgressLine
from factorsfm.report.desk import write_desk
from factorsfm.report.result_folder import report_of


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.add_argument("result", type=Path, metavar="RESULT", help="folder that factorsfm reconstruct has written")
    parser.add_argument("--no-browser", action="store_true", help="only say where the report is")
    add_shot(parser)


def run(arguments: argparse.Namespace, progress: ProgressLine) -> str:
    """Open the report; see `Command.run`."""
    report = report_of(arguments.result)
    progress("taking pictures", 0, None)
    page = write_desk(report, arguments.footage) or report
    opened = not arguments.no_browser and webbrowser.open(page.as_uri())
    return f"Opened {page}" if opened else f"Open {page} in a browser"


COMMAND = Command(
    "view",
    help="look at a result, and pick its ground, origin and unit",
    description="Open the report of a result in the browser. Picks made there give the command that aligns the result.",
    add_arguments=add_arguments,
    run=run,
)
