"""Command line: help, output and exit codes."""

import contextlib
import errno
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

from companion import __version__
from companion.command_line import cli
from companion.config import ConfigError
from companion.option_types import FloatRange
from sitl.endurance import attacks, file_mutants, forged_frames, forgeries, fuzz, parameter_sweep

COMMANDS = ("bench", "check-config", "doctor", "log", "loopback", "replay", "run", "sitl")
CUT = Path(__file__).parent / "data" / "dronekit_copter_cut.tlog"
Companion = Callable[..., subprocess.CompletedProcess[str]]


def test_help_lists_every_command() -> None:
    done = CliRunner().invoke(cli, ["--help"])
    assert done.exit_code == 0
    lines = done.output.partition("Fly:")[2].splitlines()
    assert {line.split()[0] for line in lines if line.split()} >= set(COMMANDS)
    assert [line for line in lines if line and not line.startswith(" ")] == ["Look:", "Study:", "Develop:"]


@pytest.mark.parametrize(
    ("arguments", "nearest"),
    [(["rum"], "run"), (["check_config"], "check-config"), (["study", "outage"], "outages")],
)
def test_unknown_command_suggests_the_nearest(arguments: list[str], nearest: str) -> None:
    done = CliRunner().invoke(cli, arguments)
    assert done.exit_code == 2
    assert f"No such command {arguments[-1]!r}; did you mean {nearest}?" in done.output


@pytest.mark.parametrize("arguments", [[], ["study"], ["log"], *([name] for name in COMMANDS)])
def test_help_fits_80_columns(arguments: list[str]) -> None:
    done = CliRunner().invoke(cli, [*arguments, "--help"], terminal_width=80)
    assert max(len(line) for line in done.output.splitlines()) <= 80


def groups(context: click.Context) -> Iterator[click.Context]:
    """Yield the context of each group of commands, the outermost first."""
    assert isinstance(context.command, click.Group)
    yield context
    for name in context.command.list_commands(context):
        command = context.command.get_command(context, name)
        if isinstance(command, click.Group):
            yield from groups(click.Context(command, context, name, terminal_width=80))


def test_no_summary_is_cut_at_80_columns() -> None:
    helps = {
        context.info_name: context.get_help()
        for context in groups(click.Context(cli, info_name="companion", terminal_width=80))
    }
    assert set(helps) >= {"companion", "log", "signing", "sitl", "study"}
    lines = [line for text in helps.values() for line in text.splitlines()[1:]]
    assert [line for line in lines if line.endswith("...")] == []


def commands() -> dict[str, click.Command]:
    """All commands by their names, for example `study order`."""
    return {
        f"{context.command_path} {name}".removeprefix("companion "): command
        for context in groups(click.Context(cli, info_name="companion"))
        for name in context.command.list_commands(context)
        if (command := context.command.get_command(context, name))
    }


def has_option(command: click.Command, name: str) -> bool:
    return name in {option.name for option in command.params}


TOOLS = [tool.main for tool in (attacks, file_mutants, forged_frames, forgeries, fuzz, parameter_sweep)]


def test_every_option_has_a_help_text() -> None:
    missing = [
        (command.name, *option.opts)
        for command in [*commands().values(), *TOOLS]
        for option in command.params
        if isinstance(option, click.Option) and not option.help
    ]
    assert missing == []


def test_seeds_are_not_negative() -> None:
    seeded = [command for command in [*commands().values(), *TOOLS] if has_option(command, "seed")]
    assert len(seeded) >= 15
    for command in seeded:
        done = CliRunner().invoke(command, ["--seed", "-1"])
        assert (done.exit_code, "-1 is not in the range x>=0" in done.output) == (2, True), command.name


def test_numbers_that_take_memory_have_a_limit() -> None:
    """A thousand billion flights were listed, or held in one array: MemoryError."""
    taken = {"seeds", "flights", "runs", "count", "r_max"}
    counted = {
        (name, option.name): command
        for name, command in commands().items()
        for option in command.params
        if option.name in taken
    }
    assert len(counted) >= 8
    for (name, option), command in counted.items():
        flag = "--samples" if option == "count" else f"--{str(option).replace('_', '-')}"
        done = CliRunner().invoke(command, [flag, "1000000000000"])
        assert (done.exit_code, "is not in the range" in done.output) == (2, True), name


def test_a_seed_without_beacons_is_rejected() -> None:
    seeded = [c for c in commands().values() if has_option(c, "seed") and has_option(c, "beacons")]
    assert {command.name for command in seeded} == {"replay", "outages", "wrong-sensors"}
    for command in seeded:
        done = CliRunner().invoke(command, [str(CUT), "--seed", "3"])
        assert done.exit_code == 2, command.name
        assert "--seed 3 has no effect without --rsbn: add --rsbn" in done.output
        done = CliRunner().invoke(command, [str(CUT), "--seed", "3", "--rsbn", "absent.csv"])
        assert "absent.csv" in str(done.exception), command.name


def test_a_number_of_workers_beside_a_scheduler_is_rejected() -> None:
    working = [c for c in commands().values() if has_option(c, "scheduler")]
    assert {command.name for command in working} == {"fleet", "campaign", "harm"}
    for command in working:
        folders = [str(CUT)] if command.name == "fleet" else []
        done = CliRunner().invoke(command, [*folders, "--workers", "0", "--scheduler", "127.0.0.1:8786"])
        assert done.exit_code == 2, command.name
        assert "--workers 0 has no effect with --scheduler 127.0.0.1:8786" in done.output


def test_no_number_is_nan() -> None:
    """Infinity only where it is the default: no end."""
    checked = set()
    for command in [*commands().values(), *TOOLS]:
        context = click.Context(command)
        for option in command.params:
            if isinstance(option.type, click.types.FloatParamType):
                assert isinstance(option.type, FloatRange), (command.name, option.name)
                for text in ("nan", "-nan", "inf", "-inf"):
                    if float(text) != option.get_default(context):
                        with pytest.raises(click.BadParameter, match="is not"):
                            option.type.convert(text, option, context)
                checked.add((command.name, option.name))
    assert {("live", "speed"), ("bridge", "gnss_off_after"), ("harm", "minutes")} < checked


def test_an_empty_name_is_not_the_current_folder() -> None:
    checked = set()
    for name, command in commands().items():
        for argument in command.params:
            if isinstance(argument, click.Argument) and isinstance(argument.type, click.Path):
                with pytest.raises(click.BadParameter, match="''"):
                    argument.type.convert("", argument, click.Context(command))
                checked.add(name)
    assert {"report", "replay", "log info", "live", "fleet", "study outages", "sitl play"} < checked


def test_a_configuration_that_cannot_be_read_exits_78(
    companion: Companion, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Regression: 2, that of a wrong option."""
    path = tmp_path / "x.toml"
    path.touch()
    monkeypatch.setattr(os, "access", lambda *_: False)  # root may read every file
    monkeypatch.setattr(Path, "open", unreadable)
    for arguments in (["check-config"], ["run", "--config"], ["replay", str(CUT), "--config"]):
        done = companion(*arguments, path)
        sentence = f"companion: {path}: cannot be read (Permission denied)\n"
        assert (done.returncode, done.stderr) == (78, sentence)


def unreadable(*_: object, **__: object) -> None:
    raise PermissionError(errno.EACCES, "Permission denied")


@pytest.mark.parametrize(("end", "code"), [("inf", 1), ("nan", 2), ("-inf", 2)])
def test_infinity_means_no_end(end: str, code: int, tmp_path: Path) -> None:
    done = CliRunner().invoke(cli, ["sitl", "play", str(tmp_path / "none.tlog"), "--to", end])
    assert done.exit_code == code


def test_page_names_the_commands_with_presets() -> None:
    page = (Path(__file__).parents[1] / "docs" / "configuration.md").read_text()
    (named,) = re.findall(r"The commands (`[^.]*`) have\s`--preset NAME` and `--set`", page)
    with_presets = {name for name, command in commands().items() if has_option(command, "preset")}
    assert set(re.findall("`(.*?)`", named)) == with_presets
    assert all(has_option(commands()[name], "pairs") for name in with_presets)


def test_interrupt_ends_in_one_line_and_130(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "companion", "loopback", "--logs", str(tmp_path)]
    with subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # a background shell ignores it
    ) as running:
        while not list(tmp_path.iterdir()):
            time.sleep(0.05)
        running.send_signal(signal.SIGINT)
        out, err = running.communicate()
    assert running.returncode == 130
    assert (out, err.strip()) == ("", "companion: interrupted")


#: Moments of a start, s; most of it is the same for all commands, which take them in turns.
EARLY, LATE = (0.05, 0.12, 0.3, 0.6, 1.2), (0.08, 0.2, 0.45, 0.8, 2.0)


@pytest.mark.parametrize(
    ("command", "delays_s"),
    [
        (["run", "--connect", "udpin:127.0.0.1:0", "--logs", "{folder}"], EARLY),
        (["loopback", "--logs", "{folder}"], LATE),
        (["doctor", "--connect", "udpin:127.0.0.1:0"], EARLY),
        (["study", "weights-flown"], LATE),
        (["report", str(CUT), "-o", "{folder}/report.html"], EARLY),
    ],
    ids=lambda value: value[0] if isinstance(value, list) else "",
)
def test_interrupt_at_any_time_of_the_start_is_quiet(
    tmp_path: Path, command: list[str], delays_s: tuple[float, ...]
) -> None:
    words = [word.format(folder=tmp_path) for word in command]
    running: list[tuple[float, subprocess.Popen[str]]] = []
    with contextlib.ExitStack() as stack:
        for delay_s in delays_s:
            process = subprocess.Popen(
                [sys.executable, "-m", "companion", *words],
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                text=True,
                preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
            )
            running.append((time.monotonic() + delay_s, stack.enter_context(process)))
        for due, process in sorted(running, key=lambda each: each[0]):
            time.sleep(max(0.0, due - time.monotonic()))
            process.send_signal(signal.SIGINT)
        for _, process in running:
            try:
                _, err = process.communicate(timeout=60.0)
            except subprocess.TimeoutExpired:
                process.send_signal(signal.SIGINT)
                _, err = process.communicate()
                assert "Error processing line" in err  # a .pth file: Python reports it, and goes on
            if process.returncode == 130:
                assert err.endswith("companion: interrupted\n")
                assert "Traceback" not in err
            elif process.returncode != 0:  # 0: it had ended, or `run` closed its log
                # in Python's own start only: no line of ours was running
                assert f'File "{Path(__file__).parents[1] / "companion"}' not in err


@pytest.mark.skipif(sys.platform != "linux", reason="what a process has loaded is read as on Linux")
@pytest.mark.parametrize("moment", ["Dask is imported", "workers start"])
def test_interrupt_of_many_processes_is_one_line(tmp_path: Path, moment: str) -> None:
    """Ctrl-C in a terminal goes to the workers as well."""
    pytest.importorskip("distributed")
    psutil = pytest.importorskip("psutil")

    def has_come(pid: int) -> bool:
        if moment == "Dask is imported":
            return "/tornado/" in Path(f"/proc/{pid}/maps").read_text()
        return len(psutil.Process(pid).children()) == 3  # two workers, and the tracker of their resources

    with subprocess.Popen(
        [sys.executable, "-m", "companion", "campaign", "--results", str(tmp_path), "--workers", "2"],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    ) as running:
        try:
            while not has_come(running.pid):
                time.sleep(0.05)  # each look reads what the kernel has of all processes
            os.killpg(running.pid, signal.SIGINT)
            _, err = running.communicate(timeout=200)
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(running.pid, signal.SIGKILL)
    assert (running.returncode, err.strip()) == (130, "companion: interrupted")


@pytest.mark.parametrize(
    ("jobs", "interrupt"),
    [
        # in a callback of the collector, as Dask has: what is raised there is printed and forgotten
        (300, "gc.callbacks.append(lambda phase, info: sent or sent.append(kill())); gc.collect()"),
        (5, "done == 5 and kill()"),  # nothing is left to wait for
    ],
)
def test_interrupt_of_jobs_is_not_lost(jobs: int, interrupt: str) -> None:
    pytest.importorskip("distributed")
    code = f"""
import gc, os, signal, time
from companion.analysis.jobs import run_jobs

def kill():
    os.kill(os.getpid(), signal.SIGINT)

def main():
    signal.signal(signal.SIGINT, signal.default_int_handler)
    sent = []
    orders = {{str(k): 0.01 for k in range({jobs})}}
    for done, _ in enumerate(run_jobs(time.sleep, orders, None, 1, "fleet"), 1):
        sent or {interrupt}

if __name__ == "__main__":
    try:
        main()
    except KeyboardInterrupt:
        print("interrupted")
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=200)
    assert (done.returncode, done.stdout, done.stderr) == (0, "interrupted\n", "")


@pytest.mark.parametrize("with_thread", [False, True])
def test_interrupt_is_held_until_the_end_of_the_block(with_thread: bool) -> None:
    """Also where another thread than the main one may receive the signal."""
    code = f"""
import os, signal, threading, time
from companion import interrupt

signal.signal(signal.SIGINT, signal.default_int_handler)
if {with_thread}:
    threading.Thread(target=time.sleep, args=(5,), daemon=True).start()
try:
    with interrupt.held():
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0.2)
        print("whole")
except KeyboardInterrupt:
    print("interrupted")
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=200)
    assert (done.returncode, done.stdout, done.stderr) == (0, "whole\ninterrupted\n", "")


FLIGHT = """
from companion.bench.live import STREAMS, fly
from companion.config import load
from companion.runtime.core import CompanionCore
from companion.storage.deferred_log import NoLog

core = CompanionCore(load(None, {"output.profile": "ardupilot"}, {}), NoLog())
for t, data in fly(STREAMS["ArduPilot, 500 messages/s"]):
    core.receive("main", data, round(1e9 * (t + 1.0)))
    core.settle()
    core.bear()
    if t > 12.0:
        break
assert core.has_solution
"""


ON_THE_GROUND = ("analysis", "importers", "study", "bench", "doctor")


@pytest.mark.parametrize(
    ("code", "absent"),
    [
        (FLIGHT, ("scipy",)),  # 13 MB
        (
            "from companion.command_line import cli; cli(['--help'], standalone_mode=False)",
            ("numpy", "asyncio"),
        ),
        # after a power failure it starts in flight
        (
            "import companion.runtime.service",
            ("scipy", "rich", "matplotlib", *(f"companion.{room}" for room in ON_THE_GROUND), "sitl"),
        ),
        ("import sitl.loopback", ("scipy",)),
    ],
)
def test_start_imports_only_what_it_needs(code: str, absent: tuple[str, ...]) -> None:
    code += f"\nimport sys; sys.exit([name for name in {absent} if name in sys.modules] or None)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=200)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_help(name: str) -> None:
    done = CliRunner().invoke(cli, [name, "--help"])
    assert done.exit_code == 0
    assert len(done.output) > 100


def test_version_is_printed() -> None:
    assert __version__ in CliRunner().invoke(cli, ["--version"]).output


MISSPELT = "[predictor]\nwindow_mn = 3\n"


@pytest.mark.parametrize(
    ("command", "text", "expected"),
    [
        (["check-config"], MISSPELT, ("window_mn", "window_min")),
        (["check-config"], "[predicter]\n", ("predicter", "predictor")),
        (["check-config"], "[gnss]\nsigma_m = -1\n", ("gnss.sigma_m",)),
        (["check-config"], "[gnss\n", ("TOML",)),
        (["run", "--config"], MISSPELT, ("window_mn", "window_min")),
        (["loopback", "--config"], MISSPELT, ("window_mn", "window_min")),
    ],
)
def test_configuration_mistake_exits_78_with_one_sentence(
    companion: Companion, tmp_path: Path, command: list[str], text: str, expected: tuple[str, ...]
) -> None:
    file = tmp_path / "mine.toml"
    file.write_text(text)
    done = companion(*command, file)
    assert done.returncode == 78
    assert len(done.stderr.splitlines()) == 1
    for word in (str(file), *expected):
        assert word in done.stderr


def test_json_output_is_valid(tmp_path: Path) -> None:
    config = CliRunner().invoke(cli, ["check-config", "--json"])
    assert json.loads(config.stdout)["gnss"]
    replay = CliRunner().invoke(cli, ["replay", str(CUT), "-o", str(tmp_path / "out.mcap"), "--json"])
    assert json.loads(replay.stdout)["messages"] == 841
    info = CliRunner().invoke(cli, ["log", "info", str(tmp_path / "out.mcap"), "--json"])
    assert json.loads(info.stdout)


def test_an_override_is_checked_like_a_file() -> None:
    done = CliRunner().invoke(cli, ["check-config", "--set", "gnss.sigma_m=3", "--json"])
    assert json.loads(done.stdout)["gnss"]["sigma_m"] == 3.0
    done = CliRunner().invoke(cli, ["check-config", "--defaults", "--set", "gnss.sigma_m=3"])
    assert "\nsigma_m = 3.0\n" in done.stdout
    done = CliRunner().invoke(cli, ["check-config", "--set", "gnss.sigma=3"])
    assert isinstance(done.exception, ConfigError) and "did you mean `sigma_m`?" in str(done.exception)


def test_printed_defaults_are_a_valid_configuration(tmp_path: Path) -> None:
    file = tmp_path / "defaults.toml"
    file.write_text(CliRunner().invoke(cli, ["check-config", "--defaults"]).stdout)
    assert CliRunner().invoke(cli, ["check-config", str(file)]).exit_code == 0


def test_a_file_beside_the_defaults_is_rejected() -> None:
    done = CliRunner().invoke(cli, ["check-config", "absent.toml", "--defaults"])
    assert done.exit_code == 2
    assert "FILE absent.toml has no effect with --defaults" in done.stderr


@pytest.mark.parametrize("command", ["sitl", "loopback"])
def test_unknown_scenario_suggests_the_nearest(command: str) -> None:
    done = CliRunner().invoke(cli, [command, "--scenario", "defualt"])
    assert done.exit_code == 2
    assert "did you mean default?" in done.output


@pytest.mark.parametrize("name", ["nothing.mcap", "nothing.tlog", "nothing.pdf"])
def test_missing_log_is_reported_in_one_sentence(companion: Companion, tmp_path: Path, name: str) -> None:
    done = companion("replay", tmp_path / name)
    assert done.returncode == 1
    assert len(done.stderr.splitlines()) == 1 and name in done.stderr
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is always full")
@pytest.mark.parametrize(
    "command", [["--help"], ["check-config"], ["study", "horizon", "--ahead-min", "1,2"]]
)
def test_full_output_device_is_reported_in_one_sentence(command: list[str]) -> None:
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "companion", *command], stdout=full, stderr=subprocess.PIPE, text=True
        )
    assert done.returncode == 74
    assert done.stderr == "companion: the output: No space left on device\n"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["log", "convert", "LINK.tlog", "-o", "x.mcap"], "LINK.tlog: no such log"),
        (["fleet", "LOG", "--results", "LINK.csv", "--workers", "0"], "LINK.csv"),
        (["report", "LOG", "-o", "LINK.html"], None),
        (["smooth", "LOG", "-o", "LINK.csv"], None),
        (["log", "export", "LOG", "-o", "LINK.kml"], None),
    ],
)
def test_a_link_that_leads_to_itself_is_named_or_replaced(
    arguments: list[str], message: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before Python 3.13 `Path.resolve` has an error of its own for it, which ended in a traceback."""
    monkeypatch.chdir(tmp_path)
    (link,) = (Path(word) for word in arguments if word.startswith("LINK"))
    link.symlink_to(link)
    done = CliRunner().invoke(cli, [str(CUT) if word == "LOG" else word for word in arguments])
    if message is None:
        assert done.exit_code == 0, done.output
        assert link.is_file() and not link.is_symlink()
    else:
        assert isinstance(done.exception, OSError) and message in str(done.exception)


@pytest.mark.parametrize(
    "arguments",
    [
        ["replay", "LOG", "--rsbn", "FILE"],
        ["replay", "LOG", "--correctors", "FILE"],
        ["sitl", "bridge", "--beacons", "FILE"],
        ["study", "order", "FILE"],
    ],
)
def test_a_table_that_is_no_text_is_named_without_a_codec(arguments: list[str], tmp_path: Path) -> None:
    table = tmp_path / "table.csv"
    table.write_bytes(bytes(range(128, 256)))
    done = CliRunner().invoke(cli, [{"LOG": str(CUT), "FILE": str(table)}.get(x, x) for x in arguments])
    shown = " ".join(f"{done.output} {done.exception}".split())
    assert f"{table}: not a text file in UTF-8" in shown and "codec" not in shown
