# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
import scipy.io

from tactile_resonance.recording.recording import make_recording, read_recording

RNG = np.random.default_rng(0)
U, Y = RNG.standard_normal((2, 24))


def test_shapes_become_realisations_periods_samples():
    for shape in ((24,), (4, 6), (2, 2, 6)):
        recording = make_recording(
            U.reshape(shape), Y.reshape(shape), sample_rate_hz=10.0, samples_per_period=6
        )
        np.testing.assert_array_equal(recording.u.ravel(), U)
        assert recording.u.shape == ((2, 2, 6) if len(shape) == 3 else (1, 4, 6))


def test_segments_become_realisations():
    recording = make_recording(
        U, Y, sample_rate_hz=10.0, samples_per_period=4, segments=[(1, 9), (12, 20)]
    )
    assert recording.u.shape == (2, 2, 4)
    np.testing.assert_array_equal(recording.y[1].ravel(), Y[12:20])


def test_periods_divide_or_limit():
    divided = make_recording(U, Y, sample_rate_hz=10.0, periods=3)
    assert divided.u.shape == (1, 3, 8)
    limited = make_recording(U, Y, sample_rate_hz=10.0, samples_per_period=4, periods=2)
    np.testing.assert_array_equal(limited.u.ravel(), U[:8])


def test_single_precision_is_not_copied():
    u, y = U.astype(np.float32), Y.astype(np.float32)
    recording = make_recording(u, y, sample_rate_hz=10.0, samples_per_period=6)
    assert recording.u.dtype == np.float32
    assert np.shares_memory(recording.u, u)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"sample_rate_hz": 0.0}, "sample_rate_hz: got 0.0; accepted is a positive"),
        ({"sample_rate_hz": float("nan")}, "sample_rate_hz: got nan; accepted is a finite number"),
        ({"sample_rate_hz": "10"}, "sample_rate_hz: got '10'; accepted is a finite number"),
        ({"samples_per_period": 6.5}, "samples_per_period: got 6.5; accepted is a whole number"),
        ({"periods": "2"}, "periods: got '2'; accepted is a whole number, at least 1"),
        ({"segments": 5}, r"segments: got 5; accepted is a list of \(start, stop\)"),
        ({"segments": [(0,)]}, r"segments: got \[\(0,\)\]; accepted is a list"),
        ({"segments": [(0, float("nan"))]}, "segments: got .*nan.*; accepted is a list"),
        ({"u": [[1.0, 2.0], [3.0]]}, "u: values of type object, expected an array of real"),
        ({"u": None}, "u: values of type object, expected an array of real"),
        ({"samples_per_period": 5}, "u: 24 samples, expected a multiple of the period of 5"),
        (
            {"samples_per_period": 0},
            "samples_per_period: got 0; accepted is a whole number, at least 4",
        ),
        ({"samples_per_period": None, "periods": 7}, "periods: 7, expected a divisor"),
        ({"periods": 9}, r"periods: 9, accepted is 1\.\.4"),
        ({"segments": [(0, 30)]}, "segments: 0:30"),
        ({"segments": [(0, 6), (6, 18)]}, r"segments: lengths \[6, 12\]"),
        ({"segments": [(8, 20), (0, 12)]}, "segments: 0:12 and 8:20 share samples, expected each sample once"),
        ({"y": Y[:-1]}, r"y: shape \(23,\), expected that of u"),
        ({"y": np.where(np.arange(24) == 3, np.nan, Y)}, "y: 1 samples are NaN or infinite"),
        ({"u": np.where(np.arange(24) == 3, np.inf, U)}, "u: 1 samples are NaN or infinite"),
        ({"y": 1e90 * Y}, r"y: up to .*e\+\d+ V, expected 0 or 1e-70 to 1e\+70 V"),
        ({"u": 1e-90 * U}, r"u: up to .*e-\d+ V, expected 0 or 1e-70 to 1e\+70 V"),
        ({"y": np.ma.masked_greater(Y, 0.5)}, "y: .* samples are NaN or infinite"),
        ({"u": np.array(["a"] * 24)}, "u: values of type"),
        ({"u": U * 1j}, "u: values of type complex"),
        ({"excited_harmonics": [0, 1]}, r"excited_harmonics: \[0\], expected whole numbers from 1 to 2"),
        ({"excited_harmonics": [1.5]}, r"excited_harmonics: \[1\.5\], expected"),
        ({"excited_harmonics": [1, 2, 3]}, r"excited_harmonics: \[3\], expected"),
        ({"excited_harmonics": range(1, 10)}, r"excited_harmonics: \[3 4 5 6 7\]\.\.\., expected"),
        ({"excited_harmonics": []}, r"excited_harmonics: \[\], expected"),
    ],
)
def test_bad_input_names_field_and_value(change, message):
    good = {"u": U, "y": Y, "sample_rate_hz": 10.0, "samples_per_period": 6}
    with pytest.raises(ValueError, match=message):
        make_recording(**(good | change))


@pytest.mark.parametrize("samples_per_period", [None, 24])
def test_one_period_is_read_and_refused_where_a_covariance_is_needed(samples_per_period):
    recording = make_recording(U, Y, sample_rate_hz=10.0, samples_per_period=samples_per_period)
    assert recording.u.shape == (1, 1, 24)
    with pytest.raises(
        ValueError, match="periods: 1 period of 1 realisation, 24 samples; expected"
    ):
        recording.require_driven()
    two = make_recording(U, Y, sample_rate_hz=10.0, segments=[(0, 12), (12, 24)])
    assert two.u.shape == (2, 1, 12)
    two.require_driven()


def test_numbers_may_be_those_of_numpy():
    """As `numpy.load` gives them: arrays of shape (), whole numbers as floats."""
    recording = make_recording(
        U, Y, sample_rate_hz=np.array(10.0), samples_per_period=np.array(6.0), periods=np.int64(2)
    )
    assert recording.u.shape == (1, 2, 6)
    assert recording.sample_rate_hz == 10.0


def test_a_channel_without_drive_is_read_and_refused_where_a_drive_is_needed():
    good = {"y": Y, "sample_rate_hz": 10.0, "samples_per_period": 6}
    make_recording(U, **good).require_driven()
    silent = make_recording(np.full(24, 0.5), **good)
    with pytest.raises(ValueError, match=r"u: constant \(0.5 V\), .*analyze --silent"):
        silent.require_driven()


def multisine(seed, periods, n=2000):
    rng = np.random.default_rng(seed)
    spectrum = np.zeros(n // 2 + 1, complex)
    spectrum[60:161] = np.exp(2j * np.pi * rng.random(101)) * n / np.sqrt(2 * 101)
    return np.tile(np.fft.irfft(spectrum, n), periods)


@pytest.mark.parametrize("noise", [0.0, 0.1])
@pytest.mark.parametrize("taken", [1600, 1000, 500, 1995, 3000])
def test_a_period_that_is_not_that_of_the_actuator_is_named(taken, noise):
    rng = np.random.default_rng(taken)
    u = multisine(1, 12)
    u = u + noise * rng.standard_normal(u.size)
    u = u[: u.size // taken * taken]
    recording = make_recording(u, np.cumsum(u), sample_rate_hz=5e3, samples_per_period=taken)
    with pytest.raises(ValueError, match=f"{taken}, but u repeats after 2000 samples"):
        recording.require_driven()


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("periods", [1, 2])
@pytest.mark.parametrize("disturbed", ["noise", "hum", "hum that fits", "glitch", "drift", "gain", "aperiodic"])
def test_what_disturbs_a_multisine_is_no_other_period(disturbed, periods):
    rng, u = np.random.default_rng(2), multisine(1, 8)
    time_s = np.arange(u.size) / 5e3
    u = {
        "noise": u + rng.standard_normal(u.size),
        "hum": u + np.sin(2 * np.pi * 50.3 * time_s),
        "hum that fits": u + 0.05 * np.sin(2 * np.pi * 51.25 * time_s),  # after two periods
        "glitch": u + 3.0 * (np.arange(u.size) == 8100),
        "drift": u + time_s,
        "gain": u * (1 + 0.1 * (np.arange(u.size) // 2000)),
        "aperiodic": rng.standard_normal(u.size),
    }[disturbed]
    y = u + rng.standard_normal(u.size)
    for kind in (np.float64, np.float32, np.float16):
        record = make_recording(u.astype(kind), y, sample_rate_hz=5e3, samples_per_period=periods * 2000)
        record.require_driven()


def test_copies_are_no_records():
    rng, u = np.random.default_rng(3), multisine(1, 4).reshape(4, 2000)
    y = u + rng.standard_normal(u.shape)
    assert not make_recording(u, y, sample_rate_hz=5e3).copied
    assert make_recording(u, np.tile(y[0], (4, 1)), sample_rate_hz=5e3).copied
    twice = make_recording(np.stack([u, u]), np.stack([y, y]), sample_rate_hz=5e3)
    with pytest.raises(ValueError, match="y: realisation 2 is a copy of realisation 1"):
        twice.require_driven()
    other = make_recording(np.stack([-u, u, u]), np.stack([-y, y, y]), sample_rate_hz=5e3)
    with pytest.raises(ValueError, match="y: realisation 3 is a copy of realisation 2"):
        other.require_driven()


@pytest.fixture
def fields():
    return {"u": U, "y": Y, "sample_rate_hz": 10.0, "samples_per_period": 6}


def test_npz_mat_and_csv_hold_the_same(tmp_path, fields):
    np.savez(tmp_path / "a.npz", **fields)
    scipy.io.savemat(tmp_path / "a.mat", fields)
    table = np.column_stack([np.arange(24) / 10.0, U, Y])
    np.savetxt(tmp_path / "a.csv", table, delimiter=",", header="time_s,u,y", comments="")
    np.savetxt(tmp_path / "numpy.csv", table, delimiter=",", header="time_s,u,y")  # "# time_s,u,y"
    for name in ("a.npz", "a.mat", "a.csv", "numpy.csv"):
        recording = read_recording(tmp_path / name, samples_per_period=6)
        assert recording.sample_rate_hz == pytest.approx(10.0)
        np.testing.assert_allclose(recording.u.ravel(), U, rtol=1e-15)
        np.testing.assert_allclose(recording.y.ravel(), Y, rtol=1e-15)


def test_files_that_are_no_record(tmp_path, fields):
    cases = {
        "empty.npz": (b"", "empty file"),
        "text.npz": (b"hello", "no .npz record"),
        "text.mat": (b"hello world " * 50, "no .mat record"),
        "text.csv": (b"hello\nworld\n", "no .csv record"),
        "binary.csv": (bytes(range(256)), "no .csv record"),
        "text.txt": (b"hello", "accepted are .npz, .mat and .csv"),
    }
    for name, (content, message) in cases.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(ValueError, match=message):
            read_recording(tmp_path / name)
    np.savez(tmp_path / "objects.npz", u=np.array([{}]), y=Y)
    with pytest.raises(ValueError, match="no .npz record"):
        read_recording(tmp_path / "objects.npz")


def test_fields_that_hold_text_are_named(tmp_path, fields):
    for name in ("sample_rate_hz", "samples_per_period", "excited_harmonics"):
        for suffix, save in ((".npz", np.savez), (".mat", lambda path, **of: scipy.io.savemat(path, of))):
            path = tmp_path / f"a{suffix}"
            save(path, **(fields | {name: "10"}))
            with pytest.raises(ValueError, match=f"{name}: no numbers in a{suffix}, expected numbers"):
                read_recording(path)


def test_times_that_are_not_even_are_named(tmp_path):
    table = np.column_stack([np.delete(np.arange(25), 3) / 10.0, U, Y])
    np.savetxt(tmp_path / "a.csv", table, delimiter=",", header="time_s,u,y", comments="")
    with pytest.raises(ValueError, match="time_s: steps of 0.1 to 0.2 s, expected steps that are alike"):
        read_recording(tmp_path / "a.csv")


def test_times_and_a_rate_that_contradict_each_other_are_refused(tmp_path, fields):
    path = tmp_path / "a.npz"
    for time_s in (np.arange(24) / 10.0, np.round(np.arange(24) / 10.0)):  # of the second each step is another
        np.savez(path, **fields, time_s=time_s)
        assert read_recording(path).sample_rate_hz == 10.0
    np.savez(path, **fields, time_s=np.arange(24) / 50.0)
    with pytest.raises(ValueError, match=r"sample_rate_hz: 10 in a.npz, where steps of time_s are 0.02 s"):
        read_recording(path)
    assert read_recording(path, sample_rate_hz=50.0).sample_rate_hz == 50.0


def test_times_of_another_length_than_the_record_are_refused(tmp_path):
    path, u = tmp_path / "a.npz", np.random.default_rng(0).standard_normal((2, 3, 8))
    for count, accepted in ((8, True), (24, True), (48, True), (7, False), (25, False)):
        np.savez(path, u=u, y=u, time_s=np.arange(count) / 10.0)
        if accepted:
            assert read_recording(path).sample_rate_hz == pytest.approx(10)
            continue
        with pytest.raises(ValueError, match=f"time_s: {count} values, expected one for each of 48 samples"):
            read_recording(path)


def test_missing_fields_are_named_with_those_present(tmp_path, fields):
    for name in ("u", "y", "sample_rate_hz"):
        left = {key: value for key, value in fields.items() if key != name}
        np.savez(tmp_path / "a.npz", **left)
        with pytest.raises(ValueError, match=name):
            read_recording(tmp_path / "a.npz")
