"""`python -m sitl.endurance.fuzz`: coverage-guided fuzzing of every door that bytes come in by, by atheris (libFuzzer).

    python -m sitl.fuzz --seconds 600               # each target for so long, one after another
    python -m sitl.fuzz --target log --replay FILE  # once more what broke it

What was found to lead somewhere new is kept in a folder and is where the next run begins. An input that
breaks a target is kept beside it as crash-..., and the command ends with 1. `make fuzz` installs atheris.

The work is done in a process of its own for each target: libFuzzer never comes back, and what it is to watch
must be imported under its eyes. So nothing of the companion is imported here.
"""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from pathlib import Path

import click

NAMES = ("stream", "wire", "onboard", "signed", "log", "config")
LONGEST_INPUT = 4096
MOST_MIB = 1024  # of memory; a target that takes more has broken its word
SLOWEST_S = 10  # for one input


def fuzz(name: str, seconds: int, folder: Path) -> int:
    """Fuzz one target in a process of its own; its exit code, 0 where nothing broke."""
    inputs = folder / name
    inputs.mkdir(parents=True, exist_ok=True)
    return subprocess.run(
        [sys.executable, "-m", __spec__.name, "--inside", name, str(seconds), str(inputs)]
    ).returncode


def inside(name: str, seconds: int, inputs: Path) -> None:
    """Fuzz one target in this process, which ends with it."""
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
        target.hear,
    )
    atheris.Fuzz()


@click.command()
@click.option("--target", "names", multiple=True, type=click.Choice(NAMES), help="All without it.")
@click.option("--seconds", type=click.IntRange(1), default=60, show_default=True, help="For each target.")
@click.option("--inputs", type=click.Path(path_type=Path, file_okay=False), default=Path("logs/fuzz"))
@click.option(
    "--replay", type=click.Path(path_type=Path, exists=True, dir_okay=False), help="Once, of one target."
)
def main(names: tuple[str, ...], seconds: int, inputs: Path, replay: Path | None) -> None:
    """Fuzz the companion's doors. Ends with 1 where one broke."""
    if replay is not None:
        from sitl.endurance import fuzz_targets

        for name in names:
            fuzz_targets.TARGETS[name].hear(replay.read_bytes())
        return
    if importlib.util.find_spec("atheris") is None:
        raise SystemExit(
            "companion: atheris is not installed; `make fuzz` installs it, or pip install '.[fuzz]'"
        )
    broken = [name for name in names or NAMES if fuzz(name, seconds, inputs)]
    click.echo(f"{len(names or NAMES)} targets, {seconds} s each; broken: {', '.join(broken) or 'none'}")
    if broken:
        raise SystemExit(1)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--inside"]:
        inside(sys.argv[2], int(sys.argv[3]), Path(sys.argv[4]))
    main()
