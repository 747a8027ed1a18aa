"""Command line: table of commands, each imported only when it is called.

A command is a click command in the module that does its work. The commands of the simulator come through
entry points, so that nothing here imports it: on an aircraft it need not be installed.
"""

from __future__ import annotations

import difflib
import importlib
import os
import re
import signal
import sys
from collections.abc import Collection, Mapping
from importlib.metadata import entry_points
from importlib.util import find_spec
from pathlib import Path
from types import MappingProxyType

import click

from companion import __version__, interrupt
from companion.config import ConfigError
from companion.printable import printable
from companion.storage.reader import LogError

COMMANDS = {
    "run": "companion.runtime.service:command",
    "replay": "companion.analysis.replay:command",
    "report": "companion.analysis.report:command",
    "live": "companion.analysis.live.server:command",
    "smooth": "companion.analysis.smooth_command:command",
    "fleet": "companion.analysis.fleet:command",
    "log": "companion.analysis.log_command:group",
    "doctor": "companion.doctor.command:command",
    "signing": "companion.doctor.signing_command:group",
    "check-config": "companion.runtime.check_config:command",
    "bench": "companion.bench.command:command",
}
STUDIES = {
    "horizon": "companion.study.horizon:command",
    "ins-errors": "companion.study.ins_errors:command",
    "map": "companion.study.map_smoothing:command",
    "order": "companion.study.order:command",
    "outages": "companion.study.outages:command",
    "wrong-sensors": "companion.study.wrong_sensors:command",
    "rotor-drag": "companion.study.rotor_drag:command",
    "schemes": "companion.study.schemes:command",
    "schuler": "companion.study.schuler_data:command",
    "weights": "companion.study.weights:command",
    "restrictive": "companion.study.restrictive:command",
}


#: Sections of the help; a command that no section names is listed under the last one.
SECTIONS = {
    "Fly": ("run", "doctor", "check-config", "signing"),
    "Look": ("live", "report", "log", "replay", "smooth", "fleet"),
    "Study": ("loopback", "sitl", "campaign", "study"),
    "Develop": ("bench", "kills", "soak"),
}


class LazyGroup(click.Group):
    """Command group whose commands are imported on use."""

    def __init__(
        self,
        table: dict[str, str],
        plugins: str,
        sections: Mapping[str, Collection[str]] = MappingProxyType({"Commands": ()}),
        **settings: object,
    ) -> None:
        super().__init__(**settings)  # type: ignore[arg-type]
        self._table = table | {entry.name: entry.value for entry in entry_points(group=plugins)}
        self._sections = sections

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return all names, sorted."""
        return sorted({*self._table, *self.commands})

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Find the command; an unknown name is reported with the nearest one."""
        name = args[0]
        if self.get_command(ctx, name) is None and (
            close := difflib.get_close_matches(name, self.list_commands(ctx), 1)
        ):
            ctx.fail(f"No such command {name!r}; did you mean {close[0]}?")
        return super().resolve_command(ctx, args)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import and return the command of that name."""
        if cmd_name not in self._table:
            return super().get_command(ctx, cmd_name)
        module, attribute = self._table[cmd_name].split(":")
        command: click.Command = getattr(importlib.import_module(module), attribute)
        interrupt.raise_at_interrupt()
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the list of commands; a command of the table is not imported for its first sentence."""
        left = self.list_commands(ctx)
        limit = formatter.width - 6 - max(map(len, left))
        for title, named in self._sections.items():
            names = left if title == list(self._sections)[-1] else [name for name in named if name in left]
            left = [name for name in left if name not in names]
            if names:
                with formatter.section(title):
                    formatter.write_dl([(name, self._summary(ctx, name, limit)) for name in names])

    def _summary(self, ctx: click.Context, name: str, limit: int) -> str:
        doc = _docstring(*self._table[name].split(":")) if name in self._table else None
        shown = click.Command(name, help=doc) if doc else self.get_command(ctx, name)
        return shown.get_short_help_str(limit) if shown else ""


def _docstring(module: str, function: str) -> str | None:
    """Return the docstring of a function of a module, read from the source without importing it."""
    spec = find_spec(module)
    if spec is None or spec.origin is None:
        return None
    source = Path(spec.origin).read_text(encoding="utf-8")
    found = re.search(rf'^def {function}\([^"]*?:\n    """(.*?)"""', source, re.MULTILINE | re.DOTALL)
    return found and found[1]


cli = LazyGroup(
    COMMANDS,
    "companion.commands",
    SECTIONS,
    name="companion",
    help="Keeps an aircraft's position, and a guaranteed bound on it, when GNSS is gone.",
)
cli = click.version_option(__version__, prog_name="companion")(cli)
cli.add_command(
    LazyGroup(STUDIES, "companion.studies", name="study", help="Numerical studies of the estimators.")
)


def main() -> None:
    """Run the command line; an error that the user can fix ends with one sentence and an exit code."""
    # before numpy is imported: with batches of 20 states, threads of BLAS only wait for each other
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    if sys.argv[1:2] == ["run"]:  # until the service handles it: a stop during the start is no failure
        signal.signal(signal.SIGTERM, lambda number, stack: sys.exit(0))
    try:
        try:
            code = cli(standalone_mode=False)
        finally:
            interrupt.end_at_interrupt()  # also while the interpreter shuts down
        sys.exit(code if isinstance(code, int) else 0)
    except (KeyboardInterrupt, click.exceptions.Abort):
        click.echo("companion: interrupted", err=True)
        sys.exit(interrupt.EX_INTERRUPTED)
    except click.ClickException as error:
        error.show()
        sys.exit(error.exit_code)
    except ConfigError as error:
        click.echo(f"companion: {printable(str(error))}", err=True)
        sys.exit(os.EX_CONFIG)
    except LogError as error:
        click.echo(f"companion: {printable(str(error))}", err=True)
        sys.exit(1)
    except OSError as error:
        # prevent a second flush of stdout at exit, which would print its own error
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        where = error.filename or ("the output" if error.errno else "")  # no errno: from no system call
        text = f"{where}: {error.strerror or error}" if where else str(error)
        click.echo(f"companion: {printable(text)}", err=True)
        sys.exit(os.EX_IOERR)
