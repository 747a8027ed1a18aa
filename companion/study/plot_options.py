"""Callbacks of the plot options: the output path is checked before any work is done."""

from __future__ import annotations

import os
from pathlib import Path

import click

from companion.optional_dependencies import missing_package
from companion.write_errors import make_folder


def check_plot_file(context: click.Context, parameter: click.Parameter, path: Path | None) -> Path | None:
    """Check that the path is a writable file with a suffix known to matplotlib."""
    if path is None:
        return None
    formats = _supported_formats()
    if path.suffix[1:].lower() not in formats:
        raise click.BadParameter(f"{path} has no image suffix: use one of {', '.join(formats)}")
    if not path.parent.is_dir():
        raise click.BadParameter(f"{path} cannot be written: no folder {path.parent}")
    if path.is_dir() or not os.access(path if path.exists() else path.parent, os.W_OK):
        raise click.BadParameter(f"{path} cannot be written")
    return path


def make_plot_folder(context: click.Context, parameter: click.Parameter, path: Path | None) -> Path | None:
    """Create the folder if it does not exist."""
    if path is None:
        return None
    _supported_formats()
    try:
        make_folder(path)
    except OSError as error:
        raise click.BadParameter(f"{path} cannot be created: {error.strerror}") from None
    return path


def _supported_formats() -> dict[str, str]:
    """Return the image formats of matplotlib by suffix."""
    try:
        from matplotlib.backend_bases import FigureCanvasBase
    except ImportError:
        raise click.UsageError(missing_package("plotting", "matplotlib", "plot")) from None
    formats: dict[str, str] = FigureCanvasBase.get_supported_filetypes()
    return formats
