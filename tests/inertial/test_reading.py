import numpy as np
import pytest

from factorsfm.inertial import reading
from factorsfm.inertial.reading import read_imu
from factorsfm.support.errors import InputError
from factorsfm.synthetic.imu import handheld_path, simulate_imu

NAMES = "time,gyro_x,gyro_y,gyro_z,accel_x,accel_y,accel_z"
EUROC = (
    "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
    "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]"
)
RECORDING = simulate_imu(handheld_path(1.0), 100.0)


def table(time=1.0, turn=1.0, force=1.0):
    """The samples of `RECORDING`, times factors."""
    return np.column_stack([time * RECORDING.time, turn * RECORDING.gyroscope, force * RECORDING.accelerometer])


def write(path, head, rows, end="\n"):
    lines = [head, *(",".join(f"{value:.12g}" for value in row) for row in rows)]
    path.write_text(end.join(lines) + end, newline="")
    return path


def assert_read(path):
    found = read_imu(path)
    np.testing.assert_allclose(found.time, RECORDING.time, atol=1e-9)
    np.testing.assert_allclose(found.gyroscope, RECORDING.gyroscope, atol=1e-9)
    np.testing.assert_allclose(found.accelerometer, RECORDING.accelerometer, atol=1e-9)
    assert found.cam_from_imu is None
    assert found.time_offset is None


def test_named_columns(tmp_path):
    assert_read(write(tmp_path / "imu.csv", NAMES, table()))


@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_columns_may_stand_in_any_order_among_others(tmp_path, end):
    rows = np.column_stack([np.full(len(table()), 21.5), table()[:, [4, 5, 6, 0, 1, 2, 3]]])
    head = "\ufefftemperature, Accel_X, Accel_Y ,accel_z,TIME,gyro_x,gyro_y,gyro_z"
    assert_read(write(tmp_path / "imu.csv", head, rows, end))


@pytest.mark.parametrize(
    ("suffixes", "factors"),
    [
        (("_s", "_rad", "_ms2"), (1.0, 1.0, 1.0)),
        (("_ms", "_deg", "_g"), (1e3, 180 / np.pi, 1 / 9.80665)),
        (("_us", "", ""), (1e6, 1.0, 1.0)),
        (("_ns", "", ""), (1e9, 1.0, 1.0)),
    ],
)
def test_units_stand_in_the_names(tmp_path, suffixes, factors):
    quantities = [name.split("_")[0] for name in NAMES.split(",")]
    of = dict(zip(("time", "gyro", "accel"), suffixes, strict=True))
    head = ",".join(name + of[kind] for name, kind in zip(NAMES.split(","), quantities, strict=True))
    assert_read(write(tmp_path / "imu.csv", head, table(*factors)))


def test_euroc(tmp_path):
    assert_read(write(tmp_path / "data.csv", EUROC, table(time=1e9)))


def gcsv(orientation="XYZ", columns="t,gx,gy,gz,ax,ay,az", scales="tscale,0.001\ngscale,0.002\nascale,0.0005"):
    head = f"GYROFLOW IMU LOG\nversion,1.3\nid,a_logger\norientation,{orientation}\nnote,one\n{scales}\n{columns}"
    return head.replace("\n\n", "\n")


def test_gyroflow(tmp_path):
    """The letters say which axis of the file is x, y and z: ``YxZ`` is (y, -x, z)."""
    rows = table(1e3, 1 / 0.002, 1 / 0.0005 / 9.80665)
    assert_read(write(tmp_path / "shot.gcsv", gcsv(), rows))
    # x = Y, y = -X, z = Z: the file holds (-y, x, z) of a vector (x, y, z).
    turned = rows[:, [0, 2, 1, 3, 5, 4, 6]] * [1, -1, 1, 1, -1, 1, 1]
    assert_read(write(tmp_path / "turned.gcsv", gcsv("YxZ"), turned))


def test_scales_of_gyroflow_have_defaults(tmp_path):
    assert_read(write(tmp_path / "shot.gcsv", gcsv(scales=""), table(1e3, 1.0, 1 / 9.80665)))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "is empty"),
        (b"\n\n", "is empty"),
        (b"\x00\x01\x02\xff" * 100, r"is no text; CSV or \.gcsv is expected"),
        (b"\xff\xd8\xff\xe0 JFIF", "is no text"),
        (b"hello", "has no column time, gyro_x, gyro_y, gyro_z, accel_x, accel_y, accel_z"),
        (NAMES.encode(), "has no samples below its head"),
        (NAMES.replace("gyro_y", "gyro_q").encode(), "has no column gyro_y; its first line must name"),
        (NAMES.replace("gyro_y", "gyro_y_mph").encode(), "has no column gyro_y; its first line must name"),
        (f"{NAMES},time_ns\n".encode(), 'has "time" in two columns'),
        (f"{NAMES}\n0,0,0,0,0,9.8,0\n0.01,0,0\n".encode(), "line 3 of IMU file .* has 3 columns; 7 are expected"),
        (f"{NAMES}\n0,0,0,0,0,9.8,0\n\n0.01,0,zero,0,0,9.8,0\n".encode(), "line 4 of IMU file .* holds 'zero'"),
        (f"{NAMES}\n0,0,0,,0,9.8,0\n".encode(), "line 2 of IMU file .* holds ''; a number is expected"),
        (f"{NAMES}\n0,0,0,0,0,9.8,0\n\xff\n".encode("latin-1"), "is no text"),
        (
            f"{NAMES}\n0,0,0,0,0,9.8,0\n0.01,nan,0,0,0,9.8,0\n".encode(),
            '"gyroscope" of an IMU is nan in row 1; a finite number',
        ),
        (
            f"{NAMES}\n0,0,0,0,1e308,9.8,0\n0.01,0,0,0,0,9.8,0\n".replace("accel_x", "accel_x_g").encode(),
            "is inf in row 0",
        ),
        (f"{NAMES}\n0,0,0,0,0,9.8,0\n".encode(), "has 1 samples; at least 2"),
        (gcsv("XYY").encode(), 'has the orientation "XYY"; x, y and z in any order are expected'),
        (gcsv(columns="t,gx,gy,gz").encode(), "has no column ax, ay, az"),
        (gcsv(scales="gscale,fast").encode(), 'has the gscale "fast"; a positive number is expected'),
        (gcsv(columns="").encode(), 'is a gyroflow log without the line "t,gx,gy,gz,ax,ay,az"'),
    ],
)
def test_a_file_that_is_none_is_refused_in_one_sentence(tmp_path, content, message):
    path = tmp_path / "imu.csv"
    path.write_bytes(content + (b"\n0,0,0,0,0,9.8,0\n0.01,0,0,0,0,9.8,0\n" if content.startswith(b"GYRO") else b""))
    with pytest.raises(InputError, match=message):
        read_imu(path)


def test_bytes_that_are_no_text_far_into_a_file(tmp_path):
    path = write(tmp_path / "imu.csv", NAMES, np.tile(table(), (20, 1)))
    path.write_bytes(path.read_bytes() + b"\xff\xfe\x00\n")
    with pytest.raises(InputError, match=r"line \d+ of IMU file .* has 1 columns; 7 are expected"):
        read_imu(path)


def test_files_that_cannot_be_read(tmp_path, monkeypatch):
    with pytest.raises(InputError, match="cannot be read: No such file"):
        read_imu(tmp_path / "none.csv")
    with pytest.raises(InputError, match="cannot be read: Is a directory"):
        read_imu(tmp_path)
    monkeypatch.setattr(reading, "_LARGEST_FILE", 100)
    with pytest.raises(InputError, match="GiB; at most"):
        read_imu(write(tmp_path / "imu.csv", NAMES, table()))
