"""Metadata of a log: the configuration, the version, and the numerical platform that computed its outputs.

Outputs are reproduced bit for bit only on the same platform: another processor or BLAS kernel adds in another
order.
"""

from __future__ import annotations

import platform
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_info

from companion import __version__
from companion.config import Config, parse, to_toml
from companion.storage import flight_log

CONFIGURATION = "configuration"  # the metadata record; its key is `toml`
PLATFORM = "platform"


def run_metadata(config: Config) -> dict[str, dict[str, str]]:
    """Return the metadata records of a run with this configuration on this machine."""
    return {
        CONFIGURATION: {"toml": to_toml(config)},
        "companion": {"version": __version__},
        PLATFORM: numerical_platform(),
    }


def logged_configuration(path: Path) -> Config:
    """Return the configuration in the log at `path`, as `configuration_in`."""
    return configuration_in(flight_log.metadata(path), str(path))


def configuration_in(metadata: Mapping[str, Mapping[str, str]], log: str) -> Config:
    """Return the configuration in the metadata of a log; the defaults where none is stored."""
    text = metadata.get(CONFIGURATION, {}).get("toml")
    return Config() if text is None else parse(text, f"{log} (its own configuration)")


def numerical_platform() -> dict[str, str]:
    """Return what decides the last bits of a result: processor, BLAS kernels, versions."""
    kernels = {f"{info.get('prefix')} {info.get('architecture', '?')}" for info in threadpool_info()}
    return {
        "processor": f"{platform.machine()} {_processor_model()}".strip(),
        "blas": ", ".join(sorted(kernels)),
        "libc": " ".join(platform.libc_ver()),
        "python": platform.python_version(),
        "numpy": np.__version__,
        "scipy": version("scipy"),
    }


def _processor_model() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return platform.processor()
    fields = (line.partition(":") for line in lines)
    named = (value.strip() for key, _, value in fields if key.strip() in ("model name", "CPU part"))
    return next(named, platform.processor())
