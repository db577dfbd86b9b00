"""Position fixes of every kind of source, as they were written; bad input is one line with file, line and remedy."""

from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from mcap_ros2.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Bag1Writer
from rosbags.rosbag2 import Writer as Bag2Writer
from rosbags.typesys import Stores, get_typestore

from segslam.core.stamps import stamp_of
from segslam.core.types import SegslamError
from segslam.gnss.fixes import make_fixes
from segslam.gnss.geodesy import Origin, ecef_from_geodetic, enu_from_geodetic
from segslam.gnss.reading import read_fixes, row_of

MOMENT = datetime(2021, 5, 17, 2, 33, 17, 500000, tzinfo=UTC)
STAMP_NS = stamp_of(MOMENT)
LEAP_S = 18
PLACES = np.array([[48.98, 8.39, 115.0], [48.9801, 8.3902, 115.5], [48.9803, 8.3903, 116.0]])
TOPIC, MESSAGE = "/fix", "sensor_msgs/msg/NavSatFix"
DEFINITION = """std_msgs/Header header
sensor_msgs/NavSatStatus status
float64 latitude
float64 longitude
float64 altitude
float64[9] position_covariance
uint8 position_covariance_type
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
================================================================================
MSG: sensor_msgs/NavSatStatus
int8 status
uint16 service
"""


def sentence(content: str) -> str:
    """NMEA with its checksum."""
    total = 0
    for letter in content.encode():
        total ^= letter
    return f"${content}*{total:02X}"


def _angle(degrees: float, digits: int) -> str:
    whole = int(abs(degrees))
    return f"{whole:0{digits}d}{60 * (abs(degrees) - whole):010.7f}"


def _gga(row: int, place: np.ndarray, quality: int = 4) -> str:
    at = f"02{33:02d}{17 + row:02d}.50"
    return sentence(
        f"GNGGA,{at},{_angle(place[0], 2)},N,{_angle(place[1], 3)},E,{quality},12,0.8,{place[2] - 48.0:.4f},M,48.0,M,,"
    )


def write_csv(file: Path) -> Path:
    rows = [f"{1e-9 * STAMP_NS + row:.3f};{a};{b};{c};0.5;0.4;0.9" for row, (a, b, c) in enumerate(PLACES)]
    file.write_text("Time [s];Lat;Lon;Alt (m);sde;sdn;sdu\n" + "\n".join(rows) + "\n")
    return file


def write_nmea(file: Path) -> Path:
    rmc = sentence(f"GNRMC,023317.50,A,{_angle(PLACES[0, 0], 2)},N,{_angle(PLACES[0, 1], 3)},E,0.1,,170521,,,A")
    broken = _gga(0, PLACES[0]).replace("4898", "4998")[:-1] + "?"
    file.write_text("\r\n".join([rmc, broken, *(_gga(row, place) for row, place in enumerate(PLACES))]) + "\r\n")
    return file


def write_pos(file: Path, *, is_ecef: bool) -> Path:
    values = ecef_from_geodetic(PLACES) if is_ecef else PLACES
    names = "x-ecef(m) y-ecef(m) z-ecef(m)" if is_ecef else "latitude(deg) longitude(deg) height(m)"
    rows = [
        f"2021/05/17 02:33:{17 + LEAP_S + row:02d}.500 {a:.9f} {b:.9f} {c:.4f} 1 9 0.4 0.5 0.9 0 0 0 0 0"
        for row, (a, b, c) in enumerate(values)
    ]
    file.write_text(f"% program : RTKPOST\n%  GPST  {names} Q ns\n" + "\n".join(rows) + "\n")
    return file


def write_oxts(folder: Path) -> Path:
    (folder / "data").mkdir(parents=True)
    times = [f"2021-05-17 02:33:{17 + row}.500000000" for row in range(3)]
    (folder / "timestamps.txt").write_text("\n".join(times) + "\n")
    for row, place in enumerate(PLACES):
        values = [*map(str, place), *["0"] * 20, "0.5", *["0"] * 6]
        (folder / "data" / f"{row:010d}.txt").write_text(" ".join(values) + "\n")
    return folder


def _values(row: int, *, status: int = 0) -> dict[str, Any]:
    latitude, longitude, altitude = map(float, PLACES[row])
    covariance = np.diag([0.25, 0.16, 0.81]).ravel()
    return {
        "latitude": latitude,
        "longitude": longitude,
        "altitude": altitude,
        "covariance": covariance,
        "status": status,
    }


def write_mcap(file: Path, topics: tuple[str, ...] = (TOPIC,)) -> Path:
    with file.open("wb") as stream, McapWriter(stream) as writer:
        schema = writer.register_msgdef(MESSAGE, DEFINITION)
        for row in range(3):
            values = _values(row)
            message = {
                "header": {"stamp": {"sec": STAMP_NS // 10**9 + row, "nanosec": STAMP_NS % 10**9}, "frame_id": "gps"},
                "status": {"status": values["status"], "service": 1},
                **{name: values[name] for name in ("latitude", "longitude", "altitude")},
                "position_covariance": values["covariance"].tolist(),
                "position_covariance_type": 2,
            }
            for topic in topics:
                writer.write_message(topic, schema, message, STAMP_NS + row * 10**9)
    return file


def write_bag(path: Path, *, ros: int) -> Path:
    store = get_typestore(Stores.ROS1_NOETIC if ros == 1 else Stores.ROS2_HUMBLE)
    types = store.types
    with Bag1Writer(path) if ros == 1 else Bag2Writer(path, version=8) as writer:
        connection = writer.add_connection(TOPIC, MESSAGE, typestore=store)
        for row in range(3):
            values = _values(row)
            stamp = types["builtin_interfaces/msg/Time"](sec=STAMP_NS // 10**9 + row, nanosec=STAMP_NS % 10**9)
            more = {"seq": row} if ros == 1 else {}
            message = types[MESSAGE](
                header=types["std_msgs/msg/Header"](stamp=stamp, frame_id="gps", **more),
                status=types["sensor_msgs/msg/NavSatStatus"](status=0, service=1),
                latitude=values["latitude"],
                longitude=values["longitude"],
                altitude=values["altitude"],
                position_covariance=values["covariance"],
                position_covariance_type=2,
            )
            data = store.serialize_ros1(message, MESSAGE) if ros == 1 else store.serialize_cdr(message, MESSAGE)
            writer.write(connection, STAMP_NS + row * 10**9, data)
    return path


WRITERS: dict[str, Callable[[Path], Path]] = {
    "csv": lambda folder: write_csv(folder / "fixes.txt"),
    "nmea": lambda folder: write_nmea(folder / "log.txt"),
    "pos": lambda folder: write_pos(folder / "a.pos", is_ecef=False),
    "pos ecef": lambda folder: write_pos(folder / "a.pos", is_ecef=True),
    "oxts": lambda folder: write_oxts(folder / "oxts"),
    "mcap": lambda folder: write_mcap(folder / "drive.mcap"),
    "bag": lambda folder: write_bag(folder / "drive.bag", ros=1),
    "bag2": lambda folder: write_bag(folder / "drive", ros=2),
}
WITH_SIGMA = {"csv": (0.5, 0.4, 0.9), "pos": (0.5, 0.4, 0.9), "oxts": (0.5, 0.5, 0.5)}
WITH_SIGMA |= dict.fromkeys(("mcap", "bag", "bag2"), (0.5, 0.4, 0.9))


@pytest.mark.parametrize("kind", WRITERS)
def test_fixes_are_read_as_they_were_written(kind: str, tmp_path: Path) -> None:
    fixes = read_fixes(WRITERS[kind](tmp_path))
    assert fixes.usable.sum() == len(fixes) == 3
    off_m = enu_from_geodetic(fixes.places, Origin(*PLACES[0])) - enu_from_geodetic(PLACES, Origin(*PLACES[0]))
    np.testing.assert_allclose(off_m, 0.0, atol=0.001)
    np.testing.assert_array_less(np.abs(fixes.stamp_ns - STAMP_NS - np.arange(3) * 10**9), 1_000_000)
    if kind in WITH_SIGMA:
        np.testing.assert_allclose(fixes.sigma_m, np.tile(WITH_SIGMA[kind], (3, 1)), rtol=1e-6)
    if kind == "nmea":
        assert "1 line with wrong checksums left out" in fixes.note


def test_a_topic_is_read_from_the_recording_that_is_mapped(tmp_path: Path) -> None:
    recording = write_mcap(tmp_path / "drive.mcap", (TOPIC, "/other"))
    assert len(read_fixes(TOPIC, recording=recording)) == 3
    with pytest.raises(SegslamError, match=r"the recording has: --gnss /fix, --gnss /other"):
        read_fixes(recording)
    with pytest.raises(SegslamError, match=r"no topic /gps of type .*--gnss /fix"):
        read_fixes("/gps", recording=recording)


def test_midnight_is_passed(tmp_path: Path) -> None:
    rows = []
    for at, place in zip(("235959.50", "000000.50"), PLACES, strict=False):
        where = f"{_angle(place[0], 2)},N,{_angle(place[1], 3)},E"
        rows.append(sentence(f"GPGGA,{at},{where},1,9,0.8,60.0,M,48.0,M,,"))
    rows.insert(0, sentence("GPZDA,235959.00,31,12,2025,00,00"))
    (tmp_path / "a.nmea").write_text("\n".join(rows))
    fixes = read_fixes(tmp_path / "a.nmea")
    assert np.diff(fixes.stamp_ns) == [1_000_000_000]
    assert fixes.stamp_ns[1] == stamp_of(datetime(2026, 1, 1, 0, 0, 0, 500000, tzinfo=UTC))


def test_fixes_without_position_are_not_used(tmp_path: Path) -> None:
    rows = ["time,lat,lon,alt,quality", "1,48,8,100,1", "2,nan,8,100,1", "3,48.1,8,100,0", "4,48,8,100,1", "5,0,0,0,1"]
    rows += ["6,48.2,8,,1", "6,48.3,8,,1", "7,48.3,8,,1", "8,48.3,8,,1"]
    (tmp_path / "a.csv").write_text("\n".join(rows))
    fixes = read_fixes(tmp_path / "a.csv")
    assert fixes.reasons == ("", "not_finite", "no_fix", "duplicate", "no_fix", "", "duplicate", "", "duplicate")
    (tmp_path / "none.csv").write_text("\n".join([rows[0], rows[2], rows[3]]))
    with pytest.raises(SegslamError, match="none of its 2 fixes can be used"):
        read_fixes(tmp_path / "none.csv")


def test_a_status_is_that_of_navsatfix(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("time,lat,lon,alt,status\n1,48,8,100,0\n2,48.1,8,100,-1\n")
    assert read_fixes(tmp_path / "a.csv").reasons == ("", "no_fix")


def _message(*, status: int, variance: float, kind: int = 2) -> SimpleNamespace:
    stamp = SimpleNamespace(sec=10, nanosec=5)
    return SimpleNamespace(
        header=SimpleNamespace(stamp=stamp),
        status=SimpleNamespace(status=status),
        latitude=48.0,
        longitude=8.0,
        altitude=100.0,
        position_covariance=[variance, 0, 0, 0, variance, 0, 0, 0, variance],
        position_covariance_type=kind,
    )


def test_messages_without_fix_or_covariance_are_what_they_are() -> None:
    """A receiver without a fix sends status -1, and often NaN as covariance; NaN alone is an unknown one."""
    rows = [_message(status=-1, variance=np.nan), _message(status=0, variance=np.nan), _message(status=0, variance=0.0)]
    rows += [_message(status=0, variance=4.0), _message(status=0, variance=4.0, kind=0)]
    found = [row_of(row) for row in rows]
    assert [row.has_fix for row in found] == [False, True, True, True, True]
    np.testing.assert_array_equal([row.sigma_m[0] for row in found], [np.nan, np.nan, np.nan, 2.0, np.nan])
    assert make_fixes("fix", found[:2]).reasons == ("no_fix", "")
    with pytest.raises(SegslamError, match=r"none of its 1 fixes can be used \(1 no_fix\)"):
        make_fixes("fix", found[:1])


@pytest.mark.parametrize("unit", [1, 1000, 10**6, 10**9])
def test_the_size_of_a_time_shows_its_unit(unit: int, tmp_path: Path) -> None:
    rows = [f"{(1_700_000_000 + row) * unit},{48 + row},8" for row in range(2)]
    (tmp_path / "a.csv").write_text("\n".join(rows))
    assert read_fixes(tmp_path / "a.csv").stamp_ns.tolist() == [1_700_000_000 * 10**9, 1_700_000_001 * 10**9]


BAD = {
    "a.csv": [
        ("", "contains no line with a fix"),
        ("1,48.0\n", r"a\.csv:1: 2 columns"),
        ("time,lat,lon\n1,x,8\n", r"a\.csv:2: latitude x is not a number"),
        ("time,lat,lon\n1,4898.0,8\n", r"a\.csv:2: latitude 4898 .* not metres"),
        ("time,lat,lon\nsoon,48,8\n", r"a\.csv:2: time soon"),
        ("when,lat,lon\n1,48,8\n", r"a\.csv:1: no column time"),
        (f"stamp_ns,lat,lon\n1{30 * '0'},48,8\n", "292 years"),
    ],
    "a.nmea": [("$GPGGA,1,2,N,3,E,1,1,1,1,M,1,M,,*00\n", "all 1 NMEA sentences have wrong checksums")],
    "a.pos": [("%  GPST latitude(deg) longitude(deg)\n2158 95599 48.0\n", r"a\.pos:2: 3 columns")],
}


@pytest.mark.parametrize(("name", "text", "message"), [(name, *one) for name, some in BAD.items() for one in some])
def test_bad_input_is_one_line(name: str, text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(SegslamError, match=message) as raised:
        read_fixes(tmp_path / name)
    assert "\n" not in str(raised.value)


def test_sentences_between_the_binary_messages_of_a_receiver_are_read(tmp_path: Path) -> None:
    """As u-blox's u-center logs them; a message may contain any byte, also that of $."""
    rmc = sentence(f"GNRMC,023317.50,A,{_angle(PLACES[0, 0], 2)},N,{_angle(PLACES[0, 1], 3)},E,0.1,,170521,,,A")
    sentences = [rmc, *(_gga(row, place) for row, place in enumerate(PLACES))]
    binary = b"\xb5b\x02\x15\x00\x01" + bytes(range(256)) * 4
    (tmp_path / "log.ubx").write_bytes(b"".join(binary + text.encode() + b"\r\n" for text in sentences))
    np.testing.assert_allclose(read_fixes(tmp_path / "log.ubx").places, PLACES, atol=1e-6)


def test_what_is_no_source_is_named(tmp_path: Path) -> None:
    with pytest.raises(SegslamError, match="no such file"):
        read_fixes(tmp_path / "none")
    with pytest.raises(SegslamError, match=r"no timestamps\.txt"):
        read_fixes(tmp_path)
    (tmp_path / "a.bin").write_bytes(b"\0\1" * 50)
    with pytest.raises(SegslamError, match="a binary file"):
        read_fixes(tmp_path / "a.bin")
    (tmp_path / "a.mcap").write_bytes(b"no recording")
    with pytest.raises(SegslamError, match=r"a\.mcap: cannot be opened as MCAP"):
        read_fixes(tmp_path / "a.mcap")


@pytest.mark.data
def test_a_real_receiver_in_a_city_is_as_wrong_as_known(data_dir: Path) -> None:
    fixes = read_fixes(data_dir / "gnss" / "urbannav_tst.pos")
    lines = (data_dir / "gnss" / "urbannav_tst_truth.txt").read_text().splitlines()
    truth = np.array([[float(word) for word in line.split()[:10]] for line in lines if line[:1].isdigit()])
    degrees = [truth[:, k] + truth[:, k + 1] / 60 + truth[:, k + 2] / 3600 for k in (3, 6)]
    rows = np.searchsorted(truth[:, 0], 1e-9 * fixes.stamp_ns - 1e-3)
    assert np.abs(truth[rows, 0] - 1e-9 * fixes.stamp_ns).max() < 0.01, "leap seconds"
    places = np.column_stack([*degrees, truth[:, 9]])[rows]
    origin = Origin(*places[0])
    off_m = np.hypot(*(enu_from_geodetic(fixes.places, origin) - enu_from_geodetic(places, origin))[:, :2].T)
    assert np.median(off_m) == pytest.approx(11.0, rel=0.5)


@pytest.mark.parametrize(
    ("clock", "at"),
    [
        ("GPST", "2024/05/01 00:00:18.000"),
        ("UTC", "2024/05/01 00:00:00.000"),
        ("JST", "2024/05/01 09:00:00.000"),
        ("UTC", "2024/05/01 00:00:00.000000000"),
        ("UTC", "2024/05/01 00:00:00"),
        ("GPST", "2312 259218.000"),
        ("UTC", "2312 259200.000"),
    ],
)
def test_rtklib_may_write_other_clocks_and_degrees_in_parts(clock: str, at: str, tmp_path: Path) -> None:
    rest = "100.0 1 9 0.01 0.01 0.02 0 0 0 0.0 0.0"
    texts = {
        "degrees.pos": f"%  {clock}  latitude(deg) longitude(deg)\n{at} -48.1375 11.5819444444 {rest}\n",
        "parts.pos": f"%  {clock}  latitude(d'\") longitude(d'\")\n{at} -48  8 15.0 11 34 55.0 {rest}\n",
    }
    for name, text in texts.items():
        (tmp_path / name).write_text(text)
        fixes = read_fixes(tmp_path / name)
        assert fixes.stamp_ns[0] == stamp_of(datetime(2024, 5, 1, tzinfo=UTC))
        np.testing.assert_allclose(fixes.places[0], [-48.1375, 11.581944444, 100.0], atol=1e-8)


def test_one_unknown_coordinate_of_ecef_makes_a_fix_unusable(tmp_path: Path) -> None:
    rows = [f"2024/05/01 00:00:0{row} {x} 606000.0 4790000.0 1 9" for row, x in enumerate(("4150000.0", "nan"))]
    (tmp_path / "a.pos").write_text("\n".join(["%  GPST  x-ecef(m) y-ecef(m) z-ecef(m)", *rows]))
    assert read_fixes(tmp_path / "a.pos").reasons == ("", "not_finite")


def test_midnight_is_passed_without_a_fix(tmp_path: Path) -> None:
    fix = "4800.0,N,00800.0,E,1,8,1,100,M,48,M,,"
    sentences = (
        f"GPGGA,235958.00,{fix}",
        "GPRMC,235958.00,A,4800.0,N,00800.0,E,0,0,310124,,",
        "GPRMC,000000.00,V,,,,,,,,,",
        f"GPGGA,000001.00,{fix}",
    )
    (tmp_path / "a.nmea").write_text("\n".join(map(sentence, sentences)))
    assert np.diff(read_fixes(tmp_path / "a.nmea").stamp_ns) == [3_000_000_000]


def test_a_date_that_passes_midnight_before_the_fix_counts_once(tmp_path: Path) -> None:
    fix = "4800.0,N,00800.0,E,1,8,1,100,M,48,M,,"
    sentences = (
        "GPZDA,235959.00,31,01,2026,00,00",
        f"GPGGA,235959.00,{fix}",
        "GPZDA,000000.00,01,02,2026,00,00",
        f"GPGGA,000000.00,{fix}",
        f"GPGGA,000001.00,{fix}",
    )
    (tmp_path / "a.nmea").write_text("\n".join(map(sentence, sentences)))
    fixes = read_fixes(tmp_path / "a.nmea")
    assert fixes.stamp_ns[-1] == stamp_of(datetime(2026, 2, 1, 0, 0, 1, tzinfo=UTC))
    assert np.diff(fixes.stamp_ns).tolist() == [1_000_000_000] * 2


def test_fixes_before_the_first_date_may_be_of_the_day_before(tmp_path: Path) -> None:
    fix = "4800.0,N,00800.0,E,1,8,1,100,M,48,M,,"
    sentences = (
        f"GPGGA,235958.00,{fix}",
        f"GPGGA,000000.00,{fix}",
        "GPRMC,000000.00,A,4800.0,N,00800.0,E,0,0,310124,,",
        f"GPGGA,000001.00,{fix}",
    )
    (tmp_path / "a.nmea").write_text("\n".join(map(sentence, sentences)))
    fixes = read_fixes(tmp_path / "a.nmea")
    assert fixes.stamp_ns[0] == stamp_of(datetime(2024, 1, 30, 23, 59, 58, tzinfo=UTC))
    assert np.diff(fixes.stamp_ns).tolist() == [2_000_000_000, 1_000_000_000]


@pytest.mark.parametrize("dated", [None, 0, 3])
def test_sentences_out_of_order_around_midnight_keep_their_day(dated: int | None, tmp_path: Path) -> None:
    """`dated`: row before which the date is given; without dates the first day is in 1970."""
    times, fix = ("235958.00", "000000.00", "235959.50", "000001.00"), "4800.0,N,00800.0,E,1,8,1,100,M,48,M,,"
    contents = [f"GPGGA,{at},{fix}" for at in times]
    days = ["31,01,2024", "01,02,2024", "31,01,2024", "01,02,2024"]
    if dated is not None:
        contents.insert(dated, f"GPZDA,{times[dated]},{days[dated]},00,00")
    (tmp_path / "a.nmea").write_text("\n".join(map(sentence, contents)))
    midnight = datetime(1970, 1, 2, tzinfo=UTC) if dated is None else datetime(2024, 2, 1, tzinfo=UTC)
    since_ns = read_fixes(tmp_path / "a.nmea").stamp_ns - stamp_of(midnight)
    assert since_ns.tolist() == [-2_000_000_000, -500_000_000, 0, 1_000_000_000]


@pytest.mark.parametrize(("at", "day"), [("000001", "01,01,0001"), ("235959", "31,12,9999")])
def test_a_date_whose_neighbour_does_not_exist_is_none(at: str, day: str, tmp_path: Path) -> None:
    fix = "4800.0,N,00800.0,E,1,8,1,100,M,48,M,,"
    contents = [f"GPGGA,{one}.00,{fix}" for one in ("235958", "000002")]
    (tmp_path / "a.nmea").write_text("\n".join(map(sentence, [f"GPZDA,{at}.00,{day},00,00", *contents])))
    assert np.diff(read_fixes(tmp_path / "a.nmea").stamp_ns).tolist() == [4_000_000_000]


@pytest.mark.parametrize("kind", ["GGA", "RMC", "pos", "csv"])
def test_a_leap_second_is_the_second_after_59(kind: str, tmp_path: Path) -> None:
    place = "4800.0,N,00800.0,E"
    lines = [
        {
            "GGA": sentence(f"GPGGA,{at.replace(':', '')},{place},1,8,1,100,M,48,M,,"),
            "RMC": sentence(f"GPRMC,{at.replace(':', '')},A,{place},0,0,311216,,"),
            "pos": f"2016/12/31 {at} 48.0 8.0 100.0 1 9",
            "csv": f"2016-12-31T{at}Z,48.0,8.0,100.0",
        }[kind]
        for at in ("23:59:59.50", "23:59:60.25")
    ]
    header = {"GGA": sentence("GPZDA,235959.00,31,12,2016,00,00"), "pos": "%  UTC  latitude(deg) longitude(deg)"}
    (tmp_path / "a.pos").write_text("\n".join([header.get(kind, ""), *lines]))
    midnight_ns = stamp_of(datetime(2017, 1, 1, tzinfo=UTC))
    assert (read_fixes(tmp_path / "a.pos").stamp_ns - midnight_ns).tolist() == [-500_000_000, 250_000_000]


def test_seconds_and_nanoseconds_may_be_two_columns(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("sec,nanosec,lat,lon\n100,0,48,11\n100,500000000,48.1,11\n101,0,48.2,11\n")
    assert read_fixes(tmp_path / "a.csv").stamp_ns.tolist() == [100_000_000_000, 100_500_000_000, 101_000_000_000]


def test_no_fix_may_be_written_with_a_blank(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("time,lat,lon,fix\n1,48,11,no fix\n2,48,11,RTK fix\n3,48,11,No-Fix\n")
    assert read_fixes(tmp_path / "a.csv").reasons == ("no_fix", "", "no_fix")


def test_blanks_before_a_sentence_are_ignored(tmp_path: Path) -> None:
    (tmp_path / "a.log").write_text(" " + sentence("GPGGA,235958.00,4800.0,N,00800.0,E,1,8,1,100,M,48,M,,") + "\n")
    assert read_fixes(tmp_path / "a.log").places.tolist() == [[48.0, 8.0, 148.0]]


@pytest.mark.parametrize("before", ["", "1700000000.25 ", "2024-01-01 23:59:58,100: "])
@pytest.mark.parametrize("has_checksums", [True, False])
def test_sentences_after_a_host_time_and_without_checksums_are_read(
    before: str, has_checksums: bool, tmp_path: Path
) -> None:
    contents = [f"GPGGA,23595{row}.00,480{row}.0,N,00800.0,E,1,8,1,100,M,48,M,," for row in range(3)]
    lines = [sentence(content) if has_checksums else f"${content}" for content in contents]
    (tmp_path / "a.log").write_text("".join(f"{before}{line}\r\n" for line in lines))
    fixes = read_fixes(tmp_path / "a.log")
    np.testing.assert_allclose(fixes.places, [[48.0 + row / 60.0, 8.0, 148.0] for row in range(3)])
    assert ("no line has a checksum" in fixes.note) == (not has_checksums)


def test_rostopic_echo_p_is_read_by_its_names(tmp_path: Path) -> None:
    names = "%time,field.header.seq,field.header.stamp,field.header.frame_id,field.status.status,field.status.service,"
    names += "field.latitude,field.longitude,field.altitude,field.position_covariance0,field.position_covariance_type"
    rows = ["1500000000300000000,1,1500000000100000000,gps,0,1,48.1,11.5,500.5,1.0,2"]
    rows += ["1500000001300000000,2,1500000001100000000,gps,-1,1,48.2,11.6,501.5,1.0,2"]
    (tmp_path / "fix.csv").write_text("\n".join([names, *rows]) + "\n")
    fixes = read_fixes(tmp_path / "fix.csv")
    assert fixes.stamp_ns.tolist() == [1500000000100000000, 1500000001100000000]
    assert fixes.places.tolist() == [[48.1, 11.5, 500.5], [48.2, 11.6, 501.5]]
    assert fixes.reasons == ("", "no_fix")


def test_numbers_between_semicolons_may_have_decimal_commas(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("time;lat;lon;alt\n1,5;48,25;11,5;500,5\n2,5;48,5;11,5;501\n")
    fixes = read_fixes(tmp_path / "a.csv")
    assert fixes.stamp_ns.tolist() == [1_500_000_000, 2_500_000_000]
    assert fixes.places.tolist() == [[48.25, 11.5, 500.5], [48.5, 11.5, 501.0]]


@pytest.mark.parametrize(
    ("header", "is_used"),
    [
        ("# time,lon,lat,alt", True),
        ("#longitude units: degrees\n#Time;Lon (deg);Lat (deg);Alt", True),
        (" ## time lon lat alt", True),
        ("# columns: time lon lat alt", False),
        ("# lon, lat, alt, other", False),
        ("# first drive, with the new receiver", False),
    ],
)
def test_a_header_may_be_a_comment(header: str, is_used: bool, tmp_path: Path) -> None:
    """Other comments are ignored, and the columns are in the order of a file without header."""
    (tmp_path / "a.csv").write_text(f"{header}\n# by hand\n1,11.5,48.25,500 # start\n2,11.6,48.5,501\n")
    places = read_fixes(tmp_path / "a.csv").places
    order = [1, 0, 2] if is_used else [0, 1, 2]
    np.testing.assert_array_equal(places, np.array([[11.5, 48.25, 500.0], [11.6, 48.5, 501.0]])[:, order])


def test_a_recording_may_end_in_capitals(tmp_path: Path) -> None:
    assert len(read_fixes(write_mcap(tmp_path / "DRIVE.MCAP"))) == 3


def test_the_home_of_an_unknown_user_is_refused() -> None:
    with pytest.raises(SegslamError, match="there is no user with this name"):
        read_fixes("~unknown-user/fixes.csv")
