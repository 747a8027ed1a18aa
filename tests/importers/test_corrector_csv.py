"""Tables of correctors: values arrive in SI units, mistakes are reported with their line."""

import math

import pytest

from companion.importers.corrector_csv import read_correctors
from companion.records import RangeDifference, StarFix

STAR = "t_s,star,lat_deg,lon_deg,altitude_deg,azimuth_deg,sigma_altitude_arcsec,sigma_azimuth_arcsec"
LINE = "t_s,chain,lat_a_deg,lon_a_deg,alt_a_m,lat_b_deg,lon_b_deg,alt_b_m,difference_m,sigma_m"
INS = "t_s,ins,lat_deg,lon_deg"
NS = 1_000_000_000


def read(tmp_path, text):
    path = tmp_path / "correctors.csv"
    path.write_text(text)
    return read_correctors(path, 5 * NS)


def test_stars(tmp_path):
    first, second = read(tmp_path, f"{STAR}\n60,2,20,-75,30,,20,\n1.5,1,10,70,45,200,10,15\n")
    assert isinstance(first, StarFix)
    assert (first.t_ns, first.star, first.lat) == (6_500_000_000, 1, math.radians(10))
    assert first.azimuth == pytest.approx(math.radians(200))
    assert (first.sigma_altitude, first.sigma_azimuth) == pytest.approx((4.8481368e-5, 7.2722052e-5))
    assert second.azimuth is None and second.t_ns == 65 * NS


def test_a_table_of_a_spreadsheet_may_begin_with_a_byte_order_mark(tmp_path):
    assert read(tmp_path, f"\ufeff{STAR}\n1,1,10,70,45,200,10,15\n") == read(
        tmp_path, f"{STAR}\n1,1,10,70,45,200,10,15\n"
    )


def test_lines(tmp_path):
    (line,) = read(tmp_path, f"{LINE}\n2,1,61,26,50,58,27,60,-1234.5,50\n")
    assert isinstance(line, RangeDifference)
    assert (line.chain, line.alt_b, line.difference, line.sigma) == (1, 60.0, -1234.5, 50.0)
    assert line.lat_a == math.radians(61)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a,b\n1,2\n", "the header is 'a,b'"),
        ("", "the header is ''"),
        (f"{STAR}\n1,1,10,70,x,200,10,15\n", "line 2: altitude_deg is 'x'; it must be a number"),
        (f"{STAR}\n1,1,10,70,45\n", "line 2: it has 5 columns, and the header 8"),
        (f"{INS}\n1e300,0,55.7,37.6\n", "line 2: t_s is 1e+300, beyond 1e+08 s"),
        (f"{INS}\n1,0.5,55.7,37.6\n", "line 2: ins is 0.5; it must be an integer from 0 to 65535"),
        (f"{INS}\n1,1e300,55.7,37.6\n", "line 2: ins is 1e+300; it must be an integer"),
        (f"{INS}\n1,0,55.7,437.6\n", "line 2: lon is 437.6 deg, beyond 180 deg"),
        (f"{LINE}\n2,1,61,26,1e9,58,27,60,-1234.5,50\n", "line 2: alt_a 1e+09 is beyond the limit 100000"),
        (f"{STAR}\n1,1,100,70,45,200,10,15\n", "line 2: lat is 100 deg"),
        (f"{STAR}\n1,1,,70,45,200,10,15\n", "lat_deg is missing"),
        (f"{LINE}\n2,1,61,26,50,58,27,60,-1234.5,0\n", "sigma is 0; it must be positive"),
        (f"{STAR}\n1,1,10,70,45,200,10,0\n", "sigma_azimuth is 0; it must be positive"),
    ],
)
def test_mistakes_are_reported(tmp_path, text, message):
    with pytest.raises(ValueError, match=r"correctors\.csv") as caught:
        read(tmp_path, text)
    assert message in str(caught.value)


def test_missing_file_is_named_without_names_of_python(tmp_path):
    with pytest.raises(ValueError) as caught:
        list(read_correctors(tmp_path / "none.csv", 0))
    assert str(caught.value) == f"{tmp_path / 'none.csv'}: cannot be read (No such file or directory)"
