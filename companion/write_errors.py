"""Folders and files that cannot be written: what is in the way, and what to give instead."""

from __future__ import annotations

from pathlib import Path


def make_folder(path: Path) -> None:
    """Create a folder and its parents, unless it exists. OSError if it cannot be created."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except FileExistsError as error:
        raise FileExistsError(error.errno, "it is a file; give a folder", str(path)) from None


def describe_write_error(error: OSError) -> str:
    """Return why a file cannot be written."""
    if isinstance(error, FileNotFoundError) and error.filename:
        return f"no folder {Path(error.filename).parent}"
    return error.strerror or str(error)
