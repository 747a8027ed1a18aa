"""Many logs become one row a flight; a bad log is a row with its reason; nothing is assessed twice."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from click.testing import CliRunner

from companion import optional_dependencies
from companion.analysis import fleet, jobs
from companion.analysis.fleet import FlightRow
from companion.analysis.fleet_page import render_page
from companion.config import Config, ConfigError
from companion.link import dialect, frame
from companion.storage.reader import LogError
from sitl.endurance import sample_logs


@pytest.fixture
def logs(tmp_path: Path) -> Path:
    folder = tmp_path / "logs"
    (folder / "sub").mkdir(parents=True)
    (folder / "a.tlog").write_bytes(sample_logs.tlog())
    (folder / "sub" / "b.bin").write_bytes(sample_logs.dataflash_binary())
    (folder / "broken.ulg").write_bytes(b"not a log")
    (folder / "notes.txt").write_text("no log")
    return folder


def run(*arguments: object) -> str:
    done = CliRunner().invoke(fleet.command, [str(a) for a in arguments], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return done.output


@pytest.mark.parametrize("package", ["pyarrow", "jinja2"])
def test_missing_package_is_reported_before_the_work(package: str, tmp_path: Path, monkeypatch) -> None:
    (tmp_path / "x.mcap").touch()
    monkeypatch.setattr(optional_dependencies, "find_spec", lambda name: None if name == package else True)
    monkeypatch.setattr(fleet, "Fleet", lambda *_: pytest.fail("work was done"))
    with pytest.raises(LogError, match=f"a table of flights needs {package}: run `pip install"):
        CliRunner().invoke(fleet.command, [str(tmp_path)], catch_exceptions=False)


def test_results_that_cannot_be_kept_are_one_sentence(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    (tmp_path / "x.mcap").touch()
    (tmp_path / "file").touch()
    results = tmp_path / "file" / "fleet"
    with pytest.raises(LogError, match=f"cannot keep results in {results}: Not a directory: give --results"):
        CliRunner().invoke(fleet.command, [str(tmp_path), "--results", str(results)], catch_exceptions=False)


def test_each_log_is_a_row_and_a_bad_one_has_a_reason(logs: Path, tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    results = tmp_path / "results"
    shown = run(logs, "-o", results, "--workers", 0, "--reports", 0)
    assert "3 logs: 2 flights" in shown and "1 not readable" in shown
    table = parquet.read_table(results / fleet.TABLE).to_pylist()
    assert {Path(row["log"]).name: row["reason"] for row in table} == {
        "a.tlog": None,
        "b.bin": None,
        "broken.ulg": "is not a ULog: wrong magic bytes at its beginning",
    }
    verdicts = {Path(row["log"]).name: row["verdict"] for row in table}
    assert verdicts == {"a.tlog": "Caution", "b.bin": "Caution", "broken.ulg": None}  # b has 9 s
    assert all(row["verdict_reason"] for row in table if row["verdict"])
    assert "a.tlog: Caution, " in shown
    assert all(row["duration_s"] > 5.0 for row in table if row["reason"] is None)
    assert table[-1]["reason"] and "broken.ulg" in (results / fleet.PAGE).read_text()


def test_only_new_and_changed_logs_are_read(
    logs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("pyarrow")
    options = (logs, "--results", tmp_path / "results", "--workers", 0, "--reports", 0)
    run(*options)
    read: list[str] = []

    def remembered(job: fleet.LogJob) -> list[FlightRow]:
        read.append(job.path.name)
        return [FlightRow(str(job.path), reason="again")]

    monkeypatch.setattr(fleet, "assess_log", remembered)
    run(*options)
    assert read == []
    (logs / "a.tlog").write_bytes(sample_logs.tlog() + b"more")
    (logs / "new.log").write_bytes(sample_logs.dataflash_text())
    run(*options)
    assert sorted(read) == ["a.tlog", "new.log"]
    journal = tmp_path / "results" / fleet.JOURNAL
    journal.write_bytes(journal.read_bytes()[:-30])  # killed while it wrote
    run(*options)
    assert len(read) == 3
    assert all(json.loads(line) for line in journal.read_text().splitlines())


def test_another_configuration_assesses_the_logs_again(logs: Path, tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    file, results = tmp_path / "mine.toml", tmp_path / "results"
    file.write_text("[gnss]\nsigma_m = 7.5\n")
    for options in ([], ["--config", file], ["--config", file]):
        run(logs, "--results", results, "--workers", 0, "--reports", 0, *options)
    assert len((results / fleet.JOURNAL).read_text().splitlines()) == 2 * 3


def test_an_invalid_configuration_ends_as_in_other_commands(logs: Path, tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    file = tmp_path / "mine.toml"
    file.write_text("[gnss]\nsigma_m = -7.5\n")
    done = CliRunner().invoke(fleet.command, [str(logs), "--config", str(file), "--workers", "0"])
    assert isinstance(done.exception, ConfigError) and "gnss.sigma_m = -7.5" in str(done.exception)


def test_a_configuration_for_logs_of_our_own_is_rejected(tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_bytes(sample_logs.mcap())
    file = tmp_path / "mine.toml"
    file.write_text("[gnss]\nsigma_m = 7.5\n")
    done = CliRunner().invoke(fleet.command, [str(tmp_path), "--config", str(file), "--workers", "0"])
    assert isinstance(done.exception, LogError)
    assert str(done.exception).startswith(f"--config {file} has no effect: all logs are our own")


def test_rows_of_another_version_are_assessed_again(logs: Path, tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    results = tmp_path / "results"
    options = (logs, "--results", results, "--workers", 0, "--reports", 0)
    run(*options)
    journal = results / fleet.JOURNAL
    older = [json.loads(line) for line in journal.read_text().splitlines()]
    for entry in older:
        for row in entry["rows"]:
            del row["verdict"], row["verdict_reason"]
    journal.write_text("".join(json.dumps(entry) + "\n" for entry in older))
    again = "3 of 3 logs were assessed by another version, with other columns: they are assessed again"
    assert f"companion: {journal}: {again}" in run(*options)
    assert "another version" not in run(*options)


def test_report_of_the_worst_is_linked(logs: Path, tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    pytest.importorskip("plotly")
    results = tmp_path / "results"
    run(logs, "--results", results, "--workers", 0, "--reports", 1)
    (report,) = (results / fleet.REPORTS).iterdir()
    assert f"href='reports/{report.name}'" in (results / fleet.PAGE).read_text()


def test_worst_flight_comes_first_and_text_is_escaped() -> None:
    rows = [
        FlightRow(
            "x/<!--<script>.mcap", 1, 1, largest_m=3.0, duration_s=60.0, verdict="Good", ins_largest_m=81.0
        ),
        FlightRow("unreadable", reason="<b>bad</b>"),
        FlightRow("x/worst.mcap", 1, 1, largest_m=500.0, duration_s=60.0, report="reports/worst.html"),
        FlightRow("x/unknown.mcap", 1, 1, duration_s=60.0),
    ]
    ordered = fleet.worst_first(rows)
    assert [row.largest_m for row in ordered] == [500.0, 3.0, None, None]
    assert ordered[-1].reason
    page = render_page(ordered)
    assert page.index("worst.mcap") < page.index("&lt;!--&lt;script&gt;.mcap") < page.index("unknown.mcap")
    assert "<td data-label='verdict' class='good'><span title=''>Good</span></td>" in page
    assert "<td data-label='largest, inertial channel alone'>81.0 m</td>" in page
    assert "<script" not in page and "<b>bad" not in page and "href='reports/worst.html'" in page


def test_a_flight_that_never_had_gnss_was_without_it_for_its_duration(tmp_path: Path) -> None:
    log = tmp_path / "parked.tlog"
    beat = frame.encode(dialect.new("HEARTBEAT", type=1, autopilot=3), 0, 1, 1)
    stamps = range(1_700_000_000_000_000, 1_700_000_061_000_000, 1_000_000)
    log.write_bytes(b"".join(us.to_bytes(8, "big") + beat for us in stamps))
    (row,) = fleet.assess_log(fleet.LogJob(log, Config()))
    assert row.gnss_outage_s == row.duration_s == 60.0
    page = render_page([row])
    assert "1 min" in page and "<dt>largest error</dt><dd>–</dd>" in page  # not known, which is not 0.00 m


def test_exit_code_without_any_readable_log(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    (tmp_path / "x.tlog").write_bytes(b"nothing")
    done = CliRunner().invoke(
        fleet.command, [str(tmp_path), "--results", str(tmp_path / "r"), "--workers", "0"]
    )
    assert done.exit_code == 1 and "0 flights" in done.output
    assert f"  {tmp_path / 'x.tlog'}: is not a tlog" in done.output


def slow_square(number: int | Path) -> int:
    time.sleep(0.05)
    if isinstance(number, Path):
        with number.open("a") as file:
            file.write("run\n")
        raise ValueError("not a number")
    return number * number


def test_killed_worker_loses_no_job(tmp_path: Path) -> None:
    """Two processes, one killed on the way, with results that were not fetched yet. A job that raises is not
    run again, unless its worker was lost."""
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        pids = [worker.pid for worker in cluster.workers.values()]
        work = jobs.run_jobs(
            slow_square,
            {f"job {k}": k for k in range(40)} | {"raises": tmp_path / "runs"},
            cluster.scheduler_address,
            0,
            "fleet",
        )
        done = dict[str, object]()
        for one in work:
            if not done:
                time.sleep(1.0)
                os.kill(pids[0], signal.SIGKILL)
            done[one.key] = one.failure or one.result
    assert done.pop("raises") == "ValueError('not a number')"
    assert done == {f"job {k}": k * k for k in range(40)}
    assert len((tmp_path / "runs").read_text().splitlines()) <= 2


LOST = """
import sys, time
from companion.analysis.jobs import run_jobs
work = run_jobs(time.sleep, {str(k): 0.05 for k in range(2000)}, sys.argv[1], 0, "fleet")
print(next(work).key, flush=True)
try:
    list(work)
except ValueError as error:
    print(error)
"""


def test_a_lost_scheduler_is_one_sentence() -> None:
    """In a process of its own: what the workers of the lost scheduler print is not ours."""
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=None) as cluster:
        command = [sys.executable, "-c", LOST, cluster.scheduler_address]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as client:
            assert client.stdout is not None
            assert client.stdout.readline() == "0\n"
            cluster.close()
            shown, errors = client.communicate(timeout=60.0)
    assert shown == "Dask scheduler lost: start again, finished work is kept\n"
    assert errors == ""


def test_an_absent_scheduler_is_one_sentence(logs: Path, tmp_path: Path) -> None:
    dask = pytest.importorskip("dask")
    pytest.importorskip("distributed")
    with dask.config.set({"distributed.comm.timeouts.connect": "200ms"}):
        for address in ("127.0.0.1:1", "nowhere"):
            done = CliRunner().invoke(
                fleet.command, [str(logs), "--results", str(tmp_path / "results"), "--scheduler", address]
            )
            assert isinstance(done.exception, LogError)
            assert str(done.exception).startswith(f"--scheduler {address}: ")
            assert str(done.exception).endswith("leave it out for workers on this machine")


def test_a_worker_keeps_its_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """Dask's own setting cost a third of a flight: each array of 128 KiB was given back to the kernel.

    A nanny has the environment of its worker before it starts one: a busy machine may take half a minute.
    """
    distributed = pytest.importorskip("distributed")
    name = "MALLOC_TRIM_THRESHOLD_"
    for left in (name, "OPENBLAS_NUM_THREADS"):  # the cluster of another test leaves them here
        monkeypatch.delenv(left, raising=False)

    async def environment() -> dict[str, str]:
        environ: dict[str, str] = distributed.Nanny("tcp://127.0.0.1:1").env
        return environ

    class Started(Exception):
        """Environment of a worker of the cluster."""

    def cluster(**options: object) -> None:
        raise Started(asyncio.run(environment()))

    assert name in asyncio.run(environment())
    monkeypatch.setattr("dask.distributed.LocalCluster", cluster)
    with pytest.raises(Started) as started:
        list(jobs.run_jobs(slow_square, {"one": 1}, None, 1, "fleet"))
    (environ,) = started.value.args
    assert name not in environ and environ["OPENBLAS_NUM_THREADS"] == "1"


def test_config_travels_to_workers() -> None:
    import pickle

    assert pickle.loads(pickle.dumps(Config())) == Config()
