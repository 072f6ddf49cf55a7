"""The command line, and what the installed command calls."""

from vibench.interrupts import interrupted_at_once


def start() -> None:
    """Run the command line; Ctrl-C ends it with a line from here on, among the imports as in a command."""
    with interrupted_at_once():
        from vibench.cli.main import run_command_line

        run_command_line()
