"""Kept parameters: values set by ground stations, loaded at the start unless they may have ended two starts.

    config, notes = kept.load(base, lambda: load(..., tuned=kept.path))
    kept.count_start()            # the log is open; from here on the values can end the service
    kept.withdraw_start()         # it ended for another reason: an address in use, a configuration
    kept.confirm()                # the values have flown for a minute, or the service ended as requested

A start is counted in a file, in systemd's RUNTIME_DIRECTORY or beside the parameters, and confirmed later.
After two starts of the same boot that were not confirmed, or if the values do not pass the checks, the
parameters are set aside and the operator's configuration is used. A power cut does not count. A disk that
cannot be written disables the count, not the service.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable
from pathlib import Path

from companion.config import Config, ConfigError
from companion.runtime.state_file import BOOT_ID, boot_id, replace_text

MAX_FAILED_STARTS = 2


class KeptParameters:
    """The parameters file of one service and the count of its unconfirmed starts."""

    def __init__(self, path: Path, boot_id: Path = BOOT_ID) -> None:
        self.path = path
        folder = Path(os.environ.get("RUNTIME_DIRECTORY") or path.parent)
        self._count_path = folder / f"{path.name}.starts"
        self._boot_id = boot_id

    def load(
        self, base: Config, load: Callable[[], Config], configuration: Path | None = None
    ) -> tuple[Config, list[str]]:
        """Return the configuration to start with, and what must be reported.

        `base` is the configuration without the kept values, of the file `configuration`; `load` returns the
        one with them. Raises ConfigError if the path is of something else than kept values.
        """
        if not self.path.exists():
            return base, []
        self._check(configuration)
        _, failed = self._count()
        if failed >= MAX_FAILED_STARTS:
            return base, [self._set_aside(f"the last {failed} starts with them failed")]
        try:
            return load(), []
        except ConfigError as error:
            return base, [self._set_aside(str(error))]

    def count_start(self) -> None:
        """Count this start as failed, until it is withdrawn or confirmed."""
        self._add(1)

    def withdraw_start(self) -> None:
        """Do not count this start: it failed for a reason that the values cannot have."""
        self._add(-1)

    def confirm(self) -> None:
        """Forget the failed starts."""
        with contextlib.suppress(OSError):
            self._count_path.unlink(missing_ok=True)

    def _check(self, configuration: Path | None) -> None:
        """Raise ConfigError if the path is of something else, which would be renamed or replaced."""
        what = ""
        if not self.path.is_file():
            what = "no regular file"
        elif configuration is not None and self.path.samefile(configuration):
            what = "the configuration file"
        if what:
            raise ConfigError(f"link.parameters_file: {self.path} is {what}: give another name")

    def _add(self, number: int) -> None:
        if self.path.exists():
            boot, failed = self._count()
            with contextlib.suppress(OSError):
                replace_text(self._count_path, f"{boot} {failed + number}\n")

    def _count(self) -> tuple[str, int]:
        """Return the id of this boot and its number of unconfirmed starts."""
        boot = boot_id(self._boot_id)
        try:
            before, number = self._count_path.read_text("ascii").split()
            return boot, int(number) if before == boot else 0
        except (OSError, ValueError):
            return boot, 0

    def _set_aside(self, why: str) -> str:
        aside = self.path.with_name(self.path.name + ".rejected")
        self.confirm()
        try:
            os.replace(self.path, aside)
            where = f"kept in {aside}"
        except OSError as error:
            where = f"{self.path} cannot be renamed ({error.strerror})"
        return f"parameters set by ground stations are not used: {why}; {where}"
