# SPDX-License-Identifier: Apache-2.0
"""The package as a library: `import tactile_resonance as tr`."""

import doctest
import re
import subprocess
import sys
from dataclasses import replace
from importlib import import_module

import numpy as np
import pytest

import tactile_resonance as tr
from tactile_resonance.recording.store import RecordStore
from test.recording import stores

MODULES = (
    "tactile_resonance",
    "tactile_resonance.analysis",
    "tactile_resonance.contact_analysis",
    "tactile_resonance.front",
    "tactile_resonance.multisine",
    "tactile_resonance.poles.identify",
    "tactile_resonance.poles.joint",
    "tactile_resonance.recording.recording",
)
"""Those with the examples of the public functions."""


@pytest.mark.parametrize("name", MODULES)
def test_examples_run(name):
    result = doctest.testmod(import_module(name), extraglobs={"tr": tr})
    assert result.attempted > 0
    assert result.failed == 0


def test_every_public_function_and_plan_has_an_example():
    for name in tr.__all__:
        value = getattr(tr, name)
        if not isinstance(value, type) or value is tr.PoleEstimator:
            assert ">>> " in value.__doc__, name
            assert value.__module__ in MODULES


def test_every_public_name_is_there():
    for name in tr.__all__:
        value = getattr(tr, name)
        assert value.__name__ == name
        assert value.__doc__
    assert set(tr.__all__) < set(dir(tr))
    with pytest.raises(AttributeError, match="no attribute 'estimate_frv'"):
        tr.estimate_frv  # noqa: B018


def test_nothing_is_loaded_before_it_is_used():
    code = "import sys, tactile_resonance; print('numpy' in sys.modules, 'scipy' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", "False"]


def test_a_file_goes_to_its_poles(tmp_path):
    """A resonance from rest: no period is settled, the transient is estimated along."""
    rate_hz, samples, f0_hz, damping = 5e3, 2000, 250.0, 0.02
    multisine = tr.design_multisine(
        sample_rate_hz=rate_hz, samples_per_period=samples, band_hz=(150.0, 350.0), seed=3
    )
    u = np.tile(multisine.period(), 4)
    # the same response to zeros before it: circular over twice the record
    s, w0 = 2j * np.pi * np.fft.rfftfreq(2 * u.size, 1 / rate_hz), 2 * np.pi * f0_hz
    g = 0.04 * w0**2 / (s**2 + 2 * damping * w0 * s + w0**2)
    y = np.fft.irfft(g * np.fft.rfft(np.concatenate([u, 0 * u])))[: u.size]
    y += 1e-3 * np.random.default_rng(2).standard_normal(y.size)
    path = tmp_path / "record.npz"
    fields = {"sample_rate_hz": rate_hz, "samples_per_period": samples}
    np.savez(path, u=u, y=y, excited_harmonics=multisine.harmonics, **fields)
    recording = tr.read_record(path)
    poles = tr.identify_poles(recording, band_hz=(200, 300))
    assert poles.status is tr.PolesStatus.OK
    assert np.all(np.abs(poles.main.estimate - [f0_hz, damping]) < 4 * poles.main.std)
    of_frf = tr.identify_poles(tr.estimate_frf(recording), band_hz=(200, 300))
    assert np.all(np.abs(of_frf.main.estimate - [f0_hz, damping]) < 5 * of_frf.main.std)
    assert of_frf.main.std[0] > poles.main.std[0]


def test_a_folder_of_stored_records_is_read_as_it_was_measured(tmp_path):
    """Samples and lines come back; one of several measurements is named, and so many periods are used."""
    store = RecordStore(tmp_path)
    planned, records = stores.write(store, 7, realisations=2, periods=4)
    recording = tr.read_record(tmp_path)
    assert recording.sample_rate_hz == planned[0].sample_rate_hz
    np.testing.assert_array_equal(recording.excited_harmonics, planned[0].harmonics)
    for channel, found in (("actuator", recording.u), ("sensor", recording.y)):
        volts = np.reshape([getattr(record, channel).volts() for record in records], found.shape)
        np.testing.assert_array_equal(found, volts)
    assert recording.u.shape == (2, 4, stores.SAMPLES)
    assert tr.read_record(tmp_path, periods=3).u.shape == (2, 3, stores.SAMPLES)
    _, others = stores.write(store, 9)
    with pytest.raises(ValueError, match="measurement_id: not given, .* holds 7, 9"):
        tr.read_record(tmp_path)
    chosen = tr.read_record(tmp_path, 9)
    np.testing.assert_array_equal(chosen.y[0, 0], others[0].sensor.volts())


def test_a_file_whose_names_are_damaged_is_refused_in_one_line(tmp_path):
    np.savez(tmp_path / "a.npz", **{"u\nv": np.zeros(8), "x" * 3000: np.zeros(8)})
    with pytest.raises(ValueError, match=r"^u: got 'u'; accepted is .* holds u v, x+\.\.\.$"):
        tr.read_record(tmp_path / "a.npz")


def test_something_else_than_a_recording_is_refused():
    for call in (tr.estimate_frf, tr.identify_poles, tr.analyse):
        with pytest.raises(ValueError, match="got a str; accepted is a Recording"):
            call("record.npz")


def test_run_without_rosbags_is_refused_with_what_to_install(tmp_path, monkeypatch):
    for name in [name for name in sys.modules if name.startswith("tactile_resonance.scan")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.delattr(sys.modules["tactile_resonance"], "scan", raising=False)
    monkeypatch.setitem(sys.modules, "rosbags", None)
    for name in [name for name in sys.modules if name.startswith("rosbags.")]:
        monkeypatch.delitem(sys.modules, name)
    (tmp_path / "run.json").write_text("{}")
    for call in (tr.read_run, tr.read_record):
        with pytest.raises(ValueError, match="pip install 'rosbags"):
            call(tmp_path)


def test_fields_of_a_file_are_refused_for_a_folder(tmp_path):
    with pytest.raises(ValueError, match="sample_rate_hz: only for a file; .* is a folder"):
        tr.read_record(tmp_path, sample_rate_hz=1e3)
    (tmp_path / "x.npz").touch()
    with pytest.raises(
        ValueError, match="measurement_id: got 3; accepted is none with a file"
    ):
        tr.read_record(tmp_path / "x.npz", 3)
    with pytest.raises(FileNotFoundError, match="nothing_here"):
        tr.read_record(tmp_path / "nothing_here")


RATE_HZ, SAMPLES = 5e3, 2000


@pytest.fixture(scope="module")
def recording():
    multisine = tr.design_multisine(
        sample_rate_hz=RATE_HZ, samples_per_period=SAMPLES, band_hz=(200.0, 300.0), seed=1
    )
    u = np.tile(multisine.period(), (3, 1))
    s, w0 = 2j * np.pi * np.fft.rfftfreq(SAMPLES, 1 / RATE_HZ), 2 * np.pi * 250
    y = np.fft.irfft(0.04 * w0**2 / (s**2 + 0.04 * w0 * s + w0**2) * np.fft.rfft(u))
    y += 1e-3 * np.random.default_rng(0).standard_normal(y.shape)
    harmonics = multisine.harmonics
    return tr.make_recording(u, y, sample_rate_hz=RATE_HZ, excited_harmonics=harmonics)


BANDS = (250, "200-300", ("200", "300"), (200,), (200, 250, 300), (np.nan, 300), (None, 300))
"""None of them a band; nor are those with another order, or a negative or complex end."""


@pytest.mark.parametrize("band_hz", [*BANDS, (300, 200), (-5, 300), (200, 300j)], ids=repr)
def test_what_is_no_band_is_refused_alike_everywhere(recording, band_hz):
    frf = tr.estimate_frf(recording)
    for call in (
        lambda: tr.identify_poles(recording, band_hz),
        lambda: tr.identify_poles(frf, band_hz),
        lambda: tr.identify_batch(frf, band_hz),
        lambda: tr.analyse(recording, band_hz=band_hz),
        lambda: tr.design_multisine(band_hz=band_hz),
        lambda: tr.PoleEstimator(RATE_HZ, SAMPLES, 3, recording.excited_harmonics, band_hz),
    ):
        with pytest.raises(ValueError, match=r"^band_hz: .*(accepted is|expected) \(low, high\)"):
            call()


def test_a_fault_of_the_record_is_in_the_message_of_its_poles(recording):
    assert "stands still" not in tr.identify_poles(recording, (200, 300)).message
    y = recording.y.copy()
    y[..., -1, 500:560] = y[..., -1, 499, None]
    held = tr.make_recording(recording.u, y, sample_rate_hz=recording.sample_rate_hz)
    assert "The sensor stands still for 61 samples" in tr.identify_poles(held, (200, 300)).message


def test_lines_that_were_not_driven_are_in_the_message_of_poles_that_are_none(recording):
    rng = np.random.default_rng(1)
    u = 1e-5 * rng.standard_normal(recording.u.shape)  # the generator was off
    y = 1e-3 * rng.standard_normal(recording.y.shape)
    off = replace(recording, u=u, y=y)
    assert off.excited_harmonics is not None  # the lines are stated, not found
    poles = tr.identify_poles(off, (200, 300))
    assert poles.status is not tr.PolesStatus.OK
    weak = re.search(r"input less than 10 dB above its noise at (\d+) of 41 lines", poles.message)
    # noise is ten times its own variance, of two degrees of freedom or more, on 3 % of lines at most
    assert weak is not None
    assert int(weak[1]) > 30


def test_a_band_without_lines_is_refused_for_recording_and_response_alike(recording):
    frf = tr.estimate_frf(recording)
    for data in (recording, frf):
        with pytest.raises(ValueError, match="^band_hz: 0 lines .*10 parameters need at least 6"):
            tr.identify_poles(data, (1000, 2000))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda r: tr.read_record(5), "path: got a int; accepted is a str or PathLike"),
        (lambda r: tr.read_run(None), "path: got a NoneType; accepted is a str or PathLike"),
        (lambda r: tr.read_record("x", "3"), "measurement_id: got '3'; accepted is a whole number"),
        (lambda r: tr.read_record("x", rate=3), "rate: unknown; accepted are excited_harmonics, s"),
        (lambda r: tr.read_record("x", periods=2.5), "periods: got 2.5; accepted is a whole"),
        (lambda r: tr.estimate_frf(r, method="lpm"), "method: 'lpm', accepted are local"),
        (lambda r: tr.analyse(r.u), "recording: got a ndarray; accepted is a Recording"),
        (lambda r: tr.analyse(r, structure={}), "structure: got a dict; accepted is a Model"),
        (lambda r: tr.analyse(r, candidates=2), "candidates: got a int; accepted is a Sequence"),
        (lambda r: tr.analyse(r, candidates=[2]), "candidates: got a int; accepted is a Model"),
        (lambda r: tr.analyse(r, channel_delay_s="1"), "channel_delay_s: got '1'; accepted is"),
        (lambda r: tr.analyse(r, poles_method=[]), "poles_method: .*; accepted is one of auto"),
        (lambda r: tr.identify_batch("x"), "frf: got a str; accepted is a FRF"),
        (lambda r: tr.identify_poles(tr.FRF("f", "g")), "frf.g: .*expected|accepted"),
        (lambda r: tr.identify_poles(tr.FRF([1.0], [1.0]), structure="2"), "structure: got a str"),
        (
            lambda r: tr.identify_spectra("f", 1, 1, 0),
            "frequency_hz: got 'f'; accepted is an array",
        ),
        (lambda r: tr.ModelStructure(delay=np.nan), "delay: got nan; accepted is true or false"),
        (lambda r: tr.PoleEstimator("x", 9, 3, [4], (1, 2)), "sample_rate_hz: got 'x'; accepted is a"),
        (lambda r: tr.PoleEstimator(5e3, 9, 3, [2.5], (1, 2)), "harmonics: .*2.5.*expected whole"),
        (lambda r: tr.design_multisine(sample_rate_hz="1"), "sample_rate_hz: got '1'; accepted"),
        (lambda r: tr.design_multisine(samples_per_period=9.5), "samples_per_period: got 9.5; acc"),
        (lambda r: tr.design_multisine(level_v=np.nan), "level_v: got nan; accepted is a finite"),
        (lambda r: tr.design_multisine(grid="even"), r"grid: got 'even'; accepted is Grid of FULL"),
        (lambda r: tr.design_multisine(seed="a"), "seed: got 'a'; accepted is a whole number"),
        (lambda r: tr.design_multisine(realisation=-1), "realisation: got -1; accepted is a whole"),
        (lambda r: tr.design_multisine(mains_hz=50.0), "mains_hz: got 50.0; accepted is a list"),
        (lambda r: tr.design_multisine(relative_amplitude="x"), "relative_amplitude: .*above 0"),
    ],
)
def test_wrong_arguments_are_named_with_what_is_accepted(recording, call, message):
    with pytest.raises(ValueError, match=f"^({message})"):
        call(recording)


def test_wrong_arrays_are_named_with_the_shape_accepted(recording):
    plan = tr.PoleEstimator(RATE_HZ, SAMPLES, 3, recording.excited_harmonics, (200.0, 300.0))
    for u, y, message in (
        ("a", recording.y, "u: values of type <U1, expected real numbers"),
        (recording.u[..., :5], recording.y, r"u: shape \(1, 3, 5\), expected \(..., 3, 2000\)"),
        (recording.u, recording.y[:, :2], r"y: shape \(1, 2, 2000\), expected \(..., 3, 2000\)"),
    ):
        with pytest.raises(ValueError, match=f"^{message}"):
            plan(u, y)
    poles = plan(np.full_like(recording.u, np.nan), recording.y)
    assert np.isnan(poles.f0_hz).all()


def test_grids_may_be_named():
    named, grid = (tr.design_multisine(grid=of).harmonics for of in ("odd", tr.Grid.ODD))
    assert np.array_equal(named, grid)


def test_a_folder_that_holds_no_run_is_refused(tmp_path):
    for path, what in ((tmp_path, "a folder without run.json"), (tmp_path / "a", "not there")):
        with pytest.raises(ValueError, match=f"path: .* is {what}; accepted is the folder of a sc"):
            tr.read_run(path)


@pytest.mark.parametrize(("strongest", "f0_hz"), [(0, 250.0), (1, 1550.0)])
def test_a_band_that_is_found_does_not_span_what_was_not_excited(strongest, f0_hz):
    """As of a scan's run in several bands: around 250 Hz and around 1550 Hz, nothing between."""
    stretches_hz = [(230.0, 270.0), (1480.0, 1620.0)]
    multisine = tr.design_multisine(band_hz=stretches_hz)
    s = 2j * np.pi * np.fft.rfftfreq(20_000, 1 / 50e3)
    g = 0
    for k, mode_hz in enumerate((250.0, 1550.0)):
        w0 = 2 * np.pi * mode_hz
        size = 1.0 if k == strongest else 0.01
        g = g + size * 0.04 * w0**2 / (s**2 + 0.04 * w0 * s + w0**2)
    u = np.tile(multisine.period(), (4, 1))
    y = np.fft.irfft(g * np.fft.rfft(u))
    y += 1e-5 * np.random.default_rng(0).standard_normal(y.shape)
    recording = tr.make_recording(u, y, sample_rate_hz=50e3)
    poles = tr.identify_poles(recording)
    low_hz, high_hz = stretches_hz[strongest]
    assert low_hz <= poles.band_hz[0] < poles.band_hz[1] <= high_hz
    assert poles.status.value == "ok"
    assert np.all(np.abs(poles.main.estimate - [f0_hz, 0.02]) < 4 * poles.main.std)
