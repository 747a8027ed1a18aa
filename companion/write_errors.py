"""Folders and files that cannot be written: what is in the way, and what to give instead."""

from __future__ import annotations

import errno
import os
from pathlib import Path


def make_folder(path: Path) -> None:
    """Create a folder and its parents, unless it exists. OSError if it cannot be created."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except FileExistsError as error:
        raise FileExistsError(error.errno, "it is a file; give a folder", str(path)) from None


def write_whole(path: Path, data: bytes) -> None:
    """Write a file at once: after an error the older one is still there. OSError, always with the path."""
    target = Path(os.path.realpath(path))  # `resolve` rejects a link that leads to itself until Python 3.13
    part = target.with_name(f"{target.name}.part")
    try:
        if path.exists() and not path.is_file():  # a folder, a device, or a pipe such as /dev/stdout
            path.write_bytes(data)
            return
        try:
            part.write_bytes(data)
            os.replace(part, target)
        except BaseException:
            part.unlink(missing_ok=True)
            raise
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from None


def describe_write_error(error: OSError) -> str:
    """Return why a file cannot be written."""
    if isinstance(error, FileNotFoundError) and error.filename:
        return f"no folder {Path(error.filename).parent}"
    if isinstance(error, PermissionError) or error.errno == errno.EROFS:
        return f"{error.strerror}; give a folder that may be written"
    return error.strerror or str(error)
