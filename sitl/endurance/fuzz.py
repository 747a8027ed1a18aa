"""`python -m sitl.endurance.fuzz`: coverage-guided fuzzing of all byte inputs by atheris (libFuzzer).

    python -m sitl.endurance.fuzz --seconds 600                 # per target, one after another
    python -m sitl.endurance.fuzz --target log --replay FILE    # repeat an input that failed

Inputs that reach new code are stored in a folder and are the corpus of the next run. An input that breaks a
target is stored there as crash-..., and the exit code is 1. `make fuzz` installs atheris.

Each target runs in its own process: libFuzzer does not return, and the code under test has to be imported
under its instrumentation. This module therefore imports nothing of the companion.
"""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from pathlib import Path

import click

TARGET_NAMES = ("stream", "wire", "onboard", "signed", "log", "config")
LONGEST_INPUT = 4096
MOST_MIB = 1024  # memory limit of a target
SLOWEST_S = 10  # time limit of one input


def fuzz_target(name: str, seconds: int, folder: Path) -> int:
    """Fuzz one target in its own process; return its exit code, 0 without a failure."""
    inputs = folder / name
    inputs.mkdir(parents=True, exist_ok=True)
    return subprocess.run(
        [sys.executable, "-m", __spec__.name, "--inside", name, str(seconds), str(inputs)]
    ).returncode


def run_inside(name: str, seconds: int, inputs: Path) -> None:
    """Fuzz one target in this process; does not return."""
    import atheris

    with atheris.instrument_imports(include=["companion"]):
        from sitl.endurance import fuzz_targets

    target = fuzz_targets.TARGETS[name]
    for number, seed in enumerate(target.seeds()):
        (inputs / f"seed-{number}").write_bytes(seed)
    limits = (
        f"-max_total_time={seconds} -max_len={LONGEST_INPUT} -rss_limit_mb={MOST_MIB} -timeout={SLOWEST_S}"
    )
    atheris.Setup(
        [sys.argv[0], *limits.split(), f"-artifact_prefix={inputs}/", "-print_final_stats=1", str(inputs)],
        target.check,
    )
    atheris.Fuzz()


@click.command()
@click.option("--target", "names", multiple=True, type=click.Choice(TARGET_NAMES), help="Default: all.")
@click.option("--seconds", type=click.IntRange(1), default=60, show_default=True, help="Per target.")
@click.option(
    "--inputs",
    type=click.Path(path_type=Path, file_okay=False),
    default=Path("logs/fuzz"),
    show_default=True,
    help="Folder of the inputs found.",
)
@click.option(
    "--replay", type=click.Path(path_type=Path, exists=True, dir_okay=False), help="Run this input once."
)
def main(names: tuple[str, ...], seconds: int, inputs: Path, replay: Path | None) -> None:
    """Fuzz the companion's byte inputs. Exit code 1 if a target failed."""
    names = names or TARGET_NAMES
    if replay is not None:
        from sitl.endurance import fuzz_targets

        for name in names:
            fuzz_targets.TARGETS[name].check(replay.read_bytes())
        return
    if importlib.util.find_spec("atheris") is None:
        raise SystemExit(
            "companion: atheris is not installed; `make fuzz` installs it, or pip install '.[fuzz]'"
        )
    broken = [name for name in names if fuzz_target(name, seconds, inputs)]
    click.echo(f"{len(names)} targets, {seconds} s each; failed: {', '.join(broken) or 'none'}")
    if broken:
        raise SystemExit(1)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--inside"]:
        run_inside(sys.argv[2], int(sys.argv[3]), Path(sys.argv[4]))
    main()
