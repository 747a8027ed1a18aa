"""Recordings of the InertialNav project, with and without column names, are converted to records."""

import io
import math
import pathlib
import struct
import zipfile
import zlib

import numpy as np
import pytest
from scipy.io import savemat

from companion import records as r
from companion.importers import foreign_file, inertialnav, sources
from companion.storage.reader import LogError

SHARED = pathlib.Path(__file__).parents[2].parent / "shared" / "data" / "inertialnav"


def labels(names: str) -> np.ndarray[tuple[int, ...], np.dtype[np.object_]]:
    return np.array([[name] for name in names.split()], dtype=object)


def test_matlab_tables_are_converted_as_ardupilot_messages(tmp_path: pathlib.Path) -> None:
    path = tmp_path / "log.mat"
    gps = "LineNo Status TimeMS Week NSats HDop Lat Lng RelAlt Alt Spd GCrs VZ T"
    tables = {
        "GPS": [[1, 3, 5000, 1768, 7, 2.0, -37.9, 144.7, 0.0, 16.0, 2.0, 90.0, 0.5, 13_300.0]],
        "IMU": [[2, 13_200.0, 0.1, 0.2, 0.3, 1.0, 2.0, -9.8], [3, 13_400.0, 0.1, 0.2, 0.3, 1.0, 2.0, -9.7]],
    }
    content = {name: np.array(rows, dtype=float) for name, rows in tables.items()}
    named = {"GPS_label": labels(gps), "IMU_label": labels("LineNo TimeMS GyrX GyrY GyrZ AccX AccY AccZ")}
    savemat(path, content | named)
    first, fix, last = sources.open_source(path)
    assert isinstance(first, r.Imu) and isinstance(fix, r.Gnss) and isinstance(last, r.Imu)
    assert [record.t_ns for record in (first, fix, last)] == [13_200_000_000, 13_300_000_000, 13_400_000_000]
    assert first.f_b == (1.0, 2.0, -9.8) and first.w_b == (0.1, 0.2, 0.3)
    assert (fix.lat, fix.fix, fix.stamp_us) == (math.radians(-37.9), 3, 1768 * 604_800_000_000 + 5_000_000)
    assert fix.v_n == pytest.approx((0.0, 2.0, 0.5), abs=1e-12)


def test_airspeed_of_an_old_log_is_a_sensor(tmp_path: pathlib.Path) -> None:
    """Planes up to 3.x logged it in NTUN only; without a sensor it is 0 there."""
    rows = np.array([[1, 13_100.0, 17.5], [2, 13_300.0, 0.0], [3, 13_500.0, 18.0]])
    savemat(tmp_path / "log.mat", {"NTUN": rows, "NTUN_label": labels("LineNo TimeMS Arspd")})
    seen = [record for record in sources.open_source(tmp_path / "log.mat") if isinstance(record, r.AirData)]
    assert [(record.airspeed, record.sensed) for record in seen] == [(17.5, True), (18.0, True)]


@pytest.mark.parametrize("error", [PermissionError(13, "Permission denied"), OSError(5, "I/O error")])
def test_file_that_cannot_be_read_is_one_sentence(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch, error: OSError
) -> None:
    def fail(_: pathlib.Path) -> bytes:
        raise error

    (tmp_path / "log.mat").touch()
    monkeypatch.setattr(foreign_file, "open_regular", fail)
    with pytest.raises(LogError, match=rf"log\.mat cannot be read: {error.strerror}$"):
        sources.open_source(tmp_path / "log.mat")


def matlab(order: str, kind: int, content: bytes) -> bytes:
    """A MATLAB file of one element, by the format's specification."""
    header = b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack(f"{order}HH", 0x0100, 0x4D49)
    return header + struct.pack(f"{order}II", kind, len(content)) + content


@pytest.mark.parametrize("order", "<>")
def test_matlab_file_that_expands_beyond_the_limit_is_rejected(tmp_path: pathlib.Path, order: str) -> None:
    (tmp_path / "log.mat").write_bytes(matlab(order, 15, zlib.compress(bytes(inertialnav.MAX_TABLES), 9)))
    with pytest.raises(LogError, match=r"log\.mat: its tables expand to more than 33554432 bytes$"):
        sources.open_source(tmp_path / "log.mat")


def test_matlab_file_is_rejected_by_its_size_without_being_read(tmp_path: pathlib.Path) -> None:
    with (tmp_path / "log.mat").open("wb") as file:
        file.truncate(1 << 32)
    with pytest.raises(LogError, match=r"log\.mat has 4294967296 bytes \(limit 33554432\)$"):
        sources.open_source(tmp_path / "log.mat")
    (tmp_path / "log.mat").write_bytes(bytes(200))
    with pytest.raises(LogError, match="not a MATLAB file: its header states no byte order"):
        sources.open_source(tmp_path / "log.mat")


def test_tables_that_grow_in_the_reader_are_rejected(tmp_path: pathlib.Path) -> None:
    """Rows become objects; column names take the space of the longest."""
    path, table = tmp_path / "log.mat", np.zeros((inertialnav.MAX_ROWS + 1, 1), np.float32)
    savemat(path, {"IMU": table, "IMU_label": labels("TimeMS")}, do_compression=True)
    with pytest.raises(LogError, match="its tables have more than 524288 rows"):
        sources.open_source(path)
    names = labels("x" * 100_000 + " y" * 100)
    savemat(path, {"IMU": table[:2], "IMU_label": names}, do_compression=True)
    assert path.stat().st_size < 10_000
    with pytest.raises(LogError, match=r"its tables have 40400008 bytes \(limit 33554432\)"):
        sources.open_source(path)


def tables(glitch: float = 0.0) -> dict[str, str]:
    """One minute of flight eastwards at 10 m/s, with a GNSS error of `glitch` metres for one second."""

    def text(rows: list[list[float]]) -> str:
        out = io.StringIO()
        np.savetxt(out, rows)
        return out.getvalue()

    metre = 1.0 / (6_371_000.0 * math.cos(math.radians(40.0))) * 180.0 / math.pi
    onboard, raw = [], []
    for k in range(1200):
        t = 50.0 * k
        where = [40.0, -105.0 + 0.01 * t * metre, 1800.0, 0.0, 10.0, 0.0]
        onboard.append([t, *where])
        if k % 4 == 0:
            off = glitch if 30_000 <= t < 31_000 else 0.0
            raw.append([t, where[0] + off * metre, *where[1:]])
    imu = [[50.0 * k, 50.0 * k, 0.0, 0.0, 0.0, 0.0, 0.0, -9.8] for k in range(1200)]
    return {"GPOSonboard.txt": text(onboard), "GPSraw.txt": text(raw), "IMU.txt": text(imu)}


def zipped(path: pathlib.Path, members: dict[str, str]) -> pathlib.Path:
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return path


def test_text_tables_are_read_from_zip_and_folder(tmp_path: pathlib.Path) -> None:
    records = list(sources.open_source(zipped(tmp_path / "log.zip", tables())))
    assert not any(isinstance(record, r.Event) for record in records)
    last = [record for record in records if isinstance(record, r.LocalPosition)][-1]
    assert last.x_n == pytest.approx((0.0, 599.5, 0.0), abs=2.0)
    assert [record.t_ns for record in records] == sorted(record.t_ns for record in records)
    for name, content in tables().items():
        (tmp_path / name).write_text(content)
    assert list(sources.open_source(tmp_path)) == records


def test_glitch_is_an_event(tmp_path: pathlib.Path) -> None:
    records = list(sources.open_source(zipped(tmp_path / "log.zip", tables(20.0))))
    (event,) = [record for record in records if isinstance(record, r.Event)]
    assert event.t_ns == 30_000_000_000 and event.text.startswith("GNSS glitch of 0.8 s")


def test_missing_and_damaged_tables_are_reported(tmp_path: pathlib.Path) -> None:
    lacking = {name: text for name, text in tables().items() if name != "GPSraw.txt"}
    narrow = tables() | {"IMU.txt": "1 2 3\n4 5 6\n"}
    damaged = tables() | {"IMU.txt": "1 2 three\n"}
    ragged = tables() | {"IMU.txt": "1 2 3\n4 5\n"}
    for members, words in (
        (lacking, "has no GPSraw.txt"),
        (narrow, "has 2 rows of 3 columns"),
        (damaged, r"damaged in IMU\.txt: could not convert string 'three'"),
        (ragged, "the number of columns changed from 3 to 2 at row 2$"),
        (tables() | {"IMU.txt": ""}, r"IMU\.txt is empty: it needs at least 2 rows of 8 columns$"),
    ):
        with pytest.raises(LogError, match=words) as caught:
            sources.open_source(zipped(tmp_path / "log.zip", members))
        assert "\n" not in str(caught.value)
    savemat(tmp_path / "other.mat", {"x": np.ones(3)})
    with pytest.raises(LogError, match="has no ArduPilot table"):
        sources.open_source(tmp_path / "other.mat")


def test_a_damaged_archive_is_reported_without_the_types_of_python(tmp_path: pathlib.Path) -> None:
    path = zipped(tmp_path / "log.zip", tables())
    whole, entry = path.read_bytes(), path.read_bytes().index(b"PK\x01\x02")
    encrypted = bytearray(whole)
    encrypted[entry + 8] |= 1
    for content in (b"no archive", whole[: len(whole) // 2], b"abcd" + whole[4:]):
        path.write_bytes(content)
        with pytest.raises(LogError) as caught:
            sources.open_source(path)
        assert str(caught.value) == f"{path} is no ZIP archive, or is incomplete: copy the recording again"
    path.write_bytes(encrypted)
    with pytest.raises(LogError, match=r"\.txt is encrypted: pack it without a password"):
        sources.open_source(path)
    mat = tmp_path / "log.mat"
    savemat(mat, {"IMU": np.ones((2, 3)), "IMU_label": labels("LineNo TimeMS GyrX")})
    mat.write_bytes(mat.read_bytes()[:-60])
    with pytest.raises(LogError, match=r"damaged \(could not read bytes\): copy the recording again$"):
        sources.open_source(mat)
    savemat(mat, {"GPS": np.ones((2, 2)), "GPS_label": labels("TimeMS Status")})
    with pytest.raises(LogError, match="nothing could be read: GPS at 1000 us: no column"):
        list(sources.open_source(mat))


def test_rows_of_text_tables_are_limited_in_total(tmp_path: pathlib.Path) -> None:
    rows = inertialnav.MAX_ROWS // 2
    bomb = {"IMU.txt": "1 0 0 0 0 0 0 0\n" * rows, "GPSraw.txt": "1 0 0 0 0 0 0\n" * (rows + 1)}
    with zipfile.ZipFile(tmp_path / "log.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in (tables() | bomb).items():
            archive.writestr(name, content)
    assert (tmp_path / "log.zip").stat().st_size < 100_000
    with pytest.raises(LogError, match="its tables have more than 524288 rows"):
        sources.open_source(tmp_path / "log.zip")
    with pytest.raises(LogError, match="a line has more than 1000 characters"):
        sources.open_source(zipped(tmp_path / "log.zip", tables() | {"IMU.txt": "1 " * 1000}))
    with zipfile.ZipFile(tmp_path / "log.zip", "w", zipfile.ZIP_BZIP2) as archive:
        archive.writestr("IMU.txt", "1 " * 1000)
    with pytest.raises(LogError, match=r"log\.zip: IMU\.txt is compressed by another method than Deflate"):
        sources.open_source(tmp_path / "log.zip")


@pytest.mark.shared
def test_recordings_are_read() -> None:
    if not SHARED.exists():
        pytest.skip("the recordings are not available")
    plane = list(sources.open_source(SHARED / "TestLog2.mat"))
    assert sum(isinstance(record, r.Imu) for record in plane) == 30_650
    assert sum(isinstance(record, r.Gnss) for record in plane) == 3050
    quad = list(sources.open_source(SHARED / "f450_glitch_log.zip"))
    (glitch,) = [record for record in quad if isinstance(record, r.Event)]
    assert 126.2 < glitch.t_ns * 1e-9 < 127.7


def test_a_damaged_matlab_file_that_ends_its_reader_is_rejected(tmp_path: pathlib.Path) -> None:
    """A data type without a meaning: scipy's reader ends the process on it (scipy pull request 25349)."""
    path = tmp_path / "log.mat"
    savemat(path, {"IMU": np.ones((2, 3)), "IMU_label": labels("LineNo TimeMS GyrX")}, do_compression=False)
    data = bytearray(path.read_bytes())
    at = data.index(b"\x09\x00\x00\x00\x30\x00\x00\x00")  # miDOUBLE, 48 bytes
    data[at] = 8
    path.write_bytes(data)
    with pytest.raises(LogError, match=r"is no MATLAB file, or is damaged \(its reader failed on it\)"):
        sources.open_source(path)
