"""Types of the plot options: the output path is checked before any work is done."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import click

from companion.optional_dependencies import missing_package
from companion.write_errors import make_folder


class PlotFile(click.Path):
    """Path of a writable file with a suffix known to matplotlib."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Path:
        """Convert to a path that can be written."""
        path = Path(os.fsdecode(super().convert(value, param, ctx)))
        formats = _supported_formats()
        if path.suffix[1:].lower() not in formats:
            self.fail(f"{path} has no image suffix: use one of {', '.join(formats)}", param, ctx)
        if not path.parent.is_dir():
            self.fail(f"{path} cannot be written: no folder {path.parent}", param, ctx)
        if path.is_dir() or not os.access(path if path.exists() else path.parent, os.W_OK):
            self.fail(f"{path} cannot be written", param, ctx)
        return path


class PlotFolder(click.Path):
    """Path of a folder, created if it does not exist."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Path:
        """Convert to the path of a folder that exists."""
        path = Path(os.fsdecode(super().convert(value, param, ctx)))
        _supported_formats()
        if ctx is not None and ctx.resilient_parsing:  # a shell completes the line: nothing is run
            return path
        try:
            make_folder(path)
        except OSError as error:
            self.fail(f"{path} cannot be created: {error.strerror}", param, ctx)
        return path


PLOT_FILE, PLOT_FOLDER = PlotFile(), PlotFolder()


def _supported_formats() -> dict[str, str]:
    """Return the image formats of matplotlib by suffix."""
    try:
        from matplotlib.backend_bases import FigureCanvasBase
    except ImportError:
        raise click.UsageError(missing_package("plotting", "matplotlib", "plot")) from None
    formats: dict[str, str] = FigureCanvasBase.get_supported_filetypes()
    return formats
