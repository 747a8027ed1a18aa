"""The command line: a table of commands, each loaded only when it is called.

A command is a click command in the module that does its work. The simulator's come through entry points, so
that nothing here imports it: an aircraft may fly without.
"""

from __future__ import annotations

import importlib
import os
import sys
from importlib.metadata import entry_points

import click

from companion import __version__
from companion.config import ConfigError
from companion.storage.reader import LogError

EX_IOERR, EX_CONFIG = 74, 78  # sysexits.h
COMMANDS = {
    "run": "companion.runtime.service:command",
    "replay": "companion.analysis.replay:command",
    "report": "companion.analysis.report:command",
    "log": "companion.analysis.log_command:group",
    "doctor": "companion.doctor.command:command",
    "check-config": "companion.config.check_config:command",
    "bench": "companion.bench.command:command",
}
STUDIES = {
    "horizon": "companion.study.horizon:command",
    "order": "companion.study.order:command",
    "schuler": "companion.study.schuler_data:command",
    "weights": "companion.study.weights:command",
    "restrictive": "companion.study.restrictive:command",
}


class Lazy(click.Group):
    """A group whose commands are imported when named: `companion --help` stays quick."""

    def __init__(self, table: dict[str, str], plugins: str | None = None, **settings: object) -> None:
        super().__init__(**settings)  # type: ignore[arg-type]
        self._table = dict(table)
        if plugins:
            self._table |= {entry.name: entry.value for entry in entry_points(group=plugins)}

    def list_commands(self, ctx: click.Context) -> list[str]:
        """All names, in order."""
        return sorted({*self._table, *self.commands})

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """The command of that name, imported now."""
        if cmd_name not in self._table:
            return super().get_command(ctx, cmd_name)
        module, attribute = self._table[cmd_name].split(":")
        command: click.Command = getattr(importlib.import_module(module), attribute)
        return command


cli = Lazy(
    COMMANDS,
    "companion.commands",
    name="companion",
    help="Keeps an aircraft's position, and a guaranteed bound on it, when GNSS is gone.",
)
cli = click.version_option(__version__, prog_name="companion")(cli)
cli.add_command(Lazy(STUDIES, "companion.studies", name="study", help="Numbers behind the estimators."))


def main() -> None:
    """Run the command line; whatever a person can mend ends in one sentence and an exit code."""
    try:
        cli(standalone_mode=True)
    except ConfigError as error:
        click.echo(f"companion: {error}", err=True)
        sys.exit(EX_CONFIG)
    except LogError as error:
        click.echo(f"companion: {error}", err=True)
        sys.exit(1)
    except OSError as error:
        # what the output could not take is not tried again at the exit, which would add lines of its own
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        where = error.filename or "the output"
        click.echo(f"companion: {where}: {error.strerror or error}", err=True)
        sys.exit(EX_IOERR)


if __name__ == "__main__":
    main()
