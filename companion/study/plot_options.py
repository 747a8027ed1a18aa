"""What a command draws into, as callbacks of its option: looked at before any work is done."""

from __future__ import annotations

import os
from pathlib import Path

import click

from companion.optional_dependencies import lacking


def file(context: click.Context, parameter: click.Parameter, path: Path | None) -> Path | None:
    """A file whose suffix is a format of matplotlib's, in a folder that is there."""
    if path is None:
        return None
    formats = _formats()
    if path.suffix[1:].lower() not in formats:
        raise click.BadParameter(f"{path} has no suffix of a drawing: give one of {', '.join(formats)}")
    if not path.parent.is_dir():
        raise click.BadParameter(f"{path} cannot be drawn: there is no folder {path.parent}")
    if path.is_dir() or not os.access(path if path.exists() else path.parent, os.W_OK):
        raise click.BadParameter(f"{path} cannot be written")
    return path


def folder(context: click.Context, parameter: click.Parameter, path: Path | None) -> Path | None:
    """A folder, made where it is not there."""
    if path is None:
        return None
    _formats()
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise click.BadParameter(f"{path} cannot be drawn into: {error.strerror}") from None
    return path


def _formats() -> dict[str, str]:
    """What can be drawn, by suffix."""
    try:
        from matplotlib.backend_bases import FigureCanvasBase
    except ImportError:
        raise click.UsageError(lacking("drawing", "matplotlib", "plot")) from None
    formats: dict[str, str] = FigureCanvasBase.get_supported_filetypes()
    return formats
